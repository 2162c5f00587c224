"""Tracking: from a job's folder to MLflow, also when the store is locked, away or lost."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from omegaconf import DictConfig, OmegaConf
from pandas import read_parquet

from experiments.common.records.record import Record, write_record
from experiments.runner.collecting import comparison
from experiments.runner.jobs.folder import mark_done
from experiments.runner.planning.plan import PLAN, Plan, PlannedJob
from experiments.runner.tracking import store as stores
from experiments.runner.tracking import summary, sync
from experiments.runner.tracking import upload as uploading
from experiments.runner.tracking.dashboard import last_comparison
from experiments.runner.tracking.store import TrackingError, open_store
from experiments.runner.tracking.upload import RECEIPT, upload
from experiments.sweeps.collected import Sweep, SweptJob, write_sweep_file
from mvest.errors import ConfigurationError, InputError
from mvest.problem.record import EstimateRecord, Spread, Unknown
from tests.experiments.studies.made_up import SOURCE, made_up
from tests.places import ROOT

NAMES = ["E_f.anterior", "E_f.posterior"]


@pytest.fixture(scope="module")
def empty_database(tmp_path_factory) -> Path:
    """A tracking database without the experiment: MLflow takes seconds to make one."""
    folder = tmp_path_factory.mktemp("store")
    open_store(None, folder, "another")
    return folder / "mlflow.db"


@pytest.fixture(autouse=True)
def database(tmp_path, empty_database) -> None:
    shutil.copy(empty_database, tmp_path / "mlflow.db")


def make_config(outputs: Path, **changes) -> dict:
    config = {
        "name": "debug",
        "study": "twin",
        "title": "A quick check",
        "parameters": NAMES,
        "seed": 1,
        "repeats": 1,
        "factors": {"noise": 0.5, "kind": "white"},
        "valve": {"leaflets": {"edge_thinning": 0.75}},
        "mesh": {"source": "structured", "columns": 24, "rows": 3, "layers": 1},
        "mechanics": {"element": "hex18"},
        "filter": {
            **{"mode": "paper", "initial": [5.0, 3.0], "P0": 0.01, "R": 1e-4},
            "method": {"Q": 0.01},
        },
        "observation": {"frames": ["open", "closed"], "noise_mm": 0.5},
        "truth": {"values": [6.23, 2.09], "source": None},
        "paths": {"outputs": str(outputs)},
        "tracking": {"enabled": True, "uri": None},
    }
    return config | changes


def estimate(
    values: tuple[float, float] | None = (6.0, 2.0), seed: int = 1, **changes
) -> EstimateRecord:
    """An estimate with SDs of 0.1 and 0.05 MPa, or a failed one."""
    done = values is not None
    columns = zip(NAMES, values or (None, None), (0.1, 0.05), (6.25, 1.96), strict=True)
    unknowns = tuple(
        Unknown(name=name, unit="MPa", estimate=value, std=std if done else None, truth=truth)
        for name, value, std, truth in columns
    )
    whole = {
        "seed": seed,
        "status": "converged" if done else "failed",
        "reason": "tolerance" if done else "it buckled",
        "unknowns": unknowns,
        "distance_mm": Spread(mean=0.1, std=0.05, max=0.4) if done else None,
        "iterations": 2,
        "forward_solves": 3,
        "seconds": 2.0,
        "iterates": ((5.0, 3.0), values) if done else (),
    }
    return EstimateRecord(**{**whole, **changes})


def make_record(config_hash: str = "c" * 64, **changes) -> Record:
    source = {"config_hash": config_hash, "mesh_hash": "m" * 64}
    whole = {
        "study": "twin",
        "experiment": "debug",
        "title": "A quick check",
        "row": "white noise",
        "table": "debug",
        "reason": "tolerance",
        "parameters": NAMES,
        "forward_solves": 3,
        "seconds_total": 5.0,
        "provenance": SOURCE.model_copy(update=source),
        "estimates": (estimate(),),
    }
    return made_up(**{**whole, **changes})


def make_job(outputs: Path, name: str = "job", config=None, **changes) -> Path:
    folder = outputs / "debug" / name
    folder.mkdir(parents=True)
    record = make_record((name * 64)[:64], **changes)
    (folder / "config.json").write_text(json.dumps(config or make_config(outputs)))
    write_record(folder / "result.json", record)
    (folder / "iterates.png").write_bytes(b"picture")
    if record.converged:
        mark_done(folder)
    return folder


def stored(outputs: Path) -> list:
    return open_store(None, outputs, "debug").list_runs()


# --- what is compared ---------------------------------------------------------------------------


def test_settings_have_short_names_that_read_as_numbers(tmp_path) -> None:
    config = make_config(tmp_path)
    config["filter"]["method"]["Q"] = [[0.1, 0.0], [0.0, 0.2]]
    found = comparison.parameters(config, NAMES)
    assert found["P0"] == "0.01"
    assert (found["initial.anterior"], found["initial.posterior"]) == ("5.0", "3.0")
    assert (found["Q.anterior"], found["Q.posterior"]) == ("0.1", "0.2")
    assert found["noise"] == "0.5"
    assert found["kind"] == "white"
    assert found["truth.posterior"] == "2.09"
    assert not [name for name in found if name.startswith(("paths", "tracking"))]
    assert "truth.source" not in found, "a setting that is not set would make its axis no number"


def test_numbers_of_a_job_are_means_over_its_seeds() -> None:
    # Of the truths 6.25 and 1.96 these are -4 and 2, 2 and 4 %.
    runs = (
        estimate((6.0, 1.9992), 4, seconds=1.0, iterations=2),
        estimate((6.375, 2.0384), 5, seconds=2.0, iterations=4),
        estimate(None, 6, seconds=3.0, iterations=0),
    )
    found = comparison.metrics(make_record(estimates=runs))
    single = {name: value for name, value, _ in found if not name.startswith(("repeat", "iterate"))}
    assert single["error.anterior"] == pytest.approx((4 + 2) / 2)
    assert single["error.mean"] == pytest.approx((4 + 2 + 2 + 4) / 4)
    assert single["estimate.anterior"] == pytest.approx(6.1875)
    assert single["spread.anterior"] == pytest.approx(0.375 / 2**0.5)
    assert (single["failed"], single["seconds"], single["iterations"]) == (1, 6.0, 2)
    seeds = [(v, step) for name, v, step in found if name == "repeat.estimate.anterior"]
    assert seeds == [(6.0, 4), (6.375, 5)]


def test_a_failed_run_has_no_errors() -> None:
    record = make_record(status="failed", estimates=(estimate(None),))
    found = {name: value for name, value, _ in comparison.metrics(record)}
    assert found["failed"] == 1
    assert not [name for name in found if name.startswith(("error", "estimate", "distance"))]


# --- upload -------------------------------------------------------------------------------------


def test_a_job_becomes_one_flat_run(tmp_path) -> None:
    job = make_job(tmp_path)
    assert upload(open_store(None, tmp_path, "debug"), job, "sweep-1")
    (run,) = stored(tmp_path)
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "white noise"
    tags = run.data.tags
    assert tags["sweep_id"] == "sweep-1"
    assert (tags["config_hash"], tags["mesh_hash"]) == (("job" * 64)[:64], "m" * 64)
    assert (tags["git_sha"], tags["status"], tags["reason"]) == (
        SOURCE.git.sha, "converged", "tolerance",
    )  # fmt: skip
    assert "mlflow.parentRunId" not in tags
    assert float(run.data.params["P0"]) == 0.01
    assert run.data.metrics["error.anterior"] == pytest.approx(4.0)
    kept = tmp_path / "mlartifacts" / run.info.run_id / "artifacts"
    assert {path.name for path in kept.iterdir()} == {"config.json", "result.json", "iterates.png"}


def test_upload_again_changes_nothing(tmp_path) -> None:
    job = make_job(tmp_path)
    for _ in range(2):
        store = open_store(None, tmp_path, "debug")
        upload(store, job, "sweep-1")
    (job / RECEIPT).unlink()
    assert not upload(store, job, None)
    (run,) = stored(tmp_path)
    assert run.data.tags["sweep_id"] == "sweep-1"
    assert json.loads((job / RECEIPT).read_text())["run_id"] == run.info.run_id


def test_a_new_result_takes_the_place_of_the_old_one(tmp_path) -> None:
    job = make_job(tmp_path)
    store = open_store(None, tmp_path, "debug")
    upload(store, job, "sweep-1")
    assert uploading.is_tracked(job)
    changed = make_record(("job" * 64)[:64], estimates=(estimate((6.1, 2.1)),))
    write_record(job / "result.json", changed)
    assert not uploading.is_tracked(job)
    assert upload(store, job, None)
    (run,) = stored(tmp_path)
    assert run.data.metrics["estimate.anterior"] == 6.1
    assert run.data.tags["sweep_id"] == "sweep-1"


def test_a_run_that_was_cut_short_is_made_anew(tmp_path, monkeypatch) -> None:
    job = make_job(tmp_path)
    store = open_store(None, tmp_path, "debug")
    with monkeypatch.context() as patch:
        patch.setattr(store.client, "log_artifact", lambda *_, **__: 1 / 0)
        with pytest.raises(TrackingError):
            upload(store, job, "sweep-1")
    assert not (job / RECEIPT).exists()
    assert [run.info.status for run in stored(tmp_path)] == ["RUNNING"]
    assert upload(open_store(None, tmp_path, "debug"), job, "sweep-1")
    assert [run.info.status for run in stored(tmp_path)] == ["FINISHED"]


def test_a_failed_run_is_told_with_its_reason(tmp_path) -> None:
    killed = {"status": "failed", "reason": "killed by signal 9", "estimates": ()}
    upload(open_store(None, tmp_path, "debug"), make_job(tmp_path, **killed), "s")
    (run,) = stored(tmp_path)
    assert (run.info.status, run.data.tags["reason"]) == ("FAILED", "killed by signal 9")


def test_a_password_is_not_written_down(tmp_path) -> None:
    address = "postgresql+psycopg://me:" + "secret@db.example.org/mlflow"
    with pytest.raises(ConfigurationError, match=r"pgpass") as refused:
        open_store(address, tmp_path, "debug")
    assert "secret" not in str(refused.value)


# --- a locked database, and `sync` --------------------------------------------------------------


def test_a_locked_database_costs_one_line_and_sync_makes_up_for_it(
    tmp_path, capsys, monkeypatch
) -> None:
    job, other = make_job(tmp_path, "a"), make_job(tmp_path, "b")
    open_store(None, tmp_path, "debug")
    place = f"sqlite:///{tmp_path / 'mlflow.db'}?timeout=0.2"
    real = open_store
    monkeypatch.setattr(uploading, "open_store", lambda _, *more: real(place, *more))
    holder = sqlite3.connect(tmp_path / "mlflow.db", isolation_level=None)
    holder.execute("begin exclusive")
    uploading.track_job(job, make_config(tmp_path))
    said = capsys.readouterr().err
    assert "database is locked" in said
    assert "make sync" in said
    assert len(said.strip().splitlines()) == 1
    assert not (job / RECEIPT).exists()
    holder.execute("rollback")
    holder.close()

    assert sync.main([str(tmp_path)]) == 0
    assert "debug: 2 uploaded, 0 already there" in capsys.readouterr().out
    assert len(stored(tmp_path)) == 2
    assert uploading.is_tracked(job)
    assert uploading.is_tracked(other)
    assert sync.main([str(tmp_path)]) == 0
    assert "debug: 0 uploaded, 2 already there" in capsys.readouterr().out


def test_a_store_that_takes_no_tags_costs_one_line(tmp_path, capsys, monkeypatch) -> None:
    def fails(*_, **__):
        raise UnicodeEncodeError("utf-8", "a\ud800", 1, 2, "surrogates not allowed")

    monkeypatch.setattr("mlflow.tracking.MlflowClient.create_run", fails)
    job = make_job(tmp_path, "a")
    uploading.track_job(job, make_config(tmp_path))
    assert capsys.readouterr().err.startswith("warning: tracking store")
    assert not (job / RECEIPT).exists()


def test_a_lost_database_is_rebuilt(tmp_path, capsys, empty_database) -> None:
    jobs = [make_job(tmp_path, name) for name in "abc"]
    store = open_store(None, tmp_path, "debug")
    for job in jobs:
        upload(store, job, "sweep-1")
    before = {run.data.tags["folder"]: run.data.metrics for run in stored(tmp_path)}
    # A process keeps its databases open, so it is lost together with its folder's name.
    rescued = tmp_path / "rescued"
    shutil.copytree(tmp_path / "debug", rescued / "debug")
    shutil.copy(empty_database, rescued / "mlflow.db")
    assert sync.main([str(rescued)]) == 0
    assert "3 uploaded" in capsys.readouterr().out
    after = stored(rescued)
    assert {run.data.tags["folder"]: run.data.metrics for run in after} == before
    assert {run.data.tags["sweep_id"] for run in after} == {"sweep-1"}


MAKE = """
from pathlib import Path
from experiments.runner.tracking.store import open_store
open_store(None, Path("fresh"), "debug")
"""


def test_a_database_takes_its_name_once_it_is_whole(tmp_path) -> None:
    fresh = tmp_path / "fresh"
    place = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    making = subprocess.Popen(
        [sys.executable, "-c", MAKE], cwd=tmp_path, env=os.environ | {"PYTHONPATH": place}
    )
    try:
        while not any(part.stat().st_size for part in fresh.glob(".part-*-mlflow.db")):
            assert making.poll() is None
            time.sleep(0.01)
    finally:
        making.kill()
        making.wait()
    assert not (fresh / "mlflow.db").exists()
    assert list(fresh.glob(".part-*"))
    open_store(None, fresh, "debug")
    assert {path.name for path in fresh.iterdir()} == {"mlflow.db", ".mlflow.lock"}


@pytest.mark.parametrize("state", ["unfinished", "empty", "no database", "damaged"])
def test_a_broken_database_is_set_aside_and_rebuilt(
    tmp_path, capsys, empty_database, monkeypatch, state
) -> None:
    make_job(tmp_path, "a")
    sync.main([str(tmp_path)])
    outputs = tmp_path / "outputs"
    shutil.copytree(tmp_path / "debug", outputs / "debug")
    path = outputs / "mlflow.db"
    match state:
        case "unfinished":
            # Killed while MLflow made its tables: it can never open this one again.
            with sqlite3.connect(path) as database:
                database.execute("create table experiments (experiment_id integer)")
            database.close()
        case "empty":
            path.touch()
        case "no database":
            path.write_text("nonsense " * 1000)
        case "damaged":
            whole = bytearray(empty_database.read_bytes())
            whole[4096:40960] = bytes(36864)
            path.write_bytes(whole)
    before = path.read_bytes()
    monkeypatch.setattr(stores, "_fill", lambda part: shutil.copy(empty_database, part))
    capsys.readouterr()
    assert sync.main([str(outputs)]) == 0
    said = capsys.readouterr()
    assert "debug: 1 uploaded" in said.out
    assert said.err.count("mlflow.broken-1.db") == 1
    assert len(said.err.strip().splitlines()) == 1
    assert (outputs / "mlflow.broken-1.db").read_bytes() == before
    assert len(stored(outputs)) == 1


def test_a_database_that_may_be_of_use_is_left_alone(tmp_path, empty_database) -> None:
    other = tmp_path / "other.db"
    shutil.copy(empty_database, other)
    assert stores._broken(other) == ""
    holder = sqlite3.connect(other, isolation_level=None)
    holder.execute("update alembic_version set version_num = 'of another version'")
    assert stores._broken(other) == ""
    holder.execute("begin exclusive")
    assert stores._broken(other) == "", "locked"
    holder.close()
    with pytest.raises(TrackingError):
        open_store(f"sqlite:///{other}", tmp_path, "debug")
    assert [path.name for path in tmp_path.glob("other*")] == ["other.db"]


def test_sync_leaves_out_what_is_not_to_be_uploaded_and_says_what_it_cannot_read(
    tmp_path, capsys
) -> None:
    make_job(tmp_path, "a", make_config(tmp_path, tracking={"enabled": False, "uri": None}))
    (make_job(tmp_path, "b") / "done").unlink()  # killed before everything was on disk
    (make_job(tmp_path, "c") / "config.json").write_text("{")
    make_job(tmp_path, "d")
    # Of a version before this one.
    (make_job(tmp_path, "e") / "result.json").write_text('{"version": 2}')
    assert sync.main([str(tmp_path)]) == 1
    captured = capsys.readouterr()
    assert [run.data.tags["folder"] for run in stored(tmp_path)] == ["d"]
    assert captured.err.count("left out") == 2
    assert "of this version" in captured.err
    assert "config.json" in captured.err
    assert sync.main([str(tmp_path / "nowhere")]) == 2


# --- a sweep ------------------------------------------------------------------------------------


def asked(outputs: Path, uri: str | None = None) -> DictConfig:
    """What a sweep's own configuration says of its store."""
    return OmegaConf.create({"tracking": {"uri": uri}, "paths": {"outputs": str(outputs)}})


def make_plan(outputs: Path, **factors: dict) -> Plan:
    """A sweep whose jobs are in folders of these names."""
    jobs = [
        PlannedJob(
            (name * 64)[:64],
            outputs / "debug" / name,
            (f"seed={number}",),
            {"factors": varied, "row": "white noise", "force": False},
            None,
            False,
        )
        for number, (name, varied) in enumerate(factors.items())
    ]
    plan = Plan("debug", outputs / "debug", {}, tuple(jobs), 1)
    plan.write()
    return plan


def test_a_sweep_is_logged_at_its_end(tmp_path) -> None:
    upload(open_store(None, tmp_path, "debug"), make_job(tmp_path, "before"), "an-earlier-sweep")
    untracked = make_config(tmp_path)
    untracked["tracking"]["enabled"] = False
    make_job(tmp_path, "quiet", untracked)
    make_job(tmp_path, "a")
    (make_job(tmp_path, "cut") / "done").unlink()
    make_job(tmp_path, "other")
    varied = {name: {"P0": number, "Q": 1} for number, name in enumerate(("before", "quiet", "a"))}
    plan = make_plan(tmp_path, **varied, cut={"P0": 7, "Q": 1}, missing={"P0": 8, "Q": 1})
    store = sync.open_early(asked(tmp_path), plan)
    assert store is not None
    sync.log_sweep(asked(tmp_path), plan, store)
    # Whoever sweeps with tracking wants to see the whole sweep, whatever its jobs were told before.
    sweep_id = json.loads((tmp_path / "debug" / PLAN).read_text())["sweep_id"]
    found = {run.data.tags["folder"]: run for run in stored(tmp_path)}
    assert set(found) == {"before", "quiet", "a"}
    assert {run.data.tags["sweep_id"] for run in found.values()} == {sweep_id}
    # Named by what differs between them.
    assert {name: run.info.run_name for name, run in found.items()} == {
        "before": "P0=0", "quiet": "P0=1", "a": "P0=2",
    }  # fmt: skip

    assert sync.main([str(tmp_path)]) == 0
    (other,) = [run for run in stored(tmp_path) if run.data.tags["folder"] == "other"]
    assert (other.data.tags["sweep_id"], other.info.run_name) == ("none", "white noise")

    compared = last_comparison(tmp_path)
    assert set(compared.runs) == {run.info.run_id for run in found.values()}
    page = compared.page("http://127.0.0.1")
    assert page.startswith("http://127.0.0.1/#/compare-runs?runs=%5B%22")
    assert all(run in page for run in compared.runs)
    many = replace(compared, runs=("r",) * 200).page("http://127.0.0.1")
    assert many.endswith(f"/runs?searchFilter=tags.sweep_id%20%3D%20%22{sweep_id}%22")


def write_swept(folder: Path, names: str, **changes) -> None:
    """What is collected of jobs of these names, the last of which was lost."""
    jobs = []
    for number, name in enumerate(names):
        lost = number == len(names) - 1
        killed = {"status": "failed", "reason": "killed by signal 9", "estimates": ()}
        record = make_record(
            row=name,
            factors={"noise": 0.5 * number, "R": 0.01 if number else [0.1, 0.2]},
            seconds_total=3.0,
            **(killed if lost else {"estimates": (estimate(), estimate(None, 2))}),
        )
        short = (name * 64)[:16]
        jobs.append(SweptJob(hash=short, seed=1, repeats=2, overhead=0.5, record=record))
    whole = {"name": "debug", "size": "small", "title": "A quick check", "parameters": NAMES}
    given = {**whole, "provenance": SOURCE, "jobs": tuple(jobs), **changes}
    write_sweep_file(folder / summary.SWEEP, Sweep(**given))


def test_a_sweep_is_one_run_with_a_table_of_all_jobs(tmp_path, monkeypatch) -> None:
    for name in "abc":
        make_job(tmp_path, name)
    plan = make_plan(tmp_path, a={}, b={}, c={})
    write_swept(plan.folder, "abc")
    sync.log_sweep(asked(tmp_path), plan, None)

    def kinds() -> list[str | None]:
        return sorted(str(run.data.tags.get("kind")) for run in stored(tmp_path))

    assert kinds() == ["None", "None", "None", "sweep"]
    assert len(last_comparison(tmp_path).runs) == 3, "the whole is not compared with its parts"
    (whole,) = [run for run in stored(tmp_path) if run.data.tags.get("kind") == "sweep"]
    assert whole.info.run_name == "all 3 jobs"
    assert whole.data.metrics == {
        "jobs": 3.0, "failed": 1.0, "seconds": 9.0, "overhead": 0.5,
        "error.mean": pytest.approx(50 * (0.04 + 0.04 / 1.96)),
    }  # fmt: skip
    kept = Path(unquote(urlsplit(whole.info.artifact_uri).path))
    table = read_parquet(kept / "jobs.parquet")
    # Two moduli of each of the seeds 1 and 2 of two jobs, and the lost one.
    assert list(table["job"]) == ["a" * 16] * 4 + ["b" * 16] * 4 + ["c" * 16]
    assert list(table["status"]) == [*["converged", "converged", "failed", "failed"] * 2, "failed"]
    assert list(table["reason"][7:9]) == ["it buckled", "killed by signal 9"]
    assert list(table["parameter"][:2]) == NAMES
    assert list(table["estimate"].dropna()) == [6.0, 2.0] * 2
    assert list(table["relative_error"].dropna()) == pytest.approx([-0.04, 0.04 / 1.96] * 2)
    assert set(table["unit"].dropna()) == {"MPa"}
    assert json.loads(table["factors"][4]) == {"noise": 0.5, "R": 0.01}
    assert (kept / "sweep.json").read_text() == (plan.folder / "sweep.json").read_text()

    # Once for each state of the sweep.
    sync.log_sweep(asked(tmp_path), plan, None)
    assert whole.info.run_id in {run.info.run_id for run in stored(tmp_path)}
    write_swept(plan.folder, "abc", title="Anew")
    sync.log_sweep(asked(tmp_path), plan, None)
    assert kinds() == ["None", "None", "None", "sweep"]
    assert whole.info.run_id not in {run.info.run_id for run in stored(tmp_path)}


def test_of_very_many_jobs_only_the_whole_is_a_run_unless_asked(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sync, "MANY", 2)
    for name in "abc":
        make_job(tmp_path, name)
    plan = make_plan(tmp_path, a={}, b={}, c={})
    write_swept(plan.folder, "abc")
    config = asked(tmp_path)
    sync.log_sweep(config, plan, None)
    assert sync.main([str(tmp_path)]) == 0
    (whole,) = stored(tmp_path)
    assert whole.data.tags["kind"] == "sweep"
    page = last_comparison(tmp_path).page("http://127.0.0.1")
    assert page.endswith(f"/runs/{whole.info.run_id}")
    config.tracking.runs = True
    sync.log_sweep(config, plan, None)
    assert len(stored(tmp_path)) == 4


def test_a_sweep_that_goes_on_is_the_same_one(tmp_path) -> None:
    def sweep_id(*names: str) -> str:
        make_plan(tmp_path, **{name: {"P0": name} for name in names})
        return json.loads((tmp_path / "debug" / PLAN).read_text())["sweep_id"]

    first = sweep_id("a", "b")
    assert sweep_id("a", "b") == first
    assert sweep_id("a", "b", "c") == first
    assert sweep_id("a", "d") != first


def test_runs_of_the_same_factors_are_named_by_what_else_differs(tmp_path) -> None:
    plan = make_plan(tmp_path, a={"kind": "x"}, b={"kind": "x"}, c={"kind": "y"})
    assert plan.names() == ["kind=x, seed=0", "kind=x, seed=1", "kind=y"]
    assert make_plan(tmp_path, a={"kind": "x"}).names() == ["white noise"]


def test_a_sweep_without_its_store_warns_and_loses_nothing(tmp_path, capsys) -> None:
    config = asked(tmp_path, "nonsense://place")
    job, plan = make_job(tmp_path, "a"), make_plan(tmp_path, a={})
    assert sync.open_early(config, plan) is None
    assert "warning: tracking store nonsense://place" in capsys.readouterr().err
    sync.log_sweep(config, plan, None)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert said[0].startswith("warning: 1 of 1 runs are not in MLflow: tracking store nonsense://")
    assert said[0].endswith("`make sync` uploads what is missing")
    assert (job / "result.json").exists()


def test_no_sweep_is_said_so(tmp_path) -> None:
    with pytest.raises(InputError, match="no finished sweep"):
        last_comparison(tmp_path)


@pytest.mark.slow
def test_a_server_killed_in_the_middle_loses_nothing(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")

    def serve() -> subprocess.Popen:
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1"]
        command += ["--port", "50917", "--workers", "1", "--backend-store-uri"]
        command += [
            f"sqlite:///{tmp_path}/server.db",
            "--artifacts-destination",
            f"{tmp_path}/kept",
        ]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        server = subprocess.Popen(command, start_new_session=True, **quiet)
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            try:
                with urllib.request.urlopen("http://127.0.0.1:50917/health", timeout=1.0):
                    return server
            except OSError:
                time.sleep(0.1)
        raise AssertionError("the server did not start")

    def kill(server: subprocess.Popen) -> None:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()

    uri = "http://127.0.0.1:50917"
    config = make_config(tmp_path, tracking={"enabled": True, "uri": uri})
    server = serve()
    try:
        first, second = (make_job(tmp_path, name, config) for name in "ab")
        plan = make_plan(tmp_path, a={}, b={})
        store = sync.open_early(asked(tmp_path, uri), plan)
        true = store.client.log_batch

        def die(run_id: str, **values) -> None:
            true(run_id, **values)
            if (first / RECEIPT).exists():
                kill(server)

        monkeypatch.setattr(store.client, "log_batch", die)
        sync.log_sweep(asked(tmp_path, uri), plan, store)
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1
        assert said[0].startswith("warning: 1 of 2 runs are not in MLflow")
        assert not (second / RECEIPT).exists()
        server = serve()
        assert sync.main([str(tmp_path)]) == 0
        assert "debug: 1 uploaded, 1 already there" in capsys.readouterr().out
        found = open_store(uri, tmp_path, "debug").list_runs()
        assert sorted(run.data.tags["folder"] for run in found) == ["a", "b"]
        assert len({run.data.tags["sweep_id"] for run in found}) == 1
    finally:
        kill(server)
