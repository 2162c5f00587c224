"""Derivatives of a model that gives none, by differences of its predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import ConfigurationError, InputError
from mvest.typing import FloatArray

SCHEMES = ("central", "forward")


@dataclass(frozen=True, slots=True)
class Differences:
    """Difference quotients ``(h(m + d) - h(m - d)) / 2d`` or ``(h(m + d) - h(m)) / d``.

    Central ones cost two runs for each parameter and err by the square of the step, forward ones
    cost one and err by the step itself. A program that solves to a tolerance puts that tolerance,
    divided by the step, on top: the step is not to be small beside it.

    Attributes
    ----------
    scheme : str
        ``central`` or ``forward``.
    relative_step : float
        Part of a parameter's size by which it is changed.
    floor : float
        Size that a parameter has at least, in its unit: needed where one may be zero.
    processes : int
        Runs at a time.
    """

    scheme: str = "central"
    relative_step: float = 1e-3
    floor: float = 0.0
    processes: int = 1

    def __post_init__(self) -> None:
        if self.scheme not in SCHEMES:
            raise ConfigurationError(
                f"differences scheme = {self.scheme!r}, expected one of {', '.join(SCHEMES)}"
            )
        if not 0 < self.relative_step < 1:
            raise ConfigurationError(
                f"relative_step = {self.relative_step}, expected between 0 and 1"
            )
        if not (np.isfinite(self.floor) and self.floor >= 0):
            raise ConfigurationError(f"floor = {self.floor}, expected at least 0")
        if self.processes < 1:
            raise ConfigurationError(f"processes = {self.processes}, expected at least 1")

    def neighbours(self, m: FloatArray) -> FloatArray:
        """Parameters ``(k, p)`` at which the model is to be run: upper ones, then lower ones.

        Raises
        ------
        InputError
            If a parameter is so small that its step has no size.
        """
        step = self.relative_step * np.maximum(np.abs(m), self.floor)
        if not np.all(m + step != m):
            k = int(np.flatnonzero(m + step == m)[0])
            raise InputError(
                f"parameter {k} is {m[k]:g}: a relative step of it is none; expected a floor, its "
                "usual size"
            )
        moves = np.diag(step)
        return np.concatenate([m + moves, m - moves] if self.scheme == "central" else [m + moves])

    def jacobian(self, m: FloatArray, y: FloatArray, predicted: Sequence[FloatArray]) -> FloatArray:
        """Derivatives ``(n, p)`` from predictions ``(n,)`` at `neighbours`, in their order."""
        points, values = self.neighbours(m), np.array(predicted)
        p = m.size
        if self.scheme == "central":
            # What the parameters really differ by, rounding included.
            change = np.diagonal(points[:p] - points[p:])
            return np.asarray(((values[:p] - values[p:]).T) / change)
        return np.asarray((values - y).T / np.diagonal(points - m))
