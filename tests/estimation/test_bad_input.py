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
    identifiability,
    moran,
    nees,
    observation_noise,
)
from tests.estimation.problems import bound

PRIOR = Gaussian(np.array([2.0, 3.0]), np.eye(2))
HALF_FIXED = Gaussian(np.array([2.0, 3.0]), np.diag([1.0, 0.0]))


def model(m):
    return Prediction(np.array([m[0], m[1], m[0]]), np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]))


def run(method=None, *, model=model, prior=PRIOR, y=(1.0, 2.0, 3.0), names=None, transform=None):
    method = IteratedFilter() if method is None else method
    return method(model, prior, np.array(y), 1.0, names=names, transform=transform)


def normal(P, mean=(0.0, 0.0)):
    return Gaussian(np.array(mean), np.array(P))


def noise(R, size=2):
    return observation_noise(np.array(R), size)


def prediction(y, jacobian, **more):
    return Prediction(np.array(y), np.array(jacobian), **more)


def scaled(scale, names=None, H=((1.0, 1.0),) * 3):
    return identifiability(np.array(H), 1.0, np.array(scale), names=names)


ONES, PATH = np.ones((3, 2)), np.arange(3.0)
BAD = [
    (lambda: Gaussian(np.eye(2), np.eye(2)), r"shape \(p,\).*\(2, 2\)"),
    (lambda: normal(np.eye(2), (1.0, np.nan)), "mean.*entry 1 is nan"),
    (lambda: normal(np.diag([1.0, -0.5])), "negative variance -0.5 in row 1"),
    (lambda: normal([[1.0, 0.2], [0.1, 1.0]]), r"\(0, 1\) is 0.2 and entry \(1, 0\) is 0.1"),
    (lambda: normal([[1.0, 2.0], [2.0, 1.0]]), "semi-definite; the smallest eigenvalue.*-1"),
    (lambda: noise(np.ones(4), 3), "the 3 variances.*\\(4,\\)"),
    (lambda: noise([1.0, -2.0]), "variance in R is -2"),
    (lambda: prediction(PATH, [[1.0], [0.0]]), r"\(n, p\); got \(3,\) and \(2, 1\)"),
    (lambda: prediction([0.0, np.nan], [[0.0], [0.0]]), "y must be finite; entry 1 is nan"),
    (lambda: Prediction.failed(" "), "must say why"),
    (lambda: run(y=[1.0, 2.0]), r"must predict 2 observations.*y of shape \(3,\)"),
    (lambda: run(names=["E", "E"]), "different names"),
    (lambda: IteratedFilter(objective_tolerance=-1.0), "filter objective_tolerance = -1.0"),
    (lambda: PaperFilter(max_iterations=0), "max_iterations = 0, expected >= 1"),
    (lambda: run(IteratedFilter(start=(1.0, 4.0)), prior=HALF_FIXED), "holds fixed"),
    (lambda: run(prior=normal(np.eye(2), (2.0, -3.0)), transform=Log()), "parameter 1 is -3"),
    (lambda: run(transform=Log((True,))), "names 1 parameters, but there are 2"),
    (lambda: run().interval(1.0), "between 0 and 1; got 1"),
    (lambda: nees(np.zeros(2), np.diag([1.0, 0.0])), "positive definite"),
    (lambda: moran(PATH, sparse.eye_array(3)), "zero diagonal"),
    (lambda: bound(np.array([[np.nan]]), 1.0), r"Jacobian must be finite; entry \(0, 0\)"),
    (lambda: scaled([1.0, 0.0]), "scale must be 2 positive numbers"),
    (lambda: bound(ONES, 1.0, HALF_FIXED), "positive definite here"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_input_is_one_clear_error(make, message):
    with pytest.raises(InputError, match=f"(?s){message}"):
        make()


def test_round_off_in_a_covariance_is_accepted():
    # Units far apart: a covariance of a stiffness and of a tiny damping is judged by correlations.
    P = np.array([[1e6, 0.5e-3], [0.5e-3 * (1 + 1e-13), 1e-12]])
    g = Gaussian(np.zeros(2), P)
    np.testing.assert_array_equal(g.covariance, g.covariance.T)
    np.testing.assert_allclose(g.factor @ g.factor.T, P, rtol=1e-12)
    with pytest.raises(InputError, match="semi-definite"):
        Gaussian(np.zeros(2), np.array([[1e6, 1.1e-3], [1.1e-3, 1e-12]]))
    # Semi-definite: no triangular root.
    P = np.outer([1.0, -2.0, 0.5], [1.0, -2.0, 0.5])
    L = Gaussian(np.zeros(3), P).factor
    np.testing.assert_allclose(L @ L.T, P, atol=1e-14)
