"""Estimates of an analytic model, whose answers are known by hand."""

import dataclasses

import numpy as np
import pytest

from mvest.closure.continuation import ClosedState
from mvest.errors import InputError, MaterialError
from mvest.estimation import Gaussian, Identity, IteratedFilter, PaperFilter, Prediction
from mvest.estimation.prediction import SharedStart
from mvest.mechanics.settings import TissueSettings
from mvest.observation.errors import WhiteNoise
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, StudyResult, estimate
from mvest.problem.synthetic import Truth, TwinData, simulate_observation

NAMES = ("E_f.anterior", "E_f.posterior")
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
VERTICES = 40
TRUTH = np.array([6.23, 2.09])


class Sheet:
    """Points that move by A / m: stiffer means less motion, as in a leaflet."""

    def __init__(self, factor: float = 20.0):
        rng = np.random.default_rng(7)
        self.open = rng.normal(size=3 * VERTICES)
        self.A = factor * rng.normal(size=(3 * VERTICES, 2))
        self.calls = 0

    def __call__(self, m: np.ndarray) -> Prediction:
        self.calls += 1
        if np.any(m <= 0):
            raise MaterialError(f"E_f = {m.min()} MPa, expected > 0")
        closed = self.open + self.A @ (1 / m)
        jacobian = np.concatenate([np.zeros_like(self.A), -self.A / m**2])
        return Prediction(np.concatenate([self.open, closed]), jacobian)


def failing(m: np.ndarray) -> Prediction:
    return Prediction.failed("Newton's method did not converge")


def observe(model=None, noise_mm: float = 0.0, seed: int = 1, **more) -> TwinData:
    return simulate_observation(
        model or Sheet(),
        NAMES,
        TRUTH,
        variance=more.pop("variance", 0.01),
        errors=(WhiteNoise(noise_mm), *more.pop("errors", ())),
        rng=np.random.default_rng(seed),
        **more,
    )


def case(model=None, filter_=None) -> Problem:
    prior = Gaussian.from_variance(np.array([5.0, 3.0]), 9.0)
    return Problem(NAMES, model or Sheet(), prior, filter_ or IteratedFilter(), Identity(), TISSUE)


def test_paper_filter_finds_the_truth_of_a_twin():
    data = observe()
    result = estimate(case(filter_=PaperFilter(0.01)), data.observation).against(data.truth)
    assert result.converged
    np.testing.assert_allclose(result.estimate, TRUTH, rtol=1e-6)
    assert result.distance.shape == (VERTICES,)
    assert result.distance.max() < 1e-6


def test_the_distance_to_the_truth_leaves_the_noise_out():
    data = observe(noise_mm=0.5)
    result = estimate(case(), data.observation).against(data.truth)
    # The norm of three N(0, 0.5²) numbers has the mean 0.5 · sqrt(8/π) = 0.80.
    assert result.distance.mean() == pytest.approx(0.80, rel=0.15)
    # Two parameters take up 2 of 120 parts of the noise's variance: 0.80 · sqrt(2/120) = 0.10.
    assert result.distance_to_truth.mean() < 0.2


def test_a_failing_truth_is_a_value_with_its_reason():
    data = observe(failing)
    assert data.observation is None
    assert data.truth is None
    assert "Newton" in data.reason
    result = StudyResult.failed(case(), data.reason)
    assert not result.converged
    assert result.estimate is result.std is result.distance is None
    assert str(result) == f"no estimate: {data.reason}"
    failed = estimate(case(failing), observe().observation)
    assert not failed.converged
    assert "Newton's method did not converge" in str(failed)


def test_bad_values_and_shapes_are_refused():
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="shut"):
        observe(frames=("shut",))
    with pytest.raises(InputError, match="1 true values for the 2 parameters"):
        simulate_observation(Sheet(), NAMES, np.array([1.0]), variance=1.0, rng=rng)
    with pytest.raises(InputError, match="prior has 1"):
        dataclasses.replace(case(), prior=Gaussian.from_variance(np.ones(1), 1.0))
    data = observe()
    with pytest.raises(InputError, match="truth is of"):
        estimate(case(), data.observation).against(Truth(("a", "b"), TRUTH, np.zeros((2, 1, 3))))


def test_an_unobserved_vertex_does_not_count():
    # The estimate is that of the remaining rows.
    data = observe(noise_mm=0.2)
    positions = data.observation.positions.copy()
    hidden = np.arange(VERTICES) % 4 > 0
    positions[1, hidden] = np.nan
    masked = Observation(data.observation.frames, positions, data.observation.variance)
    assert masked.y.shape == masked.R.shape == (3 * (VERTICES + 10),)
    result = estimate(case(), masked).against(data.truth)
    sheet = Sheet()
    rows = np.repeat(np.concatenate([np.ones(VERTICES, bool), ~hidden]), 3)

    def part(m: np.ndarray) -> Prediction:
        whole = sheet(m)
        return Prediction(whole.y[rows], whole.jacobian[rows])

    by_hand = IteratedFilter()(part, case().prior, positions.ravel()[rows], 0.01)
    np.testing.assert_allclose(result.estimate, by_hand.mean, rtol=1e-12)
    assert np.abs(result.estimate - estimate(case(), data.observation).estimate).max() > 1e-3
    # Unobserved vertices are fitted, but have no distance to the observation.
    assert result.fitted.shape == (2, VERTICES, 3)
    np.testing.assert_array_equal(np.isnan(result.distance), hidden)
    assert np.isfinite(result.distance_to_truth).all()


class Wandering:
    """A model whose predictions depend too much on the last state."""

    def __init__(self):
        self.sheet = Sheet()
        self.closed: ClosedState | None = None
        self.solves = 0

    def restart(self, closed: ClosedState | None):
        self.closed = closed

    def __call__(self, m: np.ndarray) -> Prediction:
        self.solves += 1
        found = self.sheet(m)
        memory = 0.0 if self.closed is None else 1e-6 * self.closed.at[0]
        self.closed = ClosedState(m.copy(), np.zeros((1, 3)))
        return Prediction(found.y + memory, found.jacobian)


def test_estimates_from_a_shared_start_do_not_depend_on_each_other():
    observations = [observe(noise_mm=0.3, seed=seed).observation for seed in range(4)]
    start = case().prior.mean

    def estimates(chosen: list[int], shared: bool = True) -> list[bytes]:
        model = Wandering()
        used = SharedStart(model, start) if shared else model
        results = [estimate(case(used), observations[k]) for k in chosen]
        solves = sum(r.filtered.forward_solves for r in results)
        assert model.solves == (solves - len(chosen) + 1 if shared else solves)
        return [r.estimate.tobytes() + r.std.tobytes() for r in results]

    together = estimates([0, 1, 2, 3])
    assert estimates([2]) + estimates([3, 1]) + estimates([0]) == [
        together[k] for k in (2, 3, 1, 0)
    ]
    # Without the shared start they do depend on each other.
    assert estimates([0, 1, 2], shared=False)[2] != estimates([2], shared=False)[0]
