"""Tracking: from folders to MLflow, also when the store is locked, away, broken or lost."""

import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from experiments.cli import main
from experiments.common.records.record import Record, write_record
from experiments.runner.jobs import Request, mark_done
from experiments.runner.metrics import implausible, metrics, settings_of
from experiments.runner.plan import Plan
from experiments.runner.tracking import last_sweep, log_run, opened, runs_of
from experiments.sweeps.collected import Sweep, SweptJob, write_sweep_file
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, Spread, Unknown
from mvest.problem.verdict import NONE, Verdict
from tests.experiments.studies.made_up import SOURCE, made_up

NAMES = ["E_f.anterior", "E_f.posterior"]


@pytest.fixture(scope="module")
def empty_database(tmp_path_factory) -> Path:
    """A tracking database without the experiment: MLflow takes seconds to make one."""
    folder = tmp_path_factory.mktemp("store")
    with opened(None, folder, "another"):
        return folder / "mlflow.db"


@pytest.fixture(autouse=True)
def database(tmp_path, empty_database) -> None:
    shutil.copy(empty_database, tmp_path / "mlflow.db")


def make_config(outputs: Path, **changes) -> dict:
    config = {
        "name": "debug", "study": "twin", "title": "A quick check", "parameters": NAMES,
        "seed": 1, "repeats": 1, "factors": {"noise": 0.5, "kind": "white"},
        "mesh": {"source": "structured", "columns": 24, "rows": 3, "layers": 1},
        "mechanics": {"element": "hex18", "tissue": {}},
        "filter": {"mode": "paper", "initial": [5.0, 3.0], "P0": 0.01, "R": 1e-4},
        "observation": {"frames": ["open", "closed"], "noise_mm": 0.5},
        "truth": {"values": [6.23, 2.09], "source": None},
        "paths": {"outputs": str(outputs)}, "tracking": {"enabled": True, "uri": None},
    }  # fmt: skip
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
        "seed": seed, "status": "converged" if done else "failed",
        "reason": "tolerance" if done else "it buckled", "unknowns": unknowns,
        "distance_mm": Spread(mean=0.1, std=0.05, max=0.4) if done else None,
        "iterations": 2, "forward_solves": 3, "seconds": 2.0,
    }  # fmt: skip
    return EstimateRecord(**{**whole, **changes})


def make_record(config_hash: str = "c" * 64, **changes) -> Record:
    source = {"config_hash": config_hash, "mesh_hash": "m" * 64}
    whole = {
        "study": "twin", "experiment": "debug", "title": "A quick check", "row": "white noise",
        "table": "debug", "reason": "tolerance", "parameters": NAMES, "forward_solves": 3,
        "seconds_total": 5.0, "provenance": SOURCE.model_copy(update=source),
        "estimates": (estimate(),),
    }  # fmt: skip
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


def stored(outputs: Path, chosen: str = "") -> list:
    """The runs in a store."""
    with opened(None, outputs, "debug"):
        return runs_of("debug", chosen)


def jobs_in(outputs: Path) -> dict:
    """Folder -> run of a job."""
    return {r.data.tags["folder"]: r for r in stored(outputs, "tags.config_hash != ''")}


def make_sweep(outputs: Path, **jobs: dict) -> Path:
    """A collected sweep, with a job in a folder of each name that starts where it is told."""
    folder, planned, swept = outputs / "debug", [], []
    for name, changes in jobs.items():
        config = make_config(outputs, row="white noise", force=False, **changes.pop("config", {}))
        if not (folder / name).is_dir():
            make_job(outputs, name, config, **changes)
        start = f"[{','.join(f'{value:g}' for value in config['filter']['initial'])}]"
        words = (f"filter.initial={start}", f"seed={config['seed']}", "+experiment=debug")
        request = Request(config, (name * 64)[:64], folder / name, None, words)
        planned.append(request)
        record = make_record((name * 64)[:64], seconds_total=3.0, **changes)
        swept.append(SweptJob(hash=(name * 64)[:16], seed=1, record=record))
    Plan("debug", folder, {}, tuple(planned)).write()
    head = {"name": "debug", "title": "A quick check", "parameters": NAMES, "provenance": SOURCE}
    write_sweep_file(folder / "sweep.json", Sweep(**head, jobs=tuple(swept)))
    return folder


def started(*initial: float, seed: int = 1, **factors) -> dict:
    """Changes of the configuration of a job."""
    settings = make_config(Path())["filter"] | {"initial": list(initial)}
    return {"config": {"filter": settings, "seed": seed, "factors": factors}}


def test_settings_are_named_and_shown_as_typed(tmp_path) -> None:
    config = make_config(tmp_path, case={"sha256": "abc"})
    words = ["filter.initial=[5,3]", "+filter=paper", "case=somewhere", "tracking.uri=x", "seed=1"]
    found = settings_of(config, words, {"seed again": 1, "kind": "white"})
    assert found == {
        "filter.initial": "[5,3]", "filter": "paper", "case": {"sha256": "abc"}, "seed": 1,
        "study": "twin", "mesh.source": "structured", "mechanics.element": "hex18",
        "filter.mode": "paper", "observation.noise_mm": 0.5, "kind": "white",
    }  # fmt: skip


def test_numbers_of_a_job_are_means_over_its_seeds() -> None:
    # Of the truths 6.25 and 1.96 these are -4 and 2, 2 and 4 %.
    runs = (
        estimate((6.0, 1.9992), 4, seconds=1.0, iterations=2),
        estimate((6.375, 2.0384), 5, seconds=2.0, iterations=4),
        estimate(None, 6, seconds=3.0, iterations=0),
    )
    found = metrics(make_record(estimates=runs))
    assert found["error.anterior"] == pytest.approx((4 + 2) / 2)
    assert found["error.mean"] == pytest.approx((4 + 2 + 2 + 4) / 4)
    assert found["estimate.anterior"] == pytest.approx(6.1875)
    assert found["spread.anterior"] == pytest.approx(0.375 / 2**0.5)
    assert (found["failed"], found["seconds"], found["iterations"]) == (1, 6.0, 2)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"estimates": (estimate((6.0, 3.93)),)}, "E_f.posterior is wrong by 101% of the truth"),
        ({"estimates": (estimate(verdict=Verdict(trust=NONE)),)}, "the verdict"),
        ({"status": "failed", "estimates": (estimate(None),)}, "failed"),
        # One seed of several.
        ({"estimates": (estimate(None), estimate(), estimate((60.0, 2.0)))}, "E_f.anterior is"),
    ],
)
def test_an_answer_without_sense_is_marked(changes, why) -> None:
    found = implausible(make_record(**changes))
    assert found.startswith(why)
    assert bool(found) == bool(why)


def test_a_job_becomes_a_run(tmp_path) -> None:
    job = make_job(tmp_path)
    (job / ".hydra").mkdir()
    (job / ".hydra" / "overrides.yaml").write_text("- experiment=debug\n- filter.P0=0.01\n")
    log_run(job, make_config(tmp_path))
    (run,) = stored(tmp_path)
    assert (run.info.status, run.info.run_name) == ("FINISHED", "white noise")
    assert run.info.end_time - run.info.start_time == 5000
    tags = run.data.tags
    assert tags["mlflow.source.git.commit"] == SOURCE.git.sha
    assert (tags["config_hash"], tags["folder"]) == (("job" * 64)[:64], "job")
    assert (tags["status"], tags["plausible"]) == ("converged", "yes")
    assert (run.data.params["filter.P0"], run.data.params["seed"]) == ("0.01", "1")
    assert run.data.metrics["error.anterior"] == pytest.approx(4.0)
    kept = tmp_path / "mlartifacts" / run.info.run_id / "artifacts"
    assert {path.name for path in kept.iterdir()} == {"config.json", "result.json", "iterates.png"}


def test_again_changes_nothing_and_another_result_takes_the_place(tmp_path) -> None:
    job = make_job(tmp_path)
    for _ in range(2):
        log_run(job, make_config(tmp_path))
    (first,) = stored(tmp_path)
    write_record(
        job / "result.json",
        make_record(first.data.tags["config_hash"], estimates=(estimate((6.1, 2.1)),)),
    )
    mark_done(job)
    log_run(job, make_config(tmp_path))
    (run,) = stored(tmp_path)
    assert run.info.run_id != first.info.run_id
    assert run.data.metrics["estimate.anterior"] == 6.1


def test_the_jobs_of_a_sweep_fold_under_its_run(tmp_path) -> None:
    lost = {"status": "failed", "reason": "killed by signal 9", "estimates": ()}
    folder = make_sweep(
        tmp_path,
        a=started(5.0, 3.0, start=5.0),
        b=started(4.0, 3.0, start=4.0, seed=2),
        c=started(4.0, 3.0, start=4.0) | lost,
    )
    log_run(folder, make_config(tmp_path))
    (whole,) = stored(tmp_path, "tags.sweep_id != ''")
    jobs = jobs_in(tmp_path)
    assert whole.info.run_name == "sweep of 3 jobs"
    assert {run.data.tags["mlflow.parentRunId"] for run in jobs.values()} == {whole.info.run_id}
    error = pytest.approx(50 * (0.04 + 0.04 / 1.96))
    assert whole.data.metrics == {"jobs": 3, "failed": 1, "seconds": 9, "error.mean": error}
    assert {"filter.initial": "[4,3]", "seed": "2", "start": "4.0"}.items() <= (
        jobs["b"].data.params.items()
    )
    assert jobs["a"].info.run_name == "start=5.0"
    assert jobs["c"].info.status == "FAILED"


def test_the_comparison_hides_what_failed_or_makes_no_sense(tmp_path, monkeypatch) -> None:
    with pytest.raises(InputError, match="holds no sweep"):
        last_sweep(tmp_path)
    wrong = {"estimates": (estimate((60.0, 2.0)),)}
    lost = {"status": "failed", "reason": "killed by signal 9", "estimates": ()}
    starts = {name: started(5.0 + k, 3.0) for k, name in enumerate("abcd")}
    starts["c"] |= wrong
    starts["d"] |= lost
    folder = make_sweep(tmp_path, **starts)
    with pytest.raises(InputError, match="mvest sync"):
        last_sweep(tmp_path)
    log_run(folder, make_config(tmp_path))
    place, page, said = last_sweep(tmp_path)
    assert place == f"sqlite:///{tmp_path / 'mlflow.db'}"
    assert said == "debug, 2 runs (2 failed or implausible)"
    jobs = jobs_in(tmp_path)
    assert page.startswith("/#/compare-runs?runs=%5B%22")
    assert [name for name, run in jobs.items() if run.info.run_id in page] == ["b", "a"]
    # Too many are listed, by the same choice.
    monkeypatch.setattr("experiments.runner.tracking.MOST", 1)
    assert "plausible%20%3D%20%27yes%27" in last_sweep(tmp_path)[1]


def test_sync_says_what_it_cannot_read(tmp_path, capsys) -> None:
    (make_job(tmp_path, "c") / "config.json").write_text("{")
    make_job(tmp_path, "d")
    assert main(["sync", str(tmp_path)]) == 1
    assert list(jobs_in(tmp_path)) == ["d"]
    assert "c/config.json is not JSON" in " ".join(capsys.readouterr().err.split())
    assert main(["sync", str(tmp_path / "nowhere")]) == 2


def test_a_broken_database_is_named_with_what_makes_it_anew(
    tmp_path, capsys, empty_database
) -> None:
    outputs = tmp_path / "outputs"
    job, path = make_job(outputs), outputs / "mlflow.db"
    # As if killed while MLflow made its tables: it can never open this one again.
    with sqlite3.connect(path) as database:
        database.execute("create table experiments (experiment_id integer)")
    database.close()
    before = path.read_bytes()
    log_run(job, make_config(outputs))
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert f"{path} is broken (" in said
    assert f"`mvest sync {outputs}`" in said
    assert path.read_bytes() == before, "nothing is repaired"
    shutil.copy(empty_database, path)  # as removed, but in less time
    assert main(["sync", str(outputs)]) == 0
    assert list(jobs_in(outputs)) == ["job"]
