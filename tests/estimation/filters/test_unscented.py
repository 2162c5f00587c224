"""The simplex filter: exact for linear models, and what its rounds do for others."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    Prediction,
    Reason,
    UnscentedFilter,
)
from tests.estimation.problems import Linear, square

PRIOR, Y, R = Gaussian(np.array([2.0]), np.array([[1.0]])), np.array([6.0]), 2.0


def test_hand_worked_rounds_on_a_square() -> None:
    # p = 1: points m ± s. h = m² has ȳ = m² + s² and the slope 2 m. Round 1 about N(2, 1):
    #   ȳ = 5, H = 4, e = 6 - 5 = 1, S = 16 + 2 = 18, m⁺ = 2 + (4/18) = 20/9, P⁺ = 1 - 16/18 = 1/9.
    # Round 2 about N(20/9, 1/9) from the prior again: ȳ = 400/81 + 1/9 = 409/81, H = 40/9,
    #   e + H (m - 2) = 6 - 409/81 + (40/9)(2/9) = 157/81, S = 1600/81 + 2 = 1762/81,
    #   m⁺ = 2 + (40/9)(157/81)/(1762/81) = 2 + 40 · 157/(9 · 1762), P⁺ = 2/S = 162/1762.
    once = UnscentedFilter(max_iterations=1)(square, PRIOR, Y, R)
    assert once.mean[0] == pytest.approx(20 / 9, rel=1e-14)
    assert once.covariance[0, 0] == pytest.approx(1 / 9, rel=1e-12)
    assert once.reason is Reason.COMPLETED
    twice = UnscentedFilter(max_iterations=2, tolerance=1e-300)(square, PRIOR, Y, R)
    assert twice.mean[0] == pytest.approx(2 + 40 * 157 / (9 * 1762), rel=1e-14)
    assert twice.covariance[0, 0] == pytest.approx(162 / 1762, rel=1e-12)
    assert twice.reason is Reason.MAX_ITERATIONS
    assert twice.forward_solves == 2 * 2 + 1


def test_points_draw_together_where_the_model_fails() -> None:
    # The points of the prior are 2 ± 1; beyond 2.6 the model fails, so that the spread is halved,
    # to 2 ± 1/2, and nothing else changes for a linear model.
    def narrow(m):
        return Prediction.failed("too large") if m[0] > 2.6 else Prediction.undifferentiated(m)

    found = UnscentedFilter()(narrow, PRIOR, np.array([2.2]), 1.0)
    assert found.converged
    assert found.mean[0] == pytest.approx(2.1, rel=1e-12)
    assert found.covariance[0, 0] == pytest.approx(0.5, rel=1e-12)
    # A model that always fails ends the run with its reason.
    found = UnscentedFilter()(lambda m: Prediction.failed("no valve"), PRIOR, Y, R)
    assert found.reason is Reason.MODEL_FAILED
    assert "no valve" in found.detail
    assert found.prediction is None
    assert found.forward_solves == 7  # 1 + MAX_REJECTIONS, each ends at its first point


def test_inadmissible_settings_and_models_are_refused() -> None:
    for settings in ({"spread": 0.0}, {"tolerance": -1.0}, {"max_iterations": 0}):
        with pytest.raises(InputError):
            UnscentedFilter(**settings)
    with pytest.raises(InputError, match="derivatives"):
        Linear().by(IteratedFilter(), plain=True)
