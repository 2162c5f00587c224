"""The polynomial surrogate: exact for polynomials, its derivative and its misfit."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import observation_noise
from mvest.estimation.filters.surrogate import Region, affordable_degree, fit_surrogate

REGION = Region(np.array([1.0, -2.0]), np.array([[2.0, 0.5], [0.0, 1.5]]))


def cubic(x):
    """Three values (k, 3) of total degree 3, and their derivatives (k, 3, 2)."""
    a, b = x.T
    y = np.stack([a * b**2, 1.0 + a - b, a**3], axis=-1)
    zero, one = np.zeros_like(a), np.ones_like(a)
    slopes = np.stack(
        [
            np.stack([b**2, 2 * a * b], axis=-1),
            np.stack([one, -one], axis=-1),
            np.stack([3 * a**2, zero], axis=-1),
        ],
        axis=1,
    )
    return y, slopes


def points(count, seed=0):
    return REGION.points(np.random.default_rng(seed).uniform(-1, 1, (count, 2)))


@pytest.mark.parametrize(("count", "with_slopes"), [(12, False), (4, True)])
def test_a_cubic_is_found_exactly(count: int, with_slopes: bool) -> None:
    # Ten terms: 12 values, or 4 runs with two derivatives each. An error in the derivative's
    # change of coordinates would leave no exact fit.
    x = points(count)
    y, slopes = cubic(x)
    surrogate = fit_surrogate(x, y, slopes if with_slopes else None, REGION, 3)
    other = points(7, seed=1)
    np.testing.assert_allclose(surrogate(other), cubic(other)[0], atol=1e-10)
    np.testing.assert_allclose(surrogate.jacobian(other[0]), cubic(other)[1][0], atol=1e-9)


def test_the_jacobian_is_that_of_the_values() -> None:
    # Central differences with step h are off by O(h²): a hundredfold smaller for a tenth of h.
    x = points(30)
    surrogate = fit_surrogate(x, np.sin(x), None, REGION, 5)
    at = np.array([0.7, -1.6])
    errors = []
    for h in (1e-2, 1e-3):
        differences = [(surrogate(at[None] + h * e) - surrogate(at[None] - h * e))[0] / (2 * h)
                       for e in np.eye(2)]  # fmt: skip
        errors.append(np.abs(np.transpose(differences) - surrogate.jacobian(at)).max())
    assert errors[1] == pytest.approx(errors[0] / 100, rel=0.05)


def test_the_error_falls_with_the_degree() -> None:
    x, other = points(60), points(50, seed=1)
    f = lambda x: np.exp(0.5 * x)  # noqa: E731
    errors = [
        np.abs(fit_surrogate(x, f(x), None, REGION, d)(other) - f(other)).max() for d in (2, 4, 6)
    ]
    # The remainder of the exponential series shrinks by (r/2)²/((d+1)(d+2)), r at most 2.
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def test_the_fast_misfit_is_the_misfit() -> None:
    x = points(20)
    y = cubic(x)[0]
    surrogate = fit_surrogate(x, np.hstack([y, y**2 / 50]), None, REGION, 4)
    noise = observation_noise(np.linspace(0.5, 2.0, 6), 6)
    data = np.arange(6.0)
    other = points(5, seed=2)
    e = noise.whiten((data - surrogate(other)).T)
    np.testing.assert_allclose(
        surrogate.misfit(data, noise)(other), 0.5 * (e**2).sum(axis=0), rtol=1e-9
    )


def test_beyond_the_region_nothing_is_likely() -> None:
    x = points(20)
    surrogate = fit_surrogate(x, x, None, REGION, 1)
    misfit = surrogate.misfit(np.zeros(2), observation_noise(1.0, 2))
    outside = REGION.points(np.array([[0.0, 1.01], [0.0, 0.99]]))
    np.testing.assert_array_equal(np.isfinite(misfit(outside)), [False, True])


def test_more_terms_than_numbers_are_refused() -> None:
    x = points(5)
    with pytest.raises(InputError, match="6 terms, but 5 runs"):
        fit_surrogate(x, x, None, REGION, 2)


def test_the_affordable_degree() -> None:
    # Two parameters: 3, 6, 10, 15 terms of degree 1, 2, 3, 4; times 1.6 they are 4.8, 9.6, 16, 24.
    assert [affordable_degree(n, 2, 3) for n in (3, 9, 10, 16, 100)] == [1, 1, 2, 3, 3]
