r"""Laws made of other laws: one that stiffens from linear to exponential, and one prestretched.

Whether a leaflet has stiffened when it is closed cannot be told beforehand, and moduli that are
fitted with the wrong law are off. So the stress of one region is that of both laws,

.. math::
    S = (1 - w) S_{lin} + w S_{exp}, \qquad w = \frac{\alpha}{1 + \alpha},

where the exponential tissue is as stiff as the linear one of the same modulus where it is stretched
as closed leaflets are (`mvest.mechanics.law.exponential.as_stiff`). The *stiffening* :math:`\alpha`
is the ratio of their shares; 0 is the linear law, and without end the exponential one. Both parts
follow the modulus, so that S is proportional to it.

Damping is that of the linear law whatever the share, so that the way to the equilibrium does not
depend on it.

Prestretched leaflets are stretched already in the shape in which they were seen open. The open
valve of an image is under load, and its leaflets were grown under tension: free of stress they
would be smaller. A leaflet that was seen :math:`\lambda` times as long in both directions of its
plane as it would be then, at the same volume, has in its fibre frame the deformation

.. math::
    F_0 = F\,G, \qquad G = \mathrm{diag}(\lambda, \lambda, \lambda^{-2}),

of which the law is asked, F being what is done to the shape that was seen. With
:math:`E_0 = \frac12 (G^T (I + 2E)\, G - I)` the stress is :math:`S = G\, S_0(E_0)\, G^T`, since
the volume is the same. The shape that was seen is then in no equilibrium by itself; what is
computed is the closed valve of such leaflets.

That leaflets in the heart are prestrained, and that a closed valve of porcine leaflets comes nearer
to what echocardiography shows where the model has it, is found by Prot and Skallerud (2017, Int. J.
Numer. Meth. Biomed. Engng 33:e2806).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw, as_stiff
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import TissueSettings
from mvest.mechanics.solid import Law
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class StiffeningLaw:
    """The law of a body of one region.

    Attributes
    ----------
    linear : BiotLaw
    exponential : ExponentialLaw
        As stiff where closed leaflets are stretched.
    stiffening : float
        Share of the exponential law over that of the linear one, at least 0.
    """

    linear: BiotLaw
    exponential: ExponentialLaw
    stiffening: float

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
        curve = as_stiff(tissue.coefficients({}), tissue, E_f)
        return cls(
            BiotLaw.of_moduli([tissue.moduli(E_f)]), ExponentialLaw.of([curve]), float(stiffening)
        )

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that the law knows (see :mod:`mvest.mechanics.parameters`)."""
        return ("E_f", "stiffening")

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measure of the linear law, ``(e, q, 6)``."""
        return self.linear.strain(green)

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa; see `BiotLaw.response`."""
        whole = 1.0 + self.stiffening
        stress, tangent = self.linear.response(green, region, previous, rate * whole)
        own, by = self.exponential.response(green, region, green, 0.0)
        stress, tangent = stress + self.stiffening * own, tangent + self.stiffening * by
        return stress / whole, tangent / whole

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
        """Derivative of S ``(e, q, 6)`` by a parameter; see `BiotLaw.partial_stress`.

        Raises
        ------
        InputError
            If the law does not know the parameter.
        """
        parameter.require(self.kinds)
        if parameter.kind == "E_f":
            return stress / parameter.value
        linear, _ = self.linear.response(green, region, previous, 0.0)
        exponential, _ = self.exponential.response(green, region, green, 0.0)
        return (exponential - linear) / (1.0 + self.stiffening) ** 2

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous strain: of the damping alone."""
        return self.linear.history_stress(green, region, d_previous, rate)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure of the linear law."""
        return self.linear.strain_change(green, d_green)


POWERS = np.array([2.0, 2.0, -4.0, -1.0, -1.0, 2.0])
"""Of the prestretch, by which components of C and S of the shape that was seen are multiplied."""
NORMAL = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class PrestretchedLaw:
    """A law of leaflets that are free of stress in another shape than the one that was seen.

    Attributes
    ----------
    base : Law
        Of leaflets that are free of stress.
    prestretch : (r,)
        Of each region.
    region : (e,)
        Of the elements, which laws do not know when they are asked for a strain.
    """

    base: Law
    prestretch: FloatArray
    region: IntArray

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that it knows: those of the base, and the prestretch."""
        return (*self.base.kinds, "prestretch")

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measure of the base, from leaflets free of stress."""
        return self.base.strain(self._whole(green))

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stress, tangent = self.base.response(self._whole(green), region, previous, rate)
        scale = self._scale
        return scale * stress, scale[..., None] * scale[..., None, :] * tangent

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
        """Derivative of the stress; see :meth:`mvest.mechanics.law.biot.BiotLaw.partial_stress`.

        Raises
        ------
        InputError
            If it is by a prestretch and the valve moves: what is damped depends on it as well.
        """
        scale, whole = self._scale, self._whole(green)
        if parameter.kind != "prestretch":
            return scale * self.base.partial_stress(
                parameter, whole, region, previous, rate, which=which, stress=stress / scale
            )
        if rate:
            raise InputError(
                f"parameter {parameter.name!r}: there are derivatives by a prestretch at an "
                "equilibrium only"
            )
        own, tangent = self.base.response(whole, region, previous, rate)
        by = np.where(self.region == which, 1.0 / self.prestretch[self.region], 0.0)
        slope = POWERS * by[:, None, None] * scale
        return slope * own + scale * np.einsum(
            "eqij,eqj->eqi", tangent, slope * (green + 0.5 * NORMAL)
        )

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of the stress for a change of the previous strain measure."""
        whole = self._whole(green)
        return self._scale * self.base.history_stress(whole, region, d_previous, rate)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure of the base."""
        return self.base.strain_change(self._whole(green), self._scale * d_green)

    @property
    def _scale(self) -> FloatArray:
        """Factor ``(e, 1, 6)`` on the components of C and S."""
        return np.asarray(self.prestretch[self.region, None, None] ** POWERS)

    def _whole(self, green: FloatArray) -> FloatArray:
        """Green-Lagrange strain ``(e, q, 6)`` from the shape that is free of stress."""
        scale = self._scale
        return np.asarray(scale * green + 0.5 * (scale - 1.0) * NORMAL)
