"""What is read from a personalised case of how far to believe it, with a formula for a closure."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role, Uncertainty
from mvest.observation.errors import SpatialCorrelation
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import _alike, diagnostics_of
from mvest.personalisation.estimation import CaseProblem
from mvest.problem.verdict import NONE, TRUSTWORTHY, judge
from tests.made_up_closure import PRIORS, made_up_case, settings, use

INDEPENDENT = Uncertainty(0.3)


@pytest.fixture
def fit(monkeypatch):
    """Personalise a case of which errors of 0.3 mm are seen."""
    use(monkeypatch)

    def run(stated=INDEPENDENT, **changes):
        case = made_up_case(0.3, noise=np.random.default_rng(3))
        return personalise(replace(case, uncertainty=stated), settings(**changes))

    return run


def size(seen, key):
    """The only value that was found."""
    ((value, _),) = seen[key]
    return value


PLAUSIBLE = {"mistakes": (), "implausible": ()}


def test_a_case_whose_errors_are_as_stated_is_trusted(fit):
    found = fit()
    seen = diagnostics_of(found)
    assert not seen["failed"]
    assert not seen["unfinished"]
    assert not seen["approximation"]
    assert found.result.filtered.check is not None
    ((_, innovation),) = seen["innovation"]
    assert innovation["low"] <= innovation["root"] <= innovation["high"]
    assert size(seen, "alike") < 0.1
    assert [words["frame"] for _, words in seen["held_out"]] == ["late"]
    assert {words["what"] for _, words in seen["data_alone"]} == {"E_f.anterior", "E_f.posterior"}
    # Of a factor, estimated by its logarithm: a prior of 1.00 and 10 %.
    stretch = {words["what"]: value for value, words in seen["stretch"]}
    k = found.result.parameters.index("pressure_scale")
    moved = np.log(found.result.estimate[k]) / np.sqrt(np.log(1.01))
    assert stretch["pressure_scale"] == pytest.approx(abs(moved), abs=0.06)
    shift = found.result.estimate[found.result.parameters.index("shift.x")] / PRIORS["shift.x"][1]
    assert stretch["shift.x"] == pytest.approx(abs(shift))
    assert judge(seen | PLAUSIBLE).trust == TRUSTWORTHY


def test_errors_three_times_those_that_are_stated_show_in_what_is_left_over(fit):
    seen = diagnostics_of(fit(Uncertainty(0.1)))
    ((value, words),) = seen["innovation"]
    assert words["root"] == pytest.approx(3.0, rel=0.08)
    assert value == pytest.approx((words["root"] / words["high"]) ** 2)
    verdict = judge(seen | PLAUSIBLE)
    assert verdict.trust == NONE
    assert "size of what is left over" in [failed.check for failed in verdict.failed_checks]


@pytest.mark.parametrize(("std", "pattern"), [(0.3, True), (0.1, False)])
def test_smooth_errors_that_are_stated_as_independent_show_as_a_pattern(monkeypatch, std, pattern):
    # Errors of a third of the size that is believed contradict nothing.
    use(monkeypatch)
    case = replace(made_up_case(0.3), uncertainty=INDEPENDENT)
    rough = SpatialCorrelation(case.surface.vertices, 8.0).factor
    smooth = std * rough @ np.random.default_rng(3).standard_normal(case.surface.vertices.shape)
    frames = tuple(
        replace(f, vertices=f.vertices + smooth) if f.role is Role.CLOSED else f
        for f in case.frames
    )
    alike = size(diagnostics_of(personalise(replace(case, frames=frames), settings())), "alike")
    assert alike > 0.4 if pattern else alike < 0.15


def test_a_fit_by_distances_is_looked_at_as_well(fit):
    seen = diagnostics_of(fit(correspondence=False))
    assert "innovation" in seen
    assert size(seen, "alike") < 0.15


@pytest.mark.parametrize("smooth", [0, 1])
def test_of_several_surfaces_the_last_is_looked_at(monkeypatch, smooth):
    use(monkeypatch)
    case = made_up_case(0.3)
    closed = case.frame(Role.CLOSED)
    early = replace(closed, name="early", role=Role.FITTED, time=closed.time - 0.1)
    frames = sorted((*case.frames, early), key=lambda frame: frame.time)
    seen = CaseProblem.of(
        replace(case, frames=tuple(frames)), settings(correspondence=False)
    ).fitted.observation()
    values = np.random.default_rng(7).standard_normal(len(seen.y))
    first = smooth * seen.sizes[0]
    points = seen.seen[smooth].points
    values[first : first + len(points)] = np.sin(points[:, 0] / 5.0)
    assert (_alike(seen, values) > 0.3) == (smooth == 1)


def test_without_an_estimate_there_is_its_reason(monkeypatch):
    use(monkeypatch, fails_above=1.0)
    found = personalise(made_up_case(0.3), settings())
    seen = diagnostics_of(found)
    ((_, words),) = seen["failed"]
    assert found.result.reason in words["what"]
    assert judge(seen).trust == NONE


def test_a_posterior_that_is_not_the_filters_is_named(fit):
    found = fit()
    filtered = found.result.filtered
    bent = replace(filtered, check=replace(filtered.check, value=3 * filtered.check.limit))
    seen = diagnostics_of(replace(found, result=replace(found.result, filtered=bent)))
    assert [words["what"] for _, words in seen["approximation"]] == [bent.check.sentence]
    assert "approximation" in [failed.check for failed in judge(seen).failed_checks]
    # The check is of the worst direction among all unknowns.
    hardly = replace(bent, check=replace(bent.check, value=1.9 * bent.check.limit))
    assert not hardly.check.holds
    found = replace(found, result=replace(found.result, filtered=hardly))
    assert not diagnostics_of(found)["approximation"]
