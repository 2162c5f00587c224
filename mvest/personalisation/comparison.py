"""How far predicted frames are from the seen ones, those that are held out among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role
from mvest.observation.surfaces import surface_distance
from mvest.personalisation.estimation import CaseEstimation
from mvest.personalisation.result import FrameDistance
from mvest.problem.estimate import StudyResult
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ComparedFrames:
    """Frames that both the generic and the fitted valve have, ``(n, 3)`` mm each.

    Attributes
    ----------
    generic, registered, fitted : mapping
        Frame -> vertices of the generic valve, the same laid on the closed frame, the fitted valve.
    distances : tuple of FrameDistance
    """

    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    distances: tuple[FrameDistance, ...]


def predicted_frames(
    estimation: CaseEstimation, m: FloatArray, closed: FloatArray
) -> dict[str, FloatArray]:
    """All frames of the closed valve as they are predicted to be seen, ``(n, 3)`` mm each.

    Parameters
    ----------
    m : (p,)
    closed : array
        Predicted frames at ``m``, stacked, the closed one last.
    """
    n = len(estimation.case.surface.vertices)
    shown = closed.reshape(-1, n, 3)[-len(estimation.fitted.frames) :]
    frames = {
        frame.name: points for frame, points in zip(estimation.fitted.frames, shown, strict=True)
    }
    further = estimation.held_out()
    states = list(further.values())
    if states:
        if estimation.frames is not None:
            states = estimation.frames.under(estimation.registered.own(m), further)
        held = estimation.model.held(estimation.registered.mechanical(m), states)
        for frame, points in zip(estimation.case.held_out, held, strict=True):
            if points is not None:
                frames[frame.name] = estimation.registered.seen(points, m)
    return frames


def compare_frames(
    estimation: CaseEstimation, generic: Mapping[str, FloatArray], fitted: Mapping[str, FloatArray]
) -> ComparedFrames:
    """How far the frames that both valves have are from where they were seen."""
    turn, origin, target = _alignment(estimation, generic[estimation.closed.name])
    registered = {name: (points - origin) @ turn.T + target for name, points in generic.items()}
    # The closed frame first, wherever others are fitted with it.
    shown = sorted(
        estimation.case.frames,
        key=lambda f: bool(estimation.case.fitted) and f is not estimation.closed,
    )
    distances = [
        FrameDistance(
            frame.name,
            frame.role in (Role.CLOSED, Role.FITTED),
            *(
                _distance(estimation, frame, positions[frame.name])
                for positions in (generic, registered, fitted)
            ),
        )
        for frame in shown
        if frame.name in generic and frame.name in fitted
    ]
    return ComparedFrames(generic, registered, fitted, tuple(distances))


def _alignment(
    estimation: CaseEstimation, generic: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Turn, origin and its target that lay the generic closed valve on the closed frame."""
    if not estimation.fitted.corresponding:
        # Without correspondence: the displacement is that of the prior, none.
        return np.eye(3), np.zeros(3), np.zeros(3)
    origin, target = generic.mean(axis=0), estimation.closed.vertices.mean(axis=0)
    turn, _ = Rotation.align_vectors(estimation.closed.vertices - target, generic - origin)
    return turn.as_matrix(), origin, target


def _distance(estimation: CaseEstimation, frame: Frame, positions: FloatArray) -> FloatArray:
    if estimation.settings.correspondence and frame.corresponds:
        return np.asarray(np.linalg.norm(positions - frame.vertices, axis=1))
    return surface_distance(frame.vertices, positions, estimation.case.surface.triangles)


def largest_difference_anew(estimation: CaseEstimation, result: StudyResult) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed from the open state."""
    assert result.estimate is not None
    assert result.fitted is not None
    anew = replace(estimation.model, continuation=False, guide=None, repeat=True)
    frames = estimation.frames and replace(estimation.frames, model=anew)
    prediction = RegisteredModel(frames or anew, estimation.names)(result.estimate)
    if not prediction.converged:
        return None
    closed = prediction.y.reshape(1 + len(estimation.fitted.frames), -1, 3)[-1]
    return float(np.linalg.norm(closed - result.fitted[-1], axis=1).max())
