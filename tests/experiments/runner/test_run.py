"""The application: from the command line to its files, messages and exit status."""

import sqlite3
import subprocess
import sys

import numpy as np
import pytest

from experiments import cli
from experiments.common.records.record import read_record
from mvest.closure.model import ClosureModel
from mvest.estimation import Prediction
from mvest.files import PREFIX
from tests.places import ROOT


def test_debug_runs_end_to_end(tmp_path) -> None:
    finished = subprocess.run(
        [sys.executable, "-m", "experiments.run", "experiment=debug"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert finished.returncode == 0, finished.stderr
    assert "E_f.anterior (MPa)" in finished.stdout
    (folder,) = (tmp_path / "outputs" / "debug").iterdir()
    record = read_record(folder / "result.json")
    (first,) = record.estimates
    assert record.converged
    assert record.forward_solves > first.iterations > 0
    # Two estimated moduli, and the four that follow from them.
    assert [unknown.kind for unknown in first.unknowns] == ["modulus"] * 2 + ["derived"] * 4
    assert max(abs(unknown.relative_error) for unknown in first.unknowns) < 1e-4
    assert record.provenance.config_hash.startswith(folder.name)
    names = {path.name for path in folder.iterdir()}
    assert {"debug.csv", "debug.md", "debug.png", "debug_valve.png", "config.json"} <= names
    assert not [name for name in names if name.startswith(PREFIX)]
    with sqlite3.connect(tmp_path / "outputs" / "mlflow.db") as database:
        metrics = dict(database.execute("select key, value from latest_metrics").fetchall())
    assert metrics["estimate.anterior"] == pytest.approx(first.moduli[0].estimate)


ERRORS = [
    ("experiment=tabel1", "Could not find 'experiment/tabel1'; did you mean table1? known: "),
    ("filter.inital=[1,2]", "did you mean initial?"),
    ("seed=abc", "seed: Value 'abc' of type 'str' could not be converted to Integer"),
    ("filter=[", "filter=[: no viable alternative"),
    ("truth.values=[1]", "truth.values has 1 values"),
    ("filter.P0=[[1,2],[2,1]]", "positive semi-definite"),
    ("filter.R=[1,2,3]", "R has shape (3,)"),
    ("observation.frames=[shut]", "observed frames ['shut']"),
    ("mechanics.element=hex99", "hex99"),
    ("parameters=[E_f.middle,E_f.posterior]", "parameter 'E_f.middle': unknown 'middle'"),
    ("hydra.run.dir=file/below", "file/below: Not a directory"),
    ("tracking.uri=postgresql://me:secret@localhost/mvest", "tracking.uri holds a password"),
    ("~filter", "filter.initial has no value"),
    ("hydra.run.dir=${paths.outputs}/${name}/x name=..", "expected a name"),
]  # fmt: skip


@pytest.mark.parametrize(("override", "words"), ERRORS, ids=[override for override, _ in ERRORS])
def test_a_wrong_request_is_one_clear_line(run, tmp_path, override: str, words: str) -> None:
    (tmp_path / "file").touch()
    first = [] if override.startswith("experiment=") else ["experiment=debug"]
    status, out, err = run(*first, *override.split())
    assert status == 2
    assert out == ""
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1, err
    assert words in err
    # The truth's own folder aside, not even an empty one is left.
    left = {path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*")}
    assert left <= {("file",), ("outputs",), ("outputs", "truths")}
    assert not list(tmp_path.rglob("*.json"))


@pytest.fixture
def instead_of_closing(monkeypatch):
    """Put a function of the parameters and the rest positions in the place of the forward model."""

    def replace(function) -> None:
        monkeypatch.setattr(
            ClosureModel, "__call__", lambda self, m: function(m, self.valve.surface.vertices)
        )

    return replace


def shrinking(m, rest) -> Prediction:
    """The valve narrows along x by 1/m[0] and along y by 1/m[1]."""
    closed = rest * np.array([1 - 1 / m[0], 1 - 1 / m[1], 1.0])
    slope = np.zeros((2, *rest.shape, 2))
    slope[1, :, 0, 0] = rest[:, 0] / m[0] ** 2
    slope[1, :, 1, 1] = rest[:, 1] / m[1] ** 2
    return Prediction(np.concatenate([rest.ravel(), closed.ravel()]), slope.reshape(-1, 2))


def test_a_failing_forward_run_is_recorded(run, tmp_path, instead_of_closing) -> None:
    instead_of_closing(lambda m, rest: Prediction.failed("Newton's method did not converge"))
    status, _, err = run("experiment=debug", "hydra.run.dir=here", "paths.results=published")
    assert status == 1
    assert err.startswith("no estimate: no synthetic observation: Newton's method")
    assert "result.json" in err
    record = read_record(tmp_path / "here" / "result.json")
    assert record.status == "failed"
    assert record.estimates[0].unknowns[0].estimate is None
    assert "Newton" in record.reason
    assert not (tmp_path / "published").exists()


def test_an_interruption_leaves_nothing_behind(run, tmp_path, instead_of_closing) -> None:
    def interrupted(m, rest):
        raise KeyboardInterrupt

    instead_of_closing(interrupted)
    status, _, err = run("experiment=debug", "hydra.run.dir=here")
    assert status == 130
    assert err.startswith("interrupted")
    assert not (tmp_path / "here").exists()
    # Whose turn it was to simulate the truth is all that is known of it.
    left = [path for path in (tmp_path / "outputs").rglob("*") if path.is_file()]
    assert [path.suffix for path in left] == [".lock"]


def test_results_are_renewed_by_the_experiment_as_configured_only(
    run, tmp_path, instead_of_closing, capsys
) -> None:
    instead_of_closing(shrinking)
    elsewhere = ("tracking.enabled=false", "paths.results=published", "hydra.run.dir=here")
    status, out, _ = run("experiment=table1", "seed=3", *elsewhere)
    assert status == 0
    assert "left as it is" in out
    assert not (tmp_path / "published").exists()

    status, out, _ = run("experiment=table1", *elsewhere)
    assert status == 0
    kept = {path.name: path.read_bytes() for path in (tmp_path / "published").glob("table1*")}
    assert {"table1.csv", "table1.md", "table1.tex", "table1.png", "table1_valve.png"} <= set(kept)
    assert b"paper, Table 1" in kept["table1.md"]
    # The run's own figures, drawn once.
    assert kept["table1.pdf"] == (tmp_path / "here" / "table1.pdf").read_bytes()
    # The tables follow from the record alone.
    for name in kept:
        if "valve" not in name:
            (tmp_path / "published" / name).unlink()
    assert cli.main(["tables", str(tmp_path / "published")]) == 0
    capsys.readouterr()
    again = {path.name: path.read_bytes() for path in (tmp_path / "published").glob("table1*")}
    assert again == kept


FAILURES = {
    "figure": ("matplotlib.figure.Figure.savefig", ValueError("no glyph for U+D800")),
    "marker": ("experiments.runner.jobs.mark_done", OSError(28, "No space left on device")),
}


@pytest.mark.parametrize("step", FAILURES)
def test_an_estimate_outlives_what_cannot_be_written_after_it(
    run, tmp_path, instead_of_closing, monkeypatch, step
) -> None:
    place, error = FAILURES[step]
    calls = []

    def counted(m, rest) -> Prediction:
        calls.append(m)
        return shrinking(m, rest)

    def fails(*_, **__):
        raise error

    instead_of_closing(counted)
    usual = ("experiment=debug", "tracking.enabled=false", "hydra.run.dir=here")
    with monkeypatch.context() as patch:
        patch.setattr(place, fails)
        status, _, err = run(*usual)
    assert status == 2
    assert "the same command writes what is missing" in err.splitlines()[-1]
    assert "Traceback" not in err
    computed, count = (tmp_path / "here" / "result.json").read_bytes(), len(calls)
    assert not (tmp_path / "here" / "done").exists()

    status, _, err = run(*usual)
    assert (status, len(calls)) == (0, count), err
    assert (tmp_path / "here" / "result.json").read_bytes() == computed
    assert (tmp_path / "here" / "done").exists()
    assert {"debug.csv", "debug.md", "debug.png"} <= {p.name for p in (tmp_path / "here").iterdir()}


def test_a_dry_run_writes_nothing(run, tmp_path) -> None:
    status, out, err = run("experiment=debug", "dry_run=true")
    assert status == 0, err
    assert "1 jobs, 0 done" in out
    assert not list(tmp_path.iterdir())
