"""What is read from a personalised case of how far to believe it, with a formula for a closure."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role, Uncertainty
from mvest.observation.errors import SpatialCorrelation
from mvest.personalisation import personalise
from mvest.personalisation.estimation import CaseProblem
from mvest.personalisation.indications import _alike, indications_of
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


def test_a_world_as_stated_is_trusted(fit):
    found = fit()
    seen = indications_of(found)
    assert seen.estimated
    assert seen.converged
    assert seen.approximation == ""
    assert found.result.filtered.check is not None
    assert seen.nis_band[0] <= seen.nis <= seen.nis_band[1]
    assert abs(seen.alike) < 0.1
    assert [held.frame for held in seen.held_out] == ["late"]
    assert set(seen.data_alone) == {"E_f.anterior", "E_f.posterior"}
    # Of a factor, estimated by its logarithm: a prior of 1.00 and 10 %.
    k = found.names.index("pressure_scale")
    moved = np.log(found.result.estimate[k]) / np.sqrt(np.log(1.01))
    assert seen.stretch["pressure_scale"] == pytest.approx(moved, abs=0.06)
    k = found.names.index("shift.x")
    assert seen.stretch["shift.x"] == pytest.approx(found.result.estimate[k] / PRIORS["shift.x"][1])
    assert judge(replace(seen, mistakes=(), doubts=())).trust == TRUSTWORTHY


def test_errors_three_times_those_that_are_stated_show_in_what_is_left_over(fit):
    seen = indications_of(fit(Uncertainty(0.1)))
    assert seen.nis == pytest.approx(9.0, rel=0.15)
    verdict = judge(replace(seen, mistakes=(), doubts=()))
    assert verdict.trust == NONE
    assert "size of what is left over" in [ground.check for ground in verdict.grounds]


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
    alike = indications_of(personalise(replace(case, frames=frames), settings())).alike
    assert alike > 0.4 if pattern else alike < 0.15


def test_a_fit_by_distances_is_looked_at_as_well(fit):
    seen = indications_of(fit(correspondence=False))
    assert seen.nis is not None
    assert abs(seen.alike) < 0.15


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
    seen = indications_of(found)
    assert not seen.estimated
    assert found.result.reason in seen.ended
    assert judge(seen).trust == NONE


def test_a_posterior_that_is_not_the_filters_is_named(fit):
    found = fit()
    filtered = found.result.filtered
    bent = replace(filtered, check=replace(filtered.check, value=3 * filtered.check.limit))
    seen = indications_of(replace(found, result=replace(found.result, filtered=bent)))
    assert seen.approximation == bent.check.sentence
    assert "approximation" in [ground.check for ground in judge(seen).grounds]
    # The check is of the worst direction among all unknowns.
    hardly = replace(bent, check=replace(bent.check, value=1.9 * bent.check.limit))
    assert not hardly.check.holds
    assert not indications_of(
        replace(found, result=replace(found.result, filtered=hardly))
    ).approximation
