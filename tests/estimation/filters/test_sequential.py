"""Filters over frames against the batch, of which they are another way of writing the same."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import sparse

from mvest.errors import InputError
from mvest.estimation import (
    DriftSmoother,
    Gaussian,
    IteratedFilter,
    Log,
    Prediction,
    Reason,
    SequentialFilter,
    kalman_update,
    observation_noise,
    random_walk,
    smooth_frames,
)
from mvest.estimation.trajectory import LinearFrame, filter_frames, frame_noises
from mvest.typing import FloatArray

SIZES = (4, 1, 6, 3)
PRIOR = Gaussian(np.array([1.0, -2.0]), np.array([[0.5, 0.1], [0.1, 2.0]]))
R = np.linspace(0.1, 0.4, sum(SIZES))


def linear_model(seed: int = 3) -> tuple[FloatArray, FloatArray, FloatArray]:
    """H, constant and an observation of two parameters in four frames."""
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(sum(SIZES), 2))
    d = rng.normal(size=sum(SIZES))
    return H, d, H @ [0.4, -1.0] + d + 0.5 * rng.normal(size=sum(SIZES))


def predicting(H: FloatArray, d: FloatArray) -> Callable[[FloatArray], Prediction]:
    return lambda m: Prediction(H @ m + d, H)


def exponential(m: FloatArray) -> Prediction:
    """Decays with rate m[1] from m[0], seen at 14 times: clearly not linear."""
    t = np.linspace(0.1, 2.0, sum(SIZES))
    e = np.exp(-m[1] * t)
    return Prediction(m[0] * e, np.stack([e, -m[0] * t * e], axis=1))


def frames_of(H: FloatArray, y: FloatArray, noise: FloatArray = R) -> list[LinearFrame]:
    ends = np.cumsum(SIZES)[:-1]
    parts = zip(np.split(y, ends), np.split(H, ends), np.split(noise, ends), SIZES, strict=True)
    return [LinearFrame(a, b, observation_noise(c, n)) for a, b, c, n in parts]


def test_frames_of_a_linear_model_give_the_batch_update():
    H, d, y = linear_model()
    states = filter_frames(PRIOR, frames_of(H, y - d))
    batch = kalman_update(PRIOR, y - d - H @ PRIOR.mean, H, observation_noise(R, y.size))
    np.testing.assert_allclose(states[-1].filtered.mean, batch.posterior.mean, rtol=1e-12)
    np.testing.assert_allclose(
        states[-1].filtered.covariance, batch.posterior.covariance, rtol=1e-12
    )
    # p(y) = prod p(y_k | y_1 ... y_{k-1}), and the determinants of P telescope.
    assert sum(s.log_likelihood for s in states) == pytest.approx(batch.log_likelihood, rel=1e-12)
    whole = (
        np.linalg.slogdet(PRIOR.covariance)[1] - np.linalg.slogdet(batch.posterior.covariance)[1]
    )
    assert sum(s.information_gain for s in states) == pytest.approx(0.5 * whole, rel=1e-10)
    assert sum(s.nis for s in states) == pytest.approx(batch.nis, rel=1e-12)


def test_the_filter_is_exact_for_a_linear_model_in_its_first_pass():
    H, d, y = linear_model()
    found = SequentialFilter(SIZES).run(predicting(H, d), PRIOR, y, R)
    batch = IteratedFilter()(predicting(H, d), PRIOR, y, R)
    assert found.estimate.converged
    for pass_ in (found.extended, found.final):
        np.testing.assert_allclose(pass_[-1].filtered.mean, batch.mean, rtol=1e-10)
        np.testing.assert_allclose(pass_[-1].filtered.covariance, batch.covariance, rtol=1e-10)
    assert found.estimate.log_likelihood[-1] == pytest.approx(batch.log_likelihood[-1], rel=1e-12)


@pytest.mark.parametrize("transform", [None, Log()])
def test_passes_of_a_nonlinear_model_end_where_the_batch_does(transform):
    prior = Gaussian.from_variance(np.array([2.0, 0.5]), np.array([1.0, 0.3]))
    rng = np.random.default_rng(0)
    y = exponential(np.array([3.0, 1.1])).y + 0.1 * rng.normal(size=sum(SIZES))
    batch = IteratedFilter(tolerance=1e-9, objective_tolerance=1e-15)(
        exponential, prior, y, 0.01, transform=transform
    )
    found = SequentialFilter(SIZES, tolerance=1e-9).run(
        exponential, prior, y, 0.01, transform=transform
    )
    assert batch.converged
    assert found.estimate.converged
    np.testing.assert_allclose(found.estimate.mean, batch.mean, rtol=1e-6)
    np.testing.assert_allclose(found.estimate.covariance, batch.covariance, rtol=1e-4)
    # One pass is not enough here, so that the further ones are what has been tested.
    first = found.extended[-1].filtered.mean
    assert np.abs(first - found.estimate.transformed.mean).max() > 1e-3
    # The order of the frames plays no part in the limit, and does in the first pass.
    order = np.arange(y.size)[::-1]

    def backwards(m: FloatArray) -> Prediction:
        found = exponential(m)
        return Prediction(found.y[order], found.jacobian[order])

    other = SequentialFilter(SIZES[::-1], tolerance=1e-9).run(
        backwards, prior, y[order], 0.01, transform=transform
    )
    np.testing.assert_allclose(other.estimate.mean, batch.mean, rtol=1e-6)
    assert np.abs(other.extended[-1].filtered.mean - first).max() > 1e-6


def test_a_failing_model_and_one_that_fails_on_the_way_are_values():
    H, d, y = linear_model()
    never = SequentialFilter(SIZES).run(lambda m: Prediction.failed("no"), PRIOR, y, R)
    assert never.estimate.reason is Reason.MODEL_FAILED
    assert "no" in never.estimate.detail

    def here_only(m: FloatArray) -> Prediction:
        at_prior = np.array_equal(m, PRIOR.mean)
        return predicting(H, d)(m) if at_prior else Prediction.failed("nowhere else")

    lost = SequentialFilter(SIZES, relinearise=0.0).run(here_only, PRIOR, y, R)
    assert lost.estimate.reason is Reason.MODEL_FAILED
    assert "nowhere else" in lost.estimate.detail


def test_noise_that_ties_frames_together_is_refused():
    tied = sparse.eye_array(14).tolil()
    tied[3, 4] = tied[4, 3] = 0.1
    with pytest.raises(InputError, match="correlates frames"):
        frame_noises(sparse.csc_array(tied), SIZES)
    tied[3, 4] = tied[4, 3] = 0.0
    tied[5, 6] = tied[6, 5] = 0.1
    blocks = frame_noises(sparse.csc_array(tied), SIZES)
    assert [b.size for b in blocks] == list(SIZES)
    # det [[1, 0.1], [0.1, 1]] = 0.99
    assert sum(b.log_determinant for b in blocks) == pytest.approx(np.log(0.99))
    with pytest.raises(InputError, match="cannot be taken apart"):
        frame_noises(observation_noise(1.0, 14), SIZES)


Q = np.array([[0.3, 0.05], [0.05, 0.1]])


def batch_trajectory(H: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (f, p) and covariances by least squares over all z_k, written out row by row."""
    ends = np.cumsum([0, *SIZES])
    f, p = len(SIZES), 2
    rows, right = (
        [np.zeros((p, f * p))],
        [np.linalg.solve(np.linalg.cholesky(PRIOR.covariance), PRIOR.mean)],
    )
    rows[0][:, :p] = np.linalg.inv(np.linalg.cholesky(PRIOR.covariance))
    step = np.linalg.inv(np.linalg.cholesky(Q))
    for k in range(f):
        part = slice(ends[k], ends[k + 1])
        row = np.zeros((SIZES[k], f * p))
        row[:, p * k : p * k + p] = H[part] / np.sqrt(R[part])[:, None]
        rows.append(row)
        right.append(y[part] / np.sqrt(R[part]))
        if k:
            row = np.zeros((p, f * p))
            row[:, p * k : p * k + p], row[:, p * k - p : p * k] = step, -step
            rows.append(row)
            right.append(np.zeros(p))
    A, b = np.concatenate(rows), np.concatenate(right)
    covariance = np.linalg.inv(A.T @ A).reshape(f, p, f, p)
    mean = np.linalg.lstsq(A, b, rcond=None)[0].reshape(f, p)
    return mean, np.stack([covariance[k, :, k, :] for k in range(f)])


def test_the_smoother_is_least_squares_over_the_whole_trajectory():
    H, _, y = linear_model()
    states = filter_frames(PRIOR, frames_of(H, y), Q)
    smoothed = smooth_frames(states)
    mean, covariance = batch_trajectory(H, y)
    np.testing.assert_allclose(smoothed.mean, mean, rtol=1e-10)
    np.testing.assert_allclose(smoothed.covariance, covariance, rtol=1e-10)
    # The filter knows less of the first frame, and the same of the last one.
    np.testing.assert_array_equal(smoothed.mean[-1], states[-1].filtered.mean)
    filtered = np.array([s.filtered.std for s in states])
    assert np.all(smoothed.std[:-1] < filtered[:-1])


def test_a_stacked_random_walk_is_the_same_problem():
    H, d, y = linear_model()
    ends = np.cumsum([0, *SIZES])
    whole = np.zeros((y.size, 2 * len(SIZES)))
    for k in range(len(SIZES)):
        rows = slice(ends[k], ends[k + 1])
        whole[rows, 2 * k : 2 * k + 2] = H[rows]
    prior = random_walk(PRIOR, Q, len(SIZES))
    found = SequentialFilter(SIZES).run(predicting(whole, d), prior, y, R)
    states = filter_frames(PRIOR, frames_of(H, y - d), Q)
    smoothed = smooth_frames(states)
    stacked = found.final[-1].filtered
    for k, state in enumerate(found.final):
        own = slice(2 * k, 2 * k + 2)
        covariance = stacked.covariance[own, own]
        np.testing.assert_allclose(stacked.mean[own], smoothed.mean[k], rtol=1e-9)
        np.testing.assert_allclose(covariance, smoothed.covariance[k], rtol=1e-9, atol=1e-14)
        # Frame k's block after frame k is what the filter has said at that moment.
        covariance = state.filtered.covariance[own, own]
        np.testing.assert_allclose(state.filtered.mean[own], states[k].filtered.mean, rtol=1e-9)
        np.testing.assert_allclose(covariance, states[k].filtered.covariance, rtol=1e-9)


def test_parameters_that_do_not_drift_are_smoothed_to_the_batch_in_every_frame():
    H, _, y = linear_model()
    states = filter_frames(PRIOR, frames_of(H, y), 0.0)
    smoothed = smooth_frames(states)
    for k in range(len(SIZES)):
        np.testing.assert_allclose(smoothed.mean[k], states[-1].filtered.mean, rtol=1e-9)
        np.testing.assert_allclose(
            smoothed.covariance[k], states[-1].filtered.covariance, rtol=1e-8
        )
    # Also where one of them is known exactly, so that P⁻ cannot be inverted.
    held = Gaussian(PRIOR.mean, np.diag([0.5, 0.0]))
    fixed = smooth_frames(filter_frames(held, frames_of(H, y), np.array([0.2, 0.0])))
    np.testing.assert_array_equal(fixed.mean[:, 1], PRIOR.mean[1])
    assert not fixed.covariance[:, 1].any()


class Growing:
    """Frame k sees exp(m) and m: not linear."""

    def frame(self, k: int, m: FloatArray, /) -> Prediction:
        if not np.all(np.abs(m) < 5):
            return Prediction.failed("too far")
        return Prediction(
            np.array([np.exp(m[0]), (k + 1) * m[0]]), np.array([np.exp(m), m * 0 + k + 1])
        )


def test_the_drift_smoother_is_the_posterior_mode_of_the_trajectory():
    sizes, walk, prior = (2,) * 5, 0.05, Gaussian.from_variance(np.array([0.0]), 1.0)
    truth = np.array([0.5, 0.7, 0.6, 1.0, 1.3])
    rng = np.random.default_rng(1)
    model = Growing()
    y = np.concatenate([model.frame(k, truth[k : k + 1]).y for k in range(5)])
    y = y + 0.5 * rng.normal(size=10)
    found = DriftSmoother(sizes, walk, tolerance=1e-9, max_iterations=60)(model, prior, y, 0.25)
    assert found.converged
    assert found.smoothed is not None

    def whole(z: FloatArray) -> Prediction:
        parts = [model.frame(k, z[k : k + 1]) for k in range(5)]
        J = np.zeros((10, 5))
        for k, part in enumerate(parts):
            J[2 * k : 2 * k + 2, k] = part.jacobian[:, 0]
        return Prediction(np.concatenate([part.y for part in parts]), J)

    batch = IteratedFilter(tolerance=1e-10, objective_tolerance=1e-16)(
        whole, random_walk(prior, walk, 5), y, 0.25
    )
    np.testing.assert_allclose(found.smoothed.mean[:, 0], batch.mean, rtol=1e-7)
    np.testing.assert_allclose(
        found.smoothed.covariance[:, 0, 0], np.diag(batch.covariance), rtol=1e-6
    )
    first = np.array([s.filtered.mean[0] for s in found.extended])
    assert np.abs(first - batch.mean).max() > 0.01


def test_a_drifting_model_that_fails_is_a_value():
    prior = Gaussian.from_variance(np.array([9.0]), 1.0)
    found = DriftSmoother((2, 2), 0.1)(Growing(), prior, np.ones(4), 1.0)
    assert found.reason is Reason.MODEL_FAILED
    assert "frame 0" in found.detail
    assert "too far" in found.detail


class Saturating:
    """Frame k sees the arc tangent of m: from afar a full Gauss-Newton step leads farther away."""

    def frame(self, k: int, m: FloatArray, /) -> Prediction:
        if not abs(m[0]) < 30:
            return Prediction.failed("too far")
        return Prediction(np.arctan(m), np.array([1 / (1 + m**2)]))


def test_the_drift_smoother_shortens_passes_that_lead_away():
    prior = Gaussian.from_variance(np.array([2.5]), 100.0)
    model = Saturating()
    found = DriftSmoother((1,), 0.01, tolerance=1e-9, max_iterations=50)(
        model, prior, np.zeros(1), 1e-2
    )
    assert found.converged
    assert found.smoothed is not None
    # From 2.5 the first pass leads to -6.1 and a full second one to 48, where the model fails; its
    # half and its quarter raise the objective.
    assert found.forward_solves > len(found.objectives) + 1
    assert np.all(np.diff(found.objectives) < 0)
    batch = IteratedFilter(tolerance=1e-10, objective_tolerance=1e-16)(
        lambda m: model.frame(0, m), prior, np.zeros(1), 1e-2
    )
    np.testing.assert_allclose(found.smoothed.mean, [batch.mean], atol=1e-9)
    # The prior's pull is part of the objective: 2.5² / 200 at 0.
    assert found.objectives[-1] == pytest.approx(batch.objective[-1], rel=1e-6)
    assert found.objectives[-1] == pytest.approx(0.03125, rel=1e-2)


class Mirrored(Saturating):
    """The same with a derivative of the wrong sign: no step lowers the objective."""

    def frame(self, k: int, m: FloatArray, /) -> Prediction:
        found = super().frame(k, m)
        return Prediction(found.y, -found.jacobian) if found.converged else found


def test_a_drift_smoother_that_gives_up_returns_what_it_last_accepted():
    prior = Gaussian.from_variance(np.array([0.5]), 1.0)
    found = DriftSmoother((1,), 0.01)(Mirrored(), prior, np.zeros(1), 1e-2)
    assert found.reason is Reason.NO_DECREASE
    assert found.smoothed is not None
    z = float(found.smoothed.mean[0, 0])
    objective = 0.5 * np.arctan(z) ** 2 / 1e-2 + 0.5 * (z - 0.5) ** 2
    assert objective == pytest.approx(found.objectives[-1])
    stopped = DriftSmoother((1,), 0.01, max_iterations=1)(
        Saturating(), Gaussian.from_variance(np.array([2.5]), 100.0), np.zeros(1), 1e-2
    )
    assert stopped.reason is Reason.MAX_ITERATIONS
    assert stopped.smoothed is not None
    z = float(stopped.smoothed.mean[0, 0])
    objective = 0.5 * np.arctan(z) ** 2 / 1e-2 + 0.5 * (z - 2.5) ** 2 / 100.0
    assert objective == pytest.approx(stopped.objectives[-1])


def test_parameters_without_a_walk_stay_the_same_in_all_frames():
    prior = Gaussian.from_variance(np.array([0.0]), 1.0)
    model = Growing()
    y = np.concatenate([model.frame(k, np.array([0.8])).y for k in range(4)])
    found = DriftSmoother((2,) * 4, 0.0, tolerance=1e-6)(model, prior, y, 1e-4)
    assert found.converged
    assert found.smoothed is not None
    np.testing.assert_allclose(found.smoothed.mean - found.smoothed.mean[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.smoothed.mean[0], 0.8, atol=1e-3)
