"""What it takes until something can begin: help, the list of experiments, the imports of a job.

``python -m tests.benchmark.startup OUT.json`` starts each in a process of its own with warm caches,
and keeps the least CPU seconds of some, its children included, and its heaviest imports.
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

from experiments.common.study import study_names

ROUNDS, HEAVIEST = 5, 4

STARTS = {
    "mvest list": ["-m", "experiments.cli", "list"],
    "mvest run --help": ["-m", "experiments.cli", "run", "--help"],
    "import mvest, a filter": ["-c", "import mvest; mvest.IteratedFilter"],
    "import mvest, a closure": ["-c", "import mvest; mvest.ClosureModel"],
} | {
    f"imports of a job, {name}": [
        "-c",
        f"import experiments.runner.job, experiments.studies.{name}.study",
    ]
    for name in study_names()
}


def cpu_seconds(arguments: list[str]) -> float:
    """CPU seconds of one process with Python."""

    def spent() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = spent()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return spent() - before


def heaviest(arguments: list[str]) -> str:
    """Packages of others whose modules took longest by themselves, with their milliseconds."""
    report = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ).stderr
    spent: dict[str, float] = {}
    for own, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)", report):
        package = name.split(".")[0].lstrip("_")
        if package not in sys.stdlib_module_names and f"_{package}" not in sys.stdlib_module_names:
            spent[package] = spent.get(package, 0.0) + 1e-3 * int(own)
    first = sorted(spent, key=lambda package: -spent[package])[:HEAVIEST]
    return ", ".join(f"{package} {spent[package]:.0f}" for package in first)


def main(target: Path) -> None:
    """Measure all and write them."""
    os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[2])
    rows = [
        {
            "start": name,
            "seconds": min(cpu_seconds(arguments) for _ in range(ROUNDS)),
            "heaviest imports [ms]": heaviest(arguments),
        }
        for name, arguments in STARTS.items()
    ]
    target.write_text(json.dumps({"startup": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
