"""The chain of one case: generic valve, estimation, held-out frames, intervals."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from mvest.cases.case import ValveCase
from mvest.estimation.estimate import OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.personalisation.accuracy import error_budget, image_share, narrower
from mvest.personalisation.comparison import (
    ComparedFrames,
    compare_frames,
    largest_difference_anew,
    predicted_frames,
)
from mvest.personalisation.defaults import default_settings
from mvest.personalisation.estimation import CaseEstimation, OnStep
from mvest.personalisation.expected import geometry_shifts, law_share
from mvest.personalisation.result import Personalised
from mvest.personalisation.settings import PersonaliseSettings
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
