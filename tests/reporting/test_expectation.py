"""Expected intervals are those that the estimation then has."""

import re

import numpy as np
import pytest

from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction, identifiability
from mvest.mechanics.settings import TissueSettings
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, estimate
from mvest.problem.registration import label_of
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


def expected(case, seen):
    """The text, and the numbers of its table by parameter."""
    text = expectation_text("twin", case, seen, "no noise")
    numbers = {
        name: [float(word) for word in re.findall(r"-?[\d.]+(?:e[+-]\d+)?", line)]
        for line in text.splitlines()
        for name in NAMES
        if line.strip().startswith(label_of(name))
    }
    return text, numbers


def test_the_expected_intervals_are_those_of_the_estimate():
    # At the prior's mean, where the noise-free truth lies, the filter linearises at the same point.
    case = case_of([3.0, 1.0, 0.1])
    _, found = expected(case, observation(0.02))
    assert case.model.calls == 1
    later = estimate(case, observation(0.02))
    low, high = later.filtered.interval()
    for name, *ends in zip(NAMES, low, high, later.identifiability.std, strict=True):
        np.testing.assert_allclose([*found[name][3:5], found[name][6]], ends, rtol=0.06)
    # Half and twice the median lie one deviation of the logarithm, 0.5, from it.
    np.testing.assert_allclose(found["E_f.anterior"][1:3], 6.0 * np.exp([-0.98, 0.98]), rtol=0.01)


def test_what_was_seen_plays_no_part():
    case = case_of([3.0, 1.0, 0.1])
    moved = observation(0.02).positions + 5.0
    other = expected(case, Observation(("closed",), moved, np.array(0.02**2)))
    assert other == expected(case, observation(0.02))


def test_the_text_names_what_is_told_badly_and_how_it_hides():
    case = case_of([3.0, 1.0, 0.1])
    text, _ = expected(case, observation(0.02))
    # Only p/a and p/b are seen well: whatever the pressure, both moduli are as much larger.
    assert "The data hardly tell apart" in text
    assert text.count("+10 % of") == 3
    assert "Known badly from the data alone" in text
    assert text.endswith("No estimation was run.")
    H = Bellies()(TRUTH).jacobian[12:]
    (group,) = identifiability(H, 0.02**2, TRUTH, names=NAMES).confounded()
    change = dict(zip(group.parameters, group.changes, strict=True))
    assert change == pytest.approx(
        {"E_f.anterior": 0.6, "E_f.posterior": 0.2, "pressure_scale": 0.1}, rel=0.02
    )
    said = alike_words(group, {"pressure_scale": "the pressure"})
    assert "of the pressure" in said
    assert "pressure_scale" not in said


def test_a_prior_without_width_and_a_model_that_fails():
    # What is held has no width before or after.
    assert (
        expected(case_of([3.0, 1.0, 0.0]), observation(0.02))[1]["pressure_scale"][:6] == [1.0] * 6
    )
    failing = case_of([3.0, 1.0, 0.1])
    object.__setattr__(failing, "model", lambda m: Prediction.failed("no equilibrium"))
    assert "is not known, the model has no prediction" in expected(failing, observation(0.02))[0]
