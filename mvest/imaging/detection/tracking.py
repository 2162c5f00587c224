"""The valve in all frames of a volume: one trajectory through the hypotheses of every frame.

Each frame has several hypotheses of the pose. Dynamic programming finds the trajectory that is
likely in every frame and no faster than a valve. The fitted valves are then smoothed in time where
vertices are uncertain, with a penalty on acceleration; a truncated Fourier series would flatten the
closure itself.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.imaging.detection.detect import (
    CANDIDATES,
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
from mvest.imaging.detection.trained_model import DetectionModel
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray

HYPOTHESES, SHARED = 3, 3
"""Poses from each frame's own search, and best poses of all frames, which every frame tries."""

SPEED_MM_S, STILL_MM = 60.0, 2.0
"""Standard deviations of the speed of the annulus, and of its error in each frame."""

SMOOTHING_S = (0.06, 0.015, 0.06)
"""s over which annulus, free edge and papillary tips are smoothed; 0: not at all."""

LOST_BY = 0.2
"""A frame is searched again, starting from its neighbours, if its confidence is this much below the
best frame's."""

Rated = tuple[Poses, FloatArray]
"""Hypotheses of a frame, with their ratings."""


def detect_valve(
    volume: VolumeSequence,
    model: DetectionModel,
    *,
    min_confidence: float = MIN_CONFIDENCE,
    progress: Callable[[int, int], None] | None = None,
) -> ValveSequence:
    """Find the valve in every frame of a volume.

    NoValveError if no frame shows a valve with this confidence. The error holds the best candidate.
    InputError if a frame holds no image.

    Parameters
    ----------
    volume : VolumeSequence
    model : DetectionModel
    min_confidence : float
        The best frame must reach it.
    progress : callable, optional
        Called with the number of finished frames and the number of all frames.
    """
    times = np.asarray(volume.times)
    frames = [standard_frame(volume, k) for k in range(len(times))]
    poses = _trajectory(frames, times, model)
    valves: list[FrameValve] = []
    for k, frame in enumerate(frames):
        valves.append(fit_frame(frame, model, poses[k : k + 1]))
        if progress is not None:
            progress(k + 1, len(frames))
    _refit_lost_frames(frames, valves, model)
    confidence = np.array([valve.confidence for valve in valves])
    seen = np.stack([valve.vertex_confidence for valve in valves])
    at_annulus, at_edge, at_tips = SMOOTHING_S
    layout, s = model.shape.layout, model.shape.layout.s
    smooth = smooth_in_time(
        times,
        np.stack([np.concatenate([valve.vertices, valve.tips]) for valve in valves]),
        np.concatenate([seen, np.ones((len(valves), 2))], axis=1) * confidence[:, None],
        np.append((1 - s) * at_annulus + s * at_edge, [at_tips] * 2),
    )
    std, length = np.full(layout.size, np.nan), np.nan
    if model.accuracy is not None:
        accuracy = model.accuracy.at(float(np.median(confidence)))
        std, length = accuracy.std_mm, accuracy.correlation_length_mm
    valve = ValveSequence(
        layout, times, smooth[:, :-2], smooth[:, -2:], confidence, seen, std, length
    )
    if confidence.max() < min_confidence:
        raise NoValveError(
            f"{volume.source}: no valve found; the best of {len(frames)} frames has a confidence "
            f"of {confidence.max():.2f}, expected at least {min_confidence:g} (a mitral valve "
            "completely within the field of view)",
            valve,
        )
    return valve


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


def _refit_lost_frames(
    frames: list[StandardFrame], valves: list[FrameValve], model: DetectionModel
) -> None:
    """Fit lost frames (`LOST_BY`) again in place, those next to the most confident ones first."""
    best = max(valve.confidence for valve in valves)
    lost = {k for k, valve in enumerate(valves) if valve.confidence < best - LOST_BY}
    while lost and len(lost) < len(valves):
        k, start = max(
            (
                (k, valves[j])
                for k in lost
                for j in (k - 1, k + 1)
                if 0 <= j < len(valves) and j not in lost
            ),
            key=lambda pair: pair[1].confidence,
        )
        lost.remove(k)
        again = fit_frame(
            frames[k], model, start.pose, coefficients=start.coefficients, tips=start.tips
        )
        if again.confidence > valves[k].confidence:
            valves[k] = again


def _trajectory(frames: list[StandardFrame], times: FloatArray, model: DetectionModel) -> Poses:
    """One pose for every frame."""
    own: list[Rated] = []
    for frame in frames:
        poses, rating = search_poses(frame, model.boosters, CANDIDATES)
        few = poses.apart(rating, HYPOTHESES)
        own.append((poses[few], rating[few]))
    pool, ratings = _joined(own)
    if not len(pool):
        raise NoValveError("no valve found; no frame has a field of view")
    best = pool[pool.apart(ratings, SHARED)]
    if np.median([rating[0] for _, rating in own if len(rating)]) < SURE:
        # Take the pose with the highest confidence in a few frames, and hypotheses within 60
        # degrees of it.
        tried = pool[pool.apart(ratings, TRIED)]
        seen = np.zeros(len(tried))
        for k in sorted({0, len(frames) // 2, len(frames) - 1}):
            seen += merits(frames[k], model, refined(frames[k], model.boosters, tried)[0])
        best = tried[[int(np.argmax(seen))]]
        for k, (poses, rating) in enumerate(own):
            turn = Rotation.from_matrix(np.swapaxes(best.rotation, 1, 2) @ poses.rotation)
            near = np.asarray(turn.magnitude() < np.deg2rad(60.0))
            own[k] = poses[near], rating[near]
    candidates = [
        _joined([rated, refined(frame, model.boosters, best)])
        for frame, rated in zip(frames, own, strict=True)
    ]
    path = _best_path(candidates, times, model)
    return Poses.joined([candidates[k][0][p : p + 1] for k, p in enumerate(path)])


def _joined(parts: list[Rated]) -> Rated:
    poses, ratings = zip(*parts, strict=True)
    return Poses.joined(list(poses)), np.concatenate(ratings)


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
