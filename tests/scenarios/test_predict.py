"""A scenario at the estimate and at samples: a linear stand-in, and a real valve."""

from types import SimpleNamespace

import numpy as np
import pytest

from mvest.errors import MaterialError
from mvest.estimation import Gaussian, IteratedFilter, Prediction, observation_noise
from mvest.mechanics.steps import StepReason
from mvest.scenarios import predict
from mvest.scenarios.measures import measure_closed
from mvest.scenarios.predict import (
    PredictedScenario,
    Sample,
    posterior_samples,
    predict_scenario,
)
from mvest.scenarios.scenario import Clip, Scenario, model_under
from tests.scenarios.valves import NAMES, model

SLOPE = np.array([[3.0, -1.0], [0.5, 2.0]])


def estimated():
    """N([6, 2], P) of two correlated parameters, whose model is linear."""
    h = np.array([[1.0, 0.5], [0.0, 1.0]])
    return IteratedFilter(1e-9)(
        lambda m: Prediction(h @ m, h),
        Gaussian.from_variance(np.array([6.0, 2.0]), np.array([100.0, 100.0])),
        h @ np.array([6.0, 2.0]),
        observation_noise(np.array([0.04, 0.01]), 2),
        names=NAMES,
    )


def test_samples_have_the_moments_of_the_posterior():
    estimate = estimated()
    samples, posterior = posterior_samples(estimate, 1024, 7), estimate.transformed
    # A Sobol sequence of n points is off by about 1/n of a standard deviation, not 1/sqrt(n) = 3 %.
    assert np.all(np.abs(samples.mean(axis=0) - posterior.mean) < 0.005 * posterior.std)
    scale = np.outer(posterior.std, posterior.std)
    assert np.all(np.abs(np.cov(samples.T) - posterior.covariance) < 0.01 * scale)
    assert abs(posterior.covariance[0, 1]) > 0.2 * scale[0, 1]  # or the factor is not tested
    np.testing.assert_array_equal(posterior_samples(estimate, 1024, 7), samples)


def spread_of(values):
    samples = tuple(Sample({"a": float(value)}) for value in values)
    return PredictedScenario(Sample({}), None, (*samples, Sample({}, "did not close"))).spread("a")


def test_the_interval_is_that_of_the_samples():
    # Type 8 of n = 40 numbers 1 to 40: at position (n + 1/3) p + 1/3 = 1.3417 for p = 0.025.
    spread = spread_of(range(1, 41))
    assert spread["samples"] == 40
    assert spread["low"] == pytest.approx(1.3417, abs=1e-4)
    assert spread["high"] == pytest.approx(41 - 1.3417, abs=1e-4)
    assert spread["mean"] == 20.5
    assert spread["std"] == pytest.approx(np.std(range(40), ddof=1))
    # One sample has no spread.
    spread = spread_of([3.0])
    assert (spread["mean"], spread["samples"]) == (3.0, 1)
    assert np.isnan([spread["std"], spread["low"], spread["high"]]).all()


class Linear:
    """A model whose one node moves linearly with the parameters."""

    names = NAMES

    def __init__(self, refuse=lambda m: None):
        self.refuse = refuse
        self.closed = "closed at the estimate"
        self.starts = []

    def restart(self, closed):
        self.starts.append(closed)

    def observed(self, x):
        return x

    def close(self, m, *, sensitivities):
        reason = self.refuse(m)
        if isinstance(reason, Exception):
            raise reason
        x = np.append(SLOPE @ m, 0.0)[None]
        simulation = SimpleNamespace(
            converged=reason is None,
            reason=reason or StepReason.COMPLETED,
            frames=[x],
            sensitivities=[np.concatenate([SLOPE.T, np.zeros((2, 1))], axis=1)[:, None]],
        )
        return SimpleNamespace(system="system", simulation=simulation)


@pytest.fixture
def linear(monkeypatch):
    def measured(model, system, x):
        return {"sum_mm": float(x.sum()), "first_mm": float(x[0, 0]), "load": 7.0}

    monkeypatch.setattr(predict, "measure_closed", measured)
    return Linear()


def test_samples_are_spread_as_the_posterior_where_all_is_linear(linear):
    estimate = estimated()
    samples = posterior_samples(estimate, 512, 3)
    found = predict_scenario(linear, estimate, samples)
    P = estimate.covariance
    for name, a in (("first_mm", SLOPE[0]), ("sum_mm", SLOPE.sum(axis=0))):
        exact = float(np.sqrt(a @ P @ a))
        assert found.spread(name)["std"] == pytest.approx(exact, rel=0.02)
        # 512 points of a Sobol sequence: the mean is off by about 1/512 standard deviations.
        centre = found.at_estimate.measures[name]
        assert found.spread(name)["mean"] == pytest.approx(centre, abs=0.01 * exact)
    assert found.failures == ()
    np.testing.assert_allclose(found.shape[0, :2], SLOPE @ estimate.mean)
    # Every sample starts from the valve at the estimate and not from the sample before.
    assert linear.starts == ["closed at the estimate"] * 512


def test_failed_samples_are_counted_and_not_dropped(linear):
    estimate = estimated()
    samples = posterior_samples(estimate, 16, 3)
    order = np.sort(samples[:, 0])

    def refuse(m):
        if m[0] == order[-1]:
            return MaterialError("E_f = -1 MPa, expected > 0")
        return StepReason.NO_CONVERGENCE if m[0] >= order[-3] else None

    linear.refuse = refuse
    found = predict_scenario(linear, estimate, samples)
    assert len(found.samples) == 16
    assert found.spread("sum_mm")["samples"] == 13
    assert sorted(found.failures) == [
        "E_f = -1 MPa, expected > 0",
        StepReason.NO_CONVERGENCE.value,
        StepReason.NO_CONVERGENCE.value,
    ]


class Finer(Linear):
    """The same, moved by 0.5 mm along x."""

    def observed(self, x):
        return x

    def close(self, m, *, sensitivities):
        result = super().close(m, sensitivities=sensitivities)
        result.simulation.frames[0][0, 0] += 0.5
        return result


def test_intervals_carry_the_error_of_the_mesh(linear):
    estimate = estimated()
    samples = posterior_samples(estimate, 64, 3)
    plain = predict_scenario(linear, estimate, samples)
    assert np.isnan(plain.mesh_error("sum_mm"))
    assert np.all(np.isnan(plain.interval("sum_mm")))
    found = predict_scenario(linear, estimate, samples, finer=Finer())
    assert found.mesh_error("first_mm") == pytest.approx(0.5)
    centre, spread = found.at_estimate.measures["first_mm"], found.spread("first_mm")
    low, high = found.interval("first_mm")
    assert centre - low == pytest.approx(np.hypot(centre - spread["low"], 1.96 * 0.5), rel=1e-4)
    assert high - centre == pytest.approx(np.hypot(spread["high"] - centre, 1.96 * 0.5), rel=1e-4)
    # Where the meshes agree, nothing is added: a load is 7 on both.
    assert found.interval("load") == (7.0, 7.0)


def test_a_valve_that_does_not_close_at_the_estimate_is_a_result(linear):
    linear.refuse = lambda m: StepReason.SINGULAR
    found = predict_scenario(linear, estimated(), posterior_samples(estimated(), 2, 1))
    assert not found.at_estimate.measures
    assert found.at_estimate.reason == StepReason.SINGULAR.value
    assert found.shape is None
    assert len(found.failures) == 2


def test_a_clip_holds_the_leaflets_at_its_distance():
    whole, found = model((24, 3), (64, 15), (96, 20)), {}
    for scenario in (Scenario("as observed"), Scenario("clip", clip=Clip())):
        changed = model_under(whole, scenario)
        result = changed.close(np.array([6.23, 2.09]), sensitivities=True)
        assert result.simulation.converged
        found[scenario.title] = changed, result
    changed, result = found["clip"]
    ties, x = result.system.ties, result.simulation.frames[-1]
    # Each pair bears less than the whole pressure on the annulus, 0.016 MPa on an ellipse of
    # 36 x 23 mm or 10 N, under which it gives way by 0.1 mm.
    assert np.all(np.abs(ties.lengths(x) - changed.ties.length) * ties.stiffness < 10.0)
    changed, result = found["as observed"]
    x = result.simulation.frames[-1]
    assert np.any(ties.lengths(x) - found["clip"][0].ties.length > 0.1)
    # A competent valve has no gap.
    measures = measure_closed(changed, result.system, x)
    assert measures["gap_mm2"] == 0.0
    # Leaflets meet over more than their thickness at the free edge, 0.75 x 1.3 mm.
    assert measures["coaptation_length_mm"] > 1.0
    assert 0 < measures["stress_p95_anterior_mpa"] < measures["stress_p99_anterior_mpa"]
    assert measures["stress_p99_anterior_mpa"] < measures["stress_max_anterior_mpa"]
