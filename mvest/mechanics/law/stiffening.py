r"""A tissue on its way from the linear law to an exponential one.

Whether a leaflet has stiffened when it is closed cannot be told beforehand, and moduli that are
fitted with the wrong law are off. So the stress of one region is that of both laws,

.. math::
    S = (1 - w) S_{lin} + w S_{exp}, \qquad w = \frac{\alpha}{1 + \alpha},

where the exponential tissue is as stiff as the linear one of the same modulus where it is stretched
as closed leaflets are (`mvest.mechanics.law.equivalent.as_stiff`). The *stiffening* :math:`\alpha`
is the ratio of their shares; 0 is the linear law, and without end the exponential one. Both parts
follow the modulus, so that S is proportional to it.

Damping is that of the linear law whatever the share, so that the way to the equilibrium does not
depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.equivalent import as_stiff
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.parameters import Parameter, known_names
from mvest.mechanics.settings import TissueSettings
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
            raise InputError(f"stiffening of a tissue = {stiffening}, expected >= 0")
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
        if parameter.kind not in self.kinds:
            raise InputError(
                f"parameter {parameter.name!r}: the stiffening law knows {known_names(self.kinds)}"
            )
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
