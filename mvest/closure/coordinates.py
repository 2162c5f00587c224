"""Coordinates in which closed states change evenly with the parameters: their logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.mechanics.parameters import Parameter, is_positive
from mvest.mechanics.settings import MechanicsSettings
from mvest.typing import BoolArray, FloatArray

STIFFENED = 0.5
"""What log(1 + stiffening) is multiplied by: with five steps of 0.2 a tissue that hardly stiffens
becomes one that is nearly all exponential, and a leaflet moves by no more than with its modulus."""


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Logarithms of positive parameters; a field's coefficients times its deviation of log E_f.

    Of a stiffening alpha it is a share of log(1 + alpha): from none at all it is a short way.

    Attributes
    ----------
    units : (p,)
        What a coefficient of a field changes log E_f by, what a logarithm is multiplied by.
    offsets : (p,)
        What is added to a parameter before its logarithm is taken; NaN where it is not.
    """

    units: FloatArray
    offsets: FloatArray

    @classmethod
    def of(cls, names: tuple[str, ...], settings: MechanicsSettings) -> Coordinates:
        """Those of the named parameters under the settings of a model."""
        units, offsets = [], []
        for name in names:
            parameter = Parameter(name, 0.0)
            stiffens, positive = parameter.kind == "stiffening", is_positive(name)
            field = 1.0 if positive else settings.fields[parameter.region].std_log
            units.append(STIFFENED if stiffens else field)
            offsets.append(np.nan if not positive else 1.0 if stiffens else 0.0)
        return cls(np.array(units), np.array(offsets))

    @property
    def _positive(self) -> BoolArray:
        return ~np.isnan(self.offsets)

    def __call__(self, m: FloatArray) -> FloatArray | None:
        """Coordinates ``(p,)`` of parameters ``(p,)``; None where one has no logarithm."""
        shifted = np.where(self._positive, m + self.offsets, 1.0)
        if np.any(shifted <= 0):
            return None
        return self.units * np.where(self._positive, np.log(shifted), m)

    def parameters(self, at: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` with the coordinates ``at (p,)``."""
        own = at / self.units
        return np.where(
            self._positive, np.exp(np.where(self._positive, own, 0.0)) - self.offsets, own
        )

    def change(self, start: FloatArray, end: FloatArray) -> FloatArray | None:
        """Difference ``(p,)`` of the coordinates of two sets of parameters; None as above."""
        one, other = self(start), self(end)
        return None if one is None or other is None else other - one

    def rates(self, m: FloatArray) -> FloatArray:
        """Derivative ``(p,)`` of each parameter by its coordinate."""
        return np.where(self._positive, m + self.offsets, 1.0) / self.units
