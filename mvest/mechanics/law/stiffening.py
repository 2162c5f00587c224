r"""A law on the way from the linear one to the exponential one.

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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw, as_stiff
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import TissueSettings
from mvest.typing import FloatArray


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
        """Derivative of S ``(e, q, 6)``; InputError if the law does not know the parameter."""
        parameter.require(self.kinds)
        if parameter.kind == "E_f":
            return stress / parameter.value
        still = at._replace(rate=0.0)
        linear, exponential = (law.response(still)[0] for law in (self.linear, self.exponential))
        return (exponential - linear) / (1.0 + self.stiffening) ** 2

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of S ``(e, q, 6)`` for a change of the previous strain: of the damping alone."""
        return self.linear.history_stress(at, d_previous)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure of the linear law."""
        return self.linear.strain_change(green, d_green)
