"""Follower pressure on the ventricular faces, with its load stiffness.

The pressure acts on the current surface, against the outward normal: a face with positions
``x(xi, eta)`` has the nodal forces ``f_a = -p int N_a (x_xi x x_eta) dxi deta``. The load stiffness
``df_a/dx_b`` is exact. Its skew part cancels between faces and remains along the rim of the loaded
surface.
"""

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.elements import FACES
from mvest.typing import FloatArray, IntArray


class PressureLoad:
    """Unit follower pressure on faces.

    Parameters
    ----------
    faces : ndarray
        ``(f, k)`` nodes, normals pointing out of the solid into the fluid.
    face_type : str
        ``tri3``, ``tri6`` or ``quad9``.
    """

    def __init__(self, faces: IntArray, face_type: str) -> None:
        self.faces = faces
        self.face = FACES[face_type]

    def rim(self) -> IntArray:
        """Pairs ``(s, 2)`` of nodes with an unsymmetric load stiffness.

        Two nodes of a face on the rim of all faces: on an edge line that no other face has in the
        opposite direction.
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

    def add_tangent(
        self,
        x: FloatArray,
        factor: float,
        positions: NDArray[np.int32],
        skew: NDArray[np.int32],
        blocks: FloatArray,
    ) -> None:
        """Add ``factor`` times the derivative of :meth:`forces` by the positions to block data.

        Parameters
        ----------
        x : (n, 3) mm
        factor : float
            MPa.
        positions, skew : ndarray
            ``(f, k, k)`` positions of the blocks in the symmetric and in the skew part, negative
            for none.
        blocks : ndarray
            N/mm.
        """
        _add_tangent(
            x,
            self.faces,
            self.face.shape,
            self.face.gradient,
            factor * self.face.weights,
            positions,
            skew,
            blocks,
        )


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
def _add_tangent(
    x: FloatArray,
    faces: IntArray,
    shape: FloatArray,
    gradient: FloatArray,
    weights: FloatArray,
    positions: NDArray[np.int32],
    skew: NDArray[np.int32],
    blocks: FloatArray,
) -> None:
    n_f, n_a = faces.shape
    g1, g2, h = np.empty(3), np.empty(3), np.empty((n_a, 3))
    sums = np.empty((n_a, n_a, 3))
    for f in range(n_f):
        sums[:] = 0.0
        for q in range(weights.shape[0]):
            _surface_vectors(x, faces[f], gradient[q], g1, g2)
            for b in range(n_a):
                # d(g1 x g2) = [g1]x dg2 - [g2]x dg1 = [h]x dx_b
                for i in range(3):
                    h[b, i] = gradient[q, b, 1] * g1[i] - gradient[q, b, 0] * g2[i]
            for a in range(n_a):
                factor = -weights[q] * shape[q, a]
                for b in range(n_a):
                    for i in range(3):
                        sums[a, b, i] += factor * h[b, i]
        # The block of nodes a and b is [sums_ab]x, and the transpose of that of b and a is
        # -[sums_ba]x.
        for a in range(n_a):
            for b in range(n_a):
                if positions[f, a, b] >= 0:
                    _add_cross(blocks[positions[f, a, b]], sums[a, b], sums[b, a], -1.0)
                if skew[f, a, b] >= 0:
                    _add_cross(blocks[skew[f, a, b]], sums[a, b], sums[b, a], 1.0)


@nb.njit(cache=True, inline="always")
def _add_cross(out: FloatArray, one: FloatArray, other: FloatArray, sign: float) -> None:
    """Add the matrix of the vector product with ``(one + sign * other) / 2``."""
    v0 = 0.5 * (one[0] + sign * other[0])
    v1 = 0.5 * (one[1] + sign * other[1])
    v2 = 0.5 * (one[2] + sign * other[2])
    out[0, 1] -= v2
    out[0, 2] += v1
    out[1, 0] += v2
    out[1, 2] -= v0
    out[2, 0] -= v1
    out[2, 1] += v0
