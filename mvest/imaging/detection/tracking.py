"""The valve in all frames of a volume: one trajectory through the hypotheses of every frame.

Each frame has several hypotheses of the pose. Dynamic programming finds the trajectory that is
likely in every frame and no faster than a valve. The fitted valves are then smoothed in time where
vertices are uncertain, with a penalty on acceleration; a truncated Fourier series would flatten the
closure itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.detection.detect import (
    CANDIDATES,
    HAND_STD_MM,
    HOLD,
    STIFFNESS,
    SURE,
    TRIED,
    FrameValve,
    NoValveError,
    fit_frame,
    merits,
)
from mvest.imaging.detection.frame import StandardFrame, standard_frame
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.pose_search import refined, search_poses
from mvest.imaging.detection.shape_model import Pulls, relax
from mvest.imaging.detection.trained_model import DetectionModel
from mvest.imaging.valve_sequence import LANDMARKS, MIN_CONFIDENCE, ValveSequence, landmark_vertices
from mvest.imaging.volume import VolumeSequence
from mvest.typing import BoolArray, FloatArray


def smooth_in_time(
    times: FloatArray, points: FloatArray, weight: FloatArray, length_s: FloatArray
) -> FloatArray:
    """Positions ``(T, m, 3)`` mm, smoothed at times ``(T,)`` s.

    Minimises sum w (z - y)^2 dt + length^4 int z''^2 dt on second divided differences (Whittaker,
    Proc. Edinburgh Math. Soc. 41:63, 1923), so that variation over much less than ``length_s (m,)``
    is removed. ``weight (T, m)`` is relative to the same point in other frames.
    """
    count = len(times)
    if count < 3 or not np.any(length_s > 0):
        return points
    step = np.diff(times)
    second = np.zeros((count - 2, count))
    for k in range(count - 2):
        a, b = step[k], step[k + 1]
        second[k, k : k + 3] = np.array([1 / a, -1 / a - 1 / b, 1 / b]) * 2 / (a + b)
    share = 0.5 * (np.concatenate([step, step[-1:]]) + np.concatenate([step[:1], step]))
    bend = second.T @ (0.5 * (step[1:] + step[:-1])[:, None] * second)
    weight = np.maximum(weight, 1e-3) / np.maximum(weight.mean(axis=0), 1e-3) * share[:, None]
    matrix = length_s[:, None, None] ** 4 * bend + np.einsum("tm,tu->mtu", weight, np.eye(count))
    right = np.swapaxes(weight[..., None] * points, 0, 1)
    return np.asarray(np.swapaxes(np.linalg.solve(matrix, right), 0, 1))


Landmarks = Mapping[int, Mapping[str, FloatArray]]
"""Placed by hand: frame -> name -> world position (3,) mm."""

POSE_LANDMARKS = 4
"""Landmarks by hand that give the pose of a frame."""

LINE_MM = 2.0
"""mm, root sum of squares about the best line. Below it landmarks determine no pose."""

HYPOTHESES, SHARED = 3, 3
"""Poses from each frame's own search, and best poses of all frames, which every frame tries."""

SPEED_MM_S, STILL_MM = 60.0, 2.0
"""Standard deviations of the speed of the annulus, and of its error in each frame."""

SMOOTHING_S = (0.06, 0.015, 0.06)
"""s over which annulus, free edge and papillary tips are smoothed; 0: not at all."""

LOST_BY = 0.2
"""A frame is searched again, starting from its neighbours, if its confidence is this much below the
best frame's."""


def detect_valve(
    volume: VolumeSequence,
    model: DetectionModel,
    *,
    min_confidence: float = MIN_CONFIDENCE,
    landmarks: Landmarks | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ValveSequence:
    """Find the valve in every frame of a volume.

    Parameters
    ----------
    volume : VolumeSequence
    model : DetectionModel
    min_confidence : float
        Of the best frame; below it there is no valve.
    landmarks : mapping, optional
        Placed by hand where the detectors fail; they stay where they are.
    progress : callable, optional
        Called with the numbers of frames done and of all frames.

    Raises
    ------
    NoValveError
        If no frame shows a valve with this confidence; it holds the best candidate.
    InputError
        If a frame holds no image, or a landmark's frame or name does not exist.
    """
    by_hand = _checked(landmarks or {}, len(volume.times))
    frames = [standard_frame(volume, k) for k in range(len(volume.times))]
    poses = _trajectory(frames, np.asarray(volume.times), model, by_hand)
    valves: list[FrameValve] = []
    for k, frame in enumerate(frames):
        valves.append(fit_frame(frame, model, poses[k : k + 1], fixed=by_hand[k]))
        if progress is not None:
            progress(k + 1, len(frames))
    valves = _found_again(frames, valves, model, by_hand)
    confidence = np.array([valve.confidence for valve in valves])
    sure = np.stack([valve.vertex_confidence for valve in valves])
    at_annulus, at_edge, at_tips = SMOOTHING_S
    layout, s = model.shape.layout, model.shape.layout.s
    smooth = smooth_in_time(
        np.asarray(volume.times),
        np.stack([np.concatenate([valve.vertices, valve.tips]) for valve in valves]),
        np.concatenate([sure, np.ones((len(valves), 2))], axis=1) * confidence[:, None],
        np.append((1 - s) * at_annulus + s * at_edge, [at_tips] * 2),
    )
    vertices, tips = smooth[:, :-2], smooth[:, -2:]
    for k in _with_hands(by_hand):
        vertices[k], tips[k] = _held(vertices[k], tips[k], by_hand[k], model)
    accuracy = model.accuracy
    if accuracy is not None:
        accuracy = accuracy.at(float(np.median(confidence)))
    valve = ValveSequence(
        layout,
        np.asarray(volume.times),
        vertices,
        tips,
        confidence,
        sure,
        np.full(layout.size, np.nan) if accuracy is None else accuracy.std_mm,
        np.nan if accuracy is None else accuracy.correlation_length_mm,
    )
    by_eye = np.isfinite(by_hand[:, :, 0]).sum(axis=1) >= POSE_LANDMARKS
    if confidence.max() < min_confidence and not by_eye.any():
        raise NoValveError(
            f"{volume.source}: no valve found; the best of {len(frames)} frames has a confidence "
            f"of {confidence.max():.2f}, expected at least {min_confidence:g} (a mitral "
            "valve whole within the field of view, or landmarks placed by hand)",
            valve,
        )
    return valve


def _found_again(
    frames: list[StandardFrame],
    valves: list[FrameValve],
    model: DetectionModel,
    by_hand: FloatArray,
) -> list[FrameValve]:
    """Search lost frames again, see `LOST_BY`, beside the most confident ones first.

    A new valve replaces the old one if its confidence is higher.
    """
    again = list(valves)
    best = max(valve.confidence for valve in valves)
    lost = {k for k, v in enumerate(valves) if v.confidence < best - LOST_BY}
    lost -= set(_with_hands(by_hand))
    while lost:
        beside = {k: max(_beside(k, again, lost), default=None) for k in lost}
        surest = {k: pair for k, pair in beside.items() if pair is not None}
        if not surest:
            break
        k = max(surest, key=lambda k: surest[k])
        near = again[surest[k][1]]
        lost.remove(k)
        other = fit_frame(
            frames[k], model, near.pose, coefficients=near.coefficients, tips=near.tips
        )
        if other.confidence > again[k].confidence:
            again[k] = other
    return again


def _beside(k: int, valves: list[FrameValve], lost: set[int]) -> list[tuple[float, int]]:
    """Confidence and number of the frames beside one that are not lost."""
    return [
        (valves[j].confidence, j) for j in (k - 1, k + 1) if 0 <= j < len(valves) and j not in lost
    ]


def _held(
    vertices: FloatArray, tips: FloatArray, points: FloatArray, model: DetectionModel
) -> tuple[FloatArray, FloatArray]:
    """One frame with its landmarks where they were placed; leaflets nearby follow."""
    placed = np.isfinite(points[:, 0])
    tips = np.where(placed[-2:, None], points[-2:], tips)
    on = np.flatnonzero(placed[:-2])
    if len(on):
        at = np.array(list(landmark_vertices(model.shape.layout).values()))[on]
        std = np.full(len(on), HAND_STD_MM[1])
        pulls = Pulls.to_points(at, vertices[at], points[on], std)
        vertices = relax(vertices, model.shape.layout, pulls, STIFFNESS, HOLD)
    return vertices, tips


def _checked(landmarks: Landmarks, frames: int) -> FloatArray:
    """Positions ``(frames, L, 3)`` of landmarks placed by hand, NaN where none was."""
    placed = np.full((frames, len(LANDMARKS), 3), np.nan)
    for frame, points in landmarks.items():
        if not 0 <= frame < frames:
            raise InputError(f"landmarks of frame {frame}; the volume has frames 0 to {frames - 1}")
        if strange := [name for name in points if name not in LANDMARKS]:
            raise InputError(
                f"landmarks of frame {frame}: {', '.join(strange)}; expected some of "
                f"{', '.join(LANDMARKS)}"
            )
        for name, point in points.items():
            if np.shape(point) != (3,) or not np.isfinite(point).all():
                raise InputError(
                    f"landmarks of frame {frame}, {name}: {np.asarray(point).tolist()}, expected "
                    "three finite coordinates"
                )
            placed[frame, LANDMARKS.index(name)] = point
        if len(points) >= POSE_LANDMARKS:
            about = np.stack(list(points.values()))
            size = np.linalg.svd(about - about.mean(axis=0), compute_uv=False)
            if size[1] < LINE_MM:
                raise InputError(
                    f"landmarks of frame {frame} lie within {size[1]:.2g} mm of one line, expected "
                    "them about the valve"
                )
    return placed


def _with_hands(placed: FloatArray) -> list[int]:
    """Frames in which landmarks were placed."""
    return [k for k, points in enumerate(placed) if np.isfinite(points).any()]


Rated = tuple[Poses, FloatArray]
"""Hypotheses of a frame, with their ratings."""


def _trajectory(
    frames: list[StandardFrame], times: FloatArray, model: DetectionModel, by_hand: FloatArray
) -> Poses:
    """One pose for every frame."""
    placed = [_pose_by_hand(points, model) for points in by_hand]
    own: list[Rated] = []
    for frame, pose in zip(frames, placed, strict=True):
        if pose is None:
            poses, rating = search_poses(frame, model.boosters, CANDIDATES)
            few = poses.apart(rating, HYPOTHESES)
            own.append((poses[few], rating[few]))
        else:
            own.append((pose, np.ones(1)))
    pool, ratings = _joined(own)
    if not len(pool):
        raise NoValveError("no valve found; no frame has a field of view")
    best = pool[pool.apart(ratings, SHARED)]
    first = [rating[0] for _, rating in own if len(rating)]
    if np.isnan(by_hand).all() and np.median(first) < SURE:
        tried = pool[pool.apart(ratings, TRIED)]
        likeliest = _likeliest_in_all(frames, model, tried)
        best = tried[likeliest : likeliest + 1]
        own = [(poses[_like(poses, best)], rating[_like(poses, best)]) for poses, rating in own]
    candidates = [
        rated if pose is not None else _joined([rated, refined(frame, model.boosters, best)])
        for frame, pose, rated in zip(frames, placed, own, strict=True)
    ]
    path = _best_path(candidates, times, model)
    return Poses.joined([candidates[k][0][p : p + 1] for k, p in enumerate(path)])


def _joined(parts: list[Rated]) -> Rated:
    """All hypotheses of several lists."""
    return (
        Poses.joined([poses for poses, _ in parts]),
        np.concatenate([rating for _, rating in parts]),
    )


def _likeliest_in_all(frames: list[StandardFrame], model: DetectionModel, tried: Poses) -> int:
    """The pose at which the valve has the highest confidence in a few frames."""
    seen = np.zeros(len(tried))
    for k in sorted({0, len(frames) // 2, len(frames) - 1}):
        poses, _ = refined(frames[k], model.boosters, tried)
        seen += merits(frames[k], model, poses)
    return int(np.argmax(seen))


def _like(poses: Poses, best: Poses) -> BoolArray:
    """Which poses ``(P,)`` have the orientation of one within 60 degrees."""
    turn = Rotation.from_matrix(np.swapaxes(best.rotation[:1], 1, 2) @ poses.rotation)
    return np.asarray(turn.magnitude() < np.deg2rad(60.0))


def _best_path(candidates: list[Rated], times: FloatArray, model: DetectionModel) -> list[int]:
    """The hypothesis of each frame on the likeliest trajectory (Viterbi)."""
    points = np.concatenate([model.shape.mean[model.shape.layout.annulus[::4]], model.shape.tips])
    where = [poses.world(points) for poses, _ in candidates]
    cost = [-2 * np.log(np.clip(rating, 1e-3, 1.0)) for _, rating in candidates]
    total, back = cost[0], []
    for k in range(1, len(candidates)):
        gap = where[k][:, None] - where[k - 1][None]
        moved = np.linalg.norm(gap, axis=3).mean(axis=2)
        std = np.hypot(STILL_MM, SPEED_MM_S * (times[k] - times[k - 1]))
        # Bounded, so that one wrong frame does not move the others.
        step = np.minimum(0.5 * (moved / std) ** 2, 8.0) + total[None]
        back.append(np.argmin(step, axis=1))
        total = cost[k] + step.min(axis=1)
    path = [int(np.argmin(total))]
    for pointer in reversed(back):
        path.append(int(pointer[path[-1]]))
    return path[::-1]


def _pose_by_hand(points: FloatArray, model: DetectionModel) -> Poses | None:
    """The pose that fits the mean valve to landmarks ``(L, 3)``, if there are four or more."""
    placed = np.isfinite(points[:, 0])
    if placed.sum() < POSE_LANDMARKS:
        return None
    shape, to = model.shape, points[placed]
    at = list(landmark_vertices(shape.layout).values())
    from_ = np.concatenate([shape.mean[at], shape.tips])[placed]
    a, b = from_ - from_.mean(axis=0), to - to.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    rotation = turn.as_matrix()
    scale = float((b * (a @ rotation.T)).sum() / (a * a).sum())
    centre = to.mean(axis=0) - scale * rotation @ from_.mean(axis=0)
    return Poses(centre[None], rotation[None], np.log([max(scale, 0.3)]))
