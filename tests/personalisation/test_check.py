"""The expected precision equals that of an estimate of the generic valve."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation import expect_case, personalise
from mvest.personalisation.known import EXACTLY, REACH
from tests.made_up_closure import PRIORS, made_up_case, settings, shape, use


@pytest.mark.parametrize("errors", [None, ErrorBeliefs()])
def test_intervals_are_those_of_an_estimate_of_the_generic_valve(monkeypatch, errors):
    use(monkeypatch)
    case = made_up_case(0.3, displaced=False)
    generic = shape({name: mean for name, (mean, _) in PRIORS.items()})
    frames = [replace(f, vertices=generic) if f.role is Role.CLOSED else f for f in case.frames]
    case = replace(case, frames=tuple(frames))
    expected = expect_case(case, settings(errors=errors))
    fit = personalise(case, settings())
    std = fit.result.filtered.transformed.std
    for k, unknown in enumerate(expected.unknowns):
        assert unknown["name"] == fit.result.parameters[k]
        high, low, generic = unknown["high"], unknown["low"], unknown["generic"]
        found = np.log(high / low) if generic > 0.0 else high - low
        if errors is None:
            assert found / (2 * REACH) == pytest.approx(std[k], rel=1e-4)
        assert unknown["low_before"] < low < generic < high < unknown["high_before"]
        assert 0.0 < unknown["width"] < 1.0
    assert sum(row["share"] for row in expected.shares) == pytest.approx(2.0)
    what = {row["what"].partition(", ")[2] for row in expected.narrower}
    assert what > {EXACTLY, "mean of 4 beats"}


def test_a_valve_that_does_not_close_has_a_reason(monkeypatch):
    use(monkeypatch, fails_above=1.0)
    expected = expect_case(made_up_case(0.3), settings())
    assert expected.unknowns == ()
    assert "no equilibrium" in expected.reason
