"""The chain of one case: default settings, generic valve, estimation, comparison, accuracy."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.frames import is_frame_pressure
from mvest.estimation.estimate import OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings, TissueSettings
from mvest.mechanics.steps import NewtonSettings
from mvest.observation.learned import ErrorBeliefs
from mvest.observation.surfaces import surface_distance
from mvest.personalisation.considered_geometry import ConsideredGeometry
from mvest.personalisation.error_budget import BudgetRow, budget_rows, sample_parts
from mvest.personalisation.estimation import CaseEstimation, OnStep
from mvest.personalisation.result import FrameDistance, Personalised, geometry_shifts, law_share
from mvest.personalisation.settings import (
    PersonaliseSettings,
    PressureErrors,
    Prior,
    Treatment,
)
from mvest.problem.estimate import StudyResult
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import FloatArray

UNKNOWNS = (
    Prior("E_f.anterior", 6.23, 3.1),
    Prior("E_f.posterior", 2.09, 1.05),
    Prior("pressure_scale", 1.0, 0.1),
    Prior("chord_stiffness", 1.0, 0.2),
    Prior("chord_rest_length", 1.0, 0.02),
    *(Prior(name, 0.0, 1.0 if name.startswith("shift") else 2.0) for name in REGISTRATION),
)
"""Priors; moduli in MPa, displacements in mm and degrees."""

CUFF = 0.15
"""Relative standard deviation of a pressure from a cuff and Doppler."""

CURVES = {
    "anterior": ExponentialTissue(0.06, 4.325, 1446.5),
    "posterior": ExponentialTissue(0.04, 4.848, 305.4),
}
"""Exponents of May-Newman and Yin 1998 as usually quoted; the scale does not matter."""


def default_settings(case: ValveCase) -> PersonaliseSettings:
    """The settings that fit where a case is from: surfaces, or a volume with its error samples.

    Parameters
    ----------
    case : ValveCase
        With an anterior and a posterior leaflet.
    """
    surfaces = PersonaliseSettings(
        tuple(
            replace(unknown, std=CUFF) if unknown.name == "pressure_scale" else unknown
            for unknown in UNKNOWNS
        ),
        MechanicsSettings(
            {
                "anterior": TissueSettings(6.23 / 2.35),
                "posterior": TissueSettings(2.09 / 1.89),
            },
            newton=NewtonSettings(max_halvings=3),
        ),
        moduli_only=True,
        confirm=True,
        errors=ErrorBeliefs(resolution_mm=0.1),
        considered_geometry=ConsideredGeometry(
            rest_lengths=0.06, thickness=0.2, share=0.98, renewals=6
        ),
        considered_law=CURVES,
        pressures=PressureErrors(),
    )
    if case.error_samples is None:
        return surfaces
    # Leaflets, annulus and tips come from one volume: nothing is displaced against anything else,
    # and their errors are in the samples.
    return replace(
        surfaces,
        unknowns=tuple(
            replace(unknown, treatment=Treatment.FIXED) if unknown.name in REGISTRATION else unknown
            for unknown in UNKNOWNS
        ),
        errors=ErrorBeliefs(resolution_mm=0.3),
        considered_geometry=ConsideredGeometry(
            shape_mm=0.0, annulus_mm=0.0, tips_mm=0.0, rest_lengths=0.04
        ),
        considered_law={},
    )


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
    estimation = CaseEstimation(case, settings, store, on_step, on_iterate)
    started = time.perf_counter()
    # Not the prior's mean, which may differ from where filters start by its last bit.
    start = estimation.shared.start
    generic = estimation.shared(start)
    seconds = {"generic": time.perf_counter() - started}
    if generic.converged and case.error_samples is not None:
        began = time.perf_counter()
        estimation.errors.sample_geometry(start, generic.y)
        seconds["geometry"] = time.perf_counter() - began

    def timed(part: str, began: float) -> None:
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - began

    # Held-out frames are gone to from the closed valve that was found last.
    began = time.perf_counter()
    before = predicted_frames(estimation, start, generic.y) if generic.converged else {}
    timed("held_out", began)
    result = estimation.estimate_all()
    seconds["estimate"] = result.seconds
    frames = ComparedFrames({}, {}, {}, ())
    stds: Mapping[str, FloatArray] = {}
    if before and result.estimate is not None and result.fitted is not None:
        began = time.perf_counter()
        frames = compare_frames(
            estimation, before, predicted_frames(estimation, result.estimate, result.fitted)
        )
        timed("held_out", began)
        stds = narrower(estimation, result)
    share = image_share(estimation, result)
    budget = error_budget(estimation, result)
    shifts, share_of_law = geometry_shifts(estimation, result), law_share(estimation, result)
    unconsidered, geometry = estimation.errors.unconsidered, estimation.errors.geometry
    moduli_only = paper = confirmed = None
    if settings.confirm and frames.distances:
        began = time.perf_counter()
        confirmed = largest_difference_anew(estimation, result)
        timed("confirm", began)
    estimation.take_as_stated()
    if settings.moduli_only:
        moduli_only = estimation.estimate_moduli(
            IteratedFilter(settings.tolerance, max_iterations=settings.max_iterations),
            estimation.errors.observation(),
            log=True,
        )
        seconds["moduli_only"] = moduli_only.seconds
    if settings.paper is not None:
        paper = estimation.estimate_as_paper(settings.paper)
        seconds["paper"] = paper.seconds
    return Personalised(
        case,
        estimation.settings,
        estimation.model.mesh,
        estimation.names,
        estimation.prior,
        result,
        moduli_only,
        paper,
        frames.distances,
        frames.generic,
        frames.registered,
        frames.fitted,
        stds,
        confirmed,
        seconds,
        geometry,
        share,
        unconsidered,
        budget,
        estimation.moved,
        shifts,
        share_of_law,
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


BETTER = 5.0
"""How many times as well as beforehand a nuisance may be measured."""


def image_share(estimation: CaseEstimation, result: StudyResult) -> FloatArray | None:
    """Share of the variance of each modulus' logarithm that errors of the image account for."""
    filtered = result.filtered
    if estimation.errors.samples is None or filtered is None or filtered.prediction is None:
        return None
    posterior = estimation.sampled_posterior(filtered)
    share = np.diag(posterior.from_samples) / np.diag(posterior.covariance)
    return share[[u.is_modulus for u in estimation.unknowns]]


def error_budget(estimation: CaseEstimation, result: StudyResult) -> tuple[BudgetRow, ...]:
    """What each part of what is not known costs the moduli; of error samples alone."""
    filtered, errors = result.filtered, estimation.errors
    if errors.samples is None or filtered is None or filtered.prediction is None:
        return ()
    m = filtered.mean
    predicted = estimation.shared(m)
    if not predicted.converged:
        return ()
    parts, motion = sample_parts(estimation.case)
    # One factorisation for all of them.
    vertices, tips = (np.concatenate(each) for each in zip(*parts.values(), motion, strict=True))
    sampled = errors.sampled(m, predicted.y, vertices, tips)
    if isinstance(sampled, str):
        return ()
    *each, differ = np.split(sampled[1], len(parts) + 1, axis=1)
    z = filtered.transformed_iterates[-1]
    return budget_rows(
        filtered.names,
        filtered.prediction.jacobian * filtered.transform.derivative(z),
        to_filter(filtered.transform, filtered.prior).covariance,
        errors.noise(filtered.learned, without=errors.kinds),
        dict(zip(parts, each, strict=True)),
        differ,
        errors.samples.source,
        {own.name: own.columns for own in errors.considered},
    )


def narrower(estimation: CaseEstimation, result: StudyResult) -> Mapping[str, FloatArray]:
    """Standard deviations of the moduli's logarithms if something more were measured.

    From the linear model at the estimate, all unknowns estimated. Whatever else is measured is
    then known ``BETTER`` times as well as beforehand.
    """
    filtered = result.filtered
    assert filtered is not None
    assert filtered.prediction is not None
    moduli = [k for k, u in enumerate(estimation.unknowns) if u.is_modulus]
    prior = to_filter(estimation.transform, estimation.prior)
    z = filtered.transformed_iterates[-1]
    H = filtered.prediction.jacobian * estimation.transform.derivative(z)
    errors, learned = estimation.errors.samples, filtered.learned
    doubt = np.zeros_like(prior.covariance) if learned is None else learned.covariance
    groups = _measurable(estimation)

    def widened(covariance: FloatArray, beats: float) -> FloatArray:
        own, more = np.diag(covariance), np.diag(doubt) / beats
        # The doubt of now: of less it may take more away than there is.
        return np.sqrt(np.where(own + more > 0.0, own + more, own))[moduli]

    def linear(P: FloatArray, beats: float = 1.0, without: Collection[str] = ()) -> FloatArray:
        plain = estimation.errors.noise(learned, beats=beats, without=without, stated=True)
        update = kalman_update(Gaussian(z, P), np.zeros(len(H)), H, plain)
        return widened(update.posterior.covariance, beats)

    def std(P: FloatArray, beats: float = 1.0) -> FloatArray:
        if errors is None:
            return linear(P, beats)
        own = estimation.errors.weighing(errors, learned, beats=beats)
        return widened(own.posterior(H, P).covariance, beats)

    stds = {"now": std(prior.covariance)}
    for words, members in groups.items():
        known = np.isin(estimation.names, members)
        if known.any():
            share = np.where(known, 1 / BETTER, 1.0)
            stds[words] = std(prior.covariance * np.outer(share, share))
    stds["4 beats averaged"] = std(prior.covariance, 4.0)
    family = estimation.errors.single_errors
    # Without a resolution errors of single observations have no floor.
    most = np.inf if family is not None and family.resolution > 0.0 else 1e6
    stds["any number of beats averaged"] = std(prior.covariance, most)
    if errors is not None:
        stds["geometry known exactly"] = linear(prior.covariance, without=estimation.errors.kinds)
        return stds
    for kind in estimation.errors.kinds:
        stds[f"{kind} known exactly"] = linear(prior.covariance, without=(kind,))
    return stds


def _measurable(estimation: CaseEstimation) -> dict[str, tuple[str, ...]]:
    """What else could be measured and how well, in words -> the nuisances that it tells of."""
    std = {u.name: u.std / BETTER for u in estimation.unknowns}
    words: dict[str, tuple[str, ...]] = {}
    # A scale is of the closed frame's pressure, errors of several frames are in mmHg.
    errors = {
        name: error * (1.0 if is_frame_pressure(name) else estimation.closed.pressure_mmHg)
        for name, error in std.items()
        if name == "pressure_scale" or is_frame_pressure(name)
    }
    if errors:
        words[f"pressure measured to ±{max(errors.values()):.2g} mmHg"] = tuple(errors)
    for name, what in (
        ("chord_rest_length", "rest lengths"),
        ("chord_stiffness", "stiffness"),
    ):
        if name in std:
            words[f"{what} of the chordae measured to ±{100 * std[name]:.2g} %"] = (name,)
    if any(name in std for name in REGISTRATION):
        words[f"annulus placed {BETTER:g} times as well"] = REGISTRATION
    others = tuple(n for n in estimation.names if not n.startswith("E_f."))
    return {**words, f"all of these measured {BETTER:g} times as well": others}
