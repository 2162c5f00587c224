"""Requests and responses as files; a damaged response is refused with the file and the row."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import Prediction
from mvest.exchange.external.contract import (
    RunRequest,
    read_answer,
    read_points,
    read_request,
    write_answer,
    write_request,
)

REQUEST = RunRequest(
    parameters=(
        {"name": "E", "value": 0.1 + 0.2, "unit": "MPa"},
        {"name": "nu, local", "value": 1e-300},
    ),
    points=2,
    settings={"law": "a"},
)
Y = np.array([1.0, 2.0, 3.0, 0.1 + 0.2, 5.0, -6e-30])
JACOBIAN = np.arange(12.0).reshape(6, 2) / 7


def test_a_request_and_its_answer_come_back_to_the_last_digit(tmp_path):
    write_request(tmp_path, REQUEST, np.array([[0.1, 0.2, 0.3], [1 / 3, 5, 6]]))
    assert read_request(tmp_path / "request.json") == REQUEST
    np.testing.assert_array_equal(read_points(tmp_path / "points.csv", 2)[1], [1 / 3, 5, 6])
    write_answer(tmp_path, Prediction(Y, JACOBIAN), REQUEST.names)
    answer = read_answer(tmp_path, REQUEST)
    assert answer.converged
    np.testing.assert_array_equal(answer.y, Y)
    np.testing.assert_array_equal(answer.jacobian, JACOBIAN)


def test_an_answer_may_lack_derivatives_or_be_a_failure(tmp_path):
    write_answer(tmp_path, Prediction(Y, JACOBIAN))
    assert not read_answer(tmp_path, REQUEST).differentiated
    write_answer(tmp_path, Prediction.failed("it buckled"), REQUEST.names)
    answer = read_answer(tmp_path, REQUEST)
    assert (answer.converged, answer.reason) == (False, "it buckled")


ORDER = '{"format": "mvest-external", "version": 1, "status": "converged", "reason": ""}'


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("response.json", None, "response.json is missing"),
        ("response.json", ORDER.replace("converged", "ok"), "status: 'ok', expected"),
        ("response.json", ORDER + " " * 1_000_001, "expected at most 1000000"),
        ("observation.csv", "x,y,z\n1,2,3\n4,nan,6\n", "y of row 1 is 'nan'"),
        ("jacobian.csv", "E,nu\n" + "1,2\n" * 6, "columns E,nu, expected E,nu, local"),
        ("jacobian.csv", 'E,"nu, local"\n' + "1,2\n" * 5, "5 rows, expected 6"),
    ],
)
def test_a_damaged_answer_is_refused(tmp_path, file, content, message):
    write_answer(tmp_path, Prediction(Y, JACOBIAN), REQUEST.names)
    read_answer(tmp_path, REQUEST)
    if content is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(content)
    with pytest.raises(InputError) as error:
        read_answer(tmp_path, REQUEST)
    assert message in str(error.value)
    assert len(str(error.value)) < 300
