"""The joint posterior of parameters and errors of the geometry."""

from types import SimpleNamespace

import numpy as np
import pytest

from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import low_rank_noise, observation_noise
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Identity
from mvest.personalisation.joint import JointPosterior, damped_step

K, Q, SIZE = 40, 6, 4.0
"""Observations, modes of the geometry, and the learned factor on their size."""
STD = 0.5


@pytest.fixture
def problem():
    """A posterior, its rows of the geometry, derivatives, and another error column."""
    rng = np.random.default_rng(3)
    rows, H = rng.normal(0.0, 0.1, (K, Q)), rng.normal(0.0, 1.0, (K, 3))
    beside = rng.normal(0.0, 0.3, (K, 1))
    base = observation_noise(STD**2, K)
    errors = SimpleNamespace(
        geometry=(SimpleNamespace(name="open shape", rows=rows),),
        geometry_sizes=lambda learned: (SIZE,),
        noise=lambda learned, *, without: low_rank_noise(base, beside),
    )
    prior = Gaussian.from_variance(np.array([0.1, -0.2, 0.3]), np.array([0.2, 0.5, 0.4]) ** 2)
    observation = SimpleNamespace(y=rng.normal(0.0, 1.0, K), of=lambda model: model)
    return JointPosterior(prior, Identity(), observation, errors, None), rows, H, beside


def test_a_step_of_parameters_and_modes_is_that_of_least_squares(problem):
    posterior, rows, H, beside = problem
    prior, residual = posterior.prior, posterior.observation.y
    z = prior.mean + np.array([0.3, -0.1, 0.2])

    def best(*columns, sizes):
        A = np.concatenate([H, *columns], axis=1) / STD
        own = np.diag(np.concatenate([1.0 / prior.std, sizes]))
        away = np.concatenate([(prior.mean - z) / prior.std, np.zeros(len(sizes))])
        right = np.concatenate([residual / STD, away])
        return np.linalg.lstsq(np.concatenate([A, own]), right, rcond=None)[0]

    end = posterior.step(z, residual, H)
    left = residual - H @ (end - z)
    found = posterior.expected(left)
    whole = best(rows, beside, sizes=np.array([1.0 / SIZE] * Q + [1.0]))
    np.testing.assert_allclose(end, z + whole[:3], atol=1e-9)
    np.testing.assert_allclose(found[0], whole[3 : 3 + Q], atol=1e-9)
    lowest = posterior.misfit(end, left - rows @ found[0], found)
    for change in 1e-3 * np.eye(Q):
        moved = (found[0] + change,)
        assert posterior.misfit(end, left - rows @ moved[0], moved) > lowest
    # With a known geometry only parameters and the other column are left.
    fitted = posterior.refitted(z, Prediction(np.zeros(K), H))
    np.testing.assert_allclose(fitted, z + best(beside, sizes=np.ones(1))[:3], atol=1e-9)


def test_a_step_is_damped_by_a_parabola_through_its_trials():
    tried = []

    def curved(curvature):
        def trial(share):
            tried.append(share)
            return 10.0 - 2.0 * 3.0 * share + curvature * share**2, share

        return trial

    # To first order the full step gains 3: as predicted, or four times as curved.
    assert damped_step(curved(3.0), 10.0, 3.0) == 1.0
    assert tried == [1.0]
    assert damped_step(curved(12.0), 10.0, 3.0) == 0.25
    # A valve that does not close halves the step; nothing is better, and nothing closes.
    assert damped_step(lambda s: "torn" if s > 0.6 else (5.0, s), 10.0, 3.0) == 0.5
    assert damped_step(lambda share: (11.0, share), 10.0, -1.0) == ""
    assert damped_step(lambda share: "torn", 10.0, 3.0) == "torn"
