"""Follower pressure on the ventricular faces, with its load stiffness.

The pressure acts on the current surface: on a face with positions ``x(xi, eta)`` the nodal force is
``f_a = p int N_a (x_xi x x_eta) dxi deta`` against the outward normal, hence the minus sign of the
load. The load stiffness ``df_a/dx_b`` is exact. Between faces its skew part cancels; along the rim
of the loaded surface it stays.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from mvest.elements import FACES
from mvest.typing import FloatArray, IntArray

__all__ = ["PressureLoad"]


class PressureLoad:
    """Unit follower pressure on faces.

    Parameters
    ----------
    faces : ndarray
        ``(f, k)`` nodes, normals pointing out of the solid (into the fluid that presses).
    face_type : str
        ``tri3``, ``tri6`` or ``quad9``.
    """

    def __init__(self, faces: IntArray, face_type: str) -> None:
        self.faces = faces
        self.face = FACES[face_type]

    def rim(self) -> IntArray:
        """Pairs ``(s, 2)`` of nodes between which the load stiffness is not symmetric.

        Two nodes of a face on the rim of all faces: on a line from one of its nodes to the next
        that no other face runs along the other way round.
        """
        lines = self.faces[:, self.face.corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
        lines = lines.reshape(-1, 2)
        size = int(self.faces.max(initial=0)) + 1
        way, back = lines[:, 0] * size + lines[:, 1], lines[:, 1] * size + lines[:, 0]
        _, which, count = np.unique(way, return_inverse=True, return_counts=True)
        alone = (count[which] > 1) | ~np.isin(back, way)
        on_rim = np.zeros(size, dtype=np.bool_)
        on_rim[lines[alone]] = True
        here = on_rim[self.faces]
        face, a, b = np.nonzero(here[:, :, None] & here[:, None, :])
        return np.column_stack([self.faces[face, a], self.faces[face, b]])

    def forces(self, x: FloatArray) -> FloatArray:
        """Nodal forces ``(f, k, 3)`` in N for a pressure of 1 MPa."""
        return _forces(x, self.faces, self.face.shape, self.face.gradient, self.face.weights)

    def tangents(self, x: FloatArray) -> FloatArray:
        """Derivatives ``(f, 3k, 3k)`` of :meth:`forces` by the nodal positions, N/mm."""
        return _tangents(x, self.faces, self.face.shape, self.face.gradient, self.face.weights)


@nb.njit(cache=True)
def _surface_vectors(
    x: FloatArray, nodes: IntArray, gradient: FloatArray, g1: FloatArray, g2: FloatArray
) -> None:
    g1[:] = 0.0
    g2[:] = 0.0
    for a in range(nodes.shape[0]):
        for i in range(3):
            g1[i] += x[nodes[a], i] * gradient[a, 0]
            g2[i] += x[nodes[a], i] * gradient[a, 1]


@nb.njit(cache=True)
def _forces(
    x: FloatArray, faces: IntArray, shape: FloatArray, gradient: FloatArray, weights: FloatArray
) -> FloatArray:
    n_f, n_a = faces.shape
    out = np.zeros((n_f, n_a, 3))
    g1, g2, n = np.empty(3), np.empty(3), np.empty(3)
    for f in range(n_f):
        for q in range(weights.shape[0]):
            _surface_vectors(x, faces[f], gradient[q], g1, g2)
            n[0] = g1[1] * g2[2] - g1[2] * g2[1]
            n[1] = g1[2] * g2[0] - g1[0] * g2[2]
            n[2] = g1[0] * g2[1] - g1[1] * g2[0]
            for a in range(n_a):
                factor = -weights[q] * shape[q, a]
                for i in range(3):
                    out[f, a, i] += factor * n[i]
    return out


@nb.njit(cache=True)
def _tangents(
    x: FloatArray, faces: IntArray, shape: FloatArray, gradient: FloatArray, weights: FloatArray
) -> FloatArray:
    n_f, n_a = faces.shape
    out = np.zeros((n_f, 3 * n_a, 3 * n_a))
    g1, g2, h = np.empty(3), np.empty(3), np.empty(3)
    for f in range(n_f):
        for q in range(weights.shape[0]):
            _surface_vectors(x, faces[f], gradient[q], g1, g2)
            for b in range(n_a):
                # d(g1 x g2) = [g1]x dg2 - [g2]x dg1 = [h]x dx_b
                for i in range(3):
                    h[i] = gradient[q, b, 1] * g1[i] - gradient[q, b, 0] * g2[i]
                for a in range(n_a):
                    c = -weights[q] * shape[q, a]
                    r, s = 3 * a, 3 * b
                    out[f, r, s + 1] -= c * h[2]
                    out[f, r, s + 2] += c * h[1]
                    out[f, r + 1, s] += c * h[2]
                    out[f, r + 1, s + 2] -= c * h[0]
                    out[f, r + 2, s] -= c * h[1]
                    out[f, r + 2, s + 1] += c * h[0]
    return out
