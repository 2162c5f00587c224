"""The valve in one frame: its pose, then landmarks, rims and leaflets."""

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.leaflets import find_boundary, find_landmarks, find_rim
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.pose_search import MODES, refined, search_poses, starting_shape
from mvest.imaging.detection.shape_model import Pulls, fit_shape, relax
from mvest.imaging.detection.trained_model import DetectionModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence, landmark_vertices
from mvest.typing import FloatArray

LANDMARK_STD_MM, RIM_STD_MM = 1.2, 0.8
"""mm, smallest standard deviation of the pull of a landmark and a rim; votes add their spread."""

ROUNDS = ((14, 6.0), (25, 4.0), (40, 3.0))
"""Largest number of modes in each round of the fit, and the search distance (mm) along normals."""

CORRELATED = 8.0
"""Divides the number of vertices in the fit, as errors of neighbouring vertices are correlated."""

STIFFNESS, HOLD = 4.0, 0.3
"""Of the free displacement at the end (:func:`mvest.imaging.detection.shape_model.relax`)."""

CANDIDATES = 40
"""Poses that a search returns, many of them similar."""

SURE, TRIED = 0.6, 14
"""If the best rating is below SURE, TRIED poses are fitted. Fewer often miss the right one."""

RATING_SHARE = 0.3
"""Weight of a pose's rating in the confidence. In simulated volumes unlike those of training, the
rating alone prefers a wrong pose in every third."""

STRANGE_SHARE = 0.15
"""Confidence lost for each unit by which the squared distance of a shape from the mean (over the
deviations, mean over the modes) exceeds 1, that of the training valves. Fitted to chamber walls, or
front to back, a shape has a distance of 1.5 to 4."""


class NoValveError(InputError):
    """A volume shows no valve of sufficient confidence.

    ``candidate`` is the best one, which was not accepted; None without a field of view.
    """

    def __init__(self, message: str, candidate: ValveSequence | None = None) -> None:
        super().__init__(message)
        self.candidate = candidate


@dataclass(frozen=True, slots=True, eq=False)
class FrameValve:
    """A valve in one frame; positions in world mm."""

    pose: Poses  #: one
    coefficients: FloatArray  #: (K,) of the shape model
    vertices: FloatArray  #: (n, 3)
    tips: FloatArray  #: (2, 3)
    confidence: float  #: 0 (no valve) to 1
    vertex_confidence: FloatArray  #: (n,)


def find_frame(frame: StandardFrame, model: DetectionModel) -> FrameValve:
    """Search one frame and fit the valve in it; NoValveError without a field of view."""
    poses, rating = search_poses(frame, model.boosters, CANDIDATES)
    if not len(poses):
        raise NoValveError("no valve found: no field of view")
    if rating[0] < SURE:
        poses = poses[poses.apart(rating, TRIED)]
        best = int(np.argmax(merits(frame, model, poses)))
        poses = poses[best : best + 1]
    return fit_frame(frame, model, poses[:1])


def merits(frame: StandardFrame, model: DetectionModel, poses: Poses) -> FloatArray:
    """Confidence ``(P,)`` of valves at some poses, fitted roughly to every second row and column.

    In images unlike those of training a wrong pose may be rated best. Its leaflets are then away
    from the detected boundary, or have an unusual shape.
    """
    shape, layout, trees = model.shape, model.shape.layout, model.boosters
    some = np.arange(layout.size).reshape(layout.rows, -1)[::2, ::2]
    coarse = ValveLayout(some.shape[1], some.shape[0])
    wide = np.sqrt(max(1.0, CORRELATED * coarse.size / layout.size))
    found = []
    for k in range(len(poses)):
        pose, b = poses[k : k + 1], np.zeros(min(ROUNDS[0][0], len(shape.std)))
        b[:MODES] = starting_shape(frame, trees, pose, shape)[0][0]
        for _, reach in (ROUNDS[0], ROUNDS[-1]):
            vertices = pose.world(shape.shape(b[None]))[0][some.ravel()]
            normals, offset, std, seen = find_boundary(frame, trees, vertices, coarse, reach)
            pose, b = fit_shape(shape, pose, b, Pulls(some.ravel(), normals, offset, wide * std))
        found.append(_confidence(frame, model, pose, b, seen))
    return np.array(found)


def _confidence(
    frame: StandardFrame, model: DetectionModel, pose: Poses, b: FloatArray, seen: FloatArray
) -> float:
    """Confidence that there is a valve, 0 to 1, by its leaflets, pose and shape.

    In volumes of walls without a valve, either the leaflets (on a wall) or the pose may look right,
    but rarely both, and the shape is mostly unusual.
    """
    rating = float(np.clip(refined(frame, model.boosters, pose)[1][0], 0.0, 1.0))
    strange = max(0.0, float(((b / model.shape.std[: len(b)]) ** 2).mean()) - 1.0)
    return max(0.0, min(1.0, RATING_SHARE * rating + float(seen.mean())) - STRANGE_SHARE * strange)


def fit_frame(
    frame: StandardFrame,
    model: DetectionModel,
    pose: Poses,
    *,
    coefficients: FloatArray | None = None,
    tips: FloatArray | None = None,
) -> FrameValve:
    """Fit the valve from a pose (one).

    The fit starts from ``coefficients (K,)`` and ``tips (2, 3)`` mm, or from those regressed at the
    pose.
    """
    shape, layout = model.shape, model.shape.layout
    start, found_tips = starting_shape(frame, model.boosters, pose, shape)
    b = np.zeros(min(ROUNDS[0][0], len(shape.std)))
    b[:MODES] = start[0] if coefficients is None else coefficients[:MODES]
    tips = found_tips[0] if tips is None else tips
    vertices = pose.world(shape.shape(b[None]))[0]
    at = np.array(list(landmark_vertices(layout).values()))
    points = np.concatenate([vertices[at], tips])
    points, spread = find_landmarks(frame, model.boosters, pose, points)
    std = np.hypot(LANDMARK_STD_MM, spread[: len(at)])
    pulls = Pulls.to_points(at, vertices[at], points[: len(at)], std)
    pose, b = fit_shape(shape, pose, b, pulls)
    for modes, reach in ROUNDS:
        b = np.concatenate([b, np.zeros(max(0, min(modes, len(shape.std)) - len(b)))])
        pose, b = fit_shape(shape, pose, b, _seen(frame, model, pose, b, reach)[1])
    vertices, pulls, confidence = _seen(frame, model, pose, b, reach)
    vertices = relax(vertices, layout, pulls, STIFFNESS, HOLD)
    sure = _confidence(frame, model, pose, b, confidence)
    return FrameValve(pose, b, vertices, points[len(at) :], sure, confidence)


def _seen(
    frame: StandardFrame, model: DetectionModel, pose: Poses, b: FloatArray, reach: float
) -> tuple[FloatArray, Pulls, FloatArray]:
    """A shape ``(n, 3)`` mm, the pulls of leaflets and rims, and vertex confidences ``(n,)``."""
    layout, boosters = model.shape.layout, model.boosters
    vertices = pose.world(model.shape.shape(b[None]))[0]
    normals, offset, std, confidence = find_boundary(frame, boosters, vertices, layout, reach)
    parts = [Pulls(np.arange(layout.size), normals, offset, np.sqrt(CORRELATED) * std)]
    for rim, at in (("annulus", layout.annulus), ("free_edge", layout.free_edge)):
        axes, off, spread = find_rim(
            frame, boosters, rim, vertices, layout, float(pose.log_scale[0])
        )
        # Errors of neighbouring columns are correlated as those of rows are.
        wide = np.sqrt(np.sqrt(CORRELATED)) * np.hypot(RIM_STD_MM, spread)
        parts += [Pulls(at, axes[:, :, 1 + k], off[:, k], wide) for k in range(2)]
    return vertices, Pulls.joined(parts), confidence
