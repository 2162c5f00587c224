"""Forty jobs, seven of which die, on each engine: ``python -m tests.benchmark.deaths OUT.json``.

The jobs take no time. Seven kill their process, leave it, raise, take memory without end, hold the
interpreter's lock, run on, or wait for a child that goes on. On each engine these seven have to
fail, each for its own reason; the others have an estimate, and no process is left.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.sweeps.collected import read_sweep
from tests.places import ROOT

DEATHS = {
    3: "kill", 5: "exit", 7: "raise", 9: "hog", 11: "hold", 13: "spin", 15: "spawn",
}  # fmt: skip
"""Seed -> how its job ends."""

ENGINES = {
    "threads": ("hydra.launcher.n_jobs=2",),
    "LocalCluster": ("hydra.launcher.cluster=LocalCluster", "hydra.launcher.jobs=2"),
    "SLURMCluster": (
        "hydra.launcher.cluster=SLURMCluster",
        "hydra.launcher.options={walltime: '00:30:00', memory: 2GB}",
        "hydra.launcher.jobs=2",
    ),
}

FAKE = str(ROOT / "tests" / "experiments" / "runner" / "fake_worker.py")

INSTEAD = f"""
import sys
from experiments.runner import engine
engine.WORKER = (sys.executable, {FAKE!r})
"""

MAIN = "from experiments.run import main; main()"

RUN = (
    "experiment=debug", "seed=range(0,40)", "time_limit_s=5", "memory_limit_gb=0.5",
    "tracking.enabled=false",
)  # fmt: skip


def measure(engine: Sequence[str]) -> dict[str, Any]:
    """One sweep in an empty folder: what failed and why, what is left, and seconds."""
    # Where tasks of Slurm can read it.
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed, death in DEATHS.items():
            (folder / f"{death}-{seed}").touch()
        instead = folder / "instead.py"
        instead.write_text(INSTEAD, encoding="utf-8")
        began = time.monotonic()
        ended = subprocess.run(
            [sys.executable, "-P", "-c", f"{INSTEAD}{MAIN}", "-m", *RUN, *engine],
            cwd=folder,
            env=os.environ
            | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__PRELOAD": f'["{instead}"]'},
            capture_output=True,
            text=True,
            check=False,
        )
        wall = time.monotonic() - began
        swept = folder / "outputs" / "debug" / "sweep.json"
        if not swept.exists():
            raise RuntimeError(ended.stdout + ended.stderr)
        records = read_sweep(swept).records
        time.sleep(2.0)
        left = subprocess.run(
            ["pgrep", "-fc", "sleep 311|fake_worker"], capture_output=True, text=True
        )
        return {
            "jobs": len(records),
            "failed": {
                str(record.factors["seed"]): record.reason
                for record in records
                if not record.converged
            },
            "begun": len((folder / "runs").read_text().split()),
            "processes left": int(left.stdout),
            "wall_s": round(wall, 1),
        }


def main(arguments: Sequence[str]) -> None:
    """Measure all engines that are here, and write."""
    found = {}
    for name, engine in ENGINES.items():
        if name == "SLURMCluster" and shutil.which("sbatch") is None:
            continue
        found[name] = measure(engine)
        print(name, json.dumps(found[name], indent=2), flush=True)
    Path(arguments[0]).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
