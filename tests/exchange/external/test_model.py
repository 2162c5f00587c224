"""A program behind the filters: its derivatives and its failures."""

import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from mvest.errors import ConfigurationError, InputError
from mvest.estimation import Gaussian, IteratedFilter, Reason
from mvest.exchange.external.contract import Command
from mvest.exchange.external.model import ProcessModel
from tests.exchange.external.programs import NAMES, SPRINGS, model, springs

M = np.array([0.8, 2.5])


def ran(folder) -> int:
    """How often the program was started."""
    return len([*(folder / "runs").glob("*/count.txt")])


def test_derivatives_of_the_program_are_used(tmp_path):
    program = model(tmp_path, "exact", differences=False)
    prediction = program(M)
    y, jacobian = springs(*M)
    assert prediction.converged, prediction.reason
    np.testing.assert_allclose(prediction.y, y, rtol=1e-15)
    np.testing.assert_allclose(prediction.jacobian, jacobian, rtol=1e-15)
    assert (program.runs, program.own_jacobian, ran(tmp_path)) == (1, True, 1)
    missing = model(tmp_path, differences=False)(M)
    assert "jacobian.csv is missing" in missing.reason


@pytest.mark.parametrize("processes", [1, 3])
def test_differences_have_second_order_errors(tmp_path, processes):
    # 2/k expanded: central differences err by d^2 f'''/6 = (s k)^2 (12 / k^4) / 6, relative to f'
    # that is s^2.
    _, jacobian = springs(*M)
    program = model(tmp_path, relative_step=0.02, processes=processes)
    found = program(M).jacobian
    relative = (found - jacobian)[jacobian != 0] / jacobian[jacobian != 0]
    np.testing.assert_allclose(relative, 0.02**2, rtol=0.03)
    assert np.all(found[jacobian == 0] == 0)
    assert not program.own_jacobian
    assert (program.runs, ran(tmp_path)) == (5, 5)
    higher = model(tmp_path, settings={"height": 4.0})(M)
    assert higher.y[5] == 4.0


def test_scripts_import_their_neighbours(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # as `mvest.processes.side_by_side` sets it
    (tmp_path / "helper.py").write_text("HEIGHT = 1\n")
    command = Command((sys.executable, str(tmp_path / "solve.py"), "{request}", "{folder}"))
    (tmp_path / "solve.py").write_text("import helper\n" + SPRINGS)
    program = ProcessModel(command, tmp_path / "runs", NAMES, 2)
    assert program(M).converged, program(M).reason


def test_an_interrupted_study_stops_its_programs(tmp_path):
    begun = tmp_path / "begun"
    begun.mkdir()
    sleep = f"open({str(begun)!r} + '/' + str(os.getpid()), 'w'); time.sleep(60)"
    slow = f"import os\nif not data['jacobian']: {sleep}\n"
    source = SPRINGS.replace("folder = pathlib", slow + "folder = pathlib", 1)
    program = model(tmp_path, source=source, limit=60, processes=2)

    def interrupt():
        while len([*begun.iterdir()]) < 2:
            time.sleep(0.02)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        program(M)
    assert len([*begun.iterdir()]) == 2
    for path in begun.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.name), 0)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("crash", "exit status 1; its last words: out of licences"),
        ("refuse", "exit status 1; material data missing in deck"),
        ("sleep", "stopped at the time limit of 0.5 s"),
    ],
)
def test_a_failed_run_is_a_failed_prediction_with_a_reason(tmp_path, how, message):
    program = model(tmp_path, how, limit=0.5 if how == "sleep" else 30)
    prediction = program(M)
    assert not prediction.converged
    assert message in prediction.reason
    assert prediction.reason.startswith("run-")
    assert (program.runs, ran(tmp_path)) == (1, 1)


def test_the_filter_reports_why_the_program_failed(tmp_path):
    program = model(tmp_path)
    assert program(np.array([-1.0, 2.0])).reason.endswith("k1 = -1.0: expected > 0")
    prior = Gaussian(np.array([-1.0, 2.0]), np.eye(2))
    found = IteratedFilter()(program, prior, springs(*M)[0], 1e-4)
    assert found.reason is Reason.MODEL_FAILED
    assert "expected > 0" in found.detail
    # The model converges at m, but not at its lower neighbour.
    near_zero = model(tmp_path, floor=1.0)(np.array([1e-4, 2.0]))
    assert near_zero.reason.startswith("run for a difference at k1 = -0.0009, k2 = 2: run-")


def test_a_parameter_of_zero_needs_a_floor(tmp_path):
    program = model(tmp_path)
    assert program.by_differences(np.array([1.0, 0.0])).startswith("parameter 1 is 0, and so is")
    assert program.runs == 0


def test_invalid_models_are_refused_before_anything_runs(tmp_path):
    command = Command((sys.executable,))
    with pytest.raises(InputError, match="k1, k2 in MPa; expected different"):
        ProcessModel(command, tmp_path, NAMES, 2, units=("MPa",))
    with pytest.raises(ConfigurationError, match="points"):
        ProcessModel(command, tmp_path, NAMES, 2, points=np.zeros((3, 3)))
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        ProcessModel(command, tmp_path / "file" / "runs", NAMES, 2)
    with pytest.raises(InputError, match="1 parameters"):
        ProcessModel(command, tmp_path, NAMES, 2)(np.ones(1))
