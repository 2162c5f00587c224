"""Signals at stages of a sweep: no orphan, no half file, and the same command goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.runner import job
from experiments.runner.tracking import opened, runs_of
from experiments.sweeps.collected import read_sweep
from tests.places import ROOT
from tests.processes import alive, gone, linux, until

pytestmark = linux
SLOW = pytest.mark.slow

HELD = str(Path(__file__).with_name("held.py"))
STATUS = {"KILL": -9, "INT": 130, "INT INT": 130}
"""Signals -> exit status."""


def start(folder: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, HELD, "run", "sweep=debug", *more],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def require_whole(folder: Path) -> None:
    """No file under its own name is cut off."""
    for path in folder.rglob("[!.]*"):
        if path.suffix == ".json":
            json.loads(path.read_text())
        if path.suffix == ".png":
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        if path.suffix in (".csv", ".html"):
            assert path.read_bytes().endswith(b"\n")


@pytest.mark.parametrize(
    ("stage", "signals", "more"),
    [
        ("simulating", "KILL", ("tracking.enabled=false", "hydra.launcher.n_jobs=2")),
        pytest.param("drawing", "INT INT", ("tracking.enabled=false", "publish=true"), marks=SLOW),
        pytest.param("logging", "INT", (), marks=SLOW),
    ],
)
def test_a_signal_leaves_nothing_behind(stage, signals, more, tmp_path):
    hold = tmp_path / "hold"
    hold.write_text(stage)
    sweep = start(tmp_path, *more)
    try:
        until(lambda: (tmp_path / "at").exists() or sweep.poll() is not None)
        assert sweep.poll() is None, sweep.communicate()[0]
        for name in signals.split():
            sweep.send_signal(signal.Signals[f"SIG{name}"])
            time.sleep(0.1)  # another one comes while the first is handled
        sweep.wait(timeout=60)
        left = [] if gone(tmp_path) else alive(tmp_path)
    finally:
        sweep.kill()
        out, _ = sweep.communicate()
    assert not left
    assert sweep.returncode == STATUS[signals], out
    assert "Traceback" not in out
    require_whole(tmp_path)

    hold.unlink()
    again = start(tmp_path, *more)
    out, _ = again.communicate(timeout=300)
    assert again.returncode == 0, out
    require_whole(tmp_path)
    found = read_sweep(tmp_path / "outputs" / "sweep_debug" / "sweep.json").records
    assert [record.converged for record in found] == [True] * 4
    if stage == "logging":
        with opened(None, tmp_path / "outputs", "sweep_debug"):
            runs = runs_of("sweep_debug", "")
        assert [run.info.status for run in runs] == ["FINISHED"] * 5, "four jobs and the sweep"


def test_an_interruption_within_compiled_code_is_no_failure_of_the_job(monkeypatch):
    def compiled(*_):
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as stopped:
                raise SystemError(
                    "a dispatcher returned a result with an exception set"
                ) from stopped
        except SystemError as wrapped:
            raise SystemError("the same, one call further out") from wrapped

    monkeypatch.setattr(job, "compute", compiled)
    with pytest.raises(KeyboardInterrupt):
        job.answer(None, 1.0)
