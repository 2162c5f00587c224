"""Personalisation of a case: generic valve, estimation, comparison with its frames, details."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Role, ValveCase
from mvest.closure.model import ClosureModel
from mvest.estimation.estimate import OnIterate
from mvest.estimation.prediction import Prediction
from mvest.observation.surfaces import surface_distance
from mvest.personalisation.calibration import calibration_for
from mvest.personalisation.closed import closed_details
from mvest.personalisation.estimation import CaseEstimate, CaseProblem, OnStep, estimate_all
from mvest.personalisation.known import known_of, law_share
from mvest.personalisation.model import held_state
from mvest.personalisation.result import FrameComparison, Personalised
from mvest.personalisation.settings import PersonaliseSettings, default_settings
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray


def personalise(
    case: ValveCase,
    settings: PersonaliseSettings | None = None,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
    on_iterate: OnIterate | None = None,
) -> Personalised:
    """Estimate the unknowns of a case.

    A numerical failure is part of the result, with its reason; only inadmissible input raises. The
    calibration is found and checked first, and applied by `mvest.personalisation.record`.

    Parameters
    ----------
    settings : PersonaliseSettings, optional
        Default: `default_settings`.
    store : Path, optional
        Cache of unstructured meshes.
    on_step : callable, optional
        Progress, see :class:`mvest.closure.model.ClosureModel`.
    on_iterate : callable, optional
        Called after each iterate of every filter.
    """
    settings = default_settings(case) if settings is None else settings
    problem = CaseProblem.of(case, settings, store, on_step, on_iterate)
    calibration = calibration_for(case, problem.settings)
    generic = problem.generic()
    before: dict[str, FloatArray] = {}
    if generic.prediction.converged:
        if case.error_samples is not None:
            generic = generic.sampled()
        # Held-out frames start from the last closed valve, so they come before other closures.
        before = predicted_frames(problem, generic.m, generic.prediction.y)
    estimate = estimate_all(problem, generic)
    result, point = estimate.result, estimate.point
    found = Personalised(
        case=case,
        settings=problem.settings,
        mesh=problem.closure.model.mesh,
        result=result,
        alternatives={},
        error_samples=0 if point.errors.frame_samples is None else len(point.errors.frame_samples),
        unaccounted=estimate.unaccounted,
        moved=estimate.moved,
        calibration=calibration,
    )
    if before and result.estimate is not None and result.fitted is not None:
        after = predicted_frames(problem, result.estimate, result.fitted)
        found = replace(
            found,
            frames=compare_frames(problem, before, after),
            details=known_of(problem, estimate),
            law_share=law_share(estimate),
            confirmed_mm=largest_difference_anew(problem, estimate) if settings.confirm else None,
        )
        at = replace(
            point, m=result.estimate, prediction=problem.closure.registered(result.estimate)
        )
        learned = None if result.filtered is None else result.filtered.learned
        closed = closed_details(at.valve, at.errors, learned)
        found = replace(found, details={**found.details, **closed})
    stated = replace(generic, errors=point.errors.as_stated())
    return replace(found, alternatives=problem.alternatives(stated))


def predicted_frames(
    problem: CaseProblem, m: FloatArray, closed: FloatArray
) -> dict[str, FloatArray]:
    """Predicted vertices ``(n, 3)`` mm of all fitted and held-out frames, as observed.

    ``closed`` are the predicted frames at ``m (p,)``, stacked, the closed one last.
    """
    closure, fitted, case = problem.closure, problem.fitted, problem.case
    shown = closed.reshape(-1, len(case.surface.vertices), 3)[-len(fitted.frames) :]
    frames = {frame.name: points for frame, points in zip(fitted.frames, shown, strict=True)}
    further = {frame.name: held_state(closure.model, frame) for frame in case.held_out}
    if not further:
        return frames
    registered, states = closure.registered, list(further.values())
    if closure.frames is not None:
        states = closure.frames.under(registered.own(m), further)
    held = closure.model.held(registered.mechanical(m), states)
    found = {name: points for name, points in zip(further, held, strict=True) if points is not None}
    return frames | {name: registered.seen(points, m) for name, points in found.items()}


def compare_frames(
    problem: CaseProblem, generic: Mapping[str, FloatArray], fitted: Mapping[str, FloatArray]
) -> tuple[FrameComparison, ...]:
    """Compare observed frames with generic and fitted valve ``(n, 3)`` mm, if both predict them."""
    case, closed = problem.case, problem.case.frame(Role.CLOSED)
    # Without correspondence the displacement is that of the prior, none.
    turn, origin, target = np.eye(3), np.zeros(3), np.zeros(3)
    if problem.fitted.corresponding:
        points = generic[closed.name]
        origin, target = points.mean(axis=0), closed.vertices.mean(axis=0)
        turn = Rotation.align_vectors(closed.vertices - target, points - origin)[0].as_matrix()
    compared = []
    for frame in sorted(case.frames, key=lambda f: bool(case.fitted) and f is not closed):
        if frame.name not in generic or frame.name not in fitted:
            continue
        positions = {
            "generic": generic[frame.name],
            "registered": (generic[frame.name] - origin) @ turn.T + target,
            "personalised": fitted[frame.name],
        }
        distances = {
            model: np.asarray(np.linalg.norm(points - frame.vertices, axis=1))
            if frame.corresponds
            else surface_distance(frame.vertices, points, case.surface.triangles)
            for model, points in positions.items()
        }
        seen = frame.role in (Role.CLOSED, Role.FITTED)
        compared.append(FrameComparison(frame, seen, positions, distances))
    return tuple(compared)


def largest_difference_anew(problem: CaseProblem, estimate: CaseEstimate) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed from the open state.

    Both on the guide mesh if there is one. None if one of them does not close.
    """
    closure, m = problem.closure, estimate.result.estimate
    assert m is not None
    model = closure.model.guide or closure.model
    anew = replace(model, continuation=False, guide=None, repeat=True)

    def closed(one: ClosureModel) -> Prediction:
        frames = closure.frames and replace(closure.frames, model=one)
        return RegisteredModel(frames or one, problem.names)(m)

    found = [closed(one) for one in (model, anew)]
    if not all(one.converged for one in found):
        return None
    continued, again = (one.y.reshape(-1, len(problem.case.surface.vertices), 3) for one in found)
    return float(np.linalg.norm(continued[-1] - again[-1], axis=1).max())
