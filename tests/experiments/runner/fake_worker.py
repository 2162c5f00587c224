"""The real worker with a study that takes no time and does what files in its folder say.

``kill-SEED``, ``raise-SEED`` and ``hog-SEED`` end the job of that seed, once. One with
``wait-SEED`` writes its process there and goes on when that is gone.
Every run leaves a line in ``runs``.
"""

import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from experiments.common.study import Result, Study
from experiments.runner import job as worker
from mvest.problem.record import EstimateRecord, Unknown


@dataclass(frozen=True)
class Settings:
    """Nothing."""


def run(job):
    seed = job.values["seed"]
    with Path("runs").open("a") as runs:
        runs.write(f"{seed}\n")
    wait = Path(f"wait-{seed}")
    with suppress(FileNotFoundError), wait.open("r+") as order:  # never made anew
        order.truncate()
        order.write(str(os.getpid()))
    while wait.exists():
        time.sleep(0.02)
    for name in ("kill", "raise", "hog"):
        order = Path(f"{name}-{seed}")
        if not order.exists():
            continue
        order.unlink()
        match name:
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "raise":
                raise RuntimeError("it broke")
            case "hog":
                kept = []
                while True:
                    kept.append(b"x" * 2**24)
    print(f"seed {seed}")
    unknowns = [
        Unknown(name=name, estimate=estimate, std=0.1, truth=truth)
        for name, estimate, truth in (
            ("E_f.anterior", 6.0 + seed / 10, 6.23),
            ("E_f.posterior", 2.0, 2.09),
        )
    ]
    estimate = EstimateRecord(seed=seed, status="converged", reason="", unknowns=tuple(unknowns))
    numbers = {"truth_store": "hit", "seconds_computing": 0.0}
    return Result(estimates=(estimate,), numbers=numbers)


# Instead of the study itself, which imports for seconds.
room = ModuleType("experiments.studies.twin")
room.__dict__["STUDY"] = Study(settings=Settings, run=run, words=lambda record: "")
sys.modules[room.__name__] = room

if __name__ == "__main__":
    worker.main()
