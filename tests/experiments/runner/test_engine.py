"""Jobs on a dask cluster of this machine: workers are killed, the client is, and no job is lost."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.sweeps.collected import read_sweep
from tests.experiments.runner.test_shards import FAKE, WORKER, runs
from tests.places import ROOT
from tests.processes import command_of, linux, living, until

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
pytestmark = linux

FOLDER = Path("outputs/debug")
CLUSTER = ("hydra.launcher.cluster=LocalCluster", "hydra.launcher.jobs=2")

INSTEAD = """
import sys
from experiments.runner import engine
engine.WORKER = (sys.executable, {fake!r})
"""
"""What dask's workers load, so that their jobs take no time."""


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """Start a sweep of eight jobs on a cluster in an empty folder."""
    monkeypatch.chdir(tmp_path)
    instead = tmp_path / "instead.py"
    instead.write_text(INSTEAD.format(fake=FAKE))

    def start(*more: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [
                *(sys.executable, "-c", WORKER, FAKE, "run", "-m", "experiment=debug"),
                *("seed=range(0,8)", "tracking.enabled=false", *(more or CLUSTER)),
            ],
            env=os.environ
            | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__PRELOAD": f'["{instead}"]'},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    yield start
    until(lambda: not living(tmp_path))


def parents(pid: int) -> list[int]:
    """A process's parent, the parent of that, and so on."""
    found = []
    while pid > 1:
        pid = int(Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1].split()[1])
        found.append(pid)
    return found


def test_jobs_that_die_on_a_cluster_cost_their_own_rows(sweep):
    Path("kill-2").touch()
    Path("raise-5").touch()
    running = sweep()
    out, _ = running.communicate(timeout=300)
    assert running.returncode == 1, out
    found = read_sweep(FOLDER / "sweep.json").records
    reasons = {record.factors["seed"]: record.reason for record in found if not record.converged}
    assert reasons.keys() == {2, 5}
    assert reasons[2].startswith("killed by signal 9")
    assert reasons[5] == "RuntimeError: it broke"
    assert runs() == list(range(8))

    # The same command runs what failed, here; nothing is done twice.
    again = sweep("hydra.launcher.n_jobs=1")
    out, _ = again.communicate(timeout=300)
    assert again.returncode == 0, out
    assert "8 of 8 jobs done (6 before)" in out
    assert runs() == sorted([*range(8), 2, 5])


@pytest.mark.slow
def test_the_job_of_a_killed_worker_is_run_again_by_itself(sweep):
    Path("wait-3").touch()
    running = sweep()
    until(lambda: Path("wait-3").read_text())
    job = int(Path("wait-3").read_text())
    above = [pid for pid in parents(job) if running.pid in parents(pid)[:1]]
    os.kill(next(pid for pid in above if "spawn_main" in command_of(pid)), signal.SIGKILL)
    until(lambda: runs().count(3) == 2)
    Path("wait-3").unlink()
    out, _ = running.communicate(timeout=300)
    assert running.returncode == 0, out
    assert "8 of 8 jobs done" in out
    assert sorted(set(runs())) == list(range(8))
