"""Several closed frames of a case as one estimation."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role
from mvest.closure.frames import ERROR, OFFSET
from mvest.errors import InputError
from mvest.personalisation import PressureErrors, personalise
from mvest.problem.registration import REGISTRATION, displace
from tests.made_up_closure import (
    CLOSED_ANNULUS,
    PRESSURE,
    TRUE,
    made_up_case,
    settings,
    shape,
    unknowns,
    use,
)

PRESSURES = PressureErrors(offset_mmHg=4.0, each_mmHg=3.0)


def seen(pressure):
    registration = np.array([TRUE[name] for name in REGISTRATION])
    return displace(shape(TRUE, pressure), registration, CLOSED_ANNULUS.mean(axis=0))


def with_fitted(case, **pressures):
    """A case with further fitted frames: name -> (stated, true) pressure.

    ``closed`` replaces the closed frame.
    """
    open_, closed, *others = case.frames
    frames, time = [open_], closed.time - 0.1
    for name, (stated, true) in pressures.items():
        role = Role.CLOSED if name == "closed" else Role.FITTED
        time += 0.01
        frames.append(
            replace(
                closed, name=name, role=role, time=time, pressure_mmHg=stated, vertices=seen(true)
            )
        )
    return replace(case, frames=(*frames, *others))


def test_frames_determine_the_errors_of_their_pressures(monkeypatch):
    use(monkeypatch)
    # Very wide priors of the pressures, a narrow one of their common factor: offset and errors of
    # two frames are three unknowns with two data, but their sums are determined.
    wanted = settings(pressures=PressureErrors(40.0, 30.0), tolerance=1e-8)
    scale = [
        replace(u, std=1e-6, mean=TRUE["pressure_scale"]) if u.name == "pressure_scale" else u
        for u in wanted.unknowns
    ]
    case = with_fitted(
        made_up_case(std_mm=1e-4), early=(60.0, 67.0), closed=(PRESSURE, PRESSURE + 1.0)
    )
    found = personalise(case, replace(wanted, unknowns=tuple(scale)))
    assert found.result.converged
    at = dict(zip(found.result.parameters, found.result.estimate, strict=True))
    for name in ("E_f.anterior", "E_f.posterior", "chord_stiffness", *REGISTRATION):
        assert at[name] == pytest.approx(TRUE[name], rel=2e-3, abs=2e-3), name
    assert at[OFFSET] + at[f"{ERROR}.early"] == pytest.approx(7.0, abs=0.05)
    assert at[OFFSET] + at[f"{ERROR}.closed"] == pytest.approx(1.0, abs=0.05)
    # The closed frame comes first, and the held-out one is predicted with the offset.
    assert [(f.frame.name, f.seen) for f in found.frames] == [
        ("closed", True), ("early", True), ("late", False),
    ]  # fmt: skip
    for one in found.frames[:2]:
        assert one.distances["personalised"].max() < 1e-3
        assert one.distances["generic"].mean() > 0.1


def test_equal_frames_with_independent_errors_are_one_with_less_variance(monkeypatch):
    use(monkeypatch)
    std, count = 0.3, 4
    many = with_fitted(
        made_up_case(std_mm=std),
        **{f"again{k}": (PRESSURE, PRESSURE) for k in range(count - 1)},
        closed=(PRESSURE, PRESSURE),
    )
    one = with_fitted(made_up_case(std_mm=std / np.sqrt(count)), closed=(PRESSURE, PRESSURE))
    a, b = (personalise(case, settings(tolerance=1e-10)).result for case in (many, one))
    np.testing.assert_allclose(a.estimate, b.estimate, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(a.filtered.covariance, b.filtered.covariance, rtol=1e-6, atol=1e-10)


def test_inadmissible_combinations_are_refused(monkeypatch):
    use(monkeypatch)
    case = with_fitted(made_up_case(), early=(60.0, 60.0), closed=(PRESSURE, PRESSURE))
    moduli = tuple(u for u in unknowns() if u.name.startswith("E_f."))
    with pytest.raises(InputError, match="need pressure_scale"):
        personalise(case, settings(*moduli, pressures=PRESSURES))
    n, f = len(case.surface.vertices), len(case.frames)
    tips = len(case.valve.papillary_tips)
    samples = ErrorSamples(np.zeros((4, f, n, 3)), np.zeros((4, f, tips, 3)))
    with pytest.raises(InputError, match="error samples and several fitted frames"):
        personalise(replace(case, error_samples=samples), settings())
