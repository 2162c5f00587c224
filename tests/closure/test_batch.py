"""Many closures at once are the closures one by one."""

import numpy as np
import pytest

from mvest.closure.batch import predict_many
from mvest.errors import InputError
from tests.closure.test_model import AT, GENTLE, OPEN, SMALL, TINY, model_of

VALUES = AT * np.linspace(0.9, 1.1, 5)[:, None]


@pytest.mark.parametrize("processes", [1, 2])
def test_predictions_come_in_order_and_are_those_of_the_model(processes):
    model = model_of(OPEN, **TINY)
    before = model(AT)
    several = predict_many(model, VALUES, processes=processes)
    assert len(several) == len(VALUES)
    for m, prediction in zip(VALUES, several, strict=True):
        alone = model_of(OPEN, **TINY)(m)
        np.testing.assert_allclose(prediction.y, alone.y, rtol=0, atol=1e-10)
        np.testing.assert_allclose(prediction.jacobian, alone.jacobian, rtol=0, atol=1e-8)
    # They differ, so that a wrong order would be seen; and the model is as it was.
    assert np.abs(several[0].y - several[1].y).max() > 1e-4
    np.testing.assert_allclose(model(AT).y, before.y, rtol=0, atol=1e-10)


def test_a_failure_stays_in_its_place():
    values = VALUES.copy()
    values[2, 0] = -1.0
    several = predict_many(model_of(GENTLE, **SMALL), values[1:4], processes=2)
    assert [p.converged for p in several] == [True, False, True]
    assert "E_f" in several[1].reason


@pytest.mark.parametrize(
    ("values", "processes", "message"),
    [
        (AT, 1, "expected (k, 2) for E_f.anterior, E_f.posterior"),
        (np.ones((3, 3)), 1, "parameter vectors of shape (3, 3)"),
        (VALUES, 0, "processes = 0, expected at least 1"),
    ],
)
def test_bad_input(values, processes, message):
    with pytest.raises(InputError) as error:
        predict_many(model_of(OPEN, **TINY), values, processes=processes)
    assert message in str(error.value)
