"""What a sweep costs beside its jobs: ``python -m tests.benchmark.sweep OUT.json [JOBS] [SHARDS]``.

Jobs of a study that takes no time are planned, drained by shards side by side, collected and logged
in an empty folder. Seconds are CPU of all processes together, unless they say otherwise.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.sweeps.collected import read_sweep
from tests.places import ROOT

JOBS, SHARDS = 10_000, 2

WORKER = str(ROOT / "tests" / "experiments" / "runner" / "fake_worker.py")

FOLDER = Path("outputs") / "sweep_debug"

PLAN = """
import sys
from experiments.run import main
sys.argv[1:] = ["sweep=debug", "filter.initial=[5,3]", "detach=true",
                f"sweep.small.seed='range(0,{sys.argv[1]})'"]
sys.exit(main())
"""

DRAIN = """
import sys
from experiments.cli import main
from experiments.runner.execution import guard
guard.WORKER = (sys.executable, sys.argv.pop(1))
sys.exit(main(sys.argv[1:]))
"""


class Spent:
    """CPU and wall seconds of processes side by side, and the memory of the largest one."""

    def __init__(self, folder: Path, commands: Sequence[Sequence[str]]) -> None:
        places = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        began = time.monotonic()
        started = [
            subprocess.Popen(
                [sys.executable, "-c", *command],
                cwd=folder,
                env=os.environ | {"PYTHONPATH": places},
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
            for command in commands
        ]
        ended = [os.wait4(process.pid, 0) for process in started]
        failed = [status for _, status, _ in ended if status]
        if failed:
            raise RuntimeError(f"a process ended with {failed[0]}")
        self.wall = time.monotonic() - began
        self.cpu = sum(usage.ru_utime + usage.ru_stime for _, _, usage in ended)
        self.mib = max(usage.ru_maxrss for _, _, usage in ended) / 1024.0

    def to_json(self) -> dict[str, float]:
        """Plain data."""
        return {"cpu_s": self.cpu, "wall_s": self.wall, "largest_process_mib": self.mib}


def size(*paths: Path) -> float:
    """MiB of files."""
    return sum(path.stat().st_size for path in paths) / 2**20


def measure(folder: Path, jobs: int, shards: int) -> dict[str, object]:
    """Plan, drain and collect a sweep in an empty folder."""
    swept = folder / FOLDER
    planned = Spent(folder, [[PLAN, str(jobs)]])
    plan_mib = size(swept / "plan.json")
    drained = Spent(
        folder,
        [
            [DRAIN, WORKER, "worker", str(FOLDER), "--shard", f"{index}/{shards}"]
            for index in range(1, shards + 1)
        ],
    )
    again = Spent(folder, [[DRAIN, WORKER, "worker", str(FOLDER), "--shard", f"1/{shards}"]])
    collected = Spent(folder, [[DRAIN, WORKER, "collect", str(FOLDER)]])
    found = read_sweep(swept / "sweep.json")
    states = [record.status for record in found.records]
    ran = (folder / "runs").read_text().split()
    if states != ["converged"] * jobs or sorted(map(int, ran)) != list(range(jobs)):
        raise RuntimeError("a job was lost, or done twice")
    overheads = sorted(job.overhead for job in found.jobs if job.overhead is not None)
    results = [path for path in swept.glob("*/*") if path.is_file()]
    return {
        "jobs": jobs,
        "shards": shards,
        "plan": planned.to_json() | {"plan_mib": plan_mib},
        "drain": drained.to_json(),
        "a shard of which all is done": again.to_json(),
        "collect and log": collected.to_json(),
        "cpu_s_per_job": {
            "plan": planned.cpu / jobs,
            "drain": drained.cpu / jobs,
            "collect and log": collected.cpu / jobs,
        },
        "median_wall_s_between_jobs_of_a_shard": overheads[len(overheads) // 2],
        "database_mib": size(folder / "outputs" / "mlflow.db"),
        "table_mib": size(swept / "jobs.parquet"),
        "sweep_json_mib": size(swept / "sweep.json"),
        "files_of_jobs": len(results),
        "files_of_jobs_mib": size(*results),
    }


def main(arguments: Sequence[str]) -> None:
    """Measure and write."""
    out = Path(arguments[0])
    jobs, shards = (int(text) for text in [*arguments[1:], *(JOBS, SHARDS)[len(arguments) - 1 :]])
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), jobs, shards)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main(sys.argv[1:])
