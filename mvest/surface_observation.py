"""What is seen of a valve where no vertex is known again: points and curves without correspondence.

A frame is seen as points somewhere on the leaflets and as curves along the free edge and the
annulus. They are compared with a predicted surface by their distances to it:

* a point with the signed distance ``d = u . (x - c)`` to the closest point c of its own leaflet.
  Inside a triangle u is its unit normal. Where c lies on an edge or a vertex, u is along x - c, on
  the side of the angle-weighted normal there (Baerentzen and Aanaes, IEEE Trans. Vis. Comput.
  Graph. 11 (2005) 243-253, who show that this side is right on any surface without border);
* a point of a curve with the two components of x - c across the curve as it was seen. A distance in
  space has a kink at zero; these have none, and two is what a point across a curve can tell.

Sliding along the surface or the curve changes neither, so only what is seen enters the estimate.
The derivatives are exact. c is where the distance is smallest, so its own sliding does not change
the distance to first order (envelope theorem): ``dd/dm = -u . dc/dm`` with c fixed in the tissue.

What to know:

* Where two parts of a surface are equally near (inside a fold, between leaflets for points of
  unknown leaflet), d has a kink; the derivative is that of one of them.
* Beyond the border of a leaflet d is the distance to the border, and its sign changes across the
  border triangle's plane. Independent errors do not see the sign; correlated ones do.
* A point however far counts, at any distance; outliers are to be removed before.
* Noise of s in every coordinate shifts d by about k s² on average, where k is the mean curvature:
  0.025 mm for s = 0.5 mm at a bend of radius 5 mm (k = 0.1/mm).
* Points are to lie on what the model predicts, the midsurface of the leaflets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError, MaterialError
from mvest.estimation import ObservationModel, Prediction
from mvest.estimation.noise import NoiseCovariance, observation_noise, stacked_noise
from mvest.observation import FRAMES
from mvest.observation_errors import SpatialCorrelation
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy import Valve, lumped_areas
from mvest.valve.proximity import closest_points

__all__ = [
    "UNKNOWN",
    "ObservedSurface",
    "PredictedSurface",
    "SurfaceFrames",
    "SurfaceObservation",
    "mean_surface_distance",
    "surface_distance",
]

UNKNOWN = -1
"""Region of a point that may be of any leaflet."""

MAX_CORRELATED_POINTS = 2000
"""Largest number of points of a frame whose correlation is factorised: 32 MB and half a second."""

TOUCHING = 1e-9
"""Distance in mm below which x - c has no direction of its own."""

TANGENT_REACH = 6.0
"""Standard deviations of a curve's points over which its direction is taken, to each side: the
direction is then known to 1 / (6 sqrt(2)) rad, and 1.4 % of the information across it is lost."""


@dataclass(frozen=True, slots=True, eq=False)
class ObservedSurface:
    """One frame as it was seen, without correspondence.

    Attributes
    ----------
    frame : str
        Name of the frame that the model predicts.
    points : (q, 3) mm
        Points seen on the leaflets.
    region : (q,)
        Leaflet of each point, ``UNKNOWN`` (-1) where it is not known.
    free_edge : (j, 3) mm or None
        Closed curve along the free edge; the last point joins the first.
    annulus : (k, 3) mm or None
        Closed curve along the annulus.

    Raises
    ------
    InputError
        On wrong shapes, values that are not finite, and curves whose points coincide.
    """

    frame: str
    points: FloatArray
    region: IntArray
    free_edge: FloatArray | None = None
    annulus: FloatArray | None = None

    def __post_init__(self) -> None:
        points = _points(f"points seen in frame {self.frame}", self.points)
        region = _numbers(f"regions seen in frame {self.frame}", self.region, UNKNOWN, None)
        if region.shape != (len(points),):
            raise InputError(
                f"frame {self.frame}: regions of shape {region.shape} for {len(points)} points; "
                f"expected one each, {UNKNOWN} where it is not known"
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "region", region)
        for name in ("free_edge", "annulus"):
            if getattr(self, name) is not None:
                what = f"{name} seen in frame {self.frame}"
                object.__setattr__(self, name, _curve(what, getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class PredictedSurface:
    """How the positions that a model predicts form a surface.

    Attributes
    ----------
    n_vertices : int
        Vertices n that the model predicts in each frame.
    triangles : (m, 3)
        Their normals point to one side throughout.
    region : (m,)
        Leaflet of each triangle.
    free_edge, annulus : (e,), (a,) or None
        Vertices in loop order; None if the curve is not to be compared.

    Raises
    ------
    InputError
        On wrong shapes and numbers out of range.
    """

    n_vertices: int
    triangles: IntArray
    region: IntArray
    free_edge: IntArray | None = None
    annulus: IntArray | None = None

    def __post_init__(self) -> None:
        last = self.n_vertices - 1
        triangles = _numbers("triangles", self.triangles, 0, last)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise InputError(f"triangles: shape {triangles.shape}, expected (m, 3)")
        region = _numbers("region", self.region, 0, None)
        if region.shape != (len(triangles),):
            raise InputError(f"region: shape {region.shape}, expected ({len(triangles)},)")
        object.__setattr__(self, "triangles", triangles)
        object.__setattr__(self, "region", region)
        for name in ("free_edge", "annulus"):
            if getattr(self, name) is not None:
                loop = _numbers(name, getattr(self, name), 0, last)
                if loop.ndim != 1 or len(loop) < 3 or len(np.unique(loop)) != len(loop):
                    raise InputError(f"{name}: expected a loop of three or more different vertices")
                object.__setattr__(self, name, loop)

    @classmethod
    def of_valve(cls, valve: Valve) -> PredictedSurface:
        """The surface of a valve whose vertices a model predicts, with both curves."""
        surface = valve.surface
        n = len(surface.vertices)
        return cls(n, surface.triangles, surface.region, valve.free_edge, valve.annulus)

    def of(self, region: int) -> IntArray:
        """Triangles of one leaflet, of all if it is ``UNKNOWN``."""
        return self.triangles if region == UNKNOWN else self.triangles[self.region == region]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceObservation:
    """What was seen without correspondence, and how well.

    The observation of each frame is the distances of its points, then two components of each point
    of the free edge and of the annulus. What is predicted are these distances; observed is zero.

    Attributes
    ----------
    seen : tuple of ObservedSurface, (f,)
        One for each observed frame, the closed one last.
    surface : PredictedSurface
    std_mm : float
        Standard deviation of the seen points along the normal.
    curve_std_mm : float or None
        Of each component of the points of the curves; None if there are none.
    correlation_length_mm : float
        Over which the errors of the distances are alike, see ``SpatialCorrelation``, within a frame
        and a leaflet; 0: independent. Errors of the curves are independent.
    R : NoiseCovariance
        Covariance in mm² of the observation.

    Raises
    ------
    InputError
        On inadmissible standard deviations, frames, or curves and leaflets that the model's surface
        does not have; and if more than ``MAX_CORRELATED_POINTS`` points are to be correlated.
    """

    seen: tuple[ObservedSurface, ...]
    surface: PredictedSurface
    std_mm: float
    curve_std_mm: float | None = None
    correlation_length_mm: float = 0.0
    R: NoiseCovariance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "seen", tuple(self.seen))
        if len(set(self.frames)) != len(self.frames):
            raise InputError(f"observed frames {list(self.frames)}, expected different ones")
        if not any(len(seen.points) or _curves(seen, self.surface) for seen in self.seen):
            raise InputError("nothing is seen: no frame has a point or a curve")
        _require_std("std_mm", self.std_mm)
        for seen in self.seen:
            self._require_counterpart(seen)
        length = self.correlation_length_mm
        if not (np.isfinite(length) and length >= 0.0):
            raise InputError(f"correlation_length_mm = {length}, expected >= 0")
        object.__setattr__(self, "R", self._noise())

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames."""
        return tuple(seen.frame for seen in self.seen)

    @property
    def y(self) -> FloatArray:
        """Zeros: the seen points have no distance to the surface that was seen."""
        return np.zeros(sum(self._size(seen) for seen in self.seen))

    def of(self, model: ObservationModel, all_frames: Sequence[str] = FRAMES, /) -> SurfaceFrames:
        """What a model predicts of this observation.

        Parameters
        ----------
        model : ObservationModel
            Predicts the stacked positions ``(3 n f,)`` mm of all frames.
        all_frames : sequence of str, (f,)
            Names of its frames in the order in which it stacks them.

        Raises
        ------
        InputError
            If the model does not predict a frame that was seen.
        """
        unknown = set(self.frames) - set(all_frames)
        if unknown:
            raise InputError(f"observed frames {sorted(unknown)}, predicted {list(all_frames)}")
        return SurfaceFrames(model, self, tuple(all_frames))

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Unsigned distances ``(q,)`` mm of the last frame's points to fitted ``(f, n, 3)``."""
        seen, distance = self.seen[-1], np.empty(len(self.seen[-1].points))
        for region, members in _by_region(seen):
            triangles = self.surface.of(region)
            distance[members] = surface_distance(seen.points[members], fitted[-1], triangles)
        return distance

    def _require_counterpart(self, seen: ObservedSurface) -> None:
        missing = set(seen.region.tolist()) - {UNKNOWN, *self.surface.region.tolist()}
        if missing:
            raise InputError(
                f"frame {seen.frame}: points of region {min(missing)}, of which the model's "
                f"surface has no triangle"
            )
        for name in ("free_edge", "annulus"):
            if getattr(seen, name) is not None:
                if getattr(self.surface, name) is None:
                    raise InputError(
                        f"frame {seen.frame}: the {name} is seen, but the model's surface has none"
                    )
                if self.curve_std_mm is None:
                    raise InputError(f"the {name} is seen, but curve_std_mm is not given")
                _require_std("curve_std_mm", self.curve_std_mm)
        q = len(seen.points)
        if self.correlation_length_mm and q > MAX_CORRELATED_POINTS:
            raise InputError(
                f"frame {seen.frame}: {q} points with correlated errors, expected at most "
                f"{MAX_CORRELATED_POINTS}; thin them: points nearer to each other than the "
                f"correlation length of {self.correlation_length_mm:g} mm say little that is new"
            )

    def _size(self, seen: ObservedSurface) -> int:
        return len(seen.points) + sum(2 * len(q) for q, _ in _curves(seen, self.surface))

    def _noise(self) -> NoiseCovariance:
        parts = []
        for seen in self.seen:
            q = len(seen.points)
            if q and self.correlation_length_mm:
                length = self.correlation_length_mm
                # Leaflets are independent: they are moved apart to where nothing is correlated.
                extent = float(np.ptp(seen.points, axis=0).max())
                apart = seen.region * (extent + 1000.0 * length)
                points = seen.points + apart[:, None]
                parts.append(SpatialCorrelation(points, length).noise(self.std_mm**2, 1))
            elif q:
                parts.append(observation_noise(self.std_mm**2, q))
            if rest := self._size(seen) - q:
                assert self.curve_std_mm is not None
                parts.append(observation_noise(self.curve_std_mm**2, rest))
        return stacked_noise(parts)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFrames:
    """The distances of what was seen to what a model predicts.

    Parameters that no tissue can have, as a filter may try, give a failed prediction. To a triangle
    without area a distance is that to its edges; a point on it has no direction and no derivative.

    Attributes
    ----------
    model : ObservationModel
        Predicts the stacked positions of all frames.
    observation : SurfaceObservation
    all_frames : tuple of str
        In the order in which the model stacks them.
    """

    model: ObservationModel
    observation: SurfaceObservation
    all_frames: tuple[str, ...]
    _whole: dict[bytes, FloatArray] = field(default_factory=dict, init=False, repr=False)

    def whole(self, m: FloatArray) -> FloatArray | None:
        """Observed frames ``(f, n, 3)`` of all vertices where the model was run with ``m (p,)``."""
        return self._whole.get(np.asarray(m, dtype=np.float64).tobytes())

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict the distances for parameters ``m (p,)``."""
        try:
            prediction = self.model(m)
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not prediction.converged:
            return prediction
        surface = self.observation.surface
        shape = (len(self.all_frames), surface.n_vertices, 3)
        if prediction.y.size != np.prod(shape):
            raise InputError(
                f"the model predicts {prediction.y.size} coordinates; expected 3 of each of "
                f"{surface.n_vertices} vertices in each of the frames {', '.join(self.all_frames)}"
            )
        chosen = [self.all_frames.index(frame) for frame in self.observation.frames]
        whole = prediction.y.reshape(shape)[chosen]
        motion = prediction.jacobian.reshape(*shape, -1)[chosen]
        y, jacobian = [], []
        for seen, vertices, moved in zip(self.observation.seen, whole, motion, strict=True):
            for h, H in self._of_frame(seen, vertices, moved):
                y.append(h)
                jacobian.append(H)
        self._whole[np.asarray(m, dtype=np.float64).tobytes()] = whole
        return Prediction(np.concatenate(y), np.concatenate(jacobian), reason=prediction.reason)

    def _of_frame(
        self, seen: ObservedSurface, vertices: FloatArray, motion: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        surface = self.observation.surface
        h, H = np.empty(len(seen.points)), np.empty((len(seen.points), motion.shape[-1]))
        for region, members in _by_region(seen):
            h[members], H[members] = _signed_distances(
                seen.points[members], vertices, surface.of(region), motion
            )
        yield h, H
        for curve, loop in _curves(seen, surface):
            assert self.observation.curve_std_mm is not None
            across = _across(curve, self.observation.curve_std_mm)
            yield _curve_offsets(curve, across, vertices[loop], motion[loop])


def surface_distance(points: FloatArray, vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Unsigned distances ``(q,)`` mm of points ``(q, 3)`` to a surface, for reporting."""
    return closest_points(points, vertices, triangles).distance


def mean_surface_distance(
    a: FloatArray, triangles_a: IntArray, b: FloatArray, triangles_b: IntArray
) -> float:
    """Mean distance (mm) of two surfaces: from each to the other, and the mean of both.

    Vertices ``(n, 3)`` mm count by the area that belongs to them, so that it does not matter where
    a surface is finely triangulated.
    """
    ways = ((a, triangles_a, b, triangles_b), (b, triangles_b, a, triangles_a))
    return float(
        np.mean(
            [
                np.average(surface_distance(x, y, other), weights=lumped_areas(x, own))
                for x, own, y, other in ways
            ]
        )
    )


def _signed_distances(
    points: FloatArray, vertices: FloatArray, triangles: IntArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed distances ``(q,)`` mm and derivatives ``(q, p)``, of vertices with ``(n, 3, p)``."""
    closest = closest_points(points, vertices, triangles)
    offset = points - closest.interpolate(vertices, triangles)
    normal, inside = _normals(vertices, triangles, closest.triangle, closest.barycentric)
    length = closest.distance[:, None]
    side = np.where(np.einsum("qk,qk->q", offset, normal) < 0.0, -1.0, 1.0)[:, None]
    apart = ~inside[:, None] & (length > TOUCHING)
    direction = np.divide(side * offset, length, out=normal.copy(), where=apart)
    moved = closest.interpolate(motion, triangles)
    distance = np.einsum("qk,qk->q", direction, offset)
    return distance, -np.einsum("qk,qkp->qp", direction, moved)


def _normals(
    vertices: FloatArray, triangles: IntArray, triangle: IntArray, barycentric: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Angle-weighted unit normals ``(q, 3)`` at closest points, and which are inside a triangle."""
    corner = vertices[triangles]
    ahead = _unit(np.roll(corner, -1, axis=1) - corner)
    behind = _unit(np.roll(corner, 1, axis=1) - corner)
    face = _unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    angle = np.arccos(np.clip(np.einsum("mck,mck->mc", ahead, behind), -1.0, 1.0))
    of_vertex = np.zeros_like(vertices)
    np.add.at(of_vertex, triangles, angle[..., None] * face[:, None])
    # Edge c of a triangle lies opposite its corner c.
    ends = np.sort(np.stack([np.roll(triangles, -1, 1), np.roll(triangles, -2, 1)], 2), axis=2)
    keys, edge = np.unique(ends @ [len(vertices), 1], return_inverse=True)
    edge = edge.reshape(triangles.shape)
    of_edge = np.zeros((len(keys), 3))
    np.add.at(of_edge, edge, face[:, None])

    zeros = np.count_nonzero(barycentric == 0.0, axis=1)
    at_edge = of_edge[edge[triangle, np.argmin(barycentric, axis=1)]]
    at_vertex = of_vertex[triangles[triangle, np.argmax(barycentric, axis=1)]]
    normal = np.choose(zeros[:, None], [face[triangle], at_edge, at_vertex])
    return _unit(normal), zeros == 0


def _across(curve: FloatArray, std: float) -> FloatArray:
    """Two unit vectors ``(j, 3, 2)`` across a closed curve as it was seen, at each of its points.

    The direction is that from a point before to a point after, ``TANGENT_REACH`` standard
    deviations away but no more than an eighth of the points. Where it is wrong by an angle, one of
    the components is too small by its cosine: information is lost, and none made up.
    """
    most = max(1, len(curve) // 8)
    for reach in range(1, most + 1):
        span = np.roll(curve, -reach, axis=0) - np.roll(curve, reach, axis=0)
        if np.median(np.linalg.norm(span, axis=1)) >= 2.0 * TANGENT_REACH * std:
            break
    # The right singular vectors after the first are an orthonormal basis across it.
    return np.linalg.svd(span[:, None, :])[2][:, 1:].swapaxes(1, 2)


def _curve_offsets(
    curve: FloatArray, across: FloatArray, loop: FloatArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Offsets ``(2 j,)`` mm of seen points from a closed polyline, and ``(2 j, p)``.

    With r = x - c, c = a + s (b - a) and the unit tangent t of length L, inside an edge::

        dr = -(I - t tT) dc - t (r . (db - da)) / L,   dc = (1 - s) da + s db

    and dr = -da at a vertex.

    Parameters
    ----------
    curve : (j, 3) mm
    across : (j, 3, 2)
        Two directions at each point, from `_across`.
    loop : (e, 3) mm
        Vertices of the polyline, the last joined to the first.
    motion : (e, 3, p)
    """
    step = np.roll(loop, -1, axis=0) - loop
    squared = np.maximum(np.einsum("ek,ek->e", step, step), np.finfo(np.float64).tiny)
    raw = np.einsum("jek,ek->je", curve[:, None] - loop, step) / squared
    foot = loop + np.clip(raw, 0.0, 1.0)[..., None] * step
    edge = np.argmin(np.linalg.norm(curve[:, None] - foot, axis=2), axis=1)

    rows = np.arange(len(curve))
    offset, raw = curve - foot[rows, edge], raw[rows, edge]
    s = np.clip(raw, 0.0, 1.0)[:, None, None]
    moved_step = (np.roll(motion, -1, axis=0) - motion)[edge]
    moved = motion[edge] + s * moved_step
    t = _unit(step[edge])
    slide = np.einsum("jk,jkp->jp", offset, moved_step) / np.sqrt(squared[edge])[:, None]
    along = np.einsum("jk,jkp->jp", t, moved) - slide
    within: BoolArray = (raw >= 0.0) & (raw <= 1.0)
    change = -moved + np.where(within[:, None, None], t[:, :, None] * along[:, None, :], 0.0)
    h = np.einsum("jki,jk->ji", across, offset)
    return h.ravel(), np.einsum("jki,jkp->jip", across, change).reshape(h.size, -1)


def _by_region(seen: ObservedSurface) -> Iterator[tuple[int, BoolArray]]:
    """Each region that is seen, and which points ``(q,)`` are of it."""
    for region in np.unique(seen.region):
        yield int(region), seen.region == region


def _curves(seen: ObservedSurface, surface: PredictedSurface) -> list[tuple[FloatArray, IntArray]]:
    """The curves that are seen and the loops of vertices that they are compared with."""
    pairs = ((seen.free_edge, surface.free_edge), (seen.annulus, surface.annulus))
    return [(curve, loop) for curve, loop in pairs if curve is not None and loop is not None]


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` of length one; zero where they were zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def _points(what: str, values: FloatArray) -> FloatArray:
    points = np.array(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{what}: shape {points.shape}, expected (q, 3) mm")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(f"{what}: point {bad[0]} is {points[bad[0]]}, expected finite numbers")
    points.setflags(write=False)
    return points


def _curve(what: str, values: FloatArray) -> FloatArray:
    curve = _points(what, values)
    if len(curve) < 3:
        raise InputError(f"{what}: {len(curve)} points, expected three or more")
    repeated = np.flatnonzero(np.all(np.roll(curve, -1, axis=0) == curve, axis=1))
    if repeated.size:
        raise InputError(
            f"{what}: point {repeated[0]} is the same as the next one; expected different points, "
            f"the first not repeated at the end"
        )
    return curve


def _numbers(what: str, values: IntArray, least: int, most: int | None) -> IntArray:
    given = np.asarray(values)
    if given.size and not np.issubdtype(given.dtype, np.integer):
        raise InputError(f"{what}: {given.dtype}, expected integers")
    numbers = np.array(given, dtype=np.int64)
    if numbers.size and (numbers.min() < least or (most is not None and numbers.max() > most)):
        raise InputError(
            f"{what}: numbers from {numbers.min()} to {numbers.max()}, expected {least} to "
            f"{'any' if most is None else most}"
        )
    numbers.setflags(write=False)
    return numbers


def _require_std(name: str, std: float) -> None:
    if not (np.isfinite(std) and std > 0.0):
        raise InputError(f"{name} = {std}, expected > 0")
