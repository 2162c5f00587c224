"""Profiles of models whose valleys are known."""

import numpy as np
import pytest
from scipy.stats import chi2

from mvest.errors import InputError
from mvest.estimation import Gaussian, Identity, Log, Prediction
from mvest.estimation.information.identifiability import cramer_rao_bound
from mvest.estimation.information.profile import CROSSED, GRID_ENDED, profile

H = np.array(
    [[1.0, 0.9, 0.0], [0.5, 0.6, 1.0], [0.0, 0.3, -0.4], [2.0, 1.0, 1.0], [1.0, -1.0, 0.3]]
)
R = np.array([0.04, 0.09, 0.01, 0.25, 0.16])


def linear(m):
    return Prediction(H @ m, H)


def product(m):
    """Only the product of the two parameters matters: m0 m1 = c is an exact flat valley."""
    y = np.array([1.0, 2.0, -0.5]) * m[0] * m[1]
    direction = np.array([1.0, 2.0, -0.5])
    return Prediction(y, np.stack([direction * m[1], direction * m[0]], axis=1))


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("with_prior", [False, True])
def test_a_linear_model_has_the_parabola_of_its_bound(index, with_prior):
    # With R known, the profile of a linear model is (m_k - best_k)² / C_kk, C = (H' R^-1 H)^-1
    # (plus the prior's precision): the bound's own parabola, whatever the data.
    y = np.array([1.0, -2.0, 0.5, 3.0, 0.2])
    prior = Gaussian.from_variance(np.array([0.5, 0.0, -1.0]), np.array([0.1, 0.2, 0.3]))
    prior = prior if with_prior else None
    C = cramer_rao_bound(H, R, prior)
    right = H.T @ (y / R)
    if prior is not None:
        right = right + np.linalg.solve(prior.covariance, prior.mean)
    best = C @ right
    std = np.sqrt(C[index, index])
    offsets = std * np.array([-2.5, -1.7, -0.3, 0.8, 1.2, 2.9])
    found = profile(linear, y, R, np.zeros(3), index, offsets, prior=prior)
    np.testing.assert_allclose(
        found.deviance, ((found.values - best[index]) / std) ** 2, rtol=1e-9, atol=1e-9
    )
    # The others follow the regression C_jk / C_kk.
    others = best + np.outer(found.values - best[index], C[:, index] / C[index, index])
    np.testing.assert_allclose(found.path, others, rtol=1e-9, atol=1e-9)
    reach = np.sqrt(chi2.ppf(0.95, 1)) * std
    assert (found.low, found.high) == pytest.approx((best[index] - reach, best[index] + reach))
    assert found.identifiable
    assert found.ends == (CROSSED, CROSSED)


def test_where_only_a_product_matters_the_interval_is_open_and_the_valley_a_hyperbola():
    truth = np.array([2.0, 3.0])
    y = product(truth).y + 0.1  # no parameters fit exactly
    offsets = np.linspace(-1.5, 1.5, 13)
    found = profile(product, y, 0.01, np.array([1.0, 1.0]), 0, offsets, transform=Log())
    assert found.flat
    assert not found.identifiable
    assert (found.low, found.high) == (-np.inf, np.inf)
    assert found.ends == (GRID_ENDED, GRID_ENDED)
    assert len(found.values) == 13
    assert found.values[-1] / found.values[0] == pytest.approx(np.exp(3.0))
    # Least squares of a v = y with v = (1, 2, -0.5): a = v'y / v'v.
    v = np.array([1.0, 2.0, -0.5])
    np.testing.assert_allclose(found.path.prod(axis=1), v @ y / (v @ v), rtol=1e-6)
    np.testing.assert_allclose(found.deviance, 0.0, atol=1e-5)


def test_what_is_known_beforehand_closes_a_valley():
    # With log m1 ~ N(log 3, 0.1²), log m0 = log(product) - log m1 has the same deviation: the
    # product itself is known to about 0.02 / (6 * 2.3) < 0.2 %.
    y = product(np.array([2.0, 3.0])).y
    prior = Gaussian.from_variance(np.array([2.0, 3.0]), np.array([1e4, 0.09]))
    found = profile(
        product, y, 4e-4, np.array([2.0, 3.0]), 0, np.linspace(-0.3, 0.3, 31),
        transform=Log(), prior=prior,
    )  # fmt: skip
    reach = 0.1 * np.sqrt(chi2.ppf(0.95, 1))
    assert np.log([found.low, found.high]) == pytest.approx(
        np.log(2.0) + np.array([-reach, reach]), abs=1e-3
    )


def test_a_saturating_model_bounds_its_parameter_on_one_side():
    # y = 1 - exp(-m) hardly changes beyond m = 5: with noise of 0.05 about y = 0.99 a small m is
    # ruled out, a large one is not. 1 - exp(-low) = 0.99 - 1.96 * 0.05.
    def saturating(m):
        return Prediction(1.0 - np.exp(-m), np.diag(np.exp(-m)))

    found = profile(
        saturating, np.array([0.99]), 0.0025, np.array([2.0]), 0,
        np.linspace(-2.0, 2.0, 401), transform=Log(),
    )  # fmt: skip
    assert found.low == pytest.approx(-np.log(0.01 + 1.95996 * 0.05), rel=1e-4)
    assert found.high == np.inf
    assert not found.identifiable
    assert not found.flat


def test_a_side_ends_where_the_model_fails():
    def failing(m):
        return linear(m) if m[0] < 1.2 else Prediction.failed("the valve does not close")

    y = H @ np.array([1.0, 1.0, 1.0])
    found = profile(failing, y, R * 100.0, np.ones(3), 0, np.linspace(-0.5, 0.5, 11))
    assert found.values[-1] == pytest.approx(1.1)
    assert found.high == np.inf
    assert found.ends == (GRID_ENDED, "the model has no prediction: the valve does not close")


def test_a_profile_is_not_followed_far_beyond_its_threshold():
    y = H @ np.array([1.0, 1.0, 1.0])
    calls = []

    def counted(m):
        calls.append(m)
        return linear(m)

    found = profile(counted, y, R, np.ones(3), 0, np.linspace(-50.0, 50.0, 401))
    # Steps of 0.25; 1.96 + 2 standard deviations of the parameter are followed, and one step.
    std = np.sqrt(cramer_rao_bound(H, R)[0, 0])
    assert abs(found.values - 1.0).max() <= 3.96 * std + 0.25
    assert len(calls) <= len(found.values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offsets": np.array([0.1, 0.2])}, "both sides"),
        ({"offsets": np.array([-0.1, np.nan])}, "must be finite"),
        ({"index": 3}, "parameter 3 of 3"),
        ({"level": 1.0}, "expected between 0 and 1"),
        ({"names": ("a",)}, "names"),
        ({"y": np.zeros(4)}, r"must predict 4 observations.*y of shape \(5,\)"),
        ({"model": lambda m: Prediction.failed("broken")}, "broken"),
    ],
)
def test_bad_input_is_refused(change, message):
    given = {
        "model": linear, "y": np.zeros(5), "R": 1.0, "start": np.zeros(3), "index": 0,
        "offsets": np.array([-1.0, 1.0]), "transform": Identity(),
    } | change  # fmt: skip
    if "y" in change:
        given["R"] = 1.0
    with pytest.raises(InputError, match=message):
        profile(**given)
