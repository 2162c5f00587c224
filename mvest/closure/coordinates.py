"""Coordinates in which closed states change evenly with the parameters: their logarithms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.mechanics.parameters import Parameter, is_positive
from mvest.mechanics.settings import MechanicsSettings
from mvest.typing import BoolArray, FloatArray

__all__ = ["Coordinates"]


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Logarithms of positive parameters; a field's coefficients times its deviation of log E_f.

    Attributes
    ----------
    units : (p,)
        What a coefficient of a field changes log E_f by; 0 for positive parameters.
    """

    units: FloatArray

    @classmethod
    def of(cls, names: tuple[str, ...], settings: MechanicsSettings) -> Coordinates:
        """Those of the named parameters under the settings of a model."""
        units = [
            0.0 if is_positive(name) else settings.fields[Parameter(name, 0.0).region].std_log
            for name in names
        ]
        return cls(np.array(units))

    @property
    def _positive(self) -> BoolArray:
        return self.units == 0

    def __call__(self, m: FloatArray) -> FloatArray | None:
        """Coordinates ``(p,)`` of parameters ``(p,)``; None where one has no logarithm."""
        if np.any(m[self._positive] <= 0):
            return None
        return np.where(self._positive, np.log(np.where(self._positive, m, 1.0)), self.units * m)

    def parameters(self, at: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` with the coordinates ``at (p,)``."""
        units = np.where(self._positive, 1.0, self.units)
        return np.where(self._positive, np.exp(np.where(self._positive, at, 0.0)), at / units)

    def change(self, start: FloatArray, end: FloatArray) -> FloatArray | None:
        """Difference ``(p,)`` of the coordinates of two sets of parameters; None as above."""
        one, other = self(start), self(end)
        return None if one is None or other is None else other - one

    def rates(self, m: FloatArray) -> FloatArray:
        """Derivative ``(p,)`` of each parameter by its coordinate."""
        return np.where(self._positive, m, 1 / np.where(self._positive, 1.0, self.units))
