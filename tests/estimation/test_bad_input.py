"""Every inadmissible input: one clear error that names the value and what would be right."""

import numpy as np
import pytest
from scipy import sparse

from mvest.errors import InputError
from mvest.estimation import (
    Gaussian,
    IteratedFilter,
    Log,
    PaperFilter,
    Prediction,
    chi_square_band,
    identifiability,
    moran,
    nees,
    observation_noise,
    zero_mean,
)
from tests.estimation.problems import bound

PRIOR = Gaussian(np.array([2.0, 3.0]), np.eye(2))


def model(m):
    return Prediction(np.array([m[0], m[1], m[0]]), np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]))


def filtered(
    *, method=None, model=model, prior=PRIOR, y=(1.0, 2.0, 3.0), R=1.0, names=None, transform=None
):
    method = IteratedFilter() if method is None else method
    return method(model, prior, np.array(y), R, names=names, transform=transform)


def correlated_noise(rows):
    return observation_noise(np.array(rows), len(rows))


BAD = {
    "mean not a vector": (lambda: Gaussian(np.eye(2), np.eye(2)), r"shape \(p,\).*\(2, 2\)"),
    "empty mean": (lambda: Gaussian(np.empty(0), np.empty((0, 0))), r"p at least 1; got \(0,\)"),
    "mean NaN": (lambda: Gaussian(np.array([1.0, np.nan]), np.eye(2)), "mean.*entry 1 is nan"),
    "covariance shape": (lambda: Gaussian(np.zeros(2), np.eye(3)), r"\(2, 2\); got \(3, 3\)"),
    "covariance infinite": (
        lambda: Gaussian(np.zeros(2), np.diag([1.0, np.inf])),
        r"entry \(1, 1\) is inf",
    ),
    "negative variance": (
        lambda: Gaussian(np.zeros(2), np.diag([1.0, -0.5])),
        "negative variance -0.5 in row 1",
    ),
    "asymmetric": (
        lambda: Gaussian(np.zeros(2), np.array([[1.0, 0.2], [0.1, 1.0]])),
        r"symmetric; entry \(0, 1\) is 0.2 and entry \(1, 0\) is 0.1",
    ),
    "indefinite": (
        lambda: Gaussian(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]])),
        "positive semi-definite; the smallest eigenvalue.*-1",
    ),
    "indefinite by a zero variance": (
        lambda: Gaussian(np.zeros(2), np.array([[0.0, 1e-30], [1e-30, 1.0]])),
        "symmetric|semi-definite",
    ),
    "variance of wrong shape": (
        lambda: Gaussian.from_variance(np.zeros(2), np.ones(3)),
        r"variance must have shape \(2, 2\); got \(3,\)",
    ),
    "R of wrong length": (lambda: observation_noise(np.ones(4), 3), "the 3 variances.*\\(4,\\)"),
    "R zero": (lambda: observation_noise(0.0, 3), "variance in R is 0, expected > 0"),
    "R negative": (lambda: observation_noise(np.array([1.0, -2.0]), 2), "variance in R is -2"),
    "R NaN": (lambda: observation_noise(np.nan, 2), "R must be finite"),
    "R of wrong shape": (lambda: observation_noise(np.eye(3), 2), r"\(2, 2\); got shape \(3, 3\)"),
    "R asymmetric": (lambda: correlated_noise([[1.0, 0.5], [0.0, 1.0]]), "R must be symmetric"),
    "R indefinite": (lambda: correlated_noise([[1.0, 2.0], [2.0, 1.0]]), "positive definite"),
    "R singular": (lambda: correlated_noise([[1.0, 1.0], [1.0, 1.0]]), "positive definite"),
    "correlated R NaN": (lambda: correlated_noise([[np.nan, 0.0], [0.0, 1.0]]), "R must be finite"),
    "R of no numbers": (lambda: observation_noise(sparse.eye_array(3), 3), "R must be numbers"),
    "prediction shapes": (
        lambda: Prediction(np.zeros(3), np.zeros((2, 1))),
        r"\(n, p\); got \(3,\) and \(2, 1\)",
    ),
    "prediction NaN": (
        lambda: Prediction(np.array([0.0, np.nan]), np.zeros((2, 1))),
        "prediction's y must be finite; entry 1 is nan",
    ),
    "Jacobian infinite": (
        lambda: Prediction(np.zeros(2), np.array([[0.0], [-np.inf]])),
        r"jacobian must be finite; entry \(1, 0\) is -inf",
    ),
    "failed prediction with values": (
        lambda: Prediction(np.zeros(2), np.zeros((2, 1)), converged=False, reason="diverged"),
        r"must carry no values.*Prediction.failed",
    ),
    "failed prediction without reason": (lambda: Prediction.failed(" "), "must say why"),
    "observation not a vector": (lambda: filtered(y=[[1.0]]), r"shape \(n,\).*\(1, 1\)"),
    "observation empty": (lambda: filtered(y=[]), r"n > 0; got \(0,\)"),
    "observation NaN": (lambda: filtered(y=[1.0, np.nan, 2.0]), "y must be finite; entry 1"),
    "observation of other length": (
        lambda: filtered(y=[1.0, 2.0]),
        r"must predict 2 observations.*y of shape \(3,\)",
    ),
    "Jacobian for other parameters": (
        lambda: filtered(prior=Gaussian(np.zeros(1), np.eye(1)), model=lambda m: model([1, 2])),
        r"1 parameters; got y of shape \(3,\) and jacobian of shape \(3, 2\)",
    ),
    "too few names": (lambda: filtered(names=["E"]), r"2 parameters.*\('E',\)"),
    "names twice": (lambda: filtered(names=["E", "E"]), "different names"),
    "Q of wrong shape": (
        lambda: filtered(method=PaperFilter(Q=np.ones(3))),
        r"Q must have shape \(2, 2\); got \(3,\)",
    ),
    "Q negative": (
        lambda: filtered(method=PaperFilter(Q=-0.01)),
        "Q has a negative variance -0.01",
    ),
    "tolerance zero": (lambda: PaperFilter(tolerance=0.0), "filter tolerance = 0.0, expected > 0"),
    "tolerance NaN": (lambda: IteratedFilter(tolerance=np.nan), "filter tolerance = nan"),
    "objective tolerance": (
        lambda: IteratedFilter(objective_tolerance=-1.0),
        "filter objective_tolerance = -1.0",
    ),
    "no rounds": (lambda: PaperFilter(max_iterations=0), "max_iterations = 0, expected >= 1"),
    "no iterations": (
        lambda: IteratedFilter(max_iterations=0),
        "max_iterations = 0, expected >= 1",
    ),
    "start of wrong length": (
        lambda: filtered(method=IteratedFilter(start=(1.0,))),
        r"start must be 2 finite numbers; got \(1.0,\)",
    ),
    "start infinite": (
        lambda: filtered(method=IteratedFilter(start=(1.0, np.inf))),
        "start must be 2 finite numbers",
    ),
    "start moves a fixed parameter": (
        lambda: filtered(
            method=IteratedFilter(start=(1.0, 4.0)),
            prior=Gaussian(np.array([2.0, 3.0]), np.diag([1.0, 0.0])),
        ),
        "holds fixed",
    ),
    "logarithm of a negative parameter": (
        lambda: filtered(prior=Gaussian(np.array([2.0, -3.0]), np.eye(2)), transform=Log()),
        "must be positive; parameter 1 is -3",
    ),
    "logarithm of a negative start": (
        lambda: filtered(method=IteratedFilter(start=(0.0, 1.0)), transform=Log()),
        "must be positive; parameter 0 is 0",
    ),
    "logarithms of other parameters": (
        lambda: filtered(transform=Log((True,))),
        "names 1 parameters, but there are 2",
    ),
    "interval level": (lambda: filtered().interval(1.0), "between 0 and 1; got 1"),
    "band without freedom": (lambda: chi_square_band(0), "degree of freedom"),
    "band level": (lambda: chi_square_band(3, 95.0), "between 0 and 1; got 3 and 95"),
    "NEES shape": (lambda: nees(np.zeros((2, 2)), np.eye(2)), r"\(p,\).*got \(2, 2\)"),
    "NEES singular": (lambda: nees(np.zeros(2), np.diag([1.0, 0.0])), "positive definite"),
    "NEES covariance": (lambda: nees(np.zeros(2), np.eye(3)), r"\(2, 2\); got \(3, 3\)"),
    "two innovations": (lambda: zero_mean(np.array([1.0, 2.0])), "n at least 3"),
    "constant innovations": (lambda: zero_mean(np.ones(5)), "all 5 innovations equal 1"),
    "neighbours shape": (
        lambda: moran(np.arange(3.0), sparse.eye_array(4)),
        r"\(3, 3\); got \(4, 4\)",
    ),
    "own neighbour": (lambda: moran(np.arange(3.0), sparse.eye_array(3)), "zero diagonal"),
    "no neighbours": (
        lambda: moran(np.arange(3.0), sparse.csr_array((3, 3))),
        "one pair",
    ),
    "Jacobian not a matrix": (
        lambda: identifiability(np.zeros(3), 1.0, np.ones(1)),
        r"\(n, p\); got \(3,\)",
    ),
    "bound of no matrix": (lambda: bound(np.zeros(3), 1.0), r"\(n, p\); got \(3,\)"),
    "Jacobian NaN": (
        lambda: bound(np.array([[np.nan]]), 1.0),
        r"Jacobian must be finite; entry \(0, 0\)",
    ),
    "scale zero": (
        lambda: identifiability(np.ones((3, 2)), 1.0, np.array([1.0, 0.0])),
        "scale must be 2 positive numbers",
    ),
    "names of other parameters": (
        lambda: identifiability(np.ones((3, 2)), 1.0, np.ones(2), names=["E"]),
        "2 parameters need as many names",
    ),
    "prior of other parameters": (
        lambda: bound(np.ones((3, 1)), 1.0, PRIOR),
        "must have 1 parameters; it has 2",
    ),
    "singular prior": (
        lambda: bound(np.ones((3, 2)), 1.0, Gaussian(np.zeros(2), np.diag([1.0, 0.0]))),
        "positive definite here",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_error(case):
    make, message = BAD[case]
    with pytest.raises(InputError, match=f"(?s){message}"):
        make()


def test_value_objects_cannot_be_changed():
    mean = np.array([1.0, 2.0])
    prior = Gaussian(mean, np.eye(2))
    mean[0] = 99.0
    assert prior.mean[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        prior.covariance[0, 0] = 2.0
    with pytest.raises(AttributeError):
        prior.mean = mean


def test_round_off_in_a_covariance_is_accepted():
    # Units far apart: a covariance of a stiffness and of a tiny damping is judged by correlations.
    P = np.array([[1e6, 0.5e-3], [0.5e-3 * (1 + 1e-13), 1e-12]])
    g = Gaussian(np.zeros(2), P)
    np.testing.assert_array_equal(g.covariance, g.covariance.T)
    np.testing.assert_allclose(g.factor @ g.factor.T, P, rtol=1e-12)
    with pytest.raises(InputError, match="semi-definite"):
        Gaussian(np.zeros(2), np.array([[1e6, 1.1e-3], [1.1e-3, 1e-12]]))


def test_factor_of_a_semi_definite_covariance():
    v = np.array([1.0, -2.0, 0.5])
    P = np.outer(v, v)
    L = Gaussian(np.zeros(3), P).factor
    np.testing.assert_allclose(L @ L.T, P, atol=1e-14)


def test_variances_of_all_shapes():
    mean = np.zeros(2)
    np.testing.assert_array_equal(Gaussian.from_variance(mean, 0.01).covariance, 0.01 * np.eye(2))
    np.testing.assert_array_equal(
        Gaussian.from_variance(mean, np.array([1.0, 4.0])).std, [1.0, 2.0]
    )
    full = np.array([[2.0, 1.0], [1.0, 2.0]])
    np.testing.assert_array_equal(Gaussian.from_variance(mean, full).covariance, full)
