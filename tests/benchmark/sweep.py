"""What a sweep costs beside its jobs: ``python -m tests.benchmark.sweep OUT.json [JOBS]``.

Jobs of a study that takes no time are run by the threads of one command in an empty folder, which
is then given again, when nothing is left to do. Seconds and memory are those of the command itself,
without the processes that run the jobs, unless they say otherwise.
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
from typing import Any

from experiments.sweeps.collected import read_sweep
from tests.places import ROOT

JOBS = 10_000

WORKER = str(ROOT / "tests" / "experiments" / "runner" / "fake_worker.py")

RUN = """
import json, resource, sys
from pathlib import Path
from experiments.run import main
from experiments.runner import engine
fake, seeds = sys.argv[1:]
engine.WORKER = (sys.executable, fake)
sys.argv[1:] = ["-m", "experiment=debug", f"seed=range(0,{seeds})", "hydra.launcher.n_jobs=2"]
status = main()
used = resource.getrusage(resource.RUSAGE_SELF)
Path("used").write_text(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0]))
sys.exit(status)
"""


def spent(folder: Path, jobs: int) -> dict[str, float]:
    """CPU and wall seconds and the largest memory of a sweep in a folder."""
    began = time.monotonic()
    subprocess.run(
        [sys.executable, "-P", "-c", RUN, WORKER, str(jobs)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    wall = time.monotonic() - began
    cpu, mib = json.loads((folder / "used").read_text(encoding="utf-8"))
    return {"cpu_s": cpu, "cpu_ms_a_job": 1e3 * cpu / jobs, "wall_s": wall, "largest_mib": mib}


def measure(folder: Path, jobs: int) -> dict[str, Any]:
    """Run a sweep twice in an empty folder."""
    swept = folder / "outputs" / "debug"
    run, again = spent(folder, jobs), spent(folder, jobs)
    states = [record.status for record in read_sweep(swept / "sweep.json").records]
    ran = (folder / "runs").read_text(encoding="utf-8").split()
    if states != ["converged"] * jobs or sorted(map(int, ran)) != list(range(jobs)):
        raise RuntimeError("a job was lost, or done twice")
    return {"jobs": jobs, "run": run, "again, when all is done": again}


def main(arguments: Sequence[str]) -> None:
    """Measure and write."""
    out = Path(arguments[0])
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), int(arguments[1]) if arguments[1:] else JOBS)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main(sys.argv[1:])
