r"""Leaflet material: linear, transversely isotropic, in Biot strain.

The order of every formula here is energy, stress, tangent. Tensors are given in the fibre frame
(axis 1 = fibre) as six-vectors in the order 11, 22, 33, 23, 13, 12; strains carry engineering shear
(twice the tensor component), stresses do not.

With the right stretch :math:`U = \sqrt{I + 2E}` and the Biot strain :math:`\epsilon = U - I`,

.. math::
    W(E) &= \tfrac12 \epsilon : C : \epsilon, \qquad T = C : \epsilon, \\
    S(E) &= L^T T, \qquad L = d\epsilon / dE, \\
    D(E) &= L^T C L + T : d^2\epsilon / dE^2 .

This is the energy-consistent corotational ("large displacement, small strain") form: the second
Piola-Kirchhoff stress S is the derivative of the energy also where U and C : epsilon do not
commute, a term that the usual corotational element force ``R K (R^T x - X)`` drops for an
anisotropic C.

In the eigenbasis of U (eigenvalues l_i): ``L: dE_ij -> 2 dE_ij / (l_i + l_j)`` and, from
differentiating ``U U = I + 2E`` twice, ``T : d2U = -S : (dU dU) `` twice polarised, with
``S_ij = 2 T_ij / (l_i + l_j)``. No difference of eigenvalues appears, so coinciding stretches need
no special case.

Kelvin-Voigt damping (the stiffness-proportional part of Rayleigh damping in its objective form)
adds ``beta d(epsilon)/dt`` to epsilon; with backward Euler
``T = C : (epsilon + rate (epsilon - epsilon_n))`` where ``rate = beta / dt``. It neither resists
nor drives rigid rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law.moduli import LeafletModuli, PoissonReading, TransverselyIsotropic
from mvest.mechanics.parameters import Parameter, known_names
from mvest.typing import FloatArray, IntArray

__all__ = ["BiotLaw", "PoissonReading", "TransverselyIsotropic"]


@dataclass(frozen=True, slots=True, eq=False)
class BiotLaw:
    """The law of a body: one stiffness per region, evaluated at all quadrature points at once.

    Arrays of points have the axes (element, quadrature point, component).

    Attributes
    ----------
    stiffness : ndarray
        ``(n_regions, 6, 6)`` MPa.
    moduli : tuple of LeafletModuli
        What the stiffness was made of, one per region; empty where it is only known itself, and
        has a scale E_f but no ratio and no G to differentiate by.
    """

    stiffness: FloatArray
    moduli: tuple[LeafletModuli, ...] = ()

    @classmethod
    def of(cls, materials: Sequence[TransverselyIsotropic]) -> BiotLaw:
        """The law with one material per region."""
        return cls(np.ascontiguousarray([m.stiffness for m in materials]))

    @classmethod
    def of_moduli(cls, moduli: Sequence[LeafletModuli]) -> BiotLaw:
        """The law with the moduli of each region.

        Raises
        ------
        MaterialError
            If some are inadmissible.
        """
        law = cls.of([m.material for m in moduli])
        return cls(law.stiffness, tuple(moduli))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that the law knows (see :mod:`mvest.mechanics.parameters`)."""
        return ("E_f", "ratio", "G")

    def strain(self, green: FloatArray) -> FloatArray:
        """Biot strain ``(e, q, 6)`` of Green-Lagrange strain ``(e, q, 6)``, both engineering."""
        return _biot_strain(green)

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress S ``(e, q, 6)`` MPa and tangent D = dS/dE ``(e, q, 6, 6)`` MPa.

        Parameters
        ----------
        green : ndarray
            ``(e, q, 6)`` Green-Lagrange strain.
        region : ndarray
            ``(e,)``.
        previous : ndarray
            ``(e, q, 6)`` Biot strain at the start of the step.
        rate : float
            ``beta / dt``, dimensionless; 0 without damping.
        """
        return _response(green, region, self.stiffness, previous, rate)

    def partial_stress(
        self,
        parameter: Parameter,
        green: FloatArray,
        region: IntArray,
        previous: FloatArray,
        rate: float,
        *,
        which: int,
        stress: FloatArray,
    ) -> FloatArray:
        """Derivative of S ``(e, q, 6)`` by a parameter of region ``which``, at fixed strain.

        Parameters
        ----------
        parameter : Parameter
        green, region, previous, rate
            As in `response`.
        which : int
            Index of the parameter's region.
        stress : ndarray
            ``(e, q, 6)`` what `response` has given.

        Raises
        ------
        InputError
            If the law does not know the parameter.
        """
        if parameter.kind not in self.kinds:
            raise InputError(
                f"parameter {parameter.name!r}: the law of the leaflets knows "
                f"{known_names(self.kinds)}"
            )
        here = region == which
        if parameter.kind == "E_f" and (not self.moduli or self.moduli[which].G is None):
            # All moduli follow E_f: S is linear in the scale of C.
            return np.where(here[:, None, None], stress, 0.0) / parameter.value
        if not self.moduli:
            raise InputError(f"parameter {parameter.name!r}: the law has a stiffness, no moduli")
        out = np.zeros_like(stress)
        by = self.moduli[which].stiffness_by(parameter.kind)
        out[here] = _linear_stress(green[here], by, previous[here], rate)
        return out

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous Biot strain: ``-rate L^T C d``."""
        return _history_stress(green, region, self.stiffness, d_previous, rate)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the Biot strain ``L dE`` ``(e, q, 6)``."""
        return _strain_change(green, d_green)


@nb.njit(cache=True)
def _eigen(a: FloatArray, q: FloatArray) -> None:
    """Diagonalise the symmetric 3x3 ``a`` in place (cyclic Jacobi); ``q`` gets the eigenvectors."""
    for i in range(3):
        for j in range(3):
            q[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off < 1e-32:
            break
        for p in range(2):
            for r in range(p + 1, 3):
                if abs(a[p, r]) < 1e-300:
                    continue
                theta = (a[r, r] - a[p, p]) / (2.0 * a[p, r])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    akp, akr = a[k, p], a[k, r]
                    a[k, p], a[k, r] = c * akp - s * akr, s * akp + c * akr
                for k in range(3):
                    apk, ark = a[p, k], a[r, k]
                    a[p, k], a[r, k] = c * apk - s * ark, s * apk + c * ark
                for k in range(3):
                    qkp, qkr = q[k, p], q[k, r]
                    q[k, p], q[k, r] = c * qkp - s * qkr, s * qkp + c * qkr


@nb.njit(cache=True)
def _stretch(green: FloatArray, q: FloatArray, lam: FloatArray, u: FloatArray) -> None:
    """Eigenvectors ``q``, stretches ``lam`` and U of a Green strain (engineering six-vector)."""
    a = u
    a[0, 0] = 1.0 + 2.0 * green[0]
    a[1, 1] = 1.0 + 2.0 * green[1]
    a[2, 2] = 1.0 + 2.0 * green[2]
    a[1, 2] = a[2, 1] = green[3]
    a[0, 2] = a[2, 0] = green[4]
    a[0, 1] = a[1, 0] = green[5]
    _eigen(a, q)
    for i in range(3):
        # An enhanced strain can leave the admissible set during a Newton iteration; a positive
        # floor keeps the numbers finite, and the line search rejects such a state by its residual.
        lam[i] = np.sqrt(max(a[i, i], 1e-6))
    for i in range(3):
        for j in range(3):
            u[i, j] = (
                q[i, 0] * lam[0] * q[j, 0] + q[i, 1] * lam[1] * q[j, 1] + q[i, 2] * lam[2] * q[j, 2]
            )


@nb.njit(cache=True)
def _linear_map(q: FloatArray, lam: FloatArray, big_l: FloatArray, du: FloatArray) -> None:
    """``L = d eps / dE`` (6, 6) and its columns as tensors ``du (6, 3, 3)``."""
    for k in range(6):
        if k < 3:
            i, j = k, k
        elif k == 3:
            i, j = 1, 2
        elif k == 4:
            i, j = 0, 2
        else:
            i, j = 0, 1
        # Tensor dC = 2 dE of a unit engineering component: dC_ii = 2, or dC_ij = dC_ji = 1.
        for m in range(3):
            for n in range(3):
                hat = q[i, m] * q[j, n] + q[j, m] * q[i, n]
                du[k, m, n] = hat / (lam[m] + lam[n])
        _rotate_back(q, du[k])
        big_l[0, k] = du[k, 0, 0]
        big_l[1, k] = du[k, 1, 1]
        big_l[2, k] = du[k, 2, 2]
        big_l[3, k] = 2.0 * du[k, 1, 2]
        big_l[4, k] = 2.0 * du[k, 0, 2]
        big_l[5, k] = 2.0 * du[k, 0, 1]


@nb.njit(cache=True)
def _rotate_back(q: FloatArray, a: FloatArray) -> None:
    """``a <- q a q^T`` for 3x3."""
    t00 = q[0, 0] * a[0, 0] + q[0, 1] * a[1, 0] + q[0, 2] * a[2, 0]
    t01 = q[0, 0] * a[0, 1] + q[0, 1] * a[1, 1] + q[0, 2] * a[2, 1]
    t02 = q[0, 0] * a[0, 2] + q[0, 1] * a[1, 2] + q[0, 2] * a[2, 2]
    t10 = q[1, 0] * a[0, 0] + q[1, 1] * a[1, 0] + q[1, 2] * a[2, 0]
    t11 = q[1, 0] * a[0, 1] + q[1, 1] * a[1, 1] + q[1, 2] * a[2, 1]
    t12 = q[1, 0] * a[0, 2] + q[1, 1] * a[1, 2] + q[1, 2] * a[2, 2]
    t20 = q[2, 0] * a[0, 0] + q[2, 1] * a[1, 0] + q[2, 2] * a[2, 0]
    t21 = q[2, 0] * a[0, 1] + q[2, 1] * a[1, 1] + q[2, 2] * a[2, 1]
    t22 = q[2, 0] * a[0, 2] + q[2, 1] * a[1, 2] + q[2, 2] * a[2, 2]
    for j in range(3):
        a[0, j] = t00 * q[j, 0] + t01 * q[j, 1] + t02 * q[j, 2]
        a[1, j] = t10 * q[j, 0] + t11 * q[j, 1] + t12 * q[j, 2]
        a[2, j] = t20 * q[j, 0] + t21 * q[j, 1] + t22 * q[j, 2]


@nb.njit(cache=True)
def _voigt_biot(u: FloatArray, out: FloatArray) -> None:
    out[0] = u[0, 0] - 1.0
    out[1] = u[1, 1] - 1.0
    out[2] = u[2, 2] - 1.0
    out[3] = 2.0 * u[1, 2]
    out[4] = 2.0 * u[0, 2]
    out[5] = 2.0 * u[0, 1]


@nb.njit(cache=True)
def _biot_strain(green: FloatArray) -> FloatArray:
    n_e, n_q, _ = green.shape
    out = np.empty((n_e, n_q, 6))
    q, lam, u = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for e in range(n_e):
        for p in range(n_q):
            _stretch(green[e, p], q, lam, u)
            _voigt_biot(u, out[e, p])
    return out


@nb.njit(cache=True)
def _response(
    green: FloatArray, region: IntArray, stiffness: FloatArray, previous: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray]:
    n_e, n_q, _ = green.shape
    stress = np.empty((n_e, n_q, 6))
    tangent = np.empty((n_e, n_q, 6, 6))
    q, lam, u = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    big_l, du = np.empty((6, 6)), np.empty((6, 3, 3))
    eps, t, cl, s3 = np.empty(6), np.empty(6), np.empty((6, 6)), np.empty((3, 3))
    sdu = np.empty((3, 3))
    for e in range(n_e):
        c = stiffness[region[e]]
        for p in range(n_q):
            _stretch(green[e, p], q, lam, u)
            _voigt_biot(u, eps)
            _linear_map(q, lam, big_l, du)
            for i in range(6):
                eps[i] = (1.0 + rate) * eps[i] - rate * previous[e, p, i]
            for i in range(6):
                t[i] = 0.0
                for j in range(6):
                    t[i] += c[i, j] * eps[j]
            s = stress[e, p]
            for i in range(6):
                s[i] = 0.0
                for j in range(6):
                    s[i] += big_l[j, i] * t[j]
            for i in range(6):
                for j in range(6):
                    value = 0.0
                    for k in range(6):
                        value += c[i, k] * big_l[k, j]
                    cl[i, j] = (1.0 + rate) * value
            s3[0, 0], s3[1, 1], s3[2, 2] = s[0], s[1], s[2]
            s3[1, 2] = s3[2, 1] = s[3]
            s3[0, 2] = s3[2, 0] = s[4]
            s3[0, 1] = s3[1, 0] = s[5]
            for j in range(6):
                # sdu = S dU_j; the second-order term is -(S : dU_i dU_j) symmetrised.
                for m in range(3):
                    for n in range(3):
                        sdu[m, n] = (
                            s3[m, 0] * du[j, 0, n] + s3[m, 1] * du[j, 1, n] + s3[m, 2] * du[j, 2, n]
                        )
                for i in range(j + 1):
                    value = 0.0
                    for k in range(6):
                        value += big_l[k, i] * cl[k, j]
                    for m in range(3):
                        for n in range(3):
                            value -= du[i, m, n] * sdu[m, n]
                    tangent[e, p, i, j] = value
                    tangent[e, p, j, i] = value
    return stress, tangent


@nb.njit(cache=True)
def _linear_stress(
    green: FloatArray, stiffness: FloatArray, previous: FloatArray, rate: float
) -> FloatArray:
    """``L^T C (eps + rate (eps - eps_n))`` with one C ``(6, 6)`` for all points."""
    n_e, n_q, _ = green.shape
    out = np.zeros((n_e, n_q, 6))
    q, lam, u = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    big_l, du, eps = np.empty((6, 6)), np.empty((6, 3, 3)), np.empty(6)
    for e in range(n_e):
        for p in range(n_q):
            _stretch(green[e, p], q, lam, u)
            _voigt_biot(u, eps)
            _linear_map(q, lam, big_l, du)
            for i in range(6):
                eps[i] = (1.0 + rate) * eps[i] - rate * previous[e, p, i]
            for j in range(6):
                t = 0.0
                for k in range(6):
                    t += stiffness[j, k] * eps[k]
                for i in range(6):
                    out[e, p, i] += big_l[j, i] * t
    return out


@nb.njit(cache=True)
def _history_stress(
    green: FloatArray, region: IntArray, stiffness: FloatArray, d_previous: FloatArray, rate: float
) -> FloatArray:
    n_e, n_q, _ = green.shape
    out = np.zeros((n_e, n_q, 6))
    q, lam, u = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    big_l, du = np.empty((6, 6)), np.empty((6, 3, 3))
    for e in range(n_e):
        c = stiffness[region[e]]
        for p in range(n_q):
            _stretch(green[e, p], q, lam, u)
            _linear_map(q, lam, big_l, du)
            for j in range(6):
                t = 0.0
                for k in range(6):
                    t += c[j, k] * d_previous[e, p, k]
                for i in range(6):
                    out[e, p, i] -= rate * big_l[j, i] * t
    return out


@nb.njit(cache=True)
def _strain_change(green: FloatArray, d_green: FloatArray) -> FloatArray:
    n_e, n_q, _ = green.shape
    out = np.zeros((n_e, n_q, 6))
    q, lam, u = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    big_l, du = np.empty((6, 6)), np.empty((6, 3, 3))
    for e in range(n_e):
        for p in range(n_q):
            _stretch(green[e, p], q, lam, u)
            _linear_map(q, lam, big_l, du)
            for i in range(6):
                for j in range(6):
                    out[e, p, i] += big_l[i, j] * d_green[e, p, j]
    return out
