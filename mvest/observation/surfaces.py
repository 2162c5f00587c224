"""Observing surfaces without point correspondence: points and curves.

A frame is seen as points somewhere on the leaflets and as a curve along the free edge. They are
compared with the predicted surface, which is refined and smoothed: on facets, derivatives jump
across creases; points on the same closed valve were up to 0.3 mm off, and no estimate converged.

* A point is compared by its signed distance to its own leaflet (`smooth_distances`). Beyond the
  border the surface is extrapolated.
* A point of the curve is compared by the two components of its offset across the observed curve
  (`smooth_offsets`). They have no kink at zero, as a distance in space has, and a point across a
  curve carries no more information. If its leaflet is known, it is compared with the edge of that
  leaflet, since in a closed valve the edge of the other is close by.

Sliding along the surface or the curve changes neither. The derivatives are exact.

Limits:

* If two parts of a surface are equally near (in a fold, or between leaflets for points of unknown
  leaflet), the distance has a kink; the derivative is that of one of them.
* Errors that are rougher than stated, as independent ones are, show in a normalised innovation far
  above one per observation.
* A point counts at any distance; remove outliers first.
* Noise of s in every coordinate shifts distances by about k s² on average, where k is the mean
  curvature: 0.025 mm for s = 0.5 mm at a bend of radius 5 mm (k = 0.1/mm).
* Points must lie on what the model predicts, the midsurface of the leaflets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array

from mvest.errors import InputError, require_numbers
from mvest.estimation.noise import NoiseCovariance, observation_noise, scaled_noise, stacked_noise
from mvest.estimation.prediction import ObservationModel, Prediction, read_only, require_finite
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.vertices import FRAMES, observed_frames, require_frames, scales
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import Valve, lumped_areas
from mvest.valve.geometry.moving_distance import across_curve, smooth_distances, smooth_offsets
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import directed_edges, refined

UNKNOWN = -1
"""Region of a point that may belong to any leaflet."""


@dataclass(frozen=True, slots=True, eq=False)
class ObservedSurface:
    """One frame seen without correspondence.

    InputError on wrong shapes, values that are not finite, and curves whose points coincide.
    """

    frame: str  #: name of the frame that the model predicts
    points: FloatArray  #: (q, 3) mm, points on the leaflets
    region: IntArray  #: (q,), leaflet of each point, or ``UNKNOWN`` (-1)
    #: (j, 3) mm or None, closed curve along the free edge; the last point joins the first
    free_edge: FloatArray | None = None
    #: (q,) or None, standard deviation of each point over that of the observation; None: all 1
    scale: FloatArray | None = None
    #: (j,) or None, leaflet of each point of the free edge, with whose edge alone it is compared;
    #: ``UNKNOWN`` for points that are not compared. None: all are compared with the whole edge.
    free_edge_region: IntArray | None = None

    def __post_init__(self) -> None:
        where = f"seen in frame {self.frame}"
        checked = {"points": _points(f"points {where}", self.points)}
        q, j = len(checked["points"]), 0
        if self.free_edge is not None:
            checked["free_edge"] = curve = _points(f"free edge {where}", self.free_edge)
            j = len(curve)
            if j < 3:
                raise InputError(f"free edge {where}: {j} points, expected three or more")
            repeated = np.flatnonzero(np.all(np.roll(curve, -1, axis=0) == curve, axis=1))
            if repeated.size:
                raise InputError(
                    f"free edge {where}: point {repeated[0]} is the same as the next one; expected "
                    "different points, the first not repeated at the end"
                )
        if self.scale is not None:
            checked["scale"] = scales(f"scale of the points {where}", self.scale, q)
        numbers = {"region": _regions(f"regions {where}", self.region, q)}
        if self.free_edge_region is not None:
            what = f"regions of the free edge {where}"
            numbers["free_edge_region"] = _regions(what, self.free_edge_region, j)
        for name, values in {**checked, **numbers}.items():
            object.__setattr__(self, name, values)

    def beyond(
        self, triangles: IntArray, vertices: FloatArray, distance: float | FloatArray
    ) -> ObservedSurface:
        """The same without the points nearer than ``distance`` mm to some triangles.

        ``distance`` is one number or one for each point ``(q,)``.
        """
        keep = surface_distance(self.points, vertices, triangles) >= distance
        scale = None if self.scale is None else self.scale[keep]
        return replace(self, points=self.points[keep], region=self.region[keep], scale=scale)

    def apart(
        self, distance: float, points: FloatArray, edge: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Places ``(q, 3)`` of the points and of the compared ones of the free edge.

        Those of different leaflets are moved ``distance`` mm apart, since errors of different
        leaflets are independent, and so are errors of distant points.
        """
        every = [points] if edge is None else [points, edge]
        distance += float(np.ptp(np.concatenate(every), axis=0).max())
        points = points + distance * self.region[:, None]
        if edge is None:
            return points, np.zeros((0, 3))
        if (region := self.free_edge_region) is not None:
            edge = edge + distance * region[:, None]
        return points, edge[self.compared]

    @property
    def compared(self) -> BoolArray:
        """Which points of the free edge ``(j,)`` are compared."""
        if self.free_edge_region is not None:
            return np.asarray(self.free_edge_region != UNKNOWN)
        return np.ones(0 if self.free_edge is None else len(self.free_edge), dtype=np.bool_)

    @property
    def size(self) -> int:
        """Number of observations: one for each point, two for each point of the free edge."""
        return len(self.points) + 2 * int(self.compared.sum())

    def by_region(self) -> Iterator[tuple[int, BoolArray]]:
        """Each region with a mask of its points ``(q,)``."""
        for region in np.unique(self.region):
            yield int(region), self.region == region


@dataclass(frozen=True, slots=True, eq=False)
class PredictedSurface:
    """A refined and smoothed surface through the positions that a model predicts."""

    #: (m, 3), of the refined vertices; their normals point to one side throughout
    triangles: IntArray
    region: IntArray  #: (m,), leaflet of each triangle
    weights: csr_array  #: (r, n) sparse, the refined vertices in terms of the predicted ones
    width: float  #: mm, over which the surface is smoothed
    #: (e,) or None, refined vertices in loop order; None if the curve is not compared
    free_edge: IntArray | None = None

    @classmethod
    def refined(
        cls,
        rest: FloatArray,
        triangles: IntArray,
        region: IntArray,
        free_edge: IntArray | None,
        edge_length: float,
        width: float,
    ) -> PredictedSurface:
        """The surface of vertices ``rest (n, 3)`` mm, with edges of a length in mm."""
        loops = () if free_edge is None else (free_edge,)
        fine = refined(rest, triangles, edge_length, loops)
        edge = fine.loops[0] if loops else None
        return cls(fine.triangles, region[fine.parent], fine.weights, width, edge)

    @classmethod
    def of_valve(cls, valve: Valve, edge_length: float, width: float) -> PredictedSurface:
        """The surface of a valve whose vertices a model predicts, with the free edge."""
        own = valve.surface
        return cls.refined(
            own.vertices, own.triangles, own.region, valve.free_edge, edge_length, width
        )

    @property
    def size(self) -> int:
        """Number n of vertices that the model predicts in each frame."""
        return int(self.weights.shape[1])

    def drawn(self, predicted: FloatArray) -> FloatArray:
        """Values at the refined vertices from the predicted ones ``(n, ...)``."""
        flat = self.weights @ predicted.reshape(len(predicted), -1)
        return np.asarray(flat).reshape(flat.shape[0], *predicted.shape[1:])

    def leaflet_along(self, loop: IntArray) -> IntArray:
        """Leaflet of each edge ``(e,)`` of a loop on the border, from each vertex to the next."""
        sides = np.sort(directed_edges(self.triangles), axis=1) @ [1 << 32, 1]
        order = np.argsort(sides)
        ends = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1) @ [1 << 32, 1]
        return self.region[order[np.searchsorted(sides[order], ends)] % len(self.triangles)]

    def leaflet(self, region: int) -> IntArray:
        """Triangles of one leaflet, of all if it is ``UNKNOWN``."""
        return self.triangles if region == UNKNOWN else self.triangles[self.region == region]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceObservation:
    """Frames seen without correspondence, with the assumed noise.

    The observation of each frame is the distances of its points, then two components of each point
    of the free edge. The model predicts these distances; zero is observed.

    InputError on inadmissible standard deviations, frames, or curves and leaflets that the model's
    surface does not have.
    """

    #: tuple of ObservedSurface, (f,), one for each observed frame, the closed one last
    seen: tuple[ObservedSurface, ...]
    surface: PredictedSurface
    #: standard deviation of the points along the normal, and of each component of the points of the
    #: free edge
    std_mm: float
    #: correlation length of the errors of the distances, and of those of the free edge, within a
    #: frame and a leaflet, see `SpatialCorrelation`; 0: independent
    correlation_length_mm: float = 0.0
    #: frames that the model predicts, in the order in which it stacks them
    predicted: tuple[str, ...] = FRAMES
    R: NoiseCovariance = field(init=False, repr=False)  #: covariance in mm² of the observation

    def __post_init__(self) -> None:
        object.__setattr__(self, "seen", tuple(self.seen))
        require_frames(self.frames, self.predicted)
        if not any(len(seen.points) or seen.free_edge is not None for seen in self.seen):
            raise InputError("nothing is seen: no frame has a point or a curve")
        require_numbers(self, "observation", "std_mm")
        require_numbers(self, "observation", "correlation_length_mm", least=0)
        for seen in self.seen:
            missing = set(seen.region.tolist()) - {UNKNOWN, *self.surface.region.tolist()}
            if missing:
                raise InputError(
                    f"frame {seen.frame}: points of region {min(missing)}, of which the model's "
                    f"surface has no triangle"
                )
            if seen.free_edge is not None and self.surface.free_edge is None:
                raise InputError(
                    f"frame {seen.frame}: the free edge is seen, but the model's surface has none"
                )
        object.__setattr__(self, "R", self._noise())

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames."""
        return tuple(seen.frame for seen in self.seen)

    @property
    def y(self) -> FloatArray:
        """Zeros: distances of the seen points to the seen surface."""
        return np.zeros(sum(self.sizes))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Length of each frame's part of ``y``."""
        return tuple(seen.size for seen in self.seen)

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """The distances of the observation to what a model predicts.

        ``aux`` of a prediction are the observed frames with all vertices, (f, n, 3) mm.

        ``model``: predicts the stacked positions ``(3 n f,)`` mm of all frames of ``predicted``.
        """
        observed, n = observed_frames(model, self.frames, None, self.predicted), self.surface.size

        def distances(m: FloatArray) -> Prediction:
            prediction = observed(m)
            if not prediction.converged:
                return prediction
            if prediction.y.size != 3 * n * len(self.frames):
                raise InputError(
                    f"the model predicts {prediction.y.size} coordinates of the frames "
                    f"{', '.join(self.frames)}; expected 3 of each of {n} vertices in each"
                )
            whole = prediction.y.reshape(len(self.frames), n, 3)
            motion = prediction.jacobian.reshape(*whole.shape, -1)
            parts = [
                part
                for seen, vertices, moved in zip(self.seen, whole, motion, strict=True)
                for part in self._of_frame(seen, vertices, moved)
            ]
            y, jacobian = (np.concatenate(column) for column in zip(*parts, strict=True))
            return replace(prediction, y=y, jacobian=jacobian)

        return distances

    def places(
        self, distance: float, shape: FloatArray | None = None
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Of each frame the points and the compared points of the free edge, see `apart`.

        With ``shape (f, n, 3)`` mm, the places of predicted frames that are nearest to them.
        """
        surface = self.surface
        for k, seen in enumerate(self.seen):
            points, edge, loop = seen.points, seen.free_edge, surface.free_edge
            if shape is not None:
                drawn, points = surface.drawn(shape[k]), np.empty_like(points)
                for region, own in seen.by_region():
                    points[own] = nearest(seen.points[own], drawn, surface.leaflet(region))
                if edge is not None and loop is not None:
                    # Triangles without area.
                    edge = nearest(edge, drawn, np.stack([loop, *2 * [np.roll(loop, -1)]], axis=1))
            yield seen.apart(distance, points, edge)

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Unsigned distances ``(q,)`` mm of the last frame's points to fitted ``(f, n, 3)``."""
        seen, distance = self.seen[-1], np.empty(len(self.seen[-1].points))
        vertices = self.surface.drawn(fitted[-1])
        for region, members in seen.by_region():
            triangles = self.surface.leaflet(region)
            distance[members] = surface_distance(seen.points[members], vertices, triangles)
        return distance

    def _of_frame(
        self, seen: ObservedSurface, vertices: FloatArray, motion: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Distances in a frame to the predicted surface, and their derivatives."""
        surface, kept = self.surface, seen.compared
        drawn, moved = surface.drawn(vertices), surface.drawn(motion)
        h, H = np.empty(len(seen.points)), np.empty((len(seen.points), motion.shape[-1]))
        for region, own in seen.by_region():
            points, triangles = seen.points[own], surface.leaflet(region)
            h[own], H[own] = smooth_distances(points, drawn, moved, triangles, surface.width)
        yield h, H
        if seen.free_edge is None or surface.free_edge is None or not kept.any():
            return
        curve, loop = seen.free_edge, surface.free_edge
        across = across_curve(curve, self.std_mm)[kept]
        same = None
        if seen.free_edge_region is not None:
            same = seen.free_edge_region[kept, None] == surface.leaflet_along(loop)
        yield smooth_offsets(curve[kept], across, drawn[loop], moved[loop], surface.width, same)

    def _noise(self) -> NoiseCovariance:
        parts, length = [], self.correlation_length_mm
        for seen, (points, edge) in zip(self.seen, self.places(1000.0 * length), strict=True):
            for at, scale, coordinates in ((points, seen.scale, 1), (edge, None, 2)):
                if not len(at):
                    continue
                noise = observation_noise(self.std_mm**2, coordinates * len(at))
                if length:
                    noise = SpatialCorrelation(at, length).noise(self.std_mm**2, coordinates)
                parts.append(noise if scale is None else scaled_noise(noise, scale))
        return stacked_noise(parts)


def nearest(points: FloatArray, vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Places ``(q, 3)`` of a surface that are nearest to points ``(q, 3)``."""
    return closest_points(points, vertices, triangles).interpolate(vertices, triangles)


def surface_distance(points: FloatArray, vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Unsigned distances ``(q,)`` mm of points ``(q, 3)`` to a surface, for reporting."""
    return closest_points(points, vertices, triangles).distance


def mean_surface_distance(
    a: FloatArray, triangles_a: IntArray, b: FloatArray, triangles_b: IntArray
) -> float:
    """Mean distance (mm) between two surfaces, averaged over both directions.

    Vertices ``(n, 3)`` mm are weighted by their area, so that the density of the triangulation
    does not matter.
    """
    ways = ((a, triangles_a, b, triangles_b), (b, triangles_b, a, triangles_a))
    means = [
        np.average(surface_distance(x, y, other), weights=lumped_areas(x, own))
        for x, own, y, other in ways
    ]
    return float(np.mean(means))


def _points(what: str, values: FloatArray) -> FloatArray:
    points = np.array(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{what}: shape {points.shape}, expected (q, 3) mm")
    require_finite(points, what)
    return read_only(points)


def _regions(what: str, values: IntArray, size: int) -> IntArray:
    given = np.asarray(values)
    if given.shape != (size,):
        raise InputError(f"{what}: shape {given.shape}, expected ({size},)")
    if size and (not np.issubdtype(given.dtype, np.integer) or given.min() < UNKNOWN):
        raise InputError(f"{what}: {given.min()}, expected integers from {UNKNOWN} on")
    regions = np.array(given, dtype=np.int64)
    regions.setflags(write=False)
    return regions
