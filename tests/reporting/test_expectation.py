"""Expected intervals are those that the estimation then has."""

import re

import numpy as np

from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction
from mvest.mechanics.settings import TissueSettings
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, estimate
from mvest.problem.registration import label_of
from mvest.reporting.expectation import expectation_text

NAMES = ("E_f.anterior", "E_f.posterior", "pressure_scale")
TRUTH = np.array([6.0, 2.0, 1.0])
DIRECTIONS = np.random.default_rng(7).standard_normal((12, 3))


def bellies(m):
    """Pressure over stiffness moves the closed points, and the pressure a little by itself."""
    a, b, p = m
    parts = np.array([12.0 * p / a, 4.0 * p / b, 0.02 * p])
    by_a, by_b = [-12.0 * p / a**2, 0.0, 0.0], [0.0, -4.0 * p / b**2, 0.0]
    by = np.array([by_a, by_b, [12.0 / a, 4.0 / b, 0.02]]).T
    # The open frame is that of the stress-free valve.
    y = np.concatenate([np.zeros(12), DIRECTIONS @ parts])
    return Prediction(y, np.concatenate([np.zeros((12, 3)), DIRECTIONS @ by]))


def problem_of(std, model=bellies):
    prior = Gaussian.from_variance(TRUTH, np.array(std) ** 2)
    tissue = {name: TissueSettings(2.0) for name in ("anterior", "posterior")}
    return Problem(NAMES, model, prior, IteratedFilter(1e-8), Log(), tissue)


CLOSED = bellies(TRUTH).y[12:].reshape(1, 4, 3)
SEEN = Observation(("closed",), CLOSED, np.array(0.02**2))


def expected(problem, seen=SEEN):
    """The text, and the numbers of its table by parameter."""
    text = expectation_text("twin", problem, seen, "no noise")
    numbers = {
        name: [float(word) for word in re.findall(r"-?[\d.]+(?:e[+-]\d+)?", line)]
        for line in text.splitlines()
        for name in NAMES
        if line.strip().startswith(label_of(name))
    }
    return text, numbers


def test_the_expected_intervals_are_those_of_the_estimate():
    # At the prior's mean, where the noise-free truth lies, the filter linearises at the same point.
    problem = problem_of([3.0, 1.0, 0.1])
    _, found = expected(problem)
    later = estimate(problem, SEEN)
    low, high = later.filtered.interval()
    for name, *ends in zip(NAMES, low, high, later.identifiability.std, strict=True):
        np.testing.assert_allclose([*found[name][3:5], found[name][6]], ends, rtol=0.06)
    # Half and twice the median lie one deviation of the logarithm, 0.5, from it.
    np.testing.assert_allclose(found["E_f.anterior"][1:3], 6.0 * np.exp([-0.98, 0.98]), rtol=0.01)
    # Observed values are not used.
    moved = Observation(("closed",), CLOSED + 5.0, np.array(0.02**2))
    assert expected(problem, moved) == expected(problem)


def test_the_text_names_parameters_that_are_poorly_determined():
    text, _ = expected(problem_of([3.0, 1.0, 0.1]))
    # Only p/a and p/b are determined well: a higher pressure raises both moduli alike.
    assert text.count("+10 % of") == 3
    assert "Poorly determined by the data alone" in text
