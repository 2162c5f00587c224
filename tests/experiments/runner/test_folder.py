"""The folder of a job: what an attempt leaves for the next one, and what it must not destroy."""

from pathlib import Path

import numpy as np
import pytest

from experiments.common.records import record as records
from experiments.common.records.record import FIELDS
from experiments.common.study import Result
from experiments.runner import jobs
from experiments.runner.jobs import Request
from mvest.files import PREFIX
from tests.experiments.runner import test_guard


def request(folder: Path, force: bool = False) -> Request:
    asked = test_guard.request(folder)
    asked.values["force"] = force
    return asked


def finish(asked: Request, number: float, mark: bool = True) -> None:
    """A record of success with one number and arrays of it."""
    result = Result(numbers={"a_mm": number}, arrays={"x": np.full(3, number)})
    jobs.replace_record(asked, result, 0.0)
    if mark:
        jobs.mark_done(asked.folder)


def number(asked: Request) -> float | None:
    """The number of the finished record; None if the job has to be run."""
    record = jobs.last_record(asked.folder, asked.config_hash)
    if record is None or not record.converged:
        return None
    found = record.numbers["a_mm"]
    assert (np.load(asked.folder / FIELDS)["x"] == found).all()
    return found


def test_what_an_earlier_attempt_left_is_removed_and_nothing_else(tmp_path):
    kept = {".lock", ".hidden.png", "config.json", "valve.png"}
    for name in (*kept, jobs.DONE, f"{PREFIX}1-result.json", f"{PREFIX}2-valve.png"):
        (tmp_path / name).touch()
    (tmp_path / jobs.RESULT).write_text("{}")
    (tmp_path / f"{PREFIX}3-case").mkdir()
    (tmp_path / f"{PREFIX}3-case" / "case.yaml").touch()
    jobs.make_way(request(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_a_finished_result_stays_until_its_replacement_is_whole(tmp_path):
    asked = request(tmp_path, force=True)
    finish(asked, 1.0)
    assert jobs.usable_record(asked) is None
    jobs.make_way(asked)
    assert number(asked) == 1.0, "where the attempt is interrupted"
    finish(asked, 2.0, mark=False)
    assert number(asked) is None, "what follows from it is not written"
    assert jobs.last_record(tmp_path, asked.config_hash, cut_off=True) is not None
    jobs.mark_done(tmp_path)
    assert number(asked) == 2.0
    assert jobs.usable_record(request(tmp_path)) is not None
    jobs.write_failure(asked, "time limit of 1 s", 0.0)
    assert number(asked) is None
    assert not (tmp_path / FIELDS).exists()


@pytest.mark.parametrize("step", ["write_atomically", "write_json", "adopt_arrays"])
def test_a_kill_while_arrays_and_record_are_replaced_loses_neither(tmp_path, monkeypatch, step):
    def killed(*_):
        raise KeyboardInterrupt

    asked = request(tmp_path)
    finish(asked, 1.0)
    with monkeypatch.context() as patched:
        patched.setattr(records, step, killed)
        with pytest.raises(KeyboardInterrupt):
            finish(asked, 2.0)
    if step == "adopt_arrays":
        jobs.make_way(asked)
        computed = jobs.last_record(tmp_path, asked.config_hash, cut_off=True)
        assert computed.numbers == {"a_mm": 2.0}
        jobs.mark_done(tmp_path)
    assert number(asked) == (2.0 if step == "adopt_arrays" else 1.0)


@pytest.mark.parametrize(("name", "left"), [("log.txt", True), (None, False)])
def test_a_folder_with_nothing_but_what_hydra_wrote_goes(tmp_path, name, left):
    folder = tmp_path / "outputs" / "debug" / "0123"
    (folder / jobs.HYDRA).mkdir(parents=True)
    for file in (f"{jobs.HYDRA}/config.yaml", jobs.LOCK, name):
        if file is not None:
            (folder / file).touch()
    with jobs.nothing_empty(folder, tmp_path / "outputs"):
        pass
    assert (folder / jobs.HYDRA).exists() is left
    assert (tmp_path / "outputs").exists() is left
