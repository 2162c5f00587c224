"""Strains of elements for thin bodies, sampled at fewer points (see :mod:`mvest.elements`).

The covariant components ``E_ij = G_i . E . G_j`` of the Green-Lagrange strain at the quadrature
points are replaced by linear combinations of themselves, which a matrix of the element's says for
each component. What that takes away does work on a constant stress where the element is distorted,
so its mean over the element is given back: the patch test holds. The strain that the law gets is a
linear function of the strains of the displacements: forces and tangents have an energy as before,
and no new unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.elements import Element
from mvest.typing import FloatArray

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Sampling:
    """How the strains of all elements are combined.

    Attributes
    ----------
    combination : ndarray
        ``(6, q, q)`` of each covariant component.
    to_covariant, from_covariant : ndarray
        ``(e, q, 6, 6)`` between strain (engineering shear) in the fibre frame and its covariant
        components.
    to_mean, from_mean : ndarray
        ``(e, q, 6, 6)`` from the fibre frame to axes that all points share, times the share of the
        element's volume, and back (without it).
    """

    combination: FloatArray
    to_covariant: FloatArray
    from_covariant: FloatArray
    to_mean: FloatArray
    from_mean: FloatArray

    @classmethod
    def of(cls, reference: Element, jacobian: FloatArray, frame: FloatArray) -> Sampling:
        """From the Jacobians ``(e, q, 3, 3)`` and fibre frames ``(e, q, 3, 3)``, in columns."""
        assert reference.sampling is not None
        to_covariant = _components(frame.swapaxes(2, 3) @ jacobian)
        volumes = np.linalg.det(jacobian) * reference.weights
        share = volumes / volumes.sum(axis=1, keepdims=True)
        to_common = _components(frame.swapaxes(2, 3))
        return cls(
            reference.sampling(reference.points, reference.weights),
            to_covariant,
            np.asarray(np.linalg.inv(to_covariant)),
            share[:, :, None, None] * to_common,
            np.asarray(np.linalg.inv(to_common)),
        )

    def strain(self, green: FloatArray) -> FloatArray:
        """Combined strain ``(e, q, 6)`` of strain ``(e, q, 6)``, in the fibre frame."""
        covariant = _times(self.to_covariant, green)
        combined = np.einsum("iqp,epi->eqi", self.combination, covariant)
        sampled = _times(self.from_covariant, combined)
        mean = _times(self.to_mean, green - sampled).sum(axis=1, keepdims=True)
        return sampled + _times(self.from_mean, mean)

    def stress(self, stress: FloatArray, volumes: FloatArray) -> FloatArray:
        """Stress ``(e, q, 6)`` that does the work of ``stress`` on the strain of displacements."""
        work = volumes[..., None] * stress
        total = _times(self.from_mean.swapaxes(2, 3), work).sum(axis=1, keepdims=True)
        mean = _times(self.to_mean.swapaxes(2, 3), total)
        covariant = _times(self.from_covariant.swapaxes(2, 3), work - mean)
        combined = np.einsum("iqp,eqi->epi", self.combination, covariant)
        work = _times(self.to_covariant.swapaxes(2, 3), combined) + mean
        return np.asarray(work / volumes[..., None])

    def add_tangents(
        self,
        gradients: FloatArray,
        volumes: FloatArray,
        deformation: FloatArray,
        stress: FloatArray,
        tangent: FloatArray,
        modes: FloatArray,
        positions: NDArray[np.int32],
        blocks: FloatArray,
    ) -> None:
        """Add the tangents of all elements, N/mm, the modes ``(e, q, 6, m)`` eliminated.

        ``stress`` is what `stress` gives; the others are those of :class:`Solid`.
        """
        _add_tangents(
            gradients, volumes, deformation, stress, tangent, modes, self.combination,
            self.to_covariant, self.from_covariant, self.to_mean, self.from_mean, positions, blocks,
        )  # fmt: skip


def _components(base: FloatArray) -> FloatArray:
    """Map ``(e, q, 6, 6)`` of strain to its components on the columns of ``base (e, q, 3, 3)``."""
    out = np.empty((*base.shape[:2], 6, 6))
    for row, (i, j) in enumerate(PAIRS):
        for column, (k, m) in enumerate(PAIRS):
            one = base[:, :, k, i] * base[:, :, m, j]
            # Engineering shear is twice the tensor's component, in the row and in the column.
            if k != m:
                one = 0.5 * (one + base[:, :, m, i] * base[:, :, k, j])
            out[:, :, row, column] = one if i == j else 2 * one
    return out


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


@nb.njit(cache=True, error_model="numpy")
def _add_tangents(
    gradients: FloatArray,
    volumes: FloatArray,
    deformation: FloatArray,
    stress: FloatArray,
    tangent: FloatArray,
    modes: FloatArray,
    combination: FloatArray,
    to_covariant: FloatArray,
    from_covariant: FloatArray,
    to_mean: FloatArray,
    from_mean: FloatArray,
    positions: NDArray[np.int32],
    blocks: FloatArray,
) -> None:
    n_e, n_q, n_a, _ = gradients.shape
    n_d, n_m = 3 * n_a, modes.shape[3]
    b = np.empty((6 * n_q, n_d))
    covariant, combined = np.empty((6, n_q, n_d)), np.empty((6, n_q, n_d))
    strain, work = np.empty((6 * n_q, n_d)), np.empty((6 * n_q, n_d))
    g, sg = np.empty((3 * n_q, n_a)), np.empty((3 * n_q, n_a))
    m = np.empty((6 * n_q, n_m))
    dm = np.empty((6 * n_q, n_m))
    for e in range(n_e):
        for q in range(n_q):
            f, s, w, r = deformation[e, q], stress[e, q], volumes[e, q], 6 * q
            for a in range(n_a):
                g0, g1, g2 = gradients[e, q, a, 0], gradients[e, q, a, 1], gradients[e, q, a, 2]
                for i in range(3):
                    c = 3 * a + i
                    b[r, c] = f[i, 0] * g0
                    b[r + 1, c] = f[i, 1] * g1
                    b[r + 2, c] = f[i, 2] * g2
                    b[r + 3, c] = f[i, 1] * g2 + f[i, 2] * g1
                    b[r + 4, c] = f[i, 0] * g2 + f[i, 2] * g0
                    b[r + 5, c] = f[i, 0] * g1 + f[i, 1] * g0
                p = 3 * q
                g[p, a], g[p + 1, a], g[p + 2, a] = g0, g1, g2
                sg[p, a] = w * (s[0] * g0 + s[5] * g1 + s[4] * g2)
                sg[p + 1, a] = w * (s[5] * g0 + s[1] * g1 + s[3] * g2)
                sg[p + 2, a] = w * (s[4] * g0 + s[3] * g1 + s[2] * g2)
            covariant[:, q] = np.dot(to_covariant[e, q], b[r : r + 6])
        for i in range(6):
            combined[i] = np.dot(combination[i], covariant[i])
        mean = np.zeros((6, n_d))
        for q in range(n_q):
            r = 6 * q
            strain[r : r + 6] = np.dot(from_covariant[e, q], np.ascontiguousarray(combined[:, q]))
            mean += np.dot(to_mean[e, q], b[r : r + 6] - strain[r : r + 6])
        for q in range(n_q):
            r = 6 * q
            strain[r : r + 6] += np.dot(from_mean[e, q], mean)
            d = volumes[e, q] * tangent[e, q]
            work[r : r + 6] = np.dot(d, strain[r : r + 6])
            m[r : r + 6] = modes[e, q]
            dm[r : r + 6] = np.dot(d, np.ascontiguousarray(modes[e, q]))
        k = np.dot(strain.T, work)
        geometric = np.dot(g.T, sg)
        if n_m > 0:
            k_am = np.dot(m.T, work)
            k -= np.dot(k_am.T, np.linalg.solve(np.dot(m.T, dm), k_am))
        for a in range(n_a):
            for c in range(n_a):
                if positions[e, a, c] < 0:
                    continue
                block = blocks[positions[e, a, c]]
                for i in range(3):
                    block[i, i] += geometric[a, c]
                    for j in range(3):
                        block[i, j] += k[3 * a + i, 3 * c + j]
