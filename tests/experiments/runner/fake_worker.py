"""The real worker with a study that takes no time and does what files in its folder say.

``kill-SEED``, ``raise-SEED`` and ``full-SEED`` end the job of that seed, once; every run leaves a
line in ``runs``.
"""

import os
import signal
from pathlib import Path

from experiments.runner import job, worker
from experiments.runner.folder import write_failure
from experiments.runner.request import Request


def run(values, config_hash, folder, started):
    seed = values["seed"]
    with Path("runs").open("a") as runs:
        runs.write(f"{seed}\n")
    for name in ("kill", "raise", "full"):
        order = Path(f"{name}-{seed}")
        if not order.exists():
            continue
        order.unlink()
        match name:
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "raise":
                raise RuntimeError("it broke")
            case "full":
                raise OSError(28, "No space left on device", str(folder / "result.json"))
    record = write_failure(Request(values, config_hash, folder), "converged", started)
    print(f"seed {seed}")
    found = {
        "status": "converged",
        "estimate": [6.0 + seed / 10, 2.0],
        "std": [0.1, 0.1],
        "relative_error": [0.01, 0.01],
        "truth_store": "hit",
        "seconds_computing": 0.0,
    }
    record |= found
    return {key: value for key, value in record.items() if key != "repeats"}, []


job.STUDIES["twin"] = job.Study(run, lambda record: "", lambda *_: [], lambda *_: [])

if __name__ == "__main__":
    worker.main()
