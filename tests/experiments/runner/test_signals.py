"""Every signal at every stage of a sweep: no orphan, no half file, the same answer afterwards.

``pytest tests/experiments/runner/test_signals.py -s`` counts what was left of all kills.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.runner.tracking import opened, runs_of
from experiments.sweeps.collected import read_sweep
from tests.places import ROOT
from tests.processes import alive, gone, linux, until

pytestmark = linux

HELD = str(Path(__file__).with_name("held.py"))
SWEEP = ("run", "sweep=debug")
PUBLISHED, UNTRACKED = "publish=true", "tracking.enabled=false"
STATUS = {
    "INT": 130, "TERM": 143, "HUP": 129, "KILL": -9, "INT INT": 130,
}  # fmt: skip
"""Signals -> exit status."""

CASES = [
    ("simulating", "KILL"),
    pytest.param("planning", "HUP", marks=pytest.mark.slow),
    pytest.param("estimating", "TERM", marks=pytest.mark.slow),
    pytest.param("writing", "KILL", marks=pytest.mark.slow),
    pytest.param("collecting", "TERM", marks=pytest.mark.slow),
    pytest.param("logging", "INT", marks=pytest.mark.slow),
    pytest.param("drawing", "INT INT", marks=pytest.mark.slow),
]
"""Stages of a sweep and the signals that it gets there."""


def start(folder: Path, *more: str) -> subprocess.Popen[str]:
    places = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen(
        [sys.executable, HELD, *SWEEP, *more],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": places},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finished(folder: Path, *more: str) -> str:
    sweep = start(folder, *more)
    out, _ = sweep.communicate(timeout=300)
    assert sweep.returncode == 0, out
    return out


def answer(folder: Path) -> dict[str, object]:
    """What a sweep found, without times and commits."""
    found = read_sweep(folder / "outputs" / "sweep_debug" / "sweep.json")
    runs = [
        (job.hash, job.record.status, [u.estimate for u in job.record.estimates[0].unknowns])
        for job in found.jobs
    ]
    # Above the rows stands the commit, with a word if the checkout has been changed since.
    tables = {
        path.name: [line for line in path.read_text().splitlines() if not line.startswith("#")]
        for path in folder.glob("outputs/results/*.csv")
    }
    return {"runs": runs, "tables": tables}


def require_whole(folder: Path) -> None:
    """No file under its own name is cut off."""
    for path in folder.rglob("*"):
        if path.name.startswith(".") or not path.is_file():
            continue
        match path.suffix:
            case ".json":
                json.loads(path.read_text())
            case ".png":
                assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
            case ".csv" | ".html":
                assert path.read_bytes().endswith(b"\n")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    finished(folder, PUBLISHED, UNTRACKED)
    return answer(folder)


@pytest.fixture(scope="module")
def database(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("store")
    with opened(None, folder, "another"):
        return folder / "mlflow.db"


@pytest.mark.parametrize(("stage", "signals"), CASES)
def test_a_signal_leaves_nothing_behind(stage, signals, undisturbed, tmp_path, request):
    more = [UNTRACKED]
    if stage == "drawing":
        more.append(PUBLISHED)
    if stage in ("simulating", "estimating"):
        more.append("hydra.launcher.n_jobs=2")
    if stage == "logging":
        (tmp_path / "outputs").mkdir()
        shutil.copy(request.getfixturevalue("database"), tmp_path / "outputs" / "mlflow.db")
        more = []
    hold = tmp_path / "hold"
    hold.write_text(stage)
    sweep = start(tmp_path, *more)
    try:
        until(lambda: (tmp_path / "at").exists() or sweep.poll() is not None)
        assert sweep.poll() is None, sweep.communicate()[0]
        for name in signals.split():
            sweep.send_signal(signal.Signals[f"SIG{name}"])
            # Another one comes while the first is dealt with.
            time.sleep(0.1)
        sweep.wait(timeout=60)
        left = [] if gone(tmp_path) else alive(tmp_path)
    finally:
        sweep.kill()
        out, _ = sweep.communicate()
    print(f"{stage}, {signals}: {len(left)} orphans")
    assert not left
    assert sweep.returncode == STATUS[signals], out
    assert "Traceback" not in out
    require_whole(tmp_path)

    hold.unlink()
    finished(tmp_path, *more)
    require_whole(tmp_path)
    if stage == "drawing":
        assert answer(tmp_path) == undisturbed
    else:
        assert answer(tmp_path)["runs"] == undisturbed["runs"]
    if stage == "logging":
        with opened(None, tmp_path / "outputs", "sweep_debug"):
            runs = runs_of("sweep_debug", "")
        assert [run.info.status for run in runs] == ["FINISHED"] * 5, "four jobs and the sweep"


@pytest.mark.slow
def test_a_forced_sweep_that_is_killed_leaves_the_former_results(tmp_path):
    finished(tmp_path, UNTRACKED)
    before = answer(tmp_path)
    (tmp_path / "hold").write_text("writing")
    sweep = start(tmp_path, UNTRACKED, "force=true")
    try:
        until(lambda: (tmp_path / "at").exists() or sweep.poll() is not None)
        assert sweep.poll() is None, sweep.communicate()[0]
    finally:
        sweep.kill()
        sweep.communicate()
    assert gone(tmp_path), alive(tmp_path)
    (tmp_path / "hold").unlink()
    computed = (tmp_path / "runs").read_text()
    finished(tmp_path, UNTRACKED)
    assert answer(tmp_path) == before
    assert (tmp_path / "runs").read_text() == computed


@pytest.mark.slow
def test_the_time_limit_of_a_job_ends_the_programs_that_it_started(tmp_path):
    (tmp_path / "hold").write_text("simulating")
    one = ("filter.initial=[5,3]", "sweep.small.seed=1")
    sweep = start(tmp_path, UNTRACKED, *one, "time_limit_s=10")
    out, _ = sweep.communicate(timeout=120)
    assert (tmp_path / "at").exists(), "the program had not begun"
    assert sweep.returncode == 1, out
    assert "time limit of 10 s" in out
    assert gone(tmp_path), alive(tmp_path)
