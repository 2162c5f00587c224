"""The fitted frames and their comparison with a prediction.

Corresponding vertices are compared one by one. Otherwise the points of a frame are compared with
the predicted surface, refined and smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.estimation.prediction import Prediction
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.surfaces import (
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
)
from mvest.observation.vertices import Observation
from mvest.personalisation.settings import PaperSettings, PersonaliseSettings
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.triangles import directed_edges

BORDER = 3.0
"""Standard deviations from the border of the leaflets within which points are not compared."""

MAX_VERTICES = 2000
"""Compared vertices of a frame. More are closer than the correlation length of their errors, so
they add nothing, and their correlation matrix is factorised."""

DRAWN, WIDTH = 0.3, 0.5
"""mm, edge length and smoothing width of the predicted surface that points are compared with. The
predicted facets are up to 0.1 mm off where leaflets bend, and their normals jump."""

BLUR, BLURRED_MM = 1.5, 0.5
"""mm, smoothing width of a first estimate, and its least standard deviation of a point. A leaflet
that is some millimetres away then attracts smoothly, and its neighbours do not."""

SURFACE_MM = 0.1
"""mm, least standard deviation of a point of a surface without correspondence, since both surfaces
are interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedFrames:
    """The fitted frames of a case."""

    case: ValveCase
    settings: PersonaliseSettings
    valve: Valve  #: of the closure
    #: Names of several fitted frames in the order of prediction, the closed frame last.
    several: tuple[str, ...] | None
    #: (f, n, 3) mm, the frames as a closed valve near them shows them, where errors of surfaces are
    #: correlated (`mvest.observation.learned.error_family`)
    near: FloatArray | None = None

    def beside(self, prediction: Prediction) -> FittedFrames:
        """The same near a closed valve, if it is closed."""
        if not prediction.converged:
            return self
        return replace(self, near=prediction.y.reshape(-1, *self.case.surface.vertices.shape)[1:])

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames in the order of prediction, the closed frame last."""
        if self.several is None:
            return (self.case.frame(Role.CLOSED),)
        by_name = {frame.name: frame for frame in self.case.frames}
        return tuple(by_name[name] for name in self.several)

    @property
    def corresponding(self) -> bool:
        """Whether vertices are compared one by one."""
        return all(one.corresponds for one in self.frames)

    @property
    def length(self) -> float:
        """Correlation length of errors in mm: as stated, or 0 besides error samples.

        With a smooth remainder the filter would trust the finest detail of a closed leaflet most,
        which neither mesh nor image resolves: moduli of two simulated patients came out two to four
        times too high, and the fitted valve farther from the frame than the generic one.
        """
        sampled = self.case.error_samples is not None
        return 0.0 if sampled else self.case.uncertainty.correlation_length_mm

    def observation(self) -> Observation | SurfaceObservation:
        """The fitted frames with the stated uncertainty, independent if it is to be learned.

        Without correspondence all points have the typical one.
        """
        uncertainty = self.case.uncertainty
        std = uncertainty.typical_mm
        length = 0.0 if self.settings.errors is not None else self.length
        names = self.several or ("closed",)
        predicted = ("open", *names)
        if not self.corresponding:
            frames = zip(names, self.frames, strict=True)
            points = tuple(self._points(name, frame) for name, frame in frames)
            surface = PredictedSurface.of_valve(self.valve, DRAWN, WIDTH)
            return SurfaceObservation(points, surface, std, length, predicted)
        scale = uncertainty.std_mm / std if isinstance(uncertainty.std_mm, np.ndarray) else None
        correlation = SpatialCorrelation(self.case.surface.vertices, length) if length > 0 else None
        some = _thinned(len(self.frames[-1].vertices))[:, None]
        seen = np.stack([np.where(some, frame.vertices, np.nan) for frame in self.frames])
        return Observation(names, seen, np.array(std**2), correlation, scale, predicted)

    def blurred(self) -> SurfaceObservation:
        """Surfaces blurred for a first estimate; see `BLUR`."""
        plain = self.observation()
        assert isinstance(plain, SurfaceObservation)
        return replace(plain, surface=PredictedSurface.of_valve(self.valve, 0.5 * BLUR, BLUR))

    def as_in_paper(self, paper: PaperSettings) -> Observation | SurfaceObservation:
        """All of the frames, with the paper's independent R."""
        seen = self.observation()
        if isinstance(seen, Observation):
            positions = np.stack([frame.vertices for frame in self.frames])
            R = np.array(paper.R)
            return replace(seen, positions=positions, variance=R, correlation=None, scale=None)
        return replace(seen, std_mm=float(np.sqrt(paper.R)), correlation_length_mm=0.0)

    def _points(self, name: str, frame: Frame) -> ObservedSurface:
        """The compared points of a frame without correspondence."""
        n, uncertainty = len(frame.vertices), self.case.uncertainty
        low, high = np.full(n, np.iinfo(np.int64).max), np.full(n, -1)
        np.minimum.at(low, frame.triangles.ravel(), np.repeat(frame.region, 3))
        np.maximum.at(high, frame.triangles.ravel(), np.repeat(frame.region, 3))
        region = np.where(low == high, low, UNKNOWN)
        border, some = BORDER * uncertainty.typical_mm, _thinned(n)
        points = ObservedSurface(name, frame.vertices[some], region[some], frame.free_edge)
        if self.settings.errors is not None or uncertainty.correlation_length_mm > 0:
            # Beyond its border the surface is extended, but does not bend as the leaflet does.
            edges = np.sort(directed_edges(frame.triangles), axis=1)
            once, count = np.unique(edges, axis=0, return_counts=True)
            rim = np.asarray(once[count == 1][:, [0, 1, 1]])  # triangles without area
            points = points.beyond(rim, frame.vertices, border)
        # Near the line between two leaflets the free edge may belong to either.
        own = region[cKDTree(frame.vertices).query(frame.free_edge)[1]]
        between = cKDTree(frame.vertices[region == UNKNOWN]).query(frame.free_edge)[0]
        return replace(points, free_edge_region=np.where(between < border, UNKNOWN, own))


def _thinned(n: int) -> BoolArray:
    """Which of n vertices are compared: all, or an even selection of very many."""
    some = np.zeros(n, dtype=np.bool_)
    some[:: -(-n // MAX_VERTICES)] = True
    return some
