"""Search for the pose of a valve in a volume.

First every position is rated without an orientation. Then orientations are rated at the best
positions, and the best poses are refined. At a pose, regressions give the leading modes of the
shape and the papillary tips, from which the fit starts.

Search in position first, then in position, orientation and size, is the marginal space learning of
Zheng et al. (IEEE Trans. Med. Imaging 27:1668, 2008). The refinement is a cascade of regressions
from the features at a pose to its error.
"""

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import SamplePattern, StandardFrame, directions, features
from mvest.imaging.detection.pose import Poses, rotation_grid
from mvest.imaging.detection.shape_model import Examples, LabelledFrame, Misses, ShapeModel
from mvest.imaging.learning.boosting import Trees
from mvest.typing import FloatArray

# -- position -------------------------------------------------------------------------------------
PLACES = 24
"""Positions at which orientations are tried."""

SHELLS = {3.0: 1, 7.0: 1, 11.0: 1, 15.0: 2, 19.0: 2, 24.0: 2, 30.0: 3, 38.0: 3}
"""Radius (mm) of the shells around a position, and the scale at which each is sampled."""

DIRECTIONS = 20
"""Samples of a shell."""

GRID_LEVEL = 2
"""Positions are the voxels of this level, every second one along each axis."""

NEAR_MM = 6.0
"""mm, width of the rating of a position: exp(-d^2 / (2 NEAR^2))."""

PATTERN = SamplePattern(
    np.concatenate([radius * directions(DIRECTIONS) for radius in SHELLS]),
    np.repeat(list(SHELLS.values()), DIRECTIONS),
    np.zeros((0, 2), dtype=np.int64),
)


def _shell_features(frame: StandardFrame, points: FloatArray) -> NDArray[np.float32]:
    """Mean, spread, extremes and median over each shell ``(P, 5 * shells)``."""
    axes = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    values = features(frame, PATTERN, points, axes).reshape(len(points), -1, DIRECTIONS)
    ordered = np.sort(values, axis=2)
    ranked = [ordered[..., k] for k in (1, DIRECTIONS // 2, -2)]
    return np.concatenate([values.mean(axis=2), values.std(axis=2), *ranked], axis=1)


def position_samples(seen: LabelledFrame, count: int) -> Examples:
    """Positions near a valve and anywhere, with their ratings ``(P, 1)``."""
    centre, rng = seen.pose.centre[0], seen.rng
    anywhere = _places(seen.frame)
    near = centre + rng.standard_normal((count // 2, 3)) * rng.choice([3.0, 8.0], (count // 2, 1))
    far = anywhere[rng.integers(len(anywhere), size=count - len(near))]
    points = np.concatenate([near, far])
    distance = np.linalg.norm(points - centre, axis=1)
    return _shell_features(seen.frame, points), np.exp(-0.5 * (distance / NEAR_MM) ** 2)[:, None]


def _places(frame: StandardFrame) -> FloatArray:
    """Positions ``(P, 3)`` mm within the field of view."""
    level = frame.level(GRID_LEVEL)
    every = np.zeros(level.shape, dtype=np.bool_)
    every[::2, ::2, ::2] = True
    return frame.centres(GRID_LEVEL)[(every & (level > 0)).ravel()]


def likely_places(frame: StandardFrame, boosters: Trees, count: int) -> FloatArray:
    """The best positions ``(count, 3)`` mm, apart from one another.

    The output of the trees is the rating, 1 at a valve's centre.
    """
    places = _places(frame)
    if not len(places):
        return np.zeros((0, 3))
    left = boosters["position"](_shell_features(frame, places))[:, 0]
    kept: list[int] = []
    for _ in range(count):
        k = int(np.argmax(left))
        if not np.isfinite(left[k]):
            break
        kept.append(k)
        left[np.linalg.norm(places - places[k], axis=1) < 0.8 * NEAR_MM] = -np.inf
    return places[kept]


# -- pose -----------------------------------------------------------------------------------------
ORIENTATIONS = 700
"""Orientations tried at every position, some 25 to 30 degrees apart."""

REFINED = 160
"""Poses that are refined."""

TURNED = 12
"""Number of the best poses that are also turned front to back and refined."""

HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi, 0.0])
"""About the valve's axis, as poses are moved."""

REFINEMENTS = (Misses(7.0, 22.0, 0.12), Misses(4.0, 12.0, 0.08), Misses(2.2, 7.0, 0.05))
"""Errors that each step of the cascade is trained to correct."""

SCALE_MM = 6.0
"""mm, width of the rating of a pose: exp(-error / SCALE)."""


def _pose_pattern(count: int, near: float, seed: int, reach: float = 1.0) -> SamplePattern:
    """Samples about the annulus' centre, denser near the leaflets."""
    rng = np.random.default_rng(seed)
    spread = reach * np.array([15.0, 14.0, 13.0])
    offsets = rng.standard_normal((count, 3)) * spread + [0, 0, -5.0]
    radius = np.linalg.norm(offsets / np.array([20.0, 18.0, 16.0]), axis=1)
    levels = np.where(radius > 1.6, 3, np.where(radius > near, 2, 1))
    return SamplePattern.paired(offsets, levels, count // 2, seed)


COARSE = _pose_pattern(140, 0.3, 1)
FINE = _pose_pattern(220, 1.0, 2)
WIDE = _pose_pattern(280, 0.8, 7, 1.5)
"""For the final rating; it reaches the surroundings that distinguish front and back."""


def pose_error(poses: Poses, true: Poses, model: ShapeModel) -> FloatArray:
    """Mean distances ``(P,)`` mm of the mean valve's annulus and tips from the true ones."""
    points = np.concatenate([model.mean[model.layout.annulus[::4]], model.tips])
    gap = poses.world(points) - true.world(points)
    return np.asarray(np.linalg.norm(gap, axis=2).mean(axis=1))


def coarse_samples(seen: LabelledFrame, count: int) -> Examples:
    """Poses like those of an orientation grid at likely positions, with ratings ``(P, 1)``."""
    rng, grid = seen.rng, rotation_grid(ORIENTATIONS)
    kinds = (Misses(3.0, 10.0, 0.1), Misses(5.0, 22.0, 0.1))
    parts = [seen.missed_poses(misses, count // 4) for misses in kinds]
    rest = count - sum(len(part) for part in parts)
    far = seen.missed_poses(Misses(8.0, 0.0, 0.1), rest)
    parts.append(Poses(far.centre, grid[rng.integers(len(grid), size=rest)], far.log_scale))
    return _rated(seen, COARSE, _strayed(Poses.joined(parts), rng))


def fine_samples(seen: LabelledFrame, count: int, mistaken: Poses | None = None) -> Examples:
    """Poses like those after refinement, with ratings ``(P, 1)``.

    Half of them are nearly right; the others are turned about the valve's axis (mostly front to
    back), tilted, or anywhere. Wrong poses of a search without this rating are added (`mistaken`).
    """
    rng = seen.rng
    kinds = (Misses(1.0, 3.0, 0.03), Misses(2.5, 8.0, 0.06), Misses(6.0, 25.0, 0.12))
    parts = [seen.missed_poses(misses, count // 6) for misses in kinds]
    turned = seen.missed_poses(Misses(3.0, 10.0, 0.08), count // 3)
    by = np.zeros((len(turned), 7))
    by[:, 5] = np.where(rng.random(len(turned)) < 0.6, np.pi, rng.uniform(0.5, 5.8, len(turned)))
    parts.append(turned.moved(by))
    rest = count - sum(len(part) for part in parts)
    parts.append(_strayed(seen.missed_poses(Misses(8.0, 60.0, 0.1), rest), rng, 0.3))
    if mistaken is not None:
        parts.append(mistaken)
    return _rated(seen, WIDE, Poses.joined(parts))


def _rated(seen: LabelledFrame, pattern: SamplePattern, poses: Poses) -> Examples:
    """Features of poses, and their ratings by their errors."""
    rating = np.exp(-pose_error(poses, seen.pose, seen.model) / SCALE_MM)[:, None]
    return features(seen.frame, pattern, poses.centre, poses.axes), rating


def _strayed(poses: Poses, rng: np.random.Generator, share: float = 0.1) -> Poses:
    """Poses, a share of which is moved away from the valve."""
    stray = rng.random(len(poses)) < share
    centre = poses.centre + stray[:, None] * rng.standard_normal((len(poses), 3)) * 25.0
    return Poses(centre, poses.rotation, poses.log_scale)


def refinement_samples(seen: LabelledFrame, step: int, count: int) -> Examples:
    """Poses with the errors of ``REFINEMENTS[step]``, and their corrections ``(P, 7)``."""
    poses = seen.missed_poses(REFINEMENTS[step], count)
    right = seen.pose.repeated(count)
    return features(seen.frame, FINE, poses.centre, poses.axes), poses.towards(right)


def search_poses(frame: StandardFrame, boosters: Trees, count: int) -> tuple[Poses, FloatArray]:
    """The best ``count`` poses in a frame and their ratings (0 to 1), best first.

    The trees ``pose_coarse`` and ``pose_fine`` have one output, the rating; each ``pose_refine``
    has seven, the correction.
    """
    places, grid = likely_places(frame, boosters, PLACES), rotation_grid(ORIENTATIONS)
    every = Poses(
        np.repeat(places, len(grid), 0),
        np.tile(grid, (len(places), 1, 1)),
        np.zeros(len(places) * len(grid)),
    )
    rating = boosters["pose_coarse"](features(frame, COARSE, every.centre, every.axes))[:, 0]
    best = np.argsort(-rating, kind="stable")[:REFINED]
    poses, rating = _sorted(*refined(frame, boosters, every[best]))
    # Only the last rating distinguishes front and back, so the best are also tried turned.
    back = poses[:TURNED].moved(np.tile(HALF_TURN, (len(poses[:TURNED]), 1)))
    back, rated = _sorted(*refined(frame, boosters, back))
    poses, rating = _sorted(Poses.joined([poses, back]), np.concatenate([rating, rated]))
    return poses[:count], rating[:count]


def _sorted(poses: Poses, rating: FloatArray) -> tuple[Poses, FloatArray]:
    """Best first."""
    best = np.argsort(-rating, kind="stable")
    return poses[best], rating[best]


def refined(frame: StandardFrame, boosters: Trees, poses: Poses) -> tuple[Poses, FloatArray]:
    """Refine poses; returns them in their order, and their ratings."""
    for k in range(len(REFINEMENTS)):
        values = features(frame, FINE, poses.centre, poses.axes)
        poses = poses.moved(boosters[f"pose_refine_{k}"](values))
    rating = boosters["pose_fine"](features(frame, WIDE, poses.centre, poses.axes))[:, 0]
    return poses, rating


# -- starting shape -------------------------------------------------------------------------------
MODES = 8
"""Leading modes that are regressed; they include how far the valve is open."""

START_MISSES = Misses(1.5, 5.0, 0.04)


def _start_pattern() -> SamplePattern:
    rng = np.random.default_rng(3)
    offsets = rng.standard_normal((260, 3)) * np.array([10.0, 9.0, 9.0]) + [0, 0, -8.0]
    offsets[200:] = rng.standard_normal((60, 3)) * 6.0 + [0, 0, -22.0]
    offsets[200:, 0] += np.repeat([15.0, -15.0], 30)  # about where papillary tips are
    return SamplePattern.paired(offsets, np.where(rng.random(260) < 0.5, 1, 2), 120, 3)


START = _start_pattern()


def shape_start_samples(seen: LabelledFrame, count: int) -> Examples:
    """Poses about the true one, with coefficients and tips in their axes ``(P, MODES + 6)``."""
    model, poses = seen.model, seen.missed_poses(START_MISSES, count)
    local = poses.local(np.broadcast_to(seen.vertices, (count, *seen.vertices.shape)))
    tips = poses.local(np.broadcast_to(seen.tips, (count, 2, 3)))
    # Over their deviation, so that all outputs have one size.
    y = model.coefficients(local)[:, :MODES] / model.std[:MODES]
    return (
        features(seen.frame, START, poses.centre, poses.axes),
        np.concatenate([y, (tips - model.tips).reshape(count, 6)], axis=1),
    )


def starting_shape(
    frame: StandardFrame, boosters: Trees, poses: Poses, model: ShapeModel
) -> tuple[FloatArray, FloatArray]:
    """Coefficients ``(P, MODES)`` and tips ``(P, 2, 3)`` in world mm, regressed at some poses.

    The outputs of the trees are coefficients over their deviation, and both tips (mm at the size of
    the mean valve).
    """
    answers = boosters["shape"](features(frame, START, poses.centre, poses.axes))
    tips = model.tips + answers[:, MODES:].reshape(-1, 2, 3)
    return answers[:, :MODES] * model.std[:MODES], poses.world(tips)
