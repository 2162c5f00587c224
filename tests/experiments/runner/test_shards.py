"""Shards: other schedulers work on a planned sweep, are killed, and nothing is done twice."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import cli
from experiments.common.config import hash_of
from experiments.run import main
from experiments.runner import engine
from experiments.runner.plan import Plan
from experiments.sweeps.collected import read_sweep
from tests.places import ROOT
from tests.processes import linux, until

FAKE = str(Path(__file__).parents[0] / "fake_worker.py")
PLAN = (
    "sweep=debug", "filter.initial=[5,3]", "sweep.small.seed='range(0,12)'", "detach=true",
    "tracking.enabled=false",
)  # fmt: skip
FOLDER = Path("outputs/sweep_debug")

WORKER = """
import signal
import sys
# Tests run in the background of a shell inherit that an interrupt is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
from experiments import cli
from experiments.runner import engine
engine.WORKER = (sys.executable, sys.argv.pop(1))
sys.exit(cli.main(sys.argv[1:]))
"""
"""``mvest`` whose jobs take no time."""


@pytest.fixture
def planned(tmp_path, monkeypatch, capsys):
    """A sweep of twelve jobs, planned in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engine, "WORKER", (sys.executable, FAKE))
    monkeypatch.setattr(sys, "argv", ["experiments.run", *PLAN])
    assert main() == 0
    assert "mvest worker outputs/sweep_debug --shard I/N" in capsys.readouterr().out
    assert not list(FOLDER.glob("*/result.json")), "detached, nothing runs here"


def runs() -> list[int]:
    place = Path("runs")
    return sorted(map(int, place.read_text().split())) if place.exists() else []


def mvest(*arguments: str, **settings) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, FAKE, *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **settings,
    )


def test_what_is_no_shard_or_no_sweep_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for text in ("0/4", "5/4", "a/b"):
        assert cli.main(["worker", str(FOLDER), f"--shard={text}"]) == 2
        assert f"error: shard {text}, expected I/N with I from" in capsys.readouterr().err
    for command in ("worker", "collect"):
        assert cli.main([command, "nowhere"]) == 2
        assert capsys.readouterr().err == "error: no sweep is planned in nowhere\n"


def test_a_plan_is_read_as_it_was_written(planned, monkeypatch, tmp_path):
    read = Plan.read(FOLDER)
    assert [job.values["seed"] for job in read.jobs] == list(range(12))
    for job in read.jobs:
        # What names it follows from its configuration, so all of that came through.
        assert job.config_hash[:16] == job.folder.name
        assert hash_of(job.values) == job.config_hash
        assert f"seed={job.values['seed']}" in job.overrides
    # From wherever it is read, a job finds its files.
    monkeypatch.chdir("/")
    assert Plan.read(tmp_path / FOLDER).jobs[0].folder == read.jobs[0].folder


def test_two_shards_at_once_do_every_job_once(planned, capsys):
    shards = [mvest("worker", str(FOLDER), "--shard", f"{k}/2") for k in (1, 2)]
    said = [shard.communicate(timeout=120)[0] for shard in shards]
    assert [shard.returncode for shard in shards] == [0, 0], said
    assert ["6 jobs, 0 without an estimate" in text for text in said] == [True, True]
    assert runs() == list(range(12))
    assert cli.main(["collect", str(FOLDER)]) == 0
    assert "12 of 12 jobs done" in capsys.readouterr().out
    found = read_sweep(FOLDER / "sweep.json")
    assert [job.record.estimates[0].seed for job in found.jobs] == list(range(12))
    assert [one.estimate for one in found.jobs[7].record.estimates[0].unknowns] == [6.7, 2.0]


@linux
def test_a_killed_shard_loses_the_job_in_flight_and_a_second_one_finishes(planned, capsys):
    Path("wait-6").touch()
    shard = mvest("worker", str(FOLDER), "--shard", "1/2")
    until(lambda: 6 in runs())
    os.kill(shard.pid, signal.SIGKILL)
    shard.communicate()
    done = {path: path.stat().st_mtime_ns for path in FOLDER.glob("*/done")}
    assert len(done) == 3, "seeds 0, 2 and 4 are kept"
    assert cli.main(["collect", str(FOLDER)]) == 1
    assert "3 of 12 jobs done (3 before)" in capsys.readouterr().out

    Path("wait-6").unlink()
    shards = [mvest("worker", str(FOLDER), "--shard", f"{k}/2") for k in (1, 2)]
    said = [one.communicate(timeout=120)[0] for one in shards]
    assert [one.returncode for one in shards] == [0, 0], said
    assert runs() == sorted([*range(12), 6])
    assert {path: path.stat().st_mtime_ns for path in done} == done
    assert cli.main(["collect", str(FOLDER)]) == 0
    assert "12 of 12 jobs done" in capsys.readouterr().out
