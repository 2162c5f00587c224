"""The valve in all frames of a volume: one trajectory through the hypotheses of every frame.

Each frame has several hypotheses; the trajectory that is likely in every frame and moves no faster
than a valve does is found by dynamic programming. What was fitted then is smoothed in time as far
as each vertex was unsure, with a penalty on acceleration; a truncated Fourier series would flatten
the closure itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.detection.detect import (
    CANDIDATES,
    HAND_STD_MM,
    SURE,
    TRIED,
    FitSettings,
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
from mvest.quantities import BeatTime, Count, Length, Share, Speed
from mvest.typing import BoolArray, FloatArray


def smooth_in_time(
    times: FloatArray, points: FloatArray, weight: FloatArray, length_s: FloatArray
) -> FloatArray:
    """Positions ``(T, m, 3)`` mm with little acceleration where they were not sure.

    Minimises sum w (z - y)^2 dt + length^4 int z''^2 dt on second divided differences (Whittaker,
    Proc. Edinburgh Math. Soc. 41:63, 1923), so what varies over much less than ``length`` goes.

    Parameters
    ----------
    times : (T,) s
    points : (T, m, 3) mm
    weight : (T, m)
        How much each counts, relative to the same point in other frames.
    length_s : (m,)
        Over which each is smoothed; where all are 0, nothing is.
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
"""mm, root sum of squares across the best line: below it a pose does not follow from points."""


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How frames are joined.

    Attributes
    ----------
    hypotheses : int
        Of each frame's own search.
    shared : int
        Best ones of all frames that are tried in every frame.
    speed_mm_s : float
        Standard deviation of the speed at which a hypothesis moves (its annulus, in mm).
    still_mm : float
        Standard deviation of its change between frames however short their interval: errors.
    smoothing_s : (float, float, float)
        Times over which annulus, free edge and papillary tips are smoothed; 0: not at all.
    min_confidence : float
        Of the best frame: below it there is no valve.
    lost_by : float
        Confidence by which a frame is behind the best one from which on it is sought again from the
        frames beside it.
    fit : FitSettings
    """

    hypotheses: Count = 3
    shared: Count = 3
    speed_mm_s: Speed = 60.0
    still_mm: Length = 2.0
    smoothing_s: tuple[BeatTime, BeatTime, BeatTime] = (0.06, 0.015, 0.06)
    min_confidence: Share = MIN_CONFIDENCE
    lost_by: Share = 0.2
    fit: FitSettings = field(default_factory=FitSettings)


def detect_valve(
    volume: VolumeSequence,
    model: DetectionModel,
    settings: TrackingSettings | None = None,
    *,
    landmarks: Landmarks | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ValveSequence:
    """Find the valve in every frame of a volume.

    Parameters
    ----------
    volume : VolumeSequence
    model : DetectionModel
    settings : TrackingSettings, optional
    landmarks : mapping, optional
        Placed by hand where the automatic ones failed; they stay where they are.
    progress : callable, optional
        Called with the number of frames done and of all.

    Raises
    ------
    NoValveError
        If no frame shows a valve with some confidence; it holds the best candidate.
    InputError
        If a frame holds no image, or landmarks name no frame or point that there is.
    """
    chosen = settings or TrackingSettings()
    by_hand = _checked(landmarks or {}, len(volume.times), model)
    frames = [standard_frame(volume, k) for k in range(len(volume.times))]
    poses = _trajectory(frames, np.asarray(volume.times), model, chosen, by_hand)
    valves: list[FrameValve] = []
    for k, frame in enumerate(frames):
        valves.append(fit_frame(frame, model, poses[k : k + 1], chosen.fit, fixed=by_hand.get(k)))
        if progress is not None:
            progress(k + 1, len(frames))
    valves = _found_again(frames, valves, model, chosen, by_hand)
    confidence = np.array([valve.confidence for valve in valves])
    sure = np.stack([valve.vertex_confidence for valve in valves])
    at_annulus, at_edge, at_tips = chosen.smoothing_s
    layout, s = model.shape.layout, model.shape.layout.s
    smooth = smooth_in_time(
        np.asarray(volume.times),
        np.stack([np.concatenate([valve.vertices, valve.tips]) for valve in valves]),
        np.concatenate([sure, np.ones((len(valves), 2))], axis=1) * confidence[:, None],
        np.append((1 - s) * at_annulus + s * at_edge, [at_tips] * 2),
    )
    vertices, tips = smooth[:, :-2], smooth[:, -2:]
    for k, points in by_hand.items():
        vertices[k], tips[k] = _held(vertices[k], tips[k], points, model, chosen.fit)
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
    by_eye = any(len(points) >= POSE_LANDMARKS for points in by_hand.values())
    if confidence.max() < chosen.min_confidence and not by_eye:
        raise NoValveError(
            f"{volume.source}: no valve found; the best of {len(frames)} frames has a confidence "
            f"of {confidence.max():.2f}, expected at least {chosen.min_confidence:g} (a mitral "
            "valve whole within the field of view, or landmarks placed by hand)",
            valve,
        )
    return valve


def _found_again(
    frames: list[StandardFrame],
    valves: list[FrameValve],
    model: DetectionModel,
    chosen: TrackingSettings,
    by_hand: Mapping[int, Mapping[int, FloatArray]],
) -> list[FrameValve]:
    """The valves, those of lost frames sought again from the frames beside them, surest first.

    A frame is lost where another one is surer by ``lost_by``. What is found again is kept if it is
    surer than what was there.
    """
    again = list(valves)
    best = max(valve.confidence for valve in valves)
    lost = {k for k, v in enumerate(valves) if v.confidence < best - chosen.lost_by}
    lost -= set(by_hand)
    while lost:
        beside = {k: max(_beside(k, again, lost), default=None) for k in lost}
        surest = {k: pair for k, pair in beside.items() if pair is not None}
        if not surest:
            break
        k = max(surest, key=lambda k: surest[k])
        near = again[surest[k][1]]
        lost.remove(k)
        other = fit_frame(
            frames[k], model, near.pose, chosen.fit, coefficients=near.coefficients, tips=near.tips
        )
        if other.confidence > again[k].confidence:
            again[k] = other
    return again


def _beside(k: int, valves: list[FrameValve], lost: set[int]) -> list[tuple[float, int]]:
    """Confidence and number of the frames beside one, those that are not lost."""
    return [
        (valves[j].confidence, j) for j in (k - 1, k + 1) if 0 <= j < len(valves) and j not in lost
    ]


def _held(
    vertices: FloatArray,
    tips: FloatArray,
    points: Mapping[int, FloatArray],
    model: DetectionModel,
    fit: FitSettings,
) -> tuple[FloatArray, FloatArray]:
    """One frame with its landmarks where they were placed; the leaflets about them come along."""
    at = np.array(list(landmark_vertices(model.shape.layout).values()))
    moved = np.array(tips)
    for number, point in points.items():
        if number >= len(at):
            moved[number - len(at)] = point
    on = [number for number in points if number < len(at)]
    if on:
        target = np.stack([points[number] for number in on])
        std = np.full(len(on), HAND_STD_MM[1])
        pulls = Pulls.to_points(at[on], vertices[at[on]], target, std)
        vertices = relax(vertices, model.shape.layout, pulls, fit.stiffness, fit.hold)
    return vertices, moved


def _checked(
    landmarks: Landmarks, frames: int, model: DetectionModel
) -> dict[int, dict[int, FloatArray]]:
    known = {name: k for k, name in enumerate(LANDMARKS)}
    placed: dict[int, dict[int, FloatArray]] = {}
    for frame, points in landmarks.items():
        if not 0 <= frame < frames:
            raise InputError(f"landmarks of frame {frame}; the volume has frames 0 to {frames - 1}")
        strange = [name for name in points if name not in known]
        if strange:
            raise InputError(
                f"landmarks of frame {frame}: {', '.join(strange)}; expected some of "
                f"{', '.join(known)}"
            )
        placed[frame] = {known[name]: np.asarray(point, float) for name, point in points.items()}
        for name, point in points.items():
            if np.shape(point) != (3,) or not np.isfinite(point).all():
                raise InputError(
                    f"landmarks of frame {frame}, {name}: {np.asarray(point).tolist()}, expected "
                    "three finite coordinates"
                )
        if len(points) >= POSE_LANDMARKS:
            about = np.stack(list(placed[frame].values()))
            size = np.linalg.svd(about - about.mean(axis=0), compute_uv=False)
            if size[1] < LINE_MM:
                raise InputError(
                    f"landmarks of frame {frame} lie within {size[1]:.2g} mm of one line, expected "
                    "them about the valve"
                )
    return placed


def _trajectory(
    frames: list[StandardFrame],
    times: FloatArray,
    model: DetectionModel,
    chosen: TrackingSettings,
    by_hand: Mapping[int, Mapping[int, FloatArray]],
) -> Poses:
    """One pose for every frame."""
    own: list[tuple[Poses, FloatArray]] = []
    for k, frame in enumerate(frames):
        placed = _pose_by_hand(by_hand.get(k, {}), model)
        if placed is None:
            poses, rating = search_poses(frame, model.boosters, CANDIDATES)
            few = poses.apart(rating, chosen.hypotheses)
            own.append((poses[few], rating[few]))
        else:
            own.append((placed, np.ones(1)))
    ratings = np.concatenate([rating for _, rating in own])
    pool = Poses.joined([poses for poses, _ in own])
    if not len(pool):
        raise NoValveError("no valve found; there is no place in any frame to look for one at")
    best = pool[pool.apart(ratings, chosen.shared)]
    if not by_hand and np.median([rating[0] for _, rating in own if len(rating)]) < SURE:
        tried = pool[pool.apart(ratings, TRIED)]
        likeliest = _likeliest_in_all(frames, model, tried, chosen.fit)
        best = tried[likeliest : likeliest + 1]
        own = [(poses[_like(poses, best)], rating[_like(poses, best)]) for poses, rating in own]
    candidates = []
    for k, frame in enumerate(frames):
        if _pose_by_hand(by_hand.get(k, {}), model) is not None:
            candidates.append(own[k])
            continue
        again, rated = refined(frame, model.boosters, best)
        candidates.append((Poses.joined([own[k][0], again]), np.concatenate([own[k][1], rated])))
    path = _best_path(candidates, times, model, chosen)
    return Poses.joined([candidates[k][0][p : p + 1] for k, p in enumerate(path)])


def _likeliest_in_all(
    frames: list[StandardFrame], model: DetectionModel, tried: Poses, fit: FitSettings
) -> int:
    """At which of some poses the valve is seen best in a few frames."""
    seen = np.zeros(len(tried))
    for k in sorted({0, len(frames) // 2, len(frames) - 1}):
        poses, _ = refined(frames[k], model.boosters, tried)
        seen += merits(frames[k], model, poses, fit)
    return int(np.argmax(seen))


def _like(poses: Poses, best: Poses) -> BoolArray:
    """Which poses ``(P,)`` face the way of one, within 60 degrees."""
    turn = Rotation.from_matrix(np.swapaxes(best.rotation[:1], 1, 2) @ poses.rotation)
    return np.asarray(turn.magnitude() < np.deg2rad(60.0))


def _best_path(
    candidates: list[tuple[Poses, FloatArray]],
    times: FloatArray,
    model: DetectionModel,
    chosen: TrackingSettings,
) -> list[int]:
    """The hypothesis of each frame on the likeliest trajectory (Viterbi)."""
    points = np.concatenate([model.shape.mean[model.shape.layout.annulus[::4]], model.shape.tips])
    where = [poses.world(points) for poses, _ in candidates]
    cost = [-2 * np.log(np.clip(rating, 1e-3, 1.0)) for _, rating in candidates]
    total, back = cost[0], []
    for k in range(1, len(candidates)):
        gap = where[k][:, None] - where[k - 1][None]
        moved = np.linalg.norm(gap, axis=3).mean(axis=2)
        std = np.hypot(chosen.still_mm, chosen.speed_mm_s * (times[k] - times[k - 1]))
        # Bounded, so that one frame gone wrong does not drag the others along.
        step = np.minimum(0.5 * (moved / std) ** 2, 8.0) + total[None]
        back.append(np.argmin(step, axis=1))
        total = cost[k] + step.min(axis=1)
    path = [int(np.argmin(total))]
    for pointer in reversed(back):
        path.append(int(pointer[path[-1]]))
    return path[::-1]


def _pose_by_hand(points: Mapping[int, FloatArray], model: DetectionModel) -> Poses | None:
    """The pose that lays the mean valve on landmarks, if there are four or more."""
    if len(points) < POSE_LANDMARKS:
        return None
    shape = model.shape
    at = list(landmark_vertices(shape.layout).values())
    from_ = np.concatenate([shape.mean[at], shape.tips])[list(points)]
    to = np.stack(list(points.values()))
    a, b = from_ - from_.mean(axis=0), to - to.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    rotation = turn.as_matrix()
    scale = float((b * (a @ rotation.T)).sum() / (a * a).sum())
    centre = to.mean(axis=0) - scale * rotation @ from_.mean(axis=0)
    return Poses(centre[None], rotation[None], np.log([max(scale, 0.3)]))
