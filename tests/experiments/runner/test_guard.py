"""A process apart: its death, its time and its memory cost its own job, and it leaves with us."""

import json
import os
import signal
import sys
import threading
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import pytest

from experiments.common.records.record import Record, stamp, write_record
from experiments.common.study import Result
from experiments.runner.engine import WorkerProcess
from experiments.runner.jobs import Request, attempt, is_done, last_record, lock, mark_done

OBEDIENT = """
import json, os, sys, time
for line in sys.stdin:
    request = json.loads(line)
    order = request["values"]["order"]
    if "signal" in order: os.kill(os.getpid(), order["signal"])
    if "exit" in order: os._exit(order["exit"])
    if "sleep" in order: time.sleep(order["sleep"])
    said = {"pid": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")}
    with open(os.path.join(request["folder"], "said.json"), "w") as file: json.dump(said, file)
    print(json.dumps({"reason": order.get("reason"), "refused": order.get("refused", False)}))
    sys.stdout.flush()
"""
"""A worker that does as it is told."""


@pytest.fixture
def worker():
    found = WorkerProcess((sys.executable, "-c", OBEDIENT))
    yield found
    found.close()


def run_in(worker: WorkerProcess, asked: Request) -> Record:
    return attempt(asked, lambda: worker.run(asked))


VALUES = {
    "study": "twin", "name": "a", "title": "b", "row": "c", "table": "d", "paper": None, "seed": 1,
    "parameters": ["x"], "factors": {"k": 1}, "filter": {"initial": [2.0], "mode": "paper"},
    "truth": {"values": [1.0], "refine": 1,
              **dict.fromkeys(("element", "source", "columns", "rows", "layers"))},
    "observation": {"noise_mm": 0.0}, "mechanics": {"element": "hex18", "tissue": {}},
    "mesh": {"columns": 1, "rows": 1, "layers": 1, "source": "structured", "edge_length": 2.5},
    "tracking": {"enabled": False}, "force": False, "figures": False, "memory_limit_gb": None,
}  # fmt: skip


def request(folder: Path, **order) -> Request:
    values = VALUES | {"time_limit_s": order.pop("limit", None), "order": order}
    return Request(values, "0" * 64, folder)


def converged(asked: Request, config_hash: str = "0" * 64, **arrays) -> Record:
    """A record of success in the job's folder."""
    record = stamp(asked.values, config_hash, Result(numbers={"a_mm": 1.0}), 0.0)
    write_record(asked.folder / "result.json", record, arrays)
    return record


def said(folder: Path) -> dict:
    return json.loads((folder / "said.json").read_text())


@pytest.mark.parametrize(
    ("order", "reason"),
    [
        ({"signal": int(signal.SIGKILL)}, "killed by signal 9 (SIGKILL"),
        ({"exit": 3}, "exit status 3"),
        ({"sleep": 60, "limit": 0.2}, "time limit of 0.2 s"),
        ({"reason": "it buckled"}, "it buckled"),
        ({"reason": "mesh.rows = 0", "refused": True}, "mesh.rows = 0"),
        ({}, "it left no record"),
    ],
)
def test_whatever_ends_a_job_costs_its_own_row(worker, tmp_path, order, reason):
    asked = request(tmp_path / "job", **order)
    record = run_in(worker, asked)
    assert record.status == "failed"
    assert reason in record.reason
    assert record.factors == {"k": 1}
    assert record.estimates == ()
    assert last_record(asked.folder, asked.config_hash) == record
    assert not is_done(asked.folder)
    # The next job finds a process at its service.
    assert worker.run(request(tmp_path / "job")) is None


def test_a_healthy_process_is_kept_and_another_is_replaced(worker, tmp_path):
    def pid(**order) -> int:
        worker.run(request(tmp_path, **order))
        return said(tmp_path)["pid"]

    first = pid()
    assert pid() == first
    assert pid(reason="inadmissible", refused=True) == first
    assert pid(reason="out of memory") == first
    second = pid()
    assert second != first
    os.kill(second, signal.SIGKILL)
    # Found dead between two jobs, it costs none.
    worker._program.process.wait(60)
    assert pid() not in (first, second)


def test_what_is_done_is_not_run_again_unless_forced(worker, tmp_path):
    asked = request(tmp_path, signal=9)
    done = converged(asked)
    mark_done(tmp_path)
    assert run_in(worker, asked) == done
    asked.values["force"] = True
    assert run_in(worker, asked).status == "failed"
    assert not is_done(tmp_path)


@pytest.mark.parametrize("order", [{"signal": int(signal.SIGKILL)}, {"reason": "no space left"}])
def test_what_was_computed_outlives_whatever_ends_the_job_after_it(worker, tmp_path, order, capsys):
    asked = request(tmp_path, **order)
    record = converged(asked)
    assert run_in(worker, asked) == record
    assert "the same command writes what is missing" in capsys.readouterr().err
    assert last_record(tmp_path, "0" * 64) is None, "of which not everything is written"
    asked.values["force"] = True
    assert run_in(worker, asked).status == "failed"


@pytest.mark.parametrize("content", ["", '{"version": 3, "provenance": 3}', None])
def test_a_damaged_or_changed_result_is_none(worker, tmp_path, content):
    converged(request(tmp_path))
    result = tmp_path / "result.json"
    changed = json.loads(result.read_text()) | {"numbers": {"a_mm": 2.0}}
    result.write_text(json.dumps(changed) if content is None else content)
    mark_done(tmp_path)
    assert last_record(tmp_path, "0" * 64) is None
    assert run_in(worker, request(tmp_path, exit=3)).status == "failed"


def test_who_finds_the_folder_locked_waits_and_says_so(tmp_path, monkeypatch):
    said = SimpleQueue()
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=said.put, flush=lambda: None))
    first = lock(tmp_path)
    second = threading.Thread(target=lambda: lock(tmp_path).lock.release())
    second.start()
    text, end = said.get(timeout=60), said.get(timeout=60)
    assert text + end == f"waiting for another process that works in {tmp_path}\n"
    assert second.is_alive()
    first.lock.release()
    second.join(60)
    assert not second.is_alive()
