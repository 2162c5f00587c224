r"""Leaflet material: linear, transversely isotropic, in Biot strain.

The order of every formula here is energy, stress, tangent. Tensors are given in the fibre frame
(axis 1 = fibre) as six-vectors in the order 11, 22, 33, 23, 13, 12; strains carry engineering shear
(twice the tensor component), stresses do not.

With the right stretch :math:`U = \sqrt{I + 2E}` and the Biot strain :math:`\epsilon = U - I`,

.. math::
    W(E) &= \tfrac12 \epsilon : C : \epsilon, \qquad T = C : \epsilon, \\
    S(E) &= L^T T, \qquad L = d\epsilon / dE, \\
    D(E) &= L^T C L + T : d^2\epsilon / dE^2 .

This is the energy-consistent corotational ("large displacement, small strain") form: S is the
derivative of the energy even if U and C : epsilon do not commute. The usual corotational element
force ``R K (R^T x - X)`` drops that term of an anisotropic C.

In the eigenbasis of U (eigenvalues l_i): ``L: dE_ij -> 2 dE_ij / (l_i + l_j)`` and, from
differentiating ``U U = I + 2E`` twice, ``T : d2U = -S : (dU dU) `` twice polarised, with
``S_ij = 2 T_ij / (l_i + l_j)``. No difference of eigenvalues appears, so equal stretches need no
special case.

Kelvin-Voigt damping (the stiffness-proportional part of Rayleigh damping in its objective form)
adds ``beta d(epsilon)/dt`` to epsilon; with backward Euler
``T = C : (epsilon + rate (epsilon - epsilon_n))`` where ``rate = beta / dt``. Rigid rotation is
not affected.

Fibres that bear tension only. With ``compression`` k < 1
(:class:`mvest.mechanics.law.moduli.TransverselyIsotropic`) the modulus along the fibres is k E_f in
compression, and E_f in tension beyond a toe. Then

.. math::
    W &= \tfrac12 \epsilon : C_m : \epsilon + (1 - k) E_f \, w(\lambda - 1), \qquad
    C_m = C - (1 - k) E_f \, e_1 \otimes e_1, \\
    S &= L^T (C_m : \epsilon) + (1 - k) E_f \, (w' / \lambda) \, e_1, \\
    D &= L^T C_m L + (C_m : \epsilon) : d^2\epsilon / dE^2
         + (1 - k) E_f \left(w'' / \lambda^2 - w' / \lambda^3\right) e_1 \otimes e_1

with the stretch of the fibres :math:`\lambda = \sqrt{1 + 2 E_{11}}` and the force w' of a cable
(:mod:`mvest.mechanics.forces.cables`): zero in compression, linear beyond the toe, W three times
continuously differentiable. Since :math:`(C^{-1})_{11} = 1 / E_f`, the Sherman-Morrison formula
gives :math:`(C_m^{-1})_{11} = 1 / (k E_f)`, and :math:`\det C_m = k \det C`: positive definite for
every k > 0, so small strains are stable. w is convex and does not decrease, so that the term of the
fibres is polyconvex; the quadratic one is not, as in the linear law. All stress is proportional to
E_f. Damping is that of the matrix C_m.

In the usual corotational tetrahedron, as in the paper's simulation, the force of an element is that
of linear elasticity in a frame that rotates with the element,

.. math:: f = R K (R^T x - X), \qquad K = V B^T C B,

with the rotation R of its edges (:class:`mvest.mechanics.solid.EdgeRotations`) and the tangent
:math:`R K R^T` at fixed R. It has no energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np

from mvest.mechanics.forces.cables import cable_force
from mvest.mechanics.law import Points
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.typing import FloatArray, IntArray

ONE, OTHER = np.array([1, 0, 0]), np.array([2, 2, 1])
"""The axes of each shear."""
ROOT = np.sqrt(2.0)
TINY = 1e-200
CONTRACT = {"contract"}
LANES = 64
"""Points that are processed together, so that all operations vectorise (four times faster)."""
SCALE = np.array([1.0, 1.0, 1.0, ROOT, ROOT, ROOT])
"""Factors on the components of a stress, and divisors of those of a strain, that preserve norms."""


@dataclass(frozen=True, slots=True, eq=False)
class BiotLaw:
    """The law of a body: one stiffness per region, evaluated at all quadrature points at once."""

    stiffness: FloatArray  #: (n_regions, 6, 6) MPa
    #: whether strain and stress are the linear ones in the rotated frame of the element
    #: (:class:`mvest.mechanics.solid.EdgeRotations`)
    corotational: bool = False
    #: (2, n_regions) modulus (MPa) that fibres have in tension only, and toe strain; None if none
    fibres: FloatArray | None = None

    @classmethod
    def of(
        cls, materials: Sequence[TransverselyIsotropic], *, corotational: bool = False
    ) -> BiotLaw:
        """The law with one material per region."""
        fibres = np.array([(m.tension_only, m.toe) for m in materials]).T
        matrix = np.array([m.stiffness for m in materials])
        matrix[:, 0, 0] -= fibres[0]
        return cls(matrix, corotational, fibres if fibres[0].any() else None)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its parameters (see :mod:`mvest.mechanics.parameters`)."""
        return ("E_f",)

    def strain(self, green: FloatArray) -> FloatArray:
        """Biot strain ``(e, q, 6)`` of Green-Lagrange strain ``(e, q, 6)``, both engineering."""
        return self._map(green, green, 0)

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress S ``(e, q, 6)`` MPa and tangent D = dS/dE ``(e, q, 6, 6)`` MPa."""
        if not self.corotational:
            stress, tangent = _response(at.green, at.region, self.stiffness, at.previous, at.rate)
            if self.fibres is not None:
                modulus, toe = self.fibres[:, at.region, None]
                # As in the kernel, a floor for strains that a Newton iteration may visit.
                stretch = np.sqrt(np.maximum(1 + 2 * at.green[..., 0], 1e-6))
                force, slope = cable_force(stretch - 1, toe)
                stress[..., 0] += modulus * force / stretch
                tangent[..., 0, 0] += modulus * (slope - force / stretch) / stretch**2
            return stress, tangent
        stiffness = self.stiffness[at.region]
        strain = (1 + at.rate) * at.green - at.rate * at.previous
        tangent = np.repeat((1 + at.rate) * stiffness[:, None], at.green.shape[1], axis=1)
        return np.einsum("eij,eqj->eqi", stiffness, strain), tangent

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of S ``(e, q, 6)``; InputError if the law has no such parameter."""
        parameter.require(self.kinds)
        # All moduli are proportional to E_f.
        return np.where((at.region == which)[:, None, None], stress, 0.0) / parameter.value

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous Biot strain: ``-rate L^T C d``."""
        stress = np.einsum("eij,eqj->eqi", self.stiffness[at.region], d_previous)
        return -at.rate * self._map(at.green, stress, 1)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the Biot strain ``L dE`` ``(e, q, 6)``."""
        return self._map(green, np.ascontiguousarray(d_green), -1)

    def _map(self, green: FloatArray, values: FloatArray, power: int) -> FloatArray:
        return values if self.corotational else _linear(green, values, power)


@nb.njit(cache=True, error_model="numpy")
def _eigen(a: FloatArray, q: FloatArray) -> None:
    """Diagonalise symmetric matrices ``a (6, LANES)`` in place (cyclic Jacobi).

    ``q (3, 3, LANES)`` are their eigenvectors.
    """
    for i in range(3):
        for j in range(3):
            for lane in range(LANES):
                q[i, j, lane] = 1.0 if i == j else 0.0
    for _ in range(30):
        largest = 0.0
        for lane in range(LANES):
            largest = max(largest, a[3, lane] ** 2 + a[4, lane] ** 2 + a[5, lane] ** 2)
        if not largest >= 1e-32:
            break
        for k in range(3):
            i, j = ONE[k], OTHER[k]
            for lane in range(LANES):
                off = a[3 + k, lane]
                theta = 0.5 * (a[j, lane] - a[i, lane]) / (off + TINY)
                t = np.copysign(1.0, theta) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                a[i, lane] -= t * off
                a[j, lane] += t * off
                a[3 + k, lane] = 0.0
                one, other = a[3 + j, lane], a[3 + i, lane]
                a[3 + j, lane], a[3 + i, lane] = c * one - s * other, s * one + c * other
                for m in range(3):
                    one, other = q[m, i, lane], q[m, j, lane]
                    q[m, i, lane], q[m, j, lane] = c * one - s * other, s * one + c * other


@nb.njit(cache=True, error_model="numpy")
def _spectral(
    green: FloatArray,
    start: int,
    a: FloatArray,
    q: FloatArray,
    stretch: FloatArray,
    g: FloatArray,
    r: FloatArray,
) -> None:
    """Spectral decomposition at the points ``start`` to ``start + LANES`` of ``green (n, 6)``.

    Writes ``l_i - 1`` (``stretch``, six components in the eigenbasis, three of them 0), the factors
    ``g = 2 / (l_i + l_j)`` of the six components, and the rotations ``r (6, 6, LANES)`` into the
    eigenbasis, orthogonal for six-vectors scaled by ``SCALE``.
    """
    for lane in range(LANES):
        point = green[min(start + lane, len(green) - 1)]
        for k in range(3):
            a[k, lane] = 1.0 + 2.0 * point[k]
            a[3 + k, lane] = point[3 + k]
    _eigen(a, q)
    for k in range(3):
        for lane in range(LANES):
            # An enhanced strain can become inadmissible during a Newton iteration. A positive floor
            # keeps the numbers finite, and the line search rejects such a state.
            stretch[k, lane] = np.sqrt(max(a[k, lane], 1e-6)) - 1.0
            g[k, lane] = 1.0 / (1.0 + stretch[k, lane])
    for k in range(3):
        i, j = ONE[k], OTHER[k]
        for lane in range(LANES):
            stretch[3 + k, lane] = 0.0
            g[3 + k, lane] = 2.0 / (2.0 + stretch[i, lane] + stretch[j, lane])
        for m in range(3):
            b, c = ONE[m], OTHER[m]
            for lane in range(LANES):
                r[k, m, lane] = q[m, k, lane] * q[m, k, lane]
                r[k, 3 + m, lane] = ROOT * q[b, k, lane] * q[c, k, lane]
                r[3 + k, m, lane] = ROOT * q[m, i, lane] * q[m, j, lane]
                one, other = q[b, i, lane] * q[c, j, lane], q[c, i, lane] * q[b, j, lane]
                r[3 + k, 3 + m, lane] = one + other


@nb.njit(cache=True, fastmath=CONTRACT)
def _times(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    for i in range(6):
        for z in range(LANES):
            out[i, z] = (
                m[i, 0, z] * v[0, z]
                + m[i, 1, z] * v[1, z]
                + m[i, 2, z] * v[2, z]
                + m[i, 3, z] * v[3, z]
                + m[i, 4, z] * v[4, z]
                + m[i, 5, z] * v[5, z]
            )


@nb.njit(cache=True, fastmath=CONTRACT)
def _transposed_times(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    for i in range(6):
        for z in range(LANES):
            out[i, z] = (
                m[0, i, z] * v[0, z]
                + m[1, i, z] * v[1, z]
                + m[2, i, z] * v[2, z]
                + m[3, i, z] * v[3, z]
                + m[4, i, z] * v[4, z]
                + m[5, i, z] * v[5, z]
            )


@nb.njit(cache=True)
def _scaled(values: FloatArray, start: int, power: int, out: FloatArray) -> None:
    """Write ``values (n, 6)`` times ``SCALE``, or divided by it (``power = -1``)."""
    for lane in range(LANES):
        for k in range(6):
            factor = SCALE[k] if power > 0 else 1.0 / SCALE[k]
            out[k, lane] = factor * values[min(start + lane, len(values) - 1), k]


@nb.njit(cache=True)
def _unscaled(values: FloatArray, start: int, power: int, out: FloatArray) -> None:
    """Undo `_scaled`, writing into ``out (n, 6)``."""
    for lane in range(min(LANES, len(out) - start)):
        for k in range(6):
            factor = 1.0 / SCALE[k] if power > 0 else SCALE[k]
            out[start + lane, k] = factor * values[k, lane]


@nb.njit(cache=True)
def _room() -> tuple[FloatArray, ...]:
    """Work arrays of `_spectral`."""
    return (
        np.empty((6, LANES)),
        np.empty((3, 3, LANES)),
        np.empty((6, LANES)),
        np.empty((6, LANES)),
        np.empty((6, 6, LANES)),
    )


@nb.njit(cache=True, error_model="numpy")
def _response(
    green: FloatArray, region: IntArray, stiffness: FloatArray, previous: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray]:
    n_q = green.shape[1]
    stress, tangent = np.empty(green.shape), np.empty((*green.shape, 6))
    points, before = green.reshape(-1, 6), previous.reshape(-1, 6)
    flat, moduli = stress.reshape(-1, 6), tangent.reshape(-1, 6, 6)
    a, q, stretch, g, r = _room()
    eps, t, s = np.empty((6, LANES)), np.empty((6, LANES)), np.empty((6, LANES))
    c, half, d = (
        np.empty((6, 6, LANES)),
        np.empty((6, 6, LANES)),
        np.empty((6, 6, LANES)),
    )
    for start in range(0, len(points), LANES):
        for lane in range(LANES):
            own = stiffness[region[min(start + lane, len(points) - 1) // n_q]]
            for i in range(6):
                for j in range(6):
                    c[i, j, lane] = own[i, j] * SCALE[i] * SCALE[j]
        _spectral(points, start, a, q, stretch, g, r)
        _transposed_times(r, stretch, eps)
        _scaled(before, start, -1, t)
        for i in range(6):
            for lane in range(LANES):
                eps[i, lane] = (1.0 + rate) * eps[i, lane] - rate * t[i, lane]
        _times(c, eps, t)
        _times(r, t, s)
        for i in range(6):
            for lane in range(LANES):
                s[i, lane] *= g[i, lane]
        _transposed_times(r, s, t)
        _unscaled(t, start, 1, flat)
        # L^T C L in the eigenbasis, where L is diagonal.
        for i in range(6):
            _times(c, r[i], half[i])
        for i in range(6):
            _times(half, r[i], d[i])
            for j in range(6):
                for lane in range(LANES):
                    d[i, j, lane] *= (1.0 + rate) * g[i, lane] * g[j, lane]
        _add_curvature(s, g, d)
        for i in range(6):
            _transposed_times(r, d[i], half[i])
        for j in range(6):
            for i in range(6):
                for lane in range(LANES):
                    t[i, lane] = r[i, j, lane]
            _transposed_times(half, t, d[j])
        for lane in range(min(LANES, len(points) - start)):
            for i in range(6):
                for j in range(i + 1):
                    value = d[i, j, lane] / (SCALE[i] * SCALE[j])
                    moduli[start + lane, i, j] = value
                    moduli[start + lane, j, i] = value
    return stress, tangent


@nb.njit(cache=True)
def _add_curvature(s: FloatArray, g: FloatArray, d: FloatArray) -> None:
    """Add ``T : d2 eps = -S : (dU dU)`` twice polarised, in the eigenbasis."""
    for k in range(3):
        i, j = ONE[k], OTHER[k]
        for lane in range(LANES):
            d[k, k, lane] -= s[k, lane] * g[k, lane] * g[k, lane]
            shear = 0.5 * (s[i, lane] + s[j, lane]) * g[3 + k, lane] * g[3 + k, lane]
            d[3 + k, 3 + k, lane] -= shear
            half = 0.5 * s[3 + k, lane]
            one, other = half * g[i, lane] * g[3 + k, lane], half * g[j, lane] * g[3 + k, lane]
            d[i, 3 + k, lane] -= one
            d[3 + k, i, lane] -= one
            d[j, 3 + k, lane] -= other
            d[3 + k, j, lane] -= other
            # The shears ki and kj share the axis k and couple to the shear ij.
            mixed = half / ROOT * g[3 + i, lane] * g[3 + j, lane]
            d[3 + i, 3 + j, lane] -= mixed
            d[3 + j, 3 + i, lane] -= mixed


@nb.njit(cache=True)
def _linear(green: FloatArray, values: FloatArray, power: int) -> FloatArray:
    """``L^T T (e, q, 6)`` of stresses T (``power = 1``), ``L dE`` of strains dE (``-1``).

    Scaled, L is its own transpose. With ``power = 0`` the result is the Biot strain itself; one
    kernel for all three saves compilation.
    """
    out, points, given = np.empty(values.shape), green.reshape(-1, 6), values.reshape(-1, 6)
    flat = out.reshape(-1, 6)
    a, q, stretch, g, r = _room()
    v, w = np.empty((6, LANES)), np.empty((6, LANES))
    for start in range(0, len(points), LANES):
        _spectral(points, start, a, q, stretch, g, r)
        _scaled(given, start, power, v)
        _times(r, v, w)
        for i in range(6):
            for lane in range(LANES):
                w[i, lane] = g[i, lane] * w[i, lane] if power != 0 else stretch[i, lane]
        _transposed_times(r, w, v)
        _unscaled(v, start, power, flat)
    return out
