r"""A fibre-reinforced exponential law of leaflet tissue, and its blend with the linear law.

With the stretch of the fibres :math:`\lambda = \sqrt{I_4}`, the first invariant of the isochoric
deformation :math:`\bar I_1 = J^{-2/3} \mathrm{tr}\, C` and :math:`C = I + 2E`,

.. math::
    W(E) &= c_0 \left(e^Q - 1\right) + \frac{\mu}{2} (\bar I_1 - 3)
            + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J), \\
    Q &= c_1 (\bar I_1 - 3)^2 + c_2 \langle \lambda - 1 \rangle^4, \\
    S(E) &= W_a\, a' + W_f\, e_1 + \frac{\kappa}{2} (J^2 - 1) C^{-1}, \\
    D(E) &= W_{aa}\, a' \otimes a' + W_{af} (a' \otimes e_1 + e_1 \otimes a')
            + W_{ff}\, e_1 \otimes e_1 + W_a\, a'' \\
         &\quad + \kappa \left(J^2 C^{-1} \otimes C^{-1} - (J^2 - 1) C^{-1} \odot C^{-1}\right),

where :math:`a = \bar I_1 - 3`, a prime is a derivative by E, and f stands for :math:`E_{11}`, the
only component on which :math:`\lambda = \sqrt{1 + 2 E_{11}}` depends in the fibre frame.

The exponential is that of May-Newman and Yin (1998, J. Biomech. Eng. 120:38) for mitral leaflets,
with :math:`(c_0, c_1, c_2)` of (0.0399 kPa, 4.325, 1446.5) for the anterior and (0.0414 kPa, 4.848,
305.4) for the posterior leaflet (recalled from there).
Prot, Skallerud and Holzapfel (2007, Int. J. Numer. Meth. Engng 71:987) have :math:`(I_4 - 1)^2` in
place of :math:`(\lambda - 1)^4`. Three additions:

* Fibres bear tension only (:math:`\langle \cdot \rangle` is the positive part). The fourth power
  keeps W three times continuously differentiable; with a square the tangent would jump.
* A neo-Hookean ground matrix of shear modulus mu, because the exponential has no stiffness at rest.
* A penalty kappa on the volume change instead of incompressibility. It acts on J and the
  exponential on the isochoric :math:`\bar I_1`, so that there is no stress at rest. The fibre term
  is not split, since fibres feel their full stretch.

What bears compression: the fibre term is zero, and the matrix remains, mu and the isotropic part of
Q, since :math:`\bar I_1 \ge 3` grows in every isochoric deformation. So collagen that the isotropic
part stands for bears compression, too. In a blend so does the share 1 - w of the linear law.

Every term is polyconvex. Beyond Q = ``MAX_EXPONENT`` the exponential continues as a parabola, so
that distant Newton iterates do not overflow; no tissue gets there.

Kelvin-Voigt damping adds the stress ``rate (E - E_n) V`` with ``rate = beta / dt`` and the constant
isotropic V = ``viscous`` (MPa; half of it for engineering shear). It acts on the rate of the
Green-Lagrange strain and hence not on rigid rotation.

In a biaxial test a thin sheet is stretched along and across its fibres; zero stress across the
thickness determines its stretch.

Whether a closed leaflet has stiffened is unknown beforehand, and moduli fitted with the wrong law
are biased. So the stress of a region blends both laws,

.. math::
    S = (1 - w) S_{lin} + w S_{exp}, \qquad w = \frac{\alpha}{1 + \alpha},

where the exponential tissue is as stiff as the linear one of the same modulus at the stretches of
closed leaflets (`as_stiff`). The *stiffening* :math:`\alpha` is the ratio of both shares: 0 is the
linear law, infinity the exponential one. Both parts are proportional to the modulus.

Damping is that of the linear law, so that the path to the equilibrium does not depend on the share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import lru_cache

import numba as nb
import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law import Law, Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import EXPONENTIAL_KINDS, ExponentialTissue, TissueSettings
from mvest.typing import FloatArray, IntArray

MAX_EXPONENT = 12.0
"""Largest exponent: 1.6e5 times c0, many times the strength of a leaflet."""

TURNED_OVER = 1e4
"""Stiffness (MPa) of inverted material towards its state at rest."""

VISCOUS = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
"""Viscous stress over strain, by component, for a unit viscous stiffness."""


@dataclass(frozen=True, slots=True, eq=False)
class ExponentialLaw:
    """The law of a body with one set of coefficients per region."""

    coefficients: FloatArray  #: ``(n_regions, 6)`` in the order of :class:`ExponentialTissue`

    @classmethod
    def of(cls, tissues: Sequence[ExponentialTissue]) -> ExponentialLaw:
        """The law with one tissue per region."""
        return cls(np.array([astuple(tissue) for tissue in tissues], dtype=np.float64))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its parameters (see :mod:`mvest.mechanics.parameters`)."""
        return ("E_f", *EXPONENTIAL_KINDS)

    def strain(self, green: FloatArray) -> FloatArray:
        """The damped strain ``(e, q, 6)``: the Green-Lagrange strain itself."""
        return green

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress S ``(e, q, 6)`` MPa and tangent D = dS/dE ``(e, q, 6, 6)`` MPa.

        Newton iterates may contain inverted material, for which W is undefined. It responds like
        very stiff linear material, which leads back to admissible states.
        """
        stress, tangent = _response(at.green, at.region, self.coefficients)
        if at.rate:
            viscous = at.rate * self._viscous(at.region)
            stress += viscous * (at.green - at.previous)
            tangent[:, :, range(6), range(6)] += viscous
        return stress, tangent

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of S ``(e, q, 6)`` by a coefficient; InputError if there is no such one."""
        parameter.require(self.kinds)
        if parameter.kind == "E_f":  # a factor on everything, damping included (`as_stiff`)
            return np.where((at.region == which)[:, None, None], stress, 0.0) / parameter.value
        kind = EXPONENTIAL_KINDS.index(parameter.kind)
        return _partial_stress(at.green, at.region, self.coefficients, kind, which)

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous strain."""
        return -at.rate * self._viscous(at.region) * d_previous

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the damped strain ``(e, q, 6)``."""
        return d_green

    def _viscous(self, region: IntArray) -> FloatArray:
        """``(e, 1, 6)`` MPa."""
        return self.coefficients[region, 5][:, None, None] * VISCOUS


@nb.njit(cache=True)
def _metric(green: FloatArray, h: FloatArray) -> tuple[float, float]:
    """Write C^-1 to ``h`` (tensor shear); return det C and tr C.

    The determinant is 0 if C is not positive definite.
    """
    a, b, c = 1.0 + 2.0 * green[0], 1.0 + 2.0 * green[1], 1.0 + 2.0 * green[2]
    d, e, f = green[3], green[4], green[5]
    h[0], h[1], h[2] = b * c - d * d, a * c - e * e, a * b - f * f
    h[3], h[4], h[5] = e * f - a * d, d * f - b * e, d * e - c * f
    det = a * h[0] + f * h[5] + e * h[4]
    if not (a > 0.0 and h[2] > 0.0 and det > 0.0):  # Sylvester's criterion
        return 0.0, a + b + c
    for i in range(6):
        h[i] /= det
    return det, a + b + c


@nb.njit(cache=True)
def _exponential(q: float) -> tuple[float, float]:
    """First two derivatives of exp(q), continued as a parabola beyond ``MAX_EXPONENT``."""
    e = np.exp(min(q, MAX_EXPONENT))
    return e * (1.0 + max(q - MAX_EXPONENT, 0.0)), e


@nb.njit(cache=True)
def _response(
    green: FloatArray, region: IntArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n_e, n_q, _ = green.shape
    stress, tangent = np.empty((n_e, n_q, 6)), np.empty((n_e, n_q, 6, 6))
    h, da = np.empty(6), np.empty(6)
    first, second = np.array([0, 1, 2, 1, 0, 0]), np.array([0, 1, 2, 2, 2, 1])
    place = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
    for e in range(n_e):
        c0, c1, c2, mu, kappa, _ = coefficients[region[e]]
        for p in range(n_q):
            det, trace = _metric(green[e, p], h)
            if det == 0.0:
                for i in range(6):
                    stress[e, p, i] = TURNED_OVER * green[e, p, i]
                    for j in range(6):
                        tangent[e, p, i, j] = TURNED_OVER if i == j else 0.0
                continue
            isochoric = det ** (-1.0 / 3.0)
            a = trace * isochoric - 3.0
            for i in range(6):
                da[i] = 2.0 * isochoric * ((1.0 if i < 3 else 0.0) - trace / 3.0 * h[i])
            length = np.sqrt(1.0 + 2.0 * green[e, p, 0])
            x = max(length - 1.0, 0.0)
            g1, g2 = _exponential(c1 * a * a + c2 * x**4)
            q_a, q_f = 2.0 * c1 * a, 4.0 * c2 * x**3 / length
            q_ff = c2 * (12.0 * x * x / length**2 - 4.0 * x**3 / length**3)
            w_a, w_f = 0.5 * mu + c0 * g1 * q_a, c0 * g1 * q_f
            w_aa, w_af = c0 * (g2 * q_a * q_a + 2.0 * g1 * c1), c0 * g2 * q_a * q_f
            for i in range(6):
                stress[e, p, i] = w_a * da[i] + 0.5 * kappa * (det - 1.0) * h[i]
                for j in range(i + 1):
                    k, m, r, s = first[i], second[i], first[j], second[j]
                    both = 0.5 * (h[place[k, r]] * h[place[m, s]] + h[place[k, s]] * h[place[m, r]])
                    mixed = (h[j] if i < 3 else 0.0) + (h[i] if j < 3 else 0.0)
                    dda = (
                        4.0
                        * isochoric
                        * (trace / 3.0 * both + trace / 9.0 * h[i] * h[j] - mixed / 3.0)
                    )
                    value = w_aa * da[i] * da[j] + w_a * dda
                    value += kappa * (det * h[i] * h[j] - (det - 1.0) * both)
                    tangent[e, p, i, j] = tangent[e, p, j, i] = value
            stress[e, p, 0] += w_f
            tangent[e, p, 0, 0] += c0 * (g2 * q_f * q_f + g1 * q_ff)
            for i in range(6):
                tangent[e, p, i, 0] += w_af * da[i]
                tangent[e, p, 0, i] += w_af * da[i]
    return stress, tangent


@nb.njit(cache=True)
def _partial_stress(
    green: FloatArray, region: IntArray, coefficients: FloatArray, kind: int, which: int
) -> FloatArray:
    n_e, n_q, _ = green.shape
    out = np.zeros((n_e, n_q, 6))
    h = np.empty(6)
    for e in range(n_e):
        if region[e] != which:
            continue
        c0, c1, c2, _, _, _ = coefficients[which]
        for p in range(n_q):
            det, trace = _metric(green[e, p], h)
            if det == 0.0:
                continue
            isochoric = det ** (-1.0 / 3.0)
            a = trace * isochoric - 3.0
            length = np.sqrt(1.0 + 2.0 * green[e, p, 0])
            x = max(length - 1.0, 0.0)
            g1, g2 = _exponential(c1 * a * a + c2 * x**4)
            q_a, fourth = 2.0 * c1 * a, 4.0 * x**3 / length
            by_a, by_f, by_volume = 0.0, 0.0, 0.0
            if kind == 0:
                by_a, by_f = g1 * q_a, g1 * c2 * fourth
            elif kind == 1:
                by_a = c0 * (g2 * a * a * q_a + 2.0 * g1 * a)
                by_f = c0 * g2 * a * a * c2 * fourth
            elif kind == 2:
                by_a, by_f = c0 * g2 * x**4 * q_a, c0 * (g2 * x**4 * c2 + g1) * fourth
            elif kind == 3:
                by_a = 0.5
            else:
                by_volume = 0.5 * (det - 1.0)
            for i in range(6):
                unit = 1.0 if i < 3 else 0.0
                da = 2.0 * isochoric * (unit - trace / 3.0 * h[i])
                out[e, p, i] = by_a * da + by_volume * h[i]
            out[e, p, 0] += by_f
    return out


MAX_ITERATIONS = 100
TOLERANCE = 1e-12
"""Convergence of the logarithmic thickness stretch."""


def biaxial_stress(law: Law, stretches: FloatArray, region: int = 0) -> FloatArray:
    """Nominal stresses ``(n, 2)`` MPa at stretches ``(n, 2)``, both along and across the fibres.

    Raises
    ------
    InputError
        If stretches are not positive, or no stretch of the thickness is found.
    """
    stretches = np.asarray(stretches, dtype=np.float64)
    if stretches.ndim != 2 or stretches.shape[1] != 2 or not np.all(stretches > 0):
        raise InputError("stretches: expected (n, 2) positive numbers")
    green = np.zeros((len(stretches), 1, 6))
    green[:, 0, :2] = 0.5 * (stretches**2 - 1)
    thickness = 1 / stretches.prod(axis=1)
    where, none = np.full(len(stretches), region), np.zeros_like(green)
    for _ in range(MAX_ITERATIONS):
        green[:, 0, 2] = 0.5 * (thickness**2 - 1)
        stress, tangent = law.response(Points(green, where, none, 0.0))
        # Newton's method in the logarithm keeps the thickness positive.
        slope = tangent[:, 0, 2, 2] * thickness**2 + 2 * stress[:, 0, 2]
        change = -stress[:, 0, 2] / np.where(slope > 0, slope, tangent[:, 0, 2, 2] * thickness**2)
        thickness = thickness * np.exp(np.clip(change, -0.1, 0.1))
        if np.abs(change).max(initial=0.0) < TOLERANCE:
            return np.asarray(stretches * stress[:, 0, :2])
    raise InputError("no thickness without stress was found at these stretches")


CLOSED_STRETCHES = (1.0, 1.11)
"""Median stretches of closed leaflets along and across the fibres (``results/law.md``)."""


def as_stiff(tissue: ExponentialTissue, linear: TissueSettings, E_f: float) -> ExponentialTissue:
    """The tissue with stresses scaled to those of a linear one of modulus ``E_f`` MPa.

    At `CLOSED_STRETCHES` of the open leaflet both have the same mean of the stresses along and
    across the fibres: the exponential one with the prestretch of ``linear``, the linear one
    without.
    """
    factor = E_f * _scale(tissue, linear)
    exponents = {"c1", "c2"}
    return replace(
        tissue,
        **{
            each.name: factor * getattr(tissue, each.name)
            for each in fields(tissue)
            if each.name not in exponents
        },
    )


@lru_cache(maxsize=64)
def _scale(tissue: ExponentialTissue, linear: TissueSettings) -> float:
    """Factor on the stresses of the tissue for a modulus of 1 MPa."""
    stretches = np.array([CLOSED_STRETCHES])
    wanted = biaxial_stress(BiotLaw.of([linear.material(1.0)]), stretches).mean()
    before = linear.prestretch * np.array([1.0, linear.prestretch_ratio])
    # Forces per area of the open leaflet, whose volume is the same.
    stress = before * biaxial_stress(ExponentialLaw.of([tissue]), before * stretches)
    return float(wanted / stress.mean())


@dataclass(frozen=True, slots=True, eq=False)
class StiffeningLaw:
    """Blend of the linear and the exponential law, for a body of one region."""

    linear: BiotLaw
    exponential: ExponentialLaw  #: of the same stiffness at the stretches of closed leaflets
    stiffening: float  #: share of the exponential law over that of the linear one, at least 0

    @classmethod
    def of(cls, tissue: TissueSettings, E_f: float, stiffening: float) -> StiffeningLaw:
        """The law of a tissue of modulus ``E_f`` MPa.

        Raises
        ------
        InputError
            If the tissue has no exponential law, or the stiffening is not a number of at least 0.
        MaterialError
            If the modulus is inadmissible.
        """
        if not (np.isfinite(stiffening) and stiffening >= 0.0):
            raise InputError(f"tissue stiffening = {stiffening}, expected >= 0")
        # A prestretch acts on both laws alike.
        curve = as_stiff(
            tissue.coefficients({}), replace(tissue, prestretch=1.0, prestretch_ratio=1.0), E_f
        )
        linear = BiotLaw.of([tissue.material(E_f)])
        return cls(linear, ExponentialLaw.of([curve]), float(stiffening))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its parameters (see :mod:`mvest.mechanics.parameters`)."""
        return ("E_f", "stiffening")

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measure of the linear law, ``(e, q, 6)``."""
        return self.linear.strain(green)

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        whole = 1.0 + self.stiffening
        stress, tangent = self.linear.response(at._replace(rate=at.rate * whole))
        own, by = self.exponential.response(at._replace(rate=0.0))
        stress, tangent = stress + self.stiffening * own, tangent + self.stiffening * by
        return stress / whole, tangent / whole

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of S ``(e, q, 6)``; InputError if the law has no such parameter."""
        parameter.require(self.kinds)
        if parameter.kind == "E_f":
            return stress / parameter.value
        still = at._replace(rate=0.0)
        linear, exponential = (law.response(still)[0] for law in (self.linear, self.exponential))
        return (exponential - linear) / (1.0 + self.stiffening) ** 2

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous strain."""
        return self.linear.history_stress(at, d_previous)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure of the linear law."""
        return self.linear.strain_change(green, d_green)
