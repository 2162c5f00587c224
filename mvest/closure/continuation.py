"""Decides from which closed state a closure may be continued, and how far.

Distances are measured in coordinates in which closed states change evenly: the logarithms of the
parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.mechanics.parameters import Parameter, is_positive
from mvest.mechanics.settings import MechanicsSettings
from mvest.typing import FloatArray

STIFFENED = 0.5
"""Factor on log(1 + stiffening). Five steps of 0.2 then lead from tissue that hardly stiffens to
nearly exponential tissue. A leaflet moves no farther per step than per step of its modulus."""


SPACING = 0.4
"""Spacing of the lattice of starting points, in the coordinates of the parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedState:
    """A closed valve from which further closures may be continued."""

    at: FloatArray  #: (p,), its parameters
    positions: FloatArray  #: (n, 3) mm, of the mesh's nodes
    guide: ClosedState | None = None  #: closed state of the model's guide
    #: (p, n, 3) mm or None, derivatives of the positions with respect to the parameters, if known
    slopes: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Logarithms of positive parameters; a field's coefficients times its deviation of log E_f.

    A stiffening alpha becomes a fraction of log(1 + alpha), which is finite without stiffening.
    """

    units: FloatArray  #: (p,), change of log E_f per coefficient of a field; factor on a logarithm
    #: (p,), added to a parameter before its logarithm is taken; NaN for coefficients of a field
    offsets: FloatArray

    @classmethod
    def of(cls, names: tuple[str, ...], settings: MechanicsSettings) -> Coordinates:
        """Coordinates of the named parameters under the settings of a model."""
        units, offsets = [], []
        for name in names:
            parameter = Parameter(name, 0.0)
            stiffens, positive = parameter.kind == "stiffening", is_positive(name)
            field = 1.0 if positive else settings.fields[parameter.region].std_log
            units.append(STIFFENED if stiffens else field)
            offsets.append(np.nan if not positive else 1.0 if stiffens else 0.0)
        return cls(np.array(units), np.array(offsets))

    def __call__(self, m: FloatArray) -> FloatArray:
        """Coordinates ``(p,)`` of parameters ``(p,)``; infinite or NaN without a logarithm."""
        positive = ~np.isnan(self.offsets)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.units * np.where(
                positive, np.log(np.where(positive, m + self.offsets, 1)), m
            )

    def parameters(self, at: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` with the coordinates ``at (p,)``."""
        own, positive = at / self.units, ~np.isnan(self.offsets)
        return np.where(positive, np.exp(np.where(positive, own, 0.0)) - self.offsets, own)

    def rounded(self, m: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` at the nearest lattice point."""
        return self.parameters(np.round(self(m) / SPACING) * SPACING)

    def distance(self, start: FloatArray, end: FloatArray) -> float:
        """Largest change of a coordinate between two parameter sets; infinite if undefined."""
        largest = np.abs(self(end) - self(start)).max()
        return float(largest) if np.isfinite(largest) else np.inf

    def between(self, start: FloatArray, end: FloatArray, largest: float) -> list[FloatArray]:
        """Intermediate parameters, such that no coordinate changes by more than ``largest``."""
        distance = self.distance(start, end)
        n = int(np.ceil(distance / largest)) if np.isfinite(distance) else 0
        one, other = self(start), self(end)
        return [self.parameters(one + (other - one) * k / n) for k in range(1, n)]

    def expected_move(self, closed: ClosedState, m: FloatArray) -> FloatArray | None:
        """First-order move ``(n, 3)`` mm of a closed state to ``m``; None if unknown."""
        if closed.slopes is None or not np.isfinite(self.distance(closed.at, m)):
            return None
        # Derivatives of the parameters with respect to their coordinates.
        rates = np.where(np.isnan(self.offsets), 1.0, closed.at + self.offsets) / self.units
        return np.tensordot(rates * (self(m) - self(closed.at)), closed.slopes, 1)
