"""A sweep through a real Slurm, with tasks that die hard: ``make slurm-check``.

``setup.sh`` beside this file makes such a Slurm on one host. Nothing of this runs in the other test
commands.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.sweeps.collected import read_sweep
from tests.places import ROOT

PATIENCE = 600.0
SWEEP = (
    sys.executable, "-P", "-m", "experiments.run", "-m", "sweep=debug", "tracking.enabled=false",
    "hydra.launcher.cluster=SLURMCluster", "hydra.launcher.jobs=2",
)  # fmt: skip
OPTIONS = "hydra.launcher.options={walltime: '00:30:00', memory: 2GB}"


@pytest.fixture(scope="module", autouse=True)
def slurm() -> None:
    if shutil.which("sbatch") is None or asked("sinfo", "--noheader") == "":
        pytest.fail("no Slurm answers here; tests/slurm/setup.sh starts one on this host")


def asked(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def start(folder: Path, options: str = OPTIONS) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*SWEEP, options],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def until(find) -> str:
    """What ``find`` returns as soon as it is something."""
    stop = time.monotonic() + PATIENCE
    while time.monotonic() < stop:
        if found := find():
            return found
        time.sleep(0.2)
    pytest.fail("waited in vain for Slurm")


def running() -> list[str]:
    """Slurm's jobs that run."""
    return asked("squeue", "--noheader", "--states=R", "--format=%A").split()


def worker_of(job: str) -> str:
    """Process of a dask worker, as Slurm follows it."""
    for line in asked("scontrol", "listpids", job).splitlines()[1:]:
        pid = line.split()[0]
        try:
            if b"distributed.cli.dask_worker" in Path("/proc", pid, "cmdline").read_bytes():
                return pid
        except OSError:
            continue
    return ""


def test_the_jobs_of_a_killed_worker_run_again_on_another_one(tmp_path) -> None:
    sweep = start(tmp_path)
    until(lambda: len(running()) == 2)
    os.kill(int(until(lambda: worker_of(running()[0]))), signal.SIGKILL)
    out, _ = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 0, out
    assert "4 of 4 jobs done" in out
    swept = read_sweep(tmp_path / "outputs" / "sweep_debug" / "sweep.json")
    assert [record.status for record in swept.records] == ["converged"] * 4
    until(lambda: not asked("squeue", "--noheader"))


def test_what_slurm_refuses_is_one_line(tmp_path) -> None:
    sweep = start(tmp_path, "hydra.launcher.options={queue: nowhere, walltime: '00:30:00'}")
    out, _ = sweep.communicate(timeout=PATIENCE)
    assert sweep.returncode == 2, out
    assert "nowhere" in out
    assert "Traceback" not in out
