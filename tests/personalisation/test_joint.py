"""The posterior of parameters and of the geometry's errors together."""

from types import SimpleNamespace

import numpy as np

from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import low_rank_noise, observation_noise
from mvest.estimation.transform import Log
from mvest.personalisation.joint import JointPosterior, damped_step

K, Q, SIZE = 40, 6, 4.0
"""Observations, modes of the geometry, and how much larger these are learned to be."""


def test_a_step_of_parameters_and_modes_is_that_of_least_squares():
    rng = np.random.default_rng(3)
    std, rows = 0.5, rng.normal(0.0, 0.1, (K, Q))
    H, beside = rng.normal(0.0, 1.0, (K, 3)), rng.normal(0.0, 0.3, (K, 1))
    base = observation_noise(std**2, K)
    errors = SimpleNamespace(
        # Of a low rank as small as can be: the filter may leave out what modes are asked for.
        geometry=(SimpleNamespace(name="open shape", rows=rows),),
        geometry_sizes=lambda learned: (SIZE,),
        noise=lambda learned, *, without: low_rank_noise(base, beside),
    )
    prior = Gaussian.from_variance(np.array([0.1, -0.2, 0.3]), np.array([0.2, 0.5, 0.4]) ** 2)
    posterior = JointPosterior(prior, Log((True,) * 3), None, errors, None)

    z, residual = prior.mean + np.array([0.3, -0.1, 0.2]), rng.normal(0.0, 1.0, K)
    end, left = posterior.stepped(z, residual, H)
    found = posterior.expected(left)

    # Over steps of the parameters, modes, and the size of the further column.
    A = np.concatenate([H, rows, beside], axis=1) / std
    own = np.diag(np.concatenate([1.0 / prior.std, np.full(Q, 1.0 / SIZE), [1.0]]))
    away = np.concatenate([(prior.mean - z) / prior.std, np.zeros(Q + 1)])
    best = np.linalg.lstsq(
        np.concatenate([A, own]), np.concatenate([residual / std, away]), rcond=None
    )[0]
    np.testing.assert_allclose(end, z + best[:3], atol=1e-9)
    np.testing.assert_allclose(found[0], best[3 : 3 + Q], atol=1e-9)
    lowest = posterior.improbability(end, left - rows @ found[0], found)
    for change in 1e-3 * np.eye(Q):
        moved = (found[0] + change,)
        assert posterior.improbability(end, left - rows @ moved[0], moved) > lowest


def test_a_step_is_gone_as_far_as_a_parabola_through_it_falls():
    asked = []

    def curved(curvature):
        def trial(share):
            asked.append(share)
            return 10.0 - 2.0 * 3.0 * share + curvature * share**2, share

        return trial

    # To first order all of the way gains 3: as promised, or four times as curved.
    assert damped_step(curved(3.0), 10.0, 3.0) == 1.0
    assert asked == [1.0]
    assert damped_step(curved(12.0), 10.0, 3.0) == 0.25
    # What does not close is left for half of the way; nothing is better, and nothing closes.
    assert damped_step(lambda s: "torn" if s > 0.6 else (5.0, s), 10.0, 3.0) == 0.5
    assert damped_step(lambda share: (11.0, share), 10.0, -1.0) == ""
    assert damped_step(lambda share: "torn", 10.0, 3.0) == "torn"
