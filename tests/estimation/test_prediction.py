"""What a model may return, and the error if it returns something else."""

import numpy as np
import pytest

from mvest.errors import InputError, MaterialError
from mvest.estimation import (
    EnsembleFilter,
    ExtendedFilter,
    Gaussian,
    Identity,
    ImportanceFilter,
    IteratedFilter,
    PaperFilter,
    Prediction,
    UnscentedFilter,
)
from mvest.estimation.prediction import Remembered, as_prediction, of_some, predict
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem
from mvest.reporting.expectation import expectation_text

H = np.random.default_rng(5).standard_normal((6, 2))
Y = H @ np.array([1.0, 2.0]) + 0.01
PRIOR = Gaussian(np.ones(2), np.eye(2))
FILTERS = {
    type(one).__name__: one
    for one in (
        PaperFilter(0.0),
        ExtendedFilter(),
        IteratedFilter(),
        UnscentedFilter(),
        EnsembleFilter(),
        ImportanceFilter(),
    )
}


def pair(m):
    return H @ m, H


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_takes_a_pair_as_a_prediction_and_hands_on_what_comes_with_it(name) -> None:
    filter_ = FILTERS[name]
    found = filter_(pair, PRIOR, Y, 0.1)
    whole = filter_(lambda m: Prediction(H @ m, H, aux=tuple(m)), PRIOR, Y, 0.1)
    np.testing.assert_array_equal(found.mean, whole.mean)
    np.testing.assert_array_equal(found.covariance, whole.covariance)
    assert found.converged
    np.testing.assert_allclose(whole.prediction.aux, whole.mean, rtol=1e-12)


def run_expectation(model):
    problem = Problem(("a", "b"), model, PRIOR, IteratedFilter(), Identity(), {})
    seen = Observation(("closed",), Y.reshape(1, 2, 3), 0.1, predicted=("closed",))
    return expectation_text("of a problem", problem, seen, "noise")


USES = {
    **{name: lambda model, f=one: f(model, PRIOR, Y, 0.1) for name, one in FILTERS.items()},
    "expectation": run_expectation,
    "some parameters": lambda model: of_some(model, np.ones(2), np.array([0]))(np.ones(1)),
    "remembered": lambda model: Remembered(model)(np.ones(2)),
    "as_prediction": lambda model: as_prediction(model(np.ones(2)), 2),
}


@pytest.mark.parametrize("use", USES)
def test_another_return_is_one_line_that_says_what_is_expected(use: str) -> None:
    for returned, words in (
        (None, "got NoneType"),
        (H, "got ndarray"),
        ((Y, H, H), "got tuple"),
        ((Y, None), "jacobian"),
        ({"y": Y}, "got dict"),
        ((Y, "slope"), "got tuple"),
        ((Y, H.T), r"shape \(n,\) and jacobian of shape \(n, p\); got \(6,\) and \(2, 6\)"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            USES[use](lambda m, r=returned: r)
        assert "\n" not in str(caught.value)


def test_a_model_cannot_write_on_its_parameters_and_fails_by_a_material_error() -> None:
    def writes(m: np.ndarray) -> Prediction:
        m[:] = 0.0
        return Prediction(H @ m, H)

    def refuses(m: np.ndarray) -> Prediction:
        raise MaterialError("E_f = -1 MPa, expected > 0")

    m = np.ones(2)
    predict(writes, m)
    np.testing.assert_array_equal(m, 1.0)
    assert predict(refuses, m).reason == "E_f = -1 MPa, expected > 0"


def test_a_model_of_some_parameters() -> None:
    seen = []

    def model(m: np.ndarray) -> Prediction:
        seen.append(tuple(m))
        return Prediction(H @ m, H, reason="closed", aux="state")

    some = of_some(model, np.array([0.1, 0.2]), np.array([1]), snap=1e-14)
    prediction = some(np.array([3.0]))
    assert (prediction.reason, prediction.aux) == ("closed", "state")
    np.testing.assert_array_equal(prediction.y, H @ np.array([0.1, 3.0]))
    # The given value is met to the last bit.
    some(np.array([0.2 * (1 + 3e-16)]))
    some(np.array([0.2 * (1 + 1e-12)]))
    assert seen[1:] == [(0.1, 0.2), (0.1, 0.2 * (1 + 1e-12))]
    failed = lambda m: Prediction.failed("does not close")  # noqa: E731
    assert of_some(failed, np.ones(2), np.array([1]))(np.ones(1)).reason == "does not close"


def test_a_remembered_run_is_not_repeated() -> None:
    calls = []

    def model(m: np.ndarray) -> Prediction:
        calls.append(m)
        return Prediction.failed("open") if m[0] < 0 else Prediction(H @ m, H)

    exact, near = Remembered(model), Remembered(model, rtol=1e-12)
    for m in ([1.0, 2.0], [1.0, 2.0], [-1.0, 2.0], [-1.0, 2.0], [1.0 + 1e-14, 2.0]):
        exact(np.array(m))
        near(np.array(m))
    assert (len(exact.runs), len(near.runs), len(calls)) == (3, 2, 5)
    Remembered(model, near.runs)(np.array([5.0, 5.0]))
    assert len(near.runs) == 2
