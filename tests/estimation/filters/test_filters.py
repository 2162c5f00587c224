"""The paper's and the iterated filter on problems whose answers are known on paper."""

import numpy as np
import pytest

from mvest.estimation import Gaussian, IteratedFilter, PaperFilter, Prediction, Reason
from tests.estimation.problems import square

NEVER = 1e-300
"""A tolerance that only an exact fixed point meets."""


class Counted:
    """Wraps a model and remembers where it was run."""

    def __init__(self, model):
        self.model, self.calls = model, []

    def __call__(self, m):
        self.calls.append(m)
        return self.model(m)


def linear(H):
    return lambda m: Prediction(H @ m, H)


HAND_PRIOR = Gaussian(np.array([2.0]), np.array([[1.0]]))


def by_hand(method, model=square, prior=HAND_PRIOR, **more):
    """The hand-worked problem: h(m) = m², prior N(2, 1), y = 6, R = 2."""
    return method(model, prior, np.array([6.0]), 2.0, **more)


def tight(tolerance=NEVER, **more):
    return IteratedFilter(tolerance=tolerance, objective_tolerance=tolerance**2 or NEVER, **more)


# --- Linear models -------------------------------------------------------------------------------


@pytest.mark.parametrize("rounds", [1, 2, 6])
def test_iterating_counts_the_data_once(rounds):
    model, prior = linear(np.eye(1)), Gaussian(np.zeros(1), np.eye(1))
    estimate = tight(max_iterations=rounds)(model, prior, np.ones(1), 1.0)
    assert estimate.covariance[0, 0] == pytest.approx(0.5, rel=1e-14)
    assert estimate.mean[0] == pytest.approx(0.5, rel=1e-14)
    # Whatever the round, the information at iterate m is the prior's 1 plus H²/R = (2m)²/2 once.
    estimate = by_hand(tight(max_iterations=rounds))
    m = estimate.iterates[:, 0]
    np.testing.assert_allclose(estimate.iterate_covariances[:, 0, 0], 1.0 / (1.0 + 2.0 * m**2))


# --- The hand-worked non-linear step -------------------------------------------------------------


def test_hand_worked_gauss_newton_steps():
    # Step 1 from the prior's mean is the extended filter's: S = 16 + 2 = 18, K = 4/18 = 2/9,
    #   z1 = 2 + (2/9)*2 = 22/9.
    # Step 2 relinearises there but keeps the prior N(2, 1): H = 44/9,
    #   e = 6 - 484/81 + (44/9)(4/9) = 178/81, S = 1936/81 + 2 = 2098/81, K = (44/9)/S = 198/1049,
    #   z2 = 2 + (198/1049)(178/81) = 2 + 3916/9441.
    # Feeding the posterior back instead gives 22/9 + (1/9)(44/9)/(1936/729 + 2)*(2/81) = 2.4473.
    estimate = by_hand(tight(max_iterations=2))
    np.testing.assert_allclose(estimate.iterates[:, 0], [2.0, 22 / 9, 2 + 3916 / 9441], rtol=1e-14)
    # J = (6 - m²)²/4 + (m - 2)²/2: 1 at the start, (2/81)²/4 + (4/9)²/2 after one step.
    np.testing.assert_allclose(
        estimate.objective[:2], [1.0, (2 / 81) ** 2 / 4 + (4 / 9) ** 2 / 2], rtol=1e-12
    )


def test_iterated_mode_ends_at_the_posterior_mode():
    # dJ/dm = -m (6 - m²) + (m - 2) = m³ - 5 m - 2 = 0 has the root 1 + sqrt 2, because
    # (1 + √2)³ = 7 + 5√2. Variance 1/(1 + (2m)²/2) = 1/(1 + 2 (3 + 2√2)) = 1/(7 + 4√2).
    estimate = by_hand(tight(1e-12))
    assert estimate.converged
    # J is flat at its minimum: rounding in J, 1e-16 J with J = 0.09, hides steps below 4e-9 of m.
    assert estimate.mean[0] == pytest.approx(1 + np.sqrt(2), rel=1e-8)
    assert estimate.covariance[0, 0] == pytest.approx(1 / (7 + 4 * np.sqrt(2)), rel=1e-8)
    assert estimate.std[0] == pytest.approx(np.sqrt(estimate.covariance[0, 0]), rel=1e-15)
    np.testing.assert_allclose(estimate.prediction.y, estimate.mean**2, rtol=1e-15)


# --- Step control --------------------------------------------------------------------------------


def test_a_curved_valley_is_descended():
    # Rosenbrock's residuals 10 (m2 - m1²) and 1 - m1 with a weak prior, from his start (-1.2, 1).
    def rosenbrock(m):
        y = np.array([10.0 * (m[1] - m[0] ** 2), 1.0 - m[0]])
        return Prediction(y, np.array([[-20.0 * m[0], 10.0], [-1.0, 0.0]]))

    prior = Gaussian.from_variance(np.array([-1.2, 1.0]), 1e6)
    estimate = IteratedFilter(max_iterations=100)(rosenbrock, prior, np.zeros(2), 1.0)
    assert estimate.converged
    assert np.all(np.diff(estimate.objective) < 0.0)
    np.testing.assert_allclose(estimate.mean, [1.0, 1.0], atol=1e-4)
    # Damping that is raised, remembered and lowered as the predicted decrease comes true takes 50
    # runs of the model; damping that forgets (or never relaxes) takes hundreds.
    assert estimate.forward_solves <= 60


def test_a_wrong_jacobian_and_the_iteration_limit_end_as_values():
    estimate = by_hand(IteratedFilter(), lambda m: Prediction(m**2, -2.0 * m[:, None]))
    assert estimate.reason is Reason.NO_DECREASE
    assert not estimate.converged
    assert estimate.mean[0] == 2.0
    estimate = by_hand(IteratedFilter(max_iterations=1))
    assert estimate.reason is Reason.MAX_ITERATIONS
    assert estimate.mean[0] == pytest.approx(22 / 9)
    # From 22/9, where the variance is 1/13, a step of -0.030 lowers J by 13/2 0.030² = 0.006; the
    # one after it, of -0.0006, by 2e-6. That is negligible, so the limit ends a converged run.
    assert by_hand(tight(max_iterations=2)).reason is Reason.CONVERGED


# --- Models that fail ----------------------------------------------------------------------------


def failing_above(limit):
    def model(m):
        if m[0] > limit:
            return Prediction.failed(f"the solver gave up at {m[0]:.4f}")
        return square(m)

    return model


def test_a_failing_step_is_shortened():
    # The full step goes to 22/9 = 2.444; the mode 2.4142 lies below the limit.
    model = Counted(failing_above(2.42))
    estimate = by_hand(tight(1e-9), model)
    assert model.calls[1][0] == pytest.approx(22 / 9)
    assert estimate.converged
    assert estimate.mean[0] == pytest.approx(1 + np.sqrt(2), rel=1e-8)
    # The failed runs cost as much as the others and are counted.
    assert estimate.forward_solves == len(model.calls) > estimate.iterations + 1


def test_a_model_that_fails_to_the_end_is_a_value():
    # Every step from 2 leads up, and there is nothing above 2.
    estimate = by_hand(IteratedFilter(), failing_above(2.0))
    assert estimate.reason is Reason.MODEL_FAILED
    assert not estimate.converged
    assert "the solver gave up" in estimate.detail
    # The estimate stays where the model last gave an answer, and the answer is that one.
    assert estimate.mean[0] == 2.0
    assert estimate.prediction.y[0] == 4.0
    # One run at the start, the full step and eight shortened ones.
    assert estimate.forward_solves == 10


@pytest.mark.parametrize("method", [PaperFilter(), IteratedFilter()])
def test_a_model_that_fails_at_the_start_is_a_value(method):
    estimate = by_hand(method, failing_above(1.0))
    assert estimate.reason is Reason.MODEL_FAILED
    assert "the solver gave up at 2.0000" in estimate.detail
    assert estimate.prediction is None
    assert estimate.innovation is None
    assert (estimate.iterations, estimate.forward_solves) == (0, 1)
    np.testing.assert_array_equal(estimate.mean, HAND_PRIOR.mean)
    np.testing.assert_array_equal(estimate.covariance, HAND_PRIOR.covariance)
    assert np.isnan(estimate.objective[-1])


def test_hand_worked_rounds_of_the_paper():
    # Q = 0 in round 1 cannot be had with Q > 0 in round 2, so Q = 1/2 enters both:
    # Round 1: P- = 1 + 1/2 = 3/2, h = 4, H = 4, e = 2, S = 16*3/2 + 2 = 26, K = 4*(3/2)/26 = 3/13;
    #   m = 2 + 6/13 = 32/13, P = (1 - 4*3/13)*3/2 = (1/13)*3/2 = 3/26,
    #   log-likelihood -(ln 2 pi + ln 26 + 4/26)/2.
    # Round 2: P- = 3/26 + 1/2 = 8/13, h = 1024/169, H = 64/13, e = 6 - 1024/169 = -10/169,
    #   S = (4096/169)(8/13) + 2 = (32768 + 4394)/2197 = 37162/2197,
    #   K = (64/13)(8/13)/S = (512/169)(2197/37162) = 6656/37162 = 3328/18581,
    #   m = 32/13 - (3328/18581)(10/169), P = (1 - (64/13)(3328/18581)) 8/13.
    estimate = by_hand(PaperFilter(Q=0.5, tolerance=NEVER, max_iterations=2))
    m1, P1 = 32 / 13, 3 / 26
    m2, P2 = 32 / 13 - (3328 / 18581) * (10 / 169), (1 - (64 / 13) * (3328 / 18581)) * 8 / 13
    np.testing.assert_allclose(estimate.iterates[:, 0], [2.0, m1, m2], rtol=1e-14)
    np.testing.assert_allclose(estimate.iterate_covariances[:, 0, 0], [1.0, P1, P2], rtol=1e-12)
    assert estimate.log_likelihood[0] == pytest.approx(
        -0.5 * (np.log(2 * np.pi) + np.log(26) + 4 / 26), rel=1e-14
    )
    # Misfit e²/(2R) at m = 2 and m = 32/13.
    np.testing.assert_allclose(estimate.objective[:2], [4 / 4, (10 / 169) ** 2 / 4], rtol=1e-11)
