"""The configured errors of an observation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mvest.observation.errors import (
    AnnulusOffset,
    CoaptationDropout,
    CorrelatedNoise,
    ObservationError,
    SpatialCorrelation,
    WhiteNoise,
)
from mvest.valve.anatomy.valve import LeafletSurface

Values = Mapping[str, Any]


class Correlations:
    """Correlations between the vertices of a surface, each length factorised once."""

    def __init__(self, surface: LeafletSurface) -> None:
        self.surface = surface
        self._made: dict[float, SpatialCorrelation] = {}

    def __call__(self, length: float) -> SpatialCorrelation:
        """The correlation of one length, mm."""
        if length not in self._made:
            self._made[length] = SpatialCorrelation(self.surface.vertices, length)
        return self._made[length]


def observation_errors(
    settings: Values, correlations: Correlations
) -> tuple[ObservationError, ...]:
    """The configured errors that are not zero, in the order in which they arise."""
    offset = settings["annulus_offset_mm"]
    made: list[ObservationError] = [AnnulusOffset(tuple(offset))] if np.any(offset) else []
    made.append(WhiteNoise(settings["noise_mm"]))
    if settings["correlated_mm"]:
        correlation = correlations(settings["correlation_length_mm"])
        made.append(CorrelatedNoise(settings["correlated_mm"], correlation))
    if settings["dropout_mm"]:
        made.append(CoaptationDropout(settings["dropout_mm"], correlations.surface))
    return tuple(made)
