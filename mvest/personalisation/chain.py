"""From a case to its moduli: generic valve, estimation, comparison, what is known of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.model import ClosureModel
from mvest.estimation.estimate import OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.prediction import Prediction
from mvest.observation.surfaces import surface_distance
from mvest.personalisation.estimation import (
    CaseEstimate,
    CaseProblem,
    OnStep,
    Place,
    estimate_all,
    sampled,
)
from mvest.personalisation.known import (
    LinearModel,
    data_alone,
    derived_quantities,
    narrower,
    strains,
    variance_shares,
)
from mvest.personalisation.model import held_state
from mvest.personalisation.result import (
    FrameDistance,
    Known,
    Personalised,
    geometry_shifts,
    law_share,
)
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

    Numerical failure is part of the result, with its reason; only inadmissible input raises.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings, optional
        By default as `default_settings` has them.
    store : Path, optional
        Where an unstructured mesh and closed states are kept.
    on_step : callable, optional
        Progress, see :class:`mvest.closure.model.ClosureModel`.
    on_iterate : callable, optional
        Called after each iterate of every filter.
    """
    settings = default_settings(case) if settings is None else settings
    problem = CaseProblem.of(case, settings, store, on_step, on_iterate)
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(part: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - began

    with timed("generic"):
        generic = problem.generic()
    if generic.prediction.converged and case.error_samples is not None:
        with timed("geometry"):
            generic = sampled(generic)
    # Held-out frames are gone to from the closed valve that was found last.
    before: dict[str, FloatArray] = {}
    with timed("held_out"):
        if generic.prediction.converged:
            before = predicted_frames(problem, generic, generic.m, generic.prediction.y)
    estimate = estimate_all(problem, generic)
    result, place = estimate.result, estimate.place
    seconds["estimate"] = result.seconds
    frames, known, confirmed = ComparedFrames({}, {}, {}, ()), Known(), None
    if before and result.estimate is not None and result.fitted is not None:
        with timed("held_out"):
            after = predicted_frames(problem, place, result.estimate, result.fitted)
            frames = compare_frames(problem, before, after)
        with timed("known"):
            known = known_of(problem, estimate)
        if settings.confirm:
            with timed("confirm"):
                confirmed = largest_difference_anew(problem, estimate)
    # From here on with geometry and law as they are stated, known exactly.
    stated = Place(
        problem.stated,
        place.errors.as_stated(),
        generic.m,
        generic.prediction,
    )
    moduli_only = paper = None
    if settings.moduli_only:
        moduli_only = problem.estimate_moduli(
            stated,
            IteratedFilter(settings.tolerance, max_iterations=settings.max_iterations),
            stated.errors.observation(),
            log=True,
        )
        seconds["moduli_only"] = moduli_only.seconds
    if settings.paper is not None:
        paper = problem.estimate_as_paper(stated, settings.paper)
        seconds["paper"] = paper.seconds
    return Personalised(
        case=case,
        settings=problem.settings,
        mesh=place.closure.model.mesh,
        result=result,
        moduli_only=moduli_only,
        paper=paper,
        distances=frames.distances,
        generic=frames.generic,
        registered=frames.registered,
        fitted=frames.fitted,
        known=known,
        confirmed_mm=confirmed,
        seconds=seconds,
        error_samples=0 if place.errors.frame_samples is None else len(place.errors.frame_samples),
        unaccounted=estimate.unaccounted,
        moved=estimate.moved,
    )


def known_of(problem: CaseProblem, estimate: CaseEstimate) -> Known:
    """What an estimate knows and what limits it, to first order about it."""
    filtered = estimate.result.filtered
    assert filtered is not None
    model = LinearModel.of(filtered, estimate.errors)
    return Known(
        quantities=(
            *derived_quantities(filtered),
            *strains(problem, estimate, model),
        ),
        data_alone=data_alone(filtered),
        shares=variance_shares(model),
        narrower=narrower(problem, model),
        geometry=geometry_shifts(problem, estimate),
        law_share=law_share(estimate),
    )


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
    problem: CaseProblem, place: Place, m: FloatArray, closed: FloatArray
) -> dict[str, FloatArray]:
    """All frames of the closed valve as they are predicted to be seen, ``(n, 3)`` mm each.

    Parameters
    ----------
    problem : CaseProblem
    place : Place
        Whose closure predicts.
    m : (p,)
    closed : array
        Predicted frames at ``m``, stacked, the closed one last.
    """
    closure, fitted, case = place.closure, problem.fitted, problem.case
    n = len(case.surface.vertices)
    shown = closed.reshape(-1, n, 3)[-len(fitted.frames) :]
    frames = {frame.name: points for frame, points in zip(fitted.frames, shown, strict=True)}
    # Their annulus and tips are off as those of the fitted frames.
    further = {
        frame.name: closure.held(held_state(problem.stated.model, frame)) for frame in case.held_out
    }
    states = list(further.values())
    if states:
        registered = closure.registered
        if closure.frames is not None:
            states = closure.frames.under(registered.own(m), further)
        held = closure.model.held(registered.mechanical(m), states)
        for frame, points in zip(case.held_out, held, strict=True):
            if points is not None:
                frames[frame.name] = registered.seen(points, m)
    return frames


def compare_frames(
    problem: CaseProblem, generic: Mapping[str, FloatArray], fitted: Mapping[str, FloatArray]
) -> ComparedFrames:
    """How far the frames that both valves have are from where they were seen."""
    case = problem.case
    closed = case.frame(Role.CLOSED)
    turn, origin, target = _alignment(problem, closed, generic[closed.name])
    registered = {name: (points - origin) @ turn.T + target for name, points in generic.items()}
    # The closed frame first, wherever others are fitted with it.
    shown = sorted(case.frames, key=lambda f: bool(case.fitted) and f is not closed)
    distances = [
        FrameDistance(
            frame.name,
            frame.role in (Role.CLOSED, Role.FITTED),
            *(
                _distance(problem, frame, positions[frame.name])
                for positions in (generic, registered, fitted)
            ),
        )
        for frame in shown
        if frame.name in generic and frame.name in fitted
    ]
    return ComparedFrames(generic, registered, fitted, tuple(distances))


def _alignment(
    problem: CaseProblem, closed: Frame, generic: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Turn, origin and its target that lay the generic closed valve on the closed frame."""
    if not problem.fitted.corresponding:
        # Without correspondence: the displacement is that of the prior, none.
        return np.eye(3), np.zeros(3), np.zeros(3)
    origin, target = generic.mean(axis=0), closed.vertices.mean(axis=0)
    turn, _ = Rotation.align_vectors(closed.vertices - target, generic - origin)
    return turn.as_matrix(), origin, target


def _distance(problem: CaseProblem, frame: Frame, positions: FloatArray) -> FloatArray:
    if problem.settings.correspondence and frame.corresponds:
        return np.asarray(np.linalg.norm(positions - frame.vertices, axis=1))
    return surface_distance(frame.vertices, positions, problem.case.surface.triangles)


def largest_difference_anew(problem: CaseProblem, estimate: CaseEstimate) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed from the open state.

    Both are on the mesh of the guide where there is one, which leads all closures of the other.
    None if one of them does not close.
    """
    closure, m = estimate.place.closure, estimate.result.estimate
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
