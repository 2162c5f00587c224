"""Sweeps: planned, run, resumed and collected. The study itself takes no time here."""

import errno
import json
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from experiments.results.published import records_of
from experiments.runner import engine, plugins, sweep
from experiments.studies import twin
from experiments.sweeps.collected import Sweep, read_sweep
from mvest.files import sha256_of

QUICK = ("hydra.launcher.n_jobs=1", "tracking.enabled=false")


@pytest.fixture
def run(run, monkeypatch):
    """Run a sweep in an empty folder: exit status, standard output and error."""
    fake = Path(__file__).with_name("fake_worker.py")
    monkeypatch.setattr(engine, "WORKER", (sys.executable, str(fake)))
    for name in engine.THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")

    def call(*arguments):
        options = [one for one in arguments if one.startswith("-")]
        return run(*options, *QUICK, *(one for one in arguments if one not in options))

    yield call
    for worker in engine._idle.pop(str(Path.cwd()), ()):
        worker.close()


DEBUG = Path("outputs/sweep_debug")


def collected() -> Sweep:
    return read_sweep(DEBUG / "sweep.json")


def runs() -> list[str]:
    place = Path("runs")
    return place.read_text().split() if place.exists() else []


def test_a_sweep_is_planned_run_and_collected(run):
    status, out, err = run("sweep=debug", "publish=true")
    assert status == 0, err
    plan = json.loads((DEBUG / "plan.json").read_text())
    factors = {"start_anterior": 5.0, "start_posterior": 3.0, "seed": 1}
    assert plan["jobs"][0]["factors"] == factors
    for job in plan["jobs"]:
        folder = DEBUG / job["folder"]
        assert (folder / "done").read_text() == sha256_of(folder / "result.json")
        said = yaml.safe_load((folder / ".hydra" / "config.yaml").read_text())
        assert said["seed"] == job["factors"]["seed"]
        assert f"seed {job['factors']['seed']}" in (folder / "log.txt").read_text()

    found = collected()
    assert [job.hash for job in found.jobs] == [job["hash"] for job in plan["jobs"]]
    assert [record.status for record in found.records] == ["converged"] * 4
    assert [record.estimates[0].seed for record in found.records] == [1, 2, 1, 2]
    assert found.records[1].estimates[0].unknown("E_f.anterior").estimate == 6.2
    assert "sweep_debug: 4 of 4 jobs done, 0 without an estimate" in out
    assert re.search(r"start anterior 5 MPa, start posterior 3 MPa +E_f.anterior +2 +0 ", out)
    assert read_sweep(Path("outputs/results/sweeps/debug.json")) == found
    lines = Path("outputs/results/sweep_debug.csv").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == 1 + 2 * 4


def test_only_what_is_missing_or_failed_is_run_again(run):
    Path("kill-2").touch()
    Path("raise-1").touch()
    usual = ("sweep=debug", "sweep.size=small", "publish=true")
    status, out, _ = run(*usual)
    assert status == 1
    assert "2 of 4 jobs done" in out
    reasons = [record.reason for record in collected().records]
    assert reasons[0] == "RuntimeError: it broke"
    assert reasons[1].startswith("killed by signal 9")
    assert "Traceback" in (DEBUG / collected().jobs[0].hash / "log.txt").read_text()

    status, out, _ = run(*usual)
    assert status == 0
    assert "2 done, 2 failed before, 2 to run" in out
    assert runs() == ["1", "2", "1", "2", "1", "2"]
    resumed = Path("outputs/results/sweep_debug.csv").read_bytes()

    status, out, _ = run(*usual)
    assert "nothing left" in out
    assert len(runs()) == 6
    assert Path("outputs/results/sweep_debug.csv").read_bytes() == resumed

    status, out, _ = run(*usual, "force=true")
    assert status == 0
    assert len(runs()) == 10
    # Undisturbed, the table is the same one, byte for byte.
    assert Path("outputs/results/sweep_debug.csv").read_bytes() == resumed


def test_a_dry_run_lists_what_would_run_and_touches_nothing(run):
    status, out, err = run("sweep=debug", "dry_run=true")
    assert (status, err) == (0, "")
    assert not Path("outputs").exists()
    assert out.count("  run   ") == 4
    Path("raise-2").touch()
    run("sweep=debug")
    _, out, _ = run("sweep=debug", "dry_run=true")
    assert out.count("  done  ") == 3
    assert "seed=2 [failed before: RuntimeError: it broke]" in " ".join(out.split())
    assert len(runs()) == 4


def test_a_job_returns_its_objective(run, monkeypatch):
    returned = []
    launch = plugins.JobLauncher.launch

    def kept(*given, **named):
        returned.append(launch(*given, **named))
        return returned[-1]

    monkeypatch.setattr(plugins.JobLauncher, "launch", kept)
    Path("raise-2").touch()
    # Hydra's own sweeper stops with the first job that failed.
    assert run("-m", "hydra/sweeper=basic", "experiment=debug", "seed=1,2")[0] == 1
    status, _, err = run("-m", "hydra/sweeper=basic", "experiment=debug", "seed=1,2")
    assert status == 0, err
    run("-m", "experiment=debug", "seed=1,2", "objective=std.anterior")
    (first, failed), done, std = returned
    # Percent of the truths, 6.23 and 2.09: the estimates are 6.1 and 2.0, then 6.2 and 2.0.
    assert first.return_value == pytest.approx(100 * (0.13 / 6.23 + 0.09 / 2.09) / 2)
    assert failed.status.name == "FAILED"
    assert done[1].return_value == pytest.approx(100 * (0.03 / 6.23 + 0.09 / 2.09) / 2)
    assert [one.return_value for one in std] == [0.1, 0.1]
    assert len(runs()) == 3


def test_jobs_may_come_in_several_batches(run, monkeypatch):
    def sweep_twice(self, arguments):
        launcher = self._parts[2]
        plain = [line for line in arguments if "seed" not in line]
        first = launcher.launch([[*plain, "seed=1"], [*plain, "seed=2"]], 0)
        # One of them is tried once more.
        return [*first, *launcher.launch([[*plain, "seed=2"], [*plain, "seed=3"]], 2)]

    monkeypatch.setattr(plugins.GridSweeper, "sweep", sweep_twice)
    monkeypatch.setattr(sweep, "GIVEN_ONCE", ())
    status, _, err = run("-m", "experiment=debug", "seed=1,2,3")
    assert status == 0, err
    assert runs() == ["1", "2", "3"]
    found = read_sweep(Path("outputs/debug/sweep.json")).records
    assert [record.factors for record in found] == [{"seed": 1}, {"seed": 2}, {"seed": 3}]
    # A sweeper that chooses by the objective cannot go on without one.
    status, _, err = run("-m", "experiment=debug", "seed=1,2,3", "objective=no_such_number")
    assert status == 2
    assert "objective = no_such_number: a job has no such number" in err


def test_results_are_renewed_by_a_sweep_as_configured_only(run):
    _, out, _ = run("sweep=debug", "publish=true", "filter.method.tolerance=1e-3")
    assert "left as it is" in out
    run("sweep=debug", "publish=true", "sweep.small.seed='1'")
    assert not Path("outputs/results").exists()
    run("sweep=debug", "publish=true", "sweep.size=full")
    assert read_sweep(Path("outputs/results/sweeps/debug.json")).size == "full"


def test_an_experiment_of_several_runs_keeps_a_record_of_each(run, monkeypatch):
    # Made-up records have no tables.
    monkeypatch.setattr(twin, "STUDY", replace(twin.STUDY, summary=None, figure=None))
    usual = ("experiment=mesh_independence", "paths.results=published")
    status, _, err = run(*usual)
    assert status == 0, err
    names = [f"mesh-independence-hex18-structured-{n}" for n in
             ("36-x-4", "36-x-8", "40-x-5", "54-x-6", "72-x-8")]  # fmt: skip
    assert list(records_of(Path("published"), "mesh_independence").records) == names
    # What was done before is taken over where the results have lost it.
    shutil.rmtree("published")
    assert run(*usual)[0] == 0
    assert len(runs()) == 5
    assert list(records_of(Path("published"), "mesh_independence").records) == names


WRONG = [
    (
        ("sweep=debug", "hydra.launcher.cluster=LocalCluster", "hydra.launcher.address=tcp://a:1"),
        "hydra.launcher: address and cluster, expected one of them",
    ),
    (("sweep=debug", "sweep.size=huge"), "sweep.size = 'huge', expected one of small, full"),
    (("sweep=debug", "seed=interval(1,2)"), "does not support sweep type"),
    (("sweep=debug", "filter.P0=0.01,-1"), "(job filter.initial=[5,3] seed=1 "),
    (("sweep=debug", "filter.initial=[5,3],[5.0,3.0]"), "one and the same: filter.initial=[5,3]"),
]  # fmt: skip


def test_another_sweeper_does_not_ignore_the_grids_of_a_sweep(run):
    status, _, err = run("sweep=debug", "hydra/sweeper=basic")
    assert (status, err.count("\n"), runs()) == (2, 1, [])
    assert "hydra/sweeper=basic knows no grid" in err


@pytest.mark.parametrize(("overrides", "words"), WRONG, ids=[" ".join(o) for o, _ in WRONG])
def test_a_wrong_sweep_is_one_clear_line_and_launches_nothing(run, overrides, words):
    status, out, err = run(*overrides)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1, err
    assert words in err
    assert runs() == []
    assert not list(Path().iterdir()), "not even an empty folder"


def test_a_full_disk_is_a_clear_error_and_leaves_no_half_file(run, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        status, out, err = run("sweep=debug")
    assert (status, out) == (2, "")
    assert "plan.json: No space left on device" in err
    assert len(err.splitlines()) == 1
    assert not list(Path().iterdir())


def test_a_sweep_that_cannot_go_on_says_so_in_a_line_and_can_be_resumed(run, monkeypatch):
    def lose(*_):
        raise OSError("the scheduler is gone")
        yield

    with monkeypatch.context() as patched:
        patched.setattr(sweep, "run_jobs", lose)
        status, _, err = run("sweep=debug", "publish=true")
    assert status == 1
    assert err.startswith("error: the sweep cannot go on (the scheduler is gone)")
    assert [record.reason for record in collected().records] == ["not run"] * 4
    assert not Path("outputs/results").exists()
    assert run("sweep=debug")[0] == 0


def test_an_interrupted_sweep_is_collected_as_far_as_it_went(run, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt
        yield

    run("sweep=debug", "filter.initial=[5,3]")
    monkeypatch.setattr(sweep, "run_jobs", interrupt)
    status, out, err = run("sweep=debug")
    assert status == 130
    assert err.startswith("interrupted")
    assert "2 of 4 jobs done (2 before), 0 without an estimate, 2 not finished" in out
    states = [record.status for record in collected().records]
    assert states == ["converged", "converged", "failed", "failed"]


def test_a_job_beyond_its_memory_costs_its_own_row(run):
    Path("hog-1").touch()
    status, _, err = run("sweep=debug", "memory_limit_gb=0.5")
    assert status == 1
    assert "seed=1: memory limit of 0.5 GB (used: up to " in err
    records = collected().records
    # Its neighbours in the same process go on.
    assert sum(record.converged for record in records) == 3
    (reason,) = [record.reason for record in records if not record.converged]
    found = re.fullmatch(r"memory limit of 0.5 GB \(used: up to (0\.\d+) GB\)", reason)
    assert 0.4 < float(found[1]) <= 0.5


def test_a_run_by_itself_may_have_a_time_limit(run, monkeypatch):
    # Made-up records have no words.
    monkeypatch.setattr(twin, "STUDY", replace(twin.STUDY, words=lambda record: ""))
    alone = ("experiment=debug", "time_limit_s=600", "seed=2")
    Path("raise-2").touch()
    status, _, err = run(*alone)
    assert status == 1
    assert err.startswith("no estimate: RuntimeError: it broke (recorded in ")
    status, _, err = run(*alone)
    assert (status, err) == (0, "")
