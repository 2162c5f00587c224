"""Expected intervals are those that the estimation then has."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction
from mvest.mechanics.settings import TissueSettings
from mvest.observation.vertices import Observation
from mvest.problem.estimate import estimate
from mvest.problem.expectation import expect
from mvest.problem.problem import Problem
from mvest.problem.record import confounded
from mvest.reporting.expectation import alike_words, expectation_text

NAMES = ("E_f.anterior", "E_f.posterior", "pressure_scale")
TRUTH = np.array([6.0, 2.0, 1.0])
DIRECTIONS = np.random.default_rng(7).standard_normal((12, 3))


class Bellies:
    """Pressure over stiffness moves the closed points, and the pressure a little by itself."""

    def __init__(self):
        self.calls = 0

    def __call__(self, m):
        self.calls += 1
        a, b, p = m
        parts = np.array([12.0 * p / a, 4.0 * p / b, 0.02 * p])
        by_a, by_b = [-12.0 * p / a**2, 0.0, 0.0], [0.0, -4.0 * p / b**2, 0.0]
        by = np.array([by_a, by_b, [12.0 / a, 4.0 / b, 0.02]]).T
        # The open frame is that of the stress-free valve.
        y = np.concatenate([np.zeros(12), DIRECTIONS @ parts])
        return Prediction(y, np.concatenate([np.zeros((12, 3)), DIRECTIONS @ by]))


def case_of(std):
    prior = Gaussian.from_variance(TRUTH, np.array(std) ** 2)
    tissue = {name: TissueSettings(2.0) for name in ("anterior", "posterior")}
    return Problem(NAMES, Bellies(), prior, IteratedFilter(1e-8), Log(), tissue)


def observation(noise):
    closed = Bellies()(TRUTH).y[12:].reshape(1, 4, 3)
    return Observation(("closed",), closed, np.array(noise**2))


def test_the_expected_intervals_are_those_of_the_estimate():
    # At the prior's mean, where the noise-free truth lies, the filter linearises at the same point.
    case = case_of([3.0, 1.0, 0.1])
    found = expect(case, observation(0.02))
    assert case.model.calls == 1
    later = estimate(case, observation(0.02))
    assert found.informed is not None
    np.testing.assert_allclose(found.informed.std, later.std, rtol=1e-6)
    np.testing.assert_allclose(found.data.std, later.identifiability.std, rtol=1e-6)
    low, high = found.interval()
    # Symmetric in the logarithm, whose deviation is the relative one.
    np.testing.assert_allclose(np.log(high / low), 2 * 1.959964 * later.std / TRUTH, rtol=1e-6)
    assert found.observations == 12


def test_what_was_seen_plays_no_part():
    case = case_of([3.0, 1.0, 0.1])
    moved = observation(0.02).positions + 5.0
    other = expect(case, Observation(("closed",), moved, np.array(0.02**2)))
    np.testing.assert_array_equal(other.data.std, expect(case, observation(0.02)).data.std)


def test_the_text_names_what_is_told_badly_and_how_it_hides():
    case = case_of([3.0, 1.0, 0.1])
    found = expect(case, observation(0.02))
    text = expectation_text("twin", found, "no noise")
    # Only p/a and p/b are seen well: whatever the pressure, both moduli are as much larger.
    assert "The data hardly tell apart" in text
    assert text.count("+10 % of") == 3
    assert "Known badly from the data alone" in text
    assert text.endswith("No estimation was run.")
    (group,) = confounded(found.data)
    assert sorted(group.parameters) == sorted(NAMES)
    change = dict(zip(group.parameters, group.changes, strict=True))
    assert change == pytest.approx(
        {"E_f.anterior": 0.6, "E_f.posterior": 0.2, "pressure_scale": 0.1}, rel=0.02
    )
    said = alike_words(group, {"pressure_scale": "the pressure"})
    assert "of the pressure" in said
    assert "pressure_scale" not in said


def test_a_prior_without_width_and_a_model_that_fails():
    held = expect(case_of([3.0, 1.0, 0.0]), observation(0.02))
    assert held.data is not None
    assert held.informed is None
    with pytest.raises(ValueError, match="nothing is known"):
        held.interval()
    assert "–" in expectation_text("twin", held, "no noise")
    failing = case_of([3.0, 1.0, 0.1])
    object.__setattr__(failing, "model", lambda m: Prediction.failed("no equilibrium"))
    lost = expect(failing, observation(0.02))
    assert lost.data is None
    assert "is not known, the model has no prediction" in expectation_text("twin", lost, "no noise")
