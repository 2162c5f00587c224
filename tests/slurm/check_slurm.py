"""A sweep through a real Slurm, with jobs that die hard: ``make slurm-check``.

``setup.sh`` beside this file makes such a Slurm on one host. Nothing of this runs in the other test
commands.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.common.records.record import Record
from experiments.sweeps.collected import read_sweep
from tests.places import ROOT

PATIENCE = 600.0
SWEEP = (
    sys.executable, "-m", "experiments.run", "-m", "sweep=debug", "launcher=slurm",
    "hydra.launcher.mem_gb=2", "hydra.launcher.poll_s=5",
)  # fmt: skip
COLLECT = (sys.executable, "-m", "experiments.cli", "collect", "outputs/sweep_debug")


@pytest.fixture(scope="module", autouse=True)
def slurm() -> None:
    if shutil.which("sbatch") is None or asked("sinfo", "--noheader") == "":
        pytest.fail("no Slurm answers here; tests/slurm/setup.sh starts one on this host")


def asked(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def start(folder: Path, *overrides: str, command=SWEEP) -> subprocess.Popen[str]:
    places = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return subprocess.Popen(
        [*command, *overrides],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": places},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(sweep: subprocess.Popen[str]) -> str:
    out, _ = sweep.communicate(timeout=PATIENCE)
    print(out)
    return out


def until(find) -> str:
    """What ``find`` returns as soon as it is something."""
    stop = time.monotonic() + PATIENCE
    while time.monotonic() < stop:
        if found := find():
            return found
        time.sleep(0.2)
    pytest.fail("waited in vain for Slurm")


def job_process(raw_id: str) -> str:
    """Process of a running job's own Python, as Slurm follows it."""
    for line in asked("scontrol", "listpids", raw_id).splitlines()[1:]:
        pid = line.split()[0]
        try:
            command = Path("/proc", pid, "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"experiments.cli" in command and b"python" in command[0]:
            return pid
    return ""


def rows(folder: Path) -> dict[str, Record]:
    swept = read_sweep(folder / "outputs" / "sweep_debug" / "sweep.json")
    return {job.hash: job.record for job in swept.jobs}


def results(folder: Path) -> dict[str, int]:
    return {
        path.parent.name: path.stat().st_mtime_ns
        for path in (folder / "outputs" / "sweep_debug").glob("*/result.json")
        if (path.parent / "done").exists()
    }


def test_jobs_that_die_cost_their_rows_and_run_again(tmp_path) -> None:
    sweep = start(tmp_path)
    array = until(lambda: asked("squeue", "-h", "-t", "R", "-r", "-o", "%A %F %K").strip())
    raw, array, _ = array.splitlines()[0].split()
    pid = until(lambda: job_process(raw))
    os.kill(int(pid), signal.SIGKILL)
    # The other one that is to die never starts.
    subprocess.run(["scancel", f"{array}_3"], check=True)
    out = end(sweep)
    assert sweep.returncode == 1
    reasons = {row.reason for row in rows(tmp_path).values() if row.status != "converged"}
    assert len(reasons) == 2
    assert any("its process died" in reason for reason in reasons), reasons
    assert any("cancelled" in reason for reason in reasons), reasons
    assert all(f"Slurm job {array}_" in reason and reason in out for reason in reasons)
    done = results(tmp_path)
    assert len(done) == 2

    again = start(tmp_path)
    end(again)
    assert again.returncode == 0
    assert {row.status for row in rows(tmp_path).values()} == {"converged"}
    after = results(tmp_path)
    assert len(after) == 4
    assert {name: after[name] for name in done} == done, "a job that was done ran again"


def test_tasks_of_several_jobs_are_left_to_themselves_and_collected_later(tmp_path) -> None:
    # Eight jobs in four tasks, of which Slurm's limit here allows three in an array.
    several = ("sweep.small.seed='1,2,3,4'", "hydra.launcher.jobs_per_task=2", "detach=true")
    out = end(start(tmp_path, *several))
    arrays = re.search(r"Slurm array (\d+) (\d+): 4 tasks, 8 jobs", out)
    assert arrays, out
    first, second = arrays.groups()
    place = tmp_path / "outputs" / "sweep_debug"
    assert not (place / "sweep.json").exists(), "nobody has waited"
    # Its task dies between its two jobs, or in the second of them.
    folders = [job["folder"] for job in json.loads((place / "plan.json").read_text())["jobs"]]
    until(lambda: (place / folders[0] / "done").exists())
    raw = until(lambda: asked("squeue", "-h", "-r", "-j", f"{first}_1", "-o", "%A").strip())
    os.kill(int(until(lambda: job_process(raw))), signal.SIGKILL)

    early = start(tmp_path, command=COLLECT)
    assert "jobs wait or run in Slurm" in end(early)
    assert early.returncode == 1
    until(lambda: not asked("squeue", "-h", "-j", f"{first},{second}").strip())
    late = start(tmp_path, command=COLLECT)
    out = end(late)
    assert late.returncode == 1
    assert "7 of 8 jobs done, 1 without an estimate" in out
    (lost,) = [row for row in rows(tmp_path).values() if row.status != "converged"]
    assert lost.reason.startswith(f"Slurm job {first}_1: its process died; its output is in ")
    done = results(tmp_path)
    assert folders[0] in done
    assert len(done) == 7

    again = start(tmp_path, *several[:2])
    out = end(again)
    assert "1 tasks, 1 jobs" in out
    assert again.returncode == 0
    after = results(tmp_path)
    assert {name: after[name] for name in done} == done, "a job that was done ran again"
    assert len(after) == 8


def test_a_job_over_its_memory_costs_its_row(tmp_path) -> None:
    # Too little for Python and its libraries. Without cgroups Slurm kills, but calls it a failure.
    sweep = start(tmp_path, "seed=1", "+hydra.launcher.mem=40M", "hydra.launcher.mem_gb=null")
    end(sweep)
    assert sweep.returncode == 1
    found = rows(tmp_path).values()
    assert len(found) == 2
    assert {row.status for row in found} == {"failed"}
    for row in found:
        assert "memory" in row.reason or "its process died" in row.reason, row.reason
        assert Path(row.reason.rsplit(" ", 1)[1]).is_file(), "where to read on"


def test_what_slurm_refuses_is_one_line(tmp_path) -> None:
    sweep = start(tmp_path, "hydra.launcher.partition=nowhere")
    out = end(sweep)
    assert sweep.returncode == 2
    assert "error: Slurm takes no jobs: sbatch: error:" in out
    assert "partition" in out
    assert "Traceback" not in out
