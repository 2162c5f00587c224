"""What errors of the frames that a model is built from do to what it predicts.

Each error sample of a case is a valve of its own: its open shape, boundary and chordae are built
and closed with the parameters at which an estimation begins. How far its closed valve moves against
that of the case, less how far its closed frame is moved, is one sample of the error of the
innovation, that of the observation included. Closures are those of the guide's mesh where there is
one: of the differences, 0.5 mm, it is off by a tenth (24 x 3 cells against 40 x 5, simulated).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.displaced import displaced_case
from mvest.closure.model import ClosureModel
from mvest.errors import MvestError
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.personalise.model import build_coarse
from mvest.personalise.settings import PersonaliseSettings
from mvest.problem.problem import Observed
from mvest.typing import FloatArray

__all__ = ["GeometryErrors", "WeighedObservation", "errors_of", "sample_geometry"]

MAX_FAILED_SHARE = 0.25
"""Share of the samples that need not close; those that do not are counted and reported."""


@dataclass(frozen=True, slots=True, eq=False)
class GeometryErrors:
    """Samples of how a prediction moves if the geometry was seen in error.

    Attributes
    ----------
    predicted : (K, n, 3) mm
        Displacement of the predicted closed valve.
    seen : (K, n, 3) mm
        Displacement of the closed frame in the same samples.
    failures : tuple of str
        Why samples were left out: they are no valve, or did not close.
    """

    predicted: FloatArray
    seen: FloatArray
    failures: tuple[str, ...]

    @property
    def asked(self) -> int:
        """Number of samples, those that failed included."""
        return len(self.predicted) + len(self.failures)

    @property
    def too_few(self) -> str:
        """Why the samples that closed do not stand for all; empty if they do."""
        if len(self.failures) <= MAX_FAILED_SHARE * self.asked and len(self.predicted) >= 2:
            return ""
        return (
            f"{len(self.failures)} of {self.asked} error samples do not close, expected at most "
            f"{MAX_FAILED_SHARE:.0%}; the first: {self.failures[0]}"
        )


def sample_geometry(
    case: ValveCase,
    settings: PersonaliseSettings,
    m: FloatArray,
    *,
    store: Path | None = None,
    on_sample: Callable[[int], None] | None = None,
) -> GeometryErrors:
    """Close the valve of every error sample of a case.

    Parameters
    ----------
    case : ValveCase
        With error samples.
    settings : PersonaliseSettings
    m : (p,)
        Parameters of the closure, those of a registration excluded.
    store : Path, optional
        Where an unstructured mesh is kept.
    on_sample : callable, optional
        Progress: called with the number of samples done.
    """
    samples = case.error_samples
    assert samples is not None
    number = next(k for k, frame in enumerate(case.frames) if frame.role is Role.CLOSED)
    n = len(case.surface.vertices)
    first = _closed(build_coarse(case, settings, store), m)
    if isinstance(first, str):
        nothing = np.zeros((0, n, 3))
        return GeometryErrors(
            nothing, nothing, (f"the valve as it was seen: {first}",) * len(samples)
        )
    predicted, seen, failures = [], [], []
    for k in range(len(samples)):
        try:
            closed = _closed(build_coarse(displaced_case(case, k), settings, store), m)
        except MvestError as fault:
            closed = str(fault)
        if isinstance(closed, str):
            failures.append(f"sample {k}: {closed}")
        else:
            predicted.append(closed - first)
            seen.append(samples.vertices[k, number])
        if on_sample is not None:
            on_sample(k + 1)
    shape = (-1, n, 3)
    return GeometryErrors(np.reshape(predicted, shape), np.reshape(seen, shape), tuple(failures))


def _closed(model: ClosureModel, m: FloatArray) -> FloatArray | str:
    """Vertices ``(n, 3)`` mm of the closed valve, or why there are none."""
    prediction = model(m)
    return prediction.y.reshape(2, -1, 3)[1] if prediction.converged else prediction.reason


def errors_of(
    observation: Observed, closed: Frame, generic: FloatArray, geometry: GeometryErrors
) -> FloatArray:
    """Samples of the error of an observation's innovation ``(k, K)`` mm, one in each column.

    Parameters
    ----------
    observation : Observed
        Of the closed frame, by its vertices or by its surface.
    closed : Frame
    generic : array
        Both frames as they are predicted, stacked.
    geometry : GeometryErrors
        About this prediction.
    """
    if isinstance(observation, Observation):
        moved = geometry.predicted - geometry.seen
        return np.asarray(moved[:, observation.seen[0]].reshape(len(moved), -1).T)
    assert isinstance(observation, SurfaceObservation)
    points = observation.seen[-1]
    _, at = cKDTree(closed.vertices).query(points.points)
    edge = None if points.free_edge is None else cKDTree(closed.vertices).query(points.free_edge)[1]
    half = len(generic) // 2
    plain = replace(observation, correlation_length_mm=0.0)

    def distances(what: SurfaceObservation, predicted: FloatArray) -> FloatArray:
        y = np.concatenate([generic[:half], generic[half:] + predicted.ravel()])
        return predict(what.of(lambda _: Prediction.undifferentiated(y)), np.zeros(1)).y

    first = distances(plain, np.zeros(half))
    columns = []
    for predicted, seen in zip(geometry.predicted, geometry.seen, strict=True):
        there = replace(
            points,
            points=points.points + seen[at],
            free_edge=None if edge is None else points.free_edge + seen[edge],
        )
        columns.append(distances(replace(plain, seen=(there,)), predicted) - first)
    return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class WeighedObservation:
    """An observation with another noise.

    Attributes
    ----------
    plain : Observed
    R : NoiseCovariance
    """

    plain: Observed
    R: NoiseCovariance

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames."""
        return self.plain.frames

    @property
    def y(self) -> FloatArray:
        """The observation ``(k,)``."""
        return self.plain.y

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """What a model predicts of this observation."""
        return self.plain.of(model)

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) of what was seen in the last frame to fitted ``(f, n, 3)``."""
        return self.plain.distance(fitted)
