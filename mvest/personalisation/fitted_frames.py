"""The frames that are fitted, and how a prediction is compared with them.

Where vertices are known again they are compared one by one; elsewhere the points of a frame with
the predicted surface, which is drawn finer and smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.surfaces import (
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
)
from mvest.observation.vertices import Observation
from mvest.personalisation.settings import PaperSettings, PersonaliseSettings
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.triangles import directed_edges

BORDER = 3.0
"""Standard deviations from the border of the leaflets within which points are not compared."""

MAX_VERTICES = 2000
"""Vertices of a frame that are compared: more, nearer to each other than errors are alike, say
nothing new, and their correlation is factorised."""

DRAWN, WIDTH = 0.3, 0.5
"""mm, edges of the predicted surface that points are compared with, and over which it is smoothed.
Facets as they are predicted are up to 0.1 mm off where leaflets bend, and their normals jump."""

BLUR, BLURRED_MM = 1.5, 0.5
"""Width for a first estimate, and standard deviation below which no point is then believed (mm): a
leaflet that is some millimetres away attracts smoothly, and what is beside it does not."""

SURFACE_MM = 0.1
"""mm, standard deviation below which no single point of a surface is believed where vertices do not
correspond: between them both surfaces are only drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedFrames:
    """The frames of a case that are fitted.

    Attributes
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    valve : Valve
        Whose closure is predicted.
    several : tuple of str, optional
        Names of several fitted frames in the order in which they are predicted, the closed last.
    """

    case: ValveCase
    settings: PersonaliseSettings
    valve: Valve
    several: tuple[str, ...] | None

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames, in the order in which they are predicted, the closed last."""
        if self.several is None:
            return (self.case.frame(Role.CLOSED),)
        by_name = {frame.name: frame for frame in self.case.frames}
        return tuple(by_name[name] for name in self.several)

    @property
    def corresponding(self) -> bool:
        """Whether vertices are compared one by one."""
        return self.settings.correspondence and all(one.corresponds for one in self.frames)

    def length(self, *, stated: bool = False) -> float:
        """Over how many mm errors are alike: as the case states, always so if ``stated``.

        Where samples tell how errors are alike, what is beside them is taken for independent. Were
        it smooth too, the filter would trust the finest detail of a closed leaflet most, which no
        mesh and no image have right: moduli of two simulated patients then came out two to four
        times too high, and the fitted valve farther from the frame than the generic one.
        """
        sampled = self.case.error_samples is not None and not stated
        return 0.0 if sampled else self.case.uncertainty.correlation_length_mm

    def observation(self, *, stated: bool = False) -> Observation | SurfaceObservation:
        """The frames that are fitted, with the uncertainty of single observations.

        That is what the case states (see `length`); independent where it is to be learned.
        """
        uncertainty = self.case.uncertainty
        std = uncertainty.typical_mm
        learned = self.settings.errors is not None
        length = 0.0 if learned else self.length(stated=stated)
        scale = uncertainty.std_mm / std if isinstance(uncertainty.std_mm, np.ndarray) else None
        names = self.several or ("closed",)
        predicted = ("open", *names)
        if self.corresponding:
            correlation = (
                SpatialCorrelation(self.case.surface.vertices, length) if length > 0 else None
            )
            kept = _thinned(len(self.frames[-1].vertices))[:, None]
            seen = np.stack([np.where(kept, frame.vertices, np.nan) for frame in self.frames])
            return Observation(names, seen, np.array(std**2), correlation, scale, predicted)
        points = tuple(
            self._points(name, frame, scale) for name, frame in zip(names, self.frames, strict=True)
        )
        return SurfaceObservation(points, self._surface(DRAWN, WIDTH), std, length, predicted)

    def blurred(self) -> SurfaceObservation:
        """Surfaces that are seen through a blur; see `BLUR`."""
        plain = self.observation()
        assert isinstance(plain, SurfaceObservation)
        return replace(plain, surface=self._surface(0.5 * BLUR, BLUR))

    def as_in_paper(self, paper: PaperSettings) -> Observation | SurfaceObservation:
        """All of the frames, with the paper's independent R."""
        seen = self.observation()
        if isinstance(seen, Observation):
            return replace(
                seen,
                positions=np.stack([frame.vertices for frame in self.frames]),
                variance=np.array(paper.R),
                correlation=None,
                scale=None,
            )
        std = float(np.sqrt(paper.R))
        return replace(
            seen,
            seen=tuple(replace(each, scale=None) for each in seen.seen),
            std_mm=std,
            correlation_length_mm=0.0,
        )

    def _surface(self, edge: float, width: float) -> PredictedSurface:
        """The predicted surface that points are compared with; see `PredictedSurface`."""
        return PredictedSurface.of_valve(self.valve, edge, width)

    def _points(self, name: str, frame: Frame, scale: FloatArray | None) -> ObservedSurface:
        """What is compared of a frame whose vertices are not known again."""
        uncertainty, region = self.case.uncertainty, _vertex_region(frame)
        border, kept = BORDER * uncertainty.typical_mm, _thinned(len(frame.vertices))
        points = ObservedSurface(
            name,
            frame.vertices[kept],
            region[kept],
            frame.free_edge,
            scale=None if scale is None else scale[kept],
        )
        far = 1.0 if points.scale is None else points.scale
        alike = self.settings.errors is not None or uncertainty.correlation_length_mm > 0
        if alike:
            # Beyond its border the surface goes on, but where it bends not as it does here.
            points = points.beyond(_rim(frame), frame.vertices, border * far)
        return replace(points, free_edge_region=_edge_region(frame, region, border))


def _thinned(n: int) -> BoolArray:
    """Which of n vertices are compared: all, or evenly spread ones if there are very many."""
    kept = np.zeros(n, dtype=np.bool_)
    kept[:: -(-n // MAX_VERTICES)] = True
    return kept


def _vertex_region(frame: Frame) -> IntArray:
    """The leaflet of each vertex of a frame ``(q,)``, ``UNKNOWN`` on the line between two."""
    n = len(frame.vertices)
    low, high = np.full(n, np.iinfo(np.int64).max), np.full(n, -1)
    np.minimum.at(low, frame.triangles.ravel(), np.repeat(frame.region, 3))
    np.maximum.at(high, frame.triangles.ravel(), np.repeat(frame.region, 3))
    return np.where(low == high, low, UNKNOWN)


def _edge_region(frame: Frame, region: IntArray, border: float) -> IntArray:
    """The leaflet of each point of the free edge ``(j,)``, ``UNKNOWN`` near to where two meet.

    ``border`` is how near, in mm, and ``region (q,)`` that of the vertices.
    """
    own = region[cKDTree(frame.vertices).query(frame.free_edge)[1]]
    between = cKDTree(frame.vertices[region == UNKNOWN]).query(frame.free_edge)[0]
    return np.where(between < border, UNKNOWN, own)


def _rim(frame: Frame) -> IntArray:
    """The border of a frame's surface, as triangles without area ``(e, 3)``."""
    edges = np.sort(directed_edges(frame.triangles), axis=1)
    once, count = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(once[count == 1][:, [0, 1, 1]])
