"""What a model may return, and what is said where it returns something else."""

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
from mvest.estimation.prediction import Remembered, SharedStart, as_prediction, of_some, predict
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem
from mvest.reporting.expectation import expectation_text

H = np.random.default_rng(5).standard_normal((6, 2))
Y = H @ np.array([1.0, 2.0]) + 0.01
PRIOR = Gaussian(np.ones(2), np.eye(2))
FILTERS = (
    PaperFilter(0.0),
    ExtendedFilter(),
    IteratedFilter(),
    UnscentedFilter(),
    EnsembleFilter(),
    ImportanceFilter(),
)


def named(filter_) -> str:
    return type(filter_).__name__


@pytest.mark.parametrize("filter_", FILTERS, ids=named)
def test_a_filter_takes_a_pair_as_it_takes_a_prediction(filter_) -> None:
    pair = filter_(lambda m: (H @ m, H), PRIOR, Y, 0.1)
    whole = filter_(lambda m: Prediction(H @ m, H), PRIOR, Y, 0.1)
    np.testing.assert_array_equal(pair.mean, whole.mean)
    np.testing.assert_array_equal(pair.covariance, whole.covariance)
    assert pair.converged


def run_filter(filter_):
    return lambda model: filter_(model, PRIOR, Y, 0.1)


def run_expectation(model):
    problem = Problem(("a", "b"), model, PRIOR, IteratedFilter(), Identity(), {})
    seen = Observation(("closed",), Y.reshape(1, 2, 3), 0.1, predicted=("closed",))
    return expectation_text("of a problem", problem, seen, "noise")


USES = {
    **{named(f): run_filter(f) for f in FILTERS},
    "expectation": run_expectation,
    "some parameters": lambda model: of_some(model, np.ones(2), np.array([0]))(np.ones(1)),
    "remembered": lambda model: Remembered(model)(np.ones(2)),
    "as_prediction": lambda model: as_prediction(model(np.ones(2)), 2),
}


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (None, "got NoneType"),
        (H, "got ndarray"),
        ((Y, H, H), "got tuple"),
        ((Y, None), "jacobian"),
        ({"y": Y}, "got dict"),
        ((Y, "slope"), "got tuple"),
        ((Y, H.T), r"shape \(n,\) and jacobian of shape \(n, p\); got \(6,\) and \(2, 6\)"),
    ],
)
@pytest.mark.parametrize("use", USES)
def test_another_return_is_one_line_that_says_what_is_expected(use: str, returned, words) -> None:
    with pytest.raises(InputError, match=words) as caught:
        USES[use](lambda m: returned)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("use", ["IteratedFilter", "expectation", "some parameters"])
def test_derivatives_by_other_parameters_are_refused(use: str) -> None:
    with pytest.raises(InputError, match=r"2 parameters.*shape \(6, 3\)"):
        USES[use](lambda m: (Y, np.ones((6, 3))))
    with pytest.raises(InputError, match=r"derivatives.*shape \(6, 0\)"):
        USES[use](lambda m: Prediction.undifferentiated(Y))


def test_a_model_cannot_write_on_what_it_is_given() -> None:
    def writes(m: np.ndarray) -> Prediction:
        m[:] = 0.0
        return Prediction(H @ m, H)

    m = np.ones(2)
    predict(writes, m)
    np.testing.assert_array_equal(m, 1.0)


def test_tissue_that_cannot_be_is_a_failed_prediction() -> None:
    def refuses(m: np.ndarray) -> Prediction:
        raise MaterialError("E_f = -1 MPa, expected > 0")

    assert predict(refuses, np.ones(2)).reason == "E_f = -1 MPa, expected > 0"


@pytest.mark.parametrize("filter_", FILTERS, ids=named)
def test_what_a_model_hands_on_arrives_with_the_estimate(filter_) -> None:
    found = filter_(lambda m: Prediction(H @ m, H, aux=tuple(m)), PRIOR, Y, 0.1)
    np.testing.assert_allclose(found.prediction.aux, found.mean, rtol=1e-12)


def test_what_a_model_without_derivatives_hands_on_arrives_too() -> None:
    model = lambda m: Prediction(H @ m, np.empty((6, 0)), aux=tuple(m))  # noqa: E731
    found = UnscentedFilter()(model, PRIOR, Y, 0.1)
    assert found.prediction.differentiated
    np.testing.assert_allclose(found.prediction.aux, found.mean, rtol=1e-12)


def test_a_model_of_some_parameters_hands_on() -> None:
    model = lambda m: Prediction(H @ m, H, reason="closed", aux="state")  # noqa: E731
    prediction = of_some(model, np.ones(2), np.array([1]))(np.array([3.0]))
    assert (prediction.reason, prediction.aux) == ("closed", "state")
    np.testing.assert_array_equal(prediction.y, H @ np.array([1.0, 3.0]))
    failed = lambda m: Prediction.failed("does not close")  # noqa: E731
    assert of_some(failed, np.ones(2), np.array([1]))(np.ones(1)).reason == "does not close"


def test_a_known_value_is_met_to_the_last_bit() -> None:
    seen = []

    def model(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(tuple(m))
        return H @ m, H

    some = of_some(model, np.array([0.1, 0.2]), np.array([1]), snap=1e-14)
    some(np.array([0.2 * (1 + 3e-16)]))
    some(np.array([0.2 * (1 + 1e-12)]))
    assert seen == [(0.1, 0.2), (0.1, 0.2 * (1 + 1e-12))]


def test_a_remembered_run_is_not_repeated() -> None:
    calls = []

    def model(m: np.ndarray) -> Prediction:
        calls.append(m)
        return Prediction.failed("open") if m[0] < 0 else Prediction(H @ m, H)

    exact, near = Remembered(model), Remembered(model, rtol=1e-12)
    for m in ([1.0, 2.0], [1.0, 2.0], [-1.0, 2.0], [-1.0, 2.0], [1.0 + 1e-14, 2.0]):
        exact(np.array(m))
        near(np.array(m))
    assert len(exact.runs) == 3
    assert len(near.runs) == 2
    assert len(calls) == 5
    branch = Remembered(model, near.runs)
    branch(np.array([5.0, 5.0]))
    assert len(near.runs) == 2


def test_a_shared_start_takes_pairs() -> None:
    class Model:
        closed = None

        def restart(self, closed) -> None:
            pass

        def __call__(self, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return H @ m, H

    shared = SharedStart(Model(), np.ones(2))
    for m in (np.ones(2), np.zeros(2)):
        np.testing.assert_array_equal(shared(m).y, H @ m)
