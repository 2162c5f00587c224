"""The real worker with a study that takes no time and does what files in its folder say.

``kill-SEED``, ``raise-SEED``, ``hog-SEED`` and ``full-SEED`` end the job of that seed, once; one
with ``wait-SEED`` goes on when that is gone. Every run leaves a line in ``runs``.
"""

import os
import signal
import sys
import time
from pathlib import Path
from types import ModuleType

from experiments.common.records.record import Outcome
from experiments.common.study import Study
from experiments.runner.execution import worker
from experiments.studies.twin.settings import Settings


def run(job):
    seed = job.values["seed"]
    with Path("runs").open("a") as runs:
        runs.write(f"{seed}\n")
    while Path(f"wait-{seed}").exists():
        time.sleep(0.02)
    for name in ("kill", "raise", "hog", "full"):
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
            case "full":
                raise OSError(28, "No space left on device", str(job.folder / "result.json"))
    print(f"seed {seed}")
    return Outcome(
        findings={
            "status": "converged",
            "estimate": [6.0 + seed / 10, 2.0],
            "std": [0.1, 0.1],
            "relative_error": [0.01, 0.01],
            "truth_store": "hit",
            "seconds_computing": 0.0,
        }
    )


# Instead of the room's own module, which imports for seconds.
room = ModuleType("experiments.studies.twin.study")
room.__dict__["STUDY"] = Study(
    settings=Settings,
    findings=dict,
    run=run,
    words=lambda record: "",
    write=lambda folder, records, arrays: [],
)
sys.modules[room.__name__] = room

if __name__ == "__main__":
    worker.main()
