"""A program behind the filters: its derivatives, its failures, its finished runs."""

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
from mvest.exchange.external.model import Differences, ProcessModel
from tests.exchange.external.programs import NAMES, SPRINGS, answering, model, springs

M = np.array([0.8, 2.5])


def ran(folder) -> int:
    """How often the program was really started."""
    return sum(len(p.read_text().split()) for p in (folder / "runs").glob("*/count.txt"))


def test_its_own_derivatives_are_taken_as_they_are(tmp_path):
    program = model(tmp_path, "exact", differences=None)
    prediction = program(M)
    y, jacobian = springs(*M)
    assert prediction.converged, prediction.reason
    np.testing.assert_allclose(prediction.y, y, rtol=1e-15)
    np.testing.assert_allclose(prediction.jacobian, jacobian, rtol=1e-15)
    assert (program.runs, program.own_jacobian, ran(tmp_path)) == (1, True, 1)
    missing = model(tmp_path, differences=None)(M)
    assert "jacobian.csv is missing" in missing.reason


@pytest.mark.parametrize("processes", [1, 3])
def test_differences_are_of_their_order(tmp_path, processes):
    # 2/k expanded: central differences err by d^2 f'''/6 = (s k)^2 (12 / k^4) / 6, relative to f'
    # that is s^2; forward ones by d f''/2, relative to f' that is s.
    _, jacobian = springs(*M)
    for scheme, step, order in (("central", 0.02, 2), ("forward", 0.02, 1)):
        differences = Differences(scheme, step, processes=processes)
        program = model(tmp_path, differences=differences)
        found = program(M).jacobian
        relative = (found - jacobian)[jacobian != 0] / jacobian[jacobian != 0]
        expected = step**order * (1 if order == 2 else -1)
        np.testing.assert_allclose(relative, expected, rtol=0.03)
        assert np.all(found[jacobian == 0] == 0)
        assert not program.own_jacobian
    # 1 + 4 runs, then upper neighbours of the forward scheme are finished already.
    assert program.runs + program.reused == 3
    assert (program.runs, ran(tmp_path)) == (0, 5)


def test_programs_side_by_side_find_what_lies_beside_them(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # as processes side by side leave it
    (tmp_path / "helper.py").write_text("HEIGHT = 1\n")
    command = Command((sys.executable, str(tmp_path / "solve.py"), "{request}", "{folder}"))
    (tmp_path / "solve.py").write_text("import helper\n" + SPRINGS)
    differences = Differences(processes=2)
    program = ProcessModel(command, tmp_path / "runs", NAMES, 2, differences=differences)
    assert program(M).converged, program(M).reason


def test_an_interrupted_study_stops_its_programs(tmp_path):
    begun = tmp_path / "begun"
    begun.mkdir()
    sleep = f"open({str(begun)!r} + '/' + str(os.getpid()), 'w'); time.sleep(60)"
    slow = f"import os\nif not data['jacobian']: {sleep}\n"
    source = SPRINGS.replace("folder = pathlib", slow + "folder = pathlib", 1)
    program = model(tmp_path, source=source, limit=60, differences=Differences(processes=2))

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


def test_a_finished_run_serves_again_until_something_it_depends_on_changes(tmp_path):
    model(tmp_path)(M)
    assert ran(tmp_path) == 5
    again = model(tmp_path)
    again(M)
    assert (again.runs, again.reused, ran(tmp_path)) == (0, 5, 5)
    # A value in its last digit, a setting, a variable, an argument: other runs.
    model(tmp_path, differences=Differences("forward"))(np.nextafter(M, 9))
    assert ran(tmp_path) == 8
    higher = model(tmp_path, settings={"height": 4.0})(M)
    assert higher.y[5] == 4.0
    assert ran(tmp_path) == 13
    fresh = model(tmp_path, reuse=False)
    fresh(M)
    assert (fresh.runs, fresh.reused) == (5, 0)


def test_a_changed_input_makes_finished_runs_worthless(tmp_path):
    mesh = tmp_path / "mesh.txt"
    for content, runs in (("coarse", 5), ("coarse", 5), ("finer!", 10)):
        mesh.write_text(content)
        model(tmp_path, inputs=[mesh])(M)
        assert ran(tmp_path) == runs
    with pytest.raises(InputError, match="cannot read"):
        model(tmp_path, inputs=[tmp_path / "absent"])


def test_a_failed_run_is_not_kept_and_its_old_answer_is_not_read(tmp_path):
    # A program that goes by what no command says: it writes nothing once there is that file.
    off = f"import os, sys\nif os.path.exists({str(tmp_path / 'off')!r}): sys.exit()\n"
    assert model(tmp_path, "exact", source=off + SPRINGS)(M).converged
    (folder,) = (tmp_path / "runs").glob("run-*")
    (folder / ".answer.sha256").unlink()
    (tmp_path / "off").touch()
    # The same run again: what lies there is another's.
    silent = model(tmp_path, "exact", source=off + SPRINGS)
    for _ in range(2):
        assert silent(M).reason == f"{folder.name}: response.json is missing"
    assert (silent.runs, silent.reused) == (2, 0)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("sys.exit('out of licences')", "exit status 1; its last words: out of licences"),
        ("time.sleep(60)", "stopped at the time limit of 0.5 s"),
        ("observation.write_text('x,y,z\\n1,2,3\\n4,nan,6\\n')", "'nan'"),
        ("jacobian.write_text('k1\\n' + '1\\n' * 6)", "jacobian.csv: columns k1"),
    ],
)
def test_whatever_goes_wrong_is_the_reason_of_a_failed_prediction(tmp_path, body, message):
    program = model(tmp_path, source=answering(body), limit=0.5 if "sleep" in body else 30)
    prediction = program(M)
    assert not prediction.converged
    assert message in prediction.reason
    assert prediction.reason.startswith("run-")
    assert (program.runs, ran(tmp_path)) == (1, 1)


def test_what_the_program_says_of_its_failure_is_told(tmp_path):
    program = model(tmp_path)
    assert program(np.array([-1.0, 2.0])).reason.endswith("k1 = -1.0: expected > 0")
    prior = Gaussian(np.array([-1.0, 2.0]), np.eye(2))
    found = IteratedFilter()(program, prior, springs(*M)[0], 1e-4)
    assert found.reason is Reason.MODEL_FAILED
    assert "expected > 0" in found.detail
    # The model stands; the lower neighbour does not.
    near_zero = model(tmp_path, differences=Differences(floor=1.0))(np.array([1e-4, 2.0]))
    assert near_zero.reason.startswith("run for a difference at k1 = -0.0009, k2 = 2: run-")


def test_parameters_without_a_size_need_a_floor(tmp_path):
    differences = Differences()
    with pytest.raises(InputError, match="parameter 1 is 0"):
        differences.neighbours(np.array([1.0, 0.0]))
    np.testing.assert_allclose(
        Differences("forward", 0.1, floor=2.0).neighbours(np.array([3.0, 0.0])),
        [[3.3, 0.0], [3.0, 0.2]],
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scheme": "exact"}, "central, forward"),
        ({"relative_step": 0.0}, "relative_step"),
    ],
)
def test_inadmissible_differences_are_refused(settings, message):
    with pytest.raises(ConfigurationError, match=message):
        Differences(**settings)


def test_an_inadmissible_model_is_refused_before_anything_runs(tmp_path):
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


def counted(monkeypatch, tmp_path, *arguments: str) -> int:
    """Runs that are started for a command line in ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    command = Command((*arguments, "{request}", "{folder}"))
    program = ProcessModel(command, tmp_path / "runs", NAMES, 2, units=("N/mm", "N/mm"))
    assert program(M).converged
    return program.runs


def test_after_a_change_of_a_file_in_the_command_nothing_finished_serves(tmp_path, monkeypatch):
    ours = tmp_path / "bin"
    ours.mkdir()
    (ours / "solve.py").write_text(SPRINGS)
    helper, mesh, tool = ours / "helper.py", tmp_path / "mesh.inp", ours / "tool"
    for file in (helper, mesh):
        file.write_text("1")
    tool.write_text(f'#!/bin/sh\nexec {sys.executable} -S "$1" "$3" "$4"\n')
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(ours), prepend=":")
    words = ("tool", "{here}/bin/solve.py", f"--mesh={mesh}")
    assert counted(monkeypatch, tmp_path, *words) == 5
    assert counted(monkeypatch, tmp_path, *words) == 0
    for file in (ours / "solve.py", helper, mesh, tool):
        file.write_text(file.read_text() + "\n# changed\n")
        assert counted(monkeypatch, tmp_path, *words) == 5, file
    # Another program of this name is found first.
    other = tmp_path / "first"
    other.mkdir()
    (other / "tool").write_text(tool.read_text() + "# another\n")
    (other / "tool").chmod(0o755)
    monkeypatch.setenv("PATH", str(other), prepend=":")
    assert counted(monkeypatch, tmp_path, *words) == 5
    # What the program writes into its run's folder is none of it, nor what lies elsewhere.
    (tmp_path / "notes.txt").touch()
    assert counted(monkeypatch, tmp_path, *words) == 0


def test_an_answer_is_not_kept_whose_program_was_changed_while_it_ran(tmp_path):
    source = SPRINGS + "\nopen(__file__, 'a').write('# and on')\n"
    prediction = model(tmp_path, "exact", source=source, differences=None)(M)
    assert "a file that it depends on was changed while it ran" in prediction.reason
    again = model(tmp_path, "exact", differences=None)
    assert again(M).converged
    assert again.runs == 1
