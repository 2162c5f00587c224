"""Where in a volume there may be a valve, and how it lies.

First every place is rated, whatever the orientation. Then orientations are rated at every place
that is left, and the best ones refined step by step.

At a pose, leading modes of the shape and the papillary tips are read off: the shape to begin with.

Search in position first and in position, orientation and size then is the marginal space learning
of Zheng et al. (IEEE Trans. Med. Imaging 27:1668, 2008); the refinement is a cascade of regressions
from what is seen at a hypothesis to its error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import SamplePattern, StandardFrame, directions, features
from mvest.imaging.detection.pose import Poses, rotation_grid
from mvest.imaging.detection.shape_model import (
    Examples,
    LabelledFrame,
    Misses,
    ShapeModel,
    TrueValve,
    missed_poses,
)
from mvest.imaging.learning.boosting import Trees
from mvest.typing import FloatArray

PLACES = 24
"""Places at which orientations are tried."""

RADII_MM = (3.0, 7.0, 11.0, 15.0, 19.0, 24.0, 30.0, 38.0)
"""mm of the shells about a place."""

SHELL_LEVELS = (1, 1, 1, 2, 2, 2, 3, 3)
DIRECTIONS = 20

GRID_LEVEL = 2
"""Places are the voxels of this level, every second one along each axis."""

NEAR_MM = 6.0
"""mm, the rating of a place falls off over: exp(-d^2 / (2 NEAR^2))."""


def _position_pattern() -> SamplePattern:
    offsets = np.concatenate([radius * directions(DIRECTIONS) for radius in RADII_MM])
    levels = np.repeat(np.array(SHELL_LEVELS), DIRECTIONS)
    return SamplePattern(offsets, levels, np.zeros((0, 2), dtype=np.int64))


PATTERN = _position_pattern()


def _shell_features(frame: StandardFrame, points: FloatArray) -> NDArray[np.float32]:
    """Mean, spread and extremes over each shell ``(P, 5 * shells)``: no orientation in them."""
    axes = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    values = features(frame, PATTERN, points, axes).reshape(len(points), -1, DIRECTIONS)
    ordered = np.sort(values, axis=2)
    parts = [
        values.mean(axis=2),
        values.std(axis=2),
        ordered[..., 1],
        ordered[..., DIRECTIONS // 2],
        ordered[..., -2],
    ]
    return np.concatenate(parts, axis=1)


def position_samples(seen: LabelledFrame, count: int) -> Examples:
    """Places near a valve and anywhere, with their ratings ``(P, 1)``."""
    frame, true, _, rng = seen
    centre = true.pose.centre[0]
    anywhere = _places(frame)
    near = centre + rng.standard_normal((count // 2, 3)) * rng.choice([3.0, 8.0], (count // 2, 1))
    far = anywhere[rng.integers(len(anywhere), size=count - len(near))]
    points = np.concatenate([near, far])
    distance = np.linalg.norm(points - centre, axis=1)
    return _shell_features(frame, points), np.exp(-0.5 * (distance / NEAR_MM) ** 2)[:, None]


def _places(frame: StandardFrame) -> FloatArray:
    """``(P, 3)`` mm within the field of view."""
    level = frame.level(GRID_LEVEL)
    every = np.zeros(level.shape, dtype=np.bool_)
    every[::2, ::2, ::2] = True
    return frame.centres(GRID_LEVEL)[(every & (level > 0)).ravel()]


def likely_places(frame: StandardFrame, boosters: Trees, count: int) -> FloatArray:
    """The best places ``(count, 3)`` mm that are apart from one another.

    Parameters
    ----------
    boosters : mapping
        One output: the rating, 1 at a valve's centre.
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


ORIENTATIONS = 700
"""Orientations tried at every place: neighbours are some 25 to 30 degrees apart."""

REFINED = 160
"""Hypotheses that are refined."""

TURNED = 12
"""Of the best ones, so many are turned front to back and refined too."""

HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi, 0.0])
"""About the valve's axis, as poses are moved."""

REFINEMENTS = (
    Misses(7.0, 22.0, 0.12),
    Misses(4.0, 12.0, 0.08),
    Misses(2.2, 7.0, 0.05),
)
"""What each step of the cascade is trained to take back."""

SCALE_MM = 6.0
"""mm, a hypothesis' rating falls off over: exp(-error / SCALE)."""


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
"""Of the final rating: it reaches to what tells the anterior side from the posterior one."""


def pose_error(poses: Poses, true: TrueValve, model: ShapeModel) -> FloatArray:
    """``(P,)`` mm: mean distance of annulus and tips, laid by each pose, from where they belong."""
    points = np.concatenate([model.mean[model.layout.annulus[::4]], model.tips])
    gap = poses.world(points) - true.pose.world(points)
    return np.asarray(np.linalg.norm(gap, axis=2).mean(axis=1))


def coarse_samples(seen: LabelledFrame, count: int) -> Examples:
    """Hypotheses such as a grid of orientations at likely places gives, with ratings ``(P, 1)``."""
    frame, true, model, rng = seen
    grid = rotation_grid(ORIENTATIONS)
    kinds = (Misses(3.0, 10.0, 0.1), Misses(5.0, 22.0, 0.1))
    parts = [missed_poses(true.pose, misses, count // 4, rng) for misses in kinds]
    rest = count - sum(len(part) for part in parts)
    far = missed_poses(true.pose, Misses(8.0, 0.0, 0.1), rest, rng)
    parts.append(Poses(far.centre, grid[rng.integers(len(grid), size=rest)], far.log_scale))
    poses = _strayed(Poses.joined(parts), rng)
    rating = _rating(pose_error(poses, true, model))
    return features(frame, COARSE, poses.centre, poses.axes), rating


def fine_samples(seen: LabelledFrame, count: int, mistaken: Poses | None = None) -> Examples:
    """Hypotheses such as remain after refinement, with ratings ``(P, 1)``.

    Half of those made up are about right; the others are turned about the valve's axis (front for
    back, most often), tilted, or anywhere.

    Parameters
    ----------
    mistaken : Poses, optional
        What a search without this rating took for the valve: also learned from.
    """
    frame, true, model, rng = seen
    kinds = (Misses(1.0, 3.0, 0.03), Misses(2.5, 8.0, 0.06), Misses(6.0, 25.0, 0.12))
    parts = [missed_poses(true.pose, misses, count // 6, rng) for misses in kinds]
    turned = missed_poses(true.pose, Misses(3.0, 10.0, 0.08), count // 3, rng)
    by = np.zeros((len(turned), 7))
    by[:, 5] = np.where(rng.random(len(turned)) < 0.6, np.pi, rng.uniform(0.5, 5.8, len(turned)))
    parts.append(turned.moved(by))
    rest = count - sum(len(part) for part in parts)
    parts.append(_strayed(missed_poses(true.pose, Misses(8.0, 60.0, 0.1), rest, rng), rng, 0.3))
    if mistaken is not None:
        parts.append(mistaken)
    poses = Poses.joined(parts)
    rating = _rating(pose_error(poses, true, model))
    return features(frame, WIDE, poses.centre, poses.axes), rating


def _rating(error: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-error / SCALE_MM)[:, None])


def _strayed(poses: Poses, rng: np.random.Generator, share: float = 0.1) -> Poses:
    """Some of the poses moved to where there is no valve."""
    stray = rng.random(len(poses)) < share
    centre = poses.centre + stray[:, None] * rng.standard_normal((len(poses), 3)) * 25.0
    return Poses(centre, poses.rotation, poses.log_scale)


def refinement_samples(seen: LabelledFrame, step: int, count: int) -> Examples:
    """Poses missed as ``REFINEMENTS[step]`` says, and what takes each back ``(P, 7)``."""
    frame, true, _, rng = seen
    poses = missed_poses(true.pose, REFINEMENTS[step], count, rng)
    right = true.pose.repeated(count)
    return features(frame, FINE, poses.centre, poses.axes), poses.towards(right)


def search_poses(frame: StandardFrame, boosters: Trees, count: int) -> tuple[Poses, FloatArray]:
    """The best ``count`` poses in a frame and their ratings (0 to 1), best first.

    Parameters
    ----------
    boosters : mapping
        One output for ``pose_coarse`` and ``pose_fine``: the rating. Seven for each step of
        ``pose_refine``: what takes the error back.
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
    # Front and back are distinguished last, so the best ones are tried the other way round too.
    back = poses[:TURNED].moved(np.tile(HALF_TURN, (len(poses[:TURNED]), 1)))
    back, rated = _sorted(*refined(frame, boosters, back))
    poses, rating = _sorted(Poses.joined([poses, back]), np.concatenate([rating, rated]))
    return poses[:count], rating[:count]


def _sorted(poses: Poses, rating: FloatArray) -> tuple[Poses, FloatArray]:
    """Best first."""
    best = np.argsort(-rating, kind="stable")
    return poses[best], rating[best]


def refined(frame: StandardFrame, boosters: Trees, poses: Poses) -> tuple[Poses, FloatArray]:
    """Refine some poses; all of them in their order, and their ratings."""
    for k in range(len(REFINEMENTS)):
        values = features(frame, FINE, poses.centre, poses.axes)
        poses = poses.moved(boosters[f"pose_refine_{k}"](values))
    rating = boosters["pose_fine"](features(frame, WIDE, poses.centre, poses.axes))[:, 0]
    return poses, rating


MODES = 8
"""Leading modes that are read off; among them how far the valve is open."""

START_MISSES = Misses(1.5, 5.0, 0.04)


def _start_pattern() -> SamplePattern:
    rng = np.random.default_rng(3)
    offsets = rng.standard_normal((260, 3)) * np.array([10.0, 9.0, 9.0]) + [0, 0, -8.0]
    offsets[200:] = rng.standard_normal((60, 3)) * 6.0 + [0, 0, -22.0]
    offsets[200:, 0] += np.repeat([15.0, -15.0], 30)  # about where papillary tips are
    return SamplePattern.paired(offsets, np.where(rng.random(260) < 0.5, 1, 2), 120, 3)


START = _start_pattern()


def shape_start_samples(seen: LabelledFrame, count: int) -> Examples:
    """Missed poses, with the coefficients and tips ``(P, MODES + 6)`` seen from them."""
    frame, true, model, rng = seen
    poses = missed_poses(true.pose, START_MISSES, count, rng)
    local = poses.local(np.broadcast_to(true.vertices, (count, *true.vertices.shape)))
    tips = poses.local(np.broadcast_to(true.tips, (count, 2, 3)))
    # Over their deviation, so that all outputs are of one size.
    y = model.coefficients(local)[:, :MODES] / model.std[:MODES]
    return (
        features(frame, START, poses.centre, poses.axes),
        np.concatenate([y, (tips - model.tips).reshape(count, 6)], axis=1),
    )


def starting_shape(
    frame: StandardFrame, boosters: Trees, poses: Poses, model: ShapeModel
) -> tuple[FloatArray, FloatArray]:
    """Coefficients ``(P, MODES)`` and tips ``(P, 2, 3)`` in world mm, read off at some poses.

    Parameters
    ----------
    boosters : mapping
        Coefficients over their deviation, then both tips (mm at the size of the mean valve).
    """
    answers = boosters["shape"](features(frame, START, poses.centre, poses.axes))
    tips = model.tips + answers[:, MODES:].reshape(-1, 2, 3)
    return answers[:, :MODES] * model.std[:MODES], poses.world(tips)
