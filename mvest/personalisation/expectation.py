"""What the frames of a case will tell, before anything is estimated from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import SCALE
from mvest.closure.model import ClosureModel
from mvest.estimation.information.design import Design
from mvest.estimation.prediction import Predicted, predict
from mvest.personalisation.design import SHARES, FrameDesigns, StatedErrors
from mvest.personalisation.estimation import CaseEstimation, OnStep
from mvest.personalisation.model import build_model
from mvest.personalisation.settings import PersonaliseSettings, PressureErrors, Treatment
from mvest.problem.expectation import Expectation, expect
from mvest.typing import FloatArray

__all__ = ["design_case", "expect_case", "foresee_case"]


def expect_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> Expectation:
    """What the frames of a case will tell, found out with one closure; see `personalise`.

    Errors that samples of the frames tell of are left out: each sample would be a closure.
    """
    return _expected(CaseEstimation(case, settings, store, on_step))


def _expected(estimation: CaseEstimation) -> Expectation:
    generic = estimation.shared(estimation.shared.start)
    if generic.converged:
        estimation.errors.consider(estimation.shared.start, generic.y)
    return expect(estimation.problem(estimation.filter), estimation.errors.observation())


def foresee_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> tuple[Expectation, FrameDesigns | str]:
    """`expect_case` and `design_case` together, with one closure."""
    estimation = CaseEstimation(case, settings, store, on_step)
    return _expected(estimation), _designed(case, settings, estimation.model)


def design_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> FrameDesigns | str:
    """What several closed frames of a case would tell, or why that is not known.

    The frames are held and seen as the closed one, under shares of its pressure (`SHARES`): one
    closure, and an equilibrium with its derivatives for each. Errors of which samples tell are left
    out.
    """
    model = build_model(case, settings, store)
    model.on_step = on_step
    return _designed(case, settings, model)


def _designed(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel
) -> FrameDesigns | str:
    closed = case.frame(Role.CLOSED)
    pressures = tuple(share * closed.pressure_mmHg for share in SHARES)
    frames = [
        replace(
            closed,
            name=str(k),
            time=closed.time + k,
            role=Role.FITTED if k else Role.CLOSED,
            pressure_mmHg=pressure,
        )
        for k, pressure in enumerate(pressures)
    ]
    case = replace(case, frames=(case.frame(Role.REFERENCE), *frames), error_samples=None)
    stated = settings.pressures or PressureErrors(0.0, 0.0)
    # As unknowns they are differentiated by; how large they are is for the designs to say.
    free = [u.name for u in settings.unknowns if u.treatment is not Treatment.FIXED]
    differentiated = PressureErrors(1.0, 1.0) if SCALE in free else None
    estimation = CaseEstimation(
        case, replace(settings, pressures=differentiated), None, None, model=model
    )
    start = estimation.shared.start
    generic = estimation.registered(start)
    if not generic.converged:
        return generic.reason
    estimation.errors.consider(start, generic.y)
    return FrameDesigns(
        pressures,
        _designs(estimation, start, generic),
        estimation.knowledge(),
        StatedErrors(estimation.knowledge().get(SCALE, 0.0), stated.offset_mmHg, stated.each_mmHg),
    )


def _designs(estimation: CaseEstimation, m: FloatArray, predicted: Predicted) -> tuple[Design, ...]:
    """What each fitted frame says of all unknowns and of what is considered, by its number."""
    fitted, errors = estimation.fitted, estimation.errors
    observation = fitted.observation()
    H = predict(observation.of(lambda _: predicted), m, derivatives=True).jacobian
    H = np.concatenate([H, *(own.columns for own in errors.considered)], axis=1)
    values = np.array([u.mean if u.is_positive else 1.0 for u in estimation.unknowns])
    names = (*estimation.names, *errors.modes)
    values = np.concatenate([values, np.ones(len(errors.modes))])
    noise = errors.noise(without=errors.kinds)
    # Errors of different frames are independent: without the others' rows a frame is by itself.
    of_frame = np.repeat([int(frame.name) for frame in fitted.frames], observation.sizes)
    return tuple(
        Design.of(np.where(of_frame[:, None] == k, H, 0.0), noise, values, names)
        for k in range(len(fitted.frames))
    )
