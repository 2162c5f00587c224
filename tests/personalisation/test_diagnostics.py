"""Diagnostics of a personalised case, with a formula for a closure."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role, Uncertainty
from mvest.observation.errors import SpatialCorrelation
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import _neighbour_correlation, diagnostics_of
from mvest.personalisation.estimation import CaseProblem
from mvest.problem.verdict import NONE, TRUSTWORTHY, judge
from tests.made_up_closure import PRIORS, made_up_case, settings, use

PLAUSIBLE = {"mistakes": (), "implausible": ()}


@pytest.fixture(autouse=True)
def formula(monkeypatch):
    use(monkeypatch)


def fitted(stated=0.3, corresponds=True):
    """A case with errors of 0.3 mm."""
    case = made_up_case(0.3, noise=np.random.default_rng(3), corresponds=corresponds)
    return personalise(replace(case, uncertainty=Uncertainty(stated)), settings())


def size(seen, key):
    """The only value that was found."""
    ((value, _),) = seen[key]
    return value


def test_a_case_with_errors_as_stated_is_trusted():
    found = fitted()
    seen = diagnostics_of(found)
    for key in ("failed", "unfinished", "approximation"):
        assert not seen[key]
    ((_, innovation),) = seen["innovation"]
    assert innovation["low"] <= innovation["root"] <= innovation["high"]
    assert size(seen, "correlation") < 0.1
    assert [words["frame"] for _, words in seen["held_out"]] == ["late"]
    assert {words["what"] for _, words in seen["data_alone"]} == {"E_f.anterior", "E_f.posterior"}
    # Of a factor, estimated by its logarithm: a prior of 1.00 and 10 %.
    stretch = {words["what"]: value for value, words in seen["stretch"]}
    at = dict(zip(found.result.parameters, found.result.estimate, strict=True))
    moved = np.log(at["pressure_scale"]) / np.sqrt(np.log(1.01))
    assert stretch["pressure_scale"] == pytest.approx(abs(moved), abs=0.06)
    assert stretch["shift.x"] == pytest.approx(abs(at["shift.x"] / PRIORS["shift.x"][1]))
    assert judge(seen | PLAUSIBLE).trust == TRUSTWORTHY


def test_errors_three_times_the_stated_ones_show_in_the_residuals():
    seen = diagnostics_of(fitted(0.1))
    ((value, words),) = seen["innovation"]
    assert words["root"] == pytest.approx(3.0, rel=0.08)
    assert value == pytest.approx((words["root"] / words["high"]) ** 2)
    verdict = judge(seen | PLAUSIBLE)
    assert verdict.trust == NONE
    assert "size of what is left over" in [failed.check for failed in verdict.failed_checks]


@pytest.mark.parametrize(("std", "pattern"), [(0.3, True), (0.1, False)])
def test_smooth_errors_that_are_stated_as_independent_show_as_a_pattern(std, pattern):
    # Errors of a third of the stated size contradict nothing.
    case = replace(made_up_case(0.3), uncertainty=Uncertainty(0.3))
    rough = SpatialCorrelation(case.surface.vertices, 8.0).factor
    smooth = rough @ np.random.default_rng(3).standard_normal(case.surface.vertices.shape)
    smooth *= std / np.sqrt(np.mean(smooth**2))  # few independent patches: not near 1 by itself
    frames = tuple(
        replace(f, vertices=f.vertices + smooth) if f.role is Role.CLOSED else f
        for f in case.frames
    )
    correlation = size(
        diagnostics_of(personalise(replace(case, frames=frames), settings())), "correlation"
    )
    assert correlation > 0.4 if pattern else correlation < 0.15


@pytest.mark.parametrize("smooth", [0, 1])
def test_the_pattern_is_that_of_the_last_surface(smooth):
    case = made_up_case(0.3, corresponds=False)
    closed = case.frame(Role.CLOSED)
    early = replace(closed, name="early", role=Role.FITTED, time=closed.time - 0.1)
    frames = sorted((*case.frames, early), key=lambda frame: frame.time)
    case = replace(case, frames=tuple(frames))
    seen = CaseProblem.of(case, settings()).fitted.observation()
    values = np.random.default_rng(7).standard_normal(len(seen.y))
    first = smooth * seen.sizes[0]
    points = seen.seen[smooth].points
    values[first : first + len(points)] = np.sin(points[:, 0] / 5.0)
    assert (_neighbour_correlation(seen, values) > 0.3) == (smooth == 1)
    assert _neighbour_correlation(seen, np.zeros_like(values)) == 0.0  # as for data without errors


@pytest.mark.parametrize(("times", "doubtful"), [(3.0, True), (1.9, False)])
def test_a_posterior_that_the_filter_misses_is_doubtful(times, doubtful):
    # The check is of the worst direction among all unknowns, so twice its limit is admitted.
    found = fitted()
    filtered = found.result.filtered
    bent = replace(filtered, check=replace(filtered.check, value=times * filtered.check.limit))
    assert not bent.check.holds
    seen = diagnostics_of(replace(found, result=replace(found.result, filtered=bent)))
    expected = [bent.check.sentence] if doubtful else []
    assert [words["what"] for _, words in seen["approximation"]] == expected
