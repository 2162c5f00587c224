"""This code beside another commit, in turns on one machine: ratios of CPU time.

``python -m tests.benchmark.beside COMMIT [--only NAME ...] [--rounds 3]``

Each round runs every measurement once by either code, in a process of its own with one thread, so
that whatever else the machine does strikes both. What is measured is written here once and runs by
both; it may use only what both have. The smallest time of the rounds counts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
ONE_THREAD = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
}
OF_A_SWEEP = ("publish=false", "figures=false")
FARTHER = [1.3, 1 / 1.3]


def _valve(size: str) -> tuple[Any, Any]:
    from tests.benchmark import valves

    valves.CELLS.setdefault(("hex18", "default"), (54, 6))
    return valves.model("hex18", size).fresh(), valves.VALUES


def cold(size: str) -> float:
    """A closure from the open valve with derivatives by two moduli, guided; compiled before."""
    valve, values = _valve(size)
    valve.close(values * 1.01)
    at = valve
    while at is not None:
        at._closed = None
        at = at.guide
    return _seconds(lambda: valve.close(values))


def continued(size: str) -> float:
    """A closure with other moduli, by 30 % each, from a closed state with its derivatives."""
    valve, values = _valve(size)
    valve.close(values)
    valve.continuation, start = True, valve.closed
    valve.close(values * FARTHER)
    valve.restart(start)
    return _seconds(lambda: valve.close(values * FARTHER))


def _seconds(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def command(*overrides: str) -> float:
    """A command from its start to its end, after one like it that fills caches and stores."""
    with tempfile.TemporaryDirectory() as folder:
        call = [sys.executable, "-m", "experiments.run", f"paths.outputs={folder}/outputs"]
        call.append(f"paths.results={folder}/results")
        subprocess.run([*call, *overrides], check=True, capture_output=True)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*call, *overrides, "force=true"], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


MEASURED: dict[str, Callable[[], float]] = {
    "cold, default mesh": lambda: cold("default"),
    "continued by 30 %, default mesh": lambda: continued("default"),
    "cold, 7 k nodes": lambda: cold("7k"),
    "cold, 25 k nodes": lambda: cold("25k"),
    "Table 1, command to end": lambda: command("experiment=table1"),
    "job of a sweep": lambda: command(
        "experiment=table1",
        *OF_A_SWEEP,
        "filter=iterated",
        "filter.initial=[4.1,2.7]",
    ),
}


def main() -> None:
    """Measure by both codes in turns, and print and write the ratios."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("commit")
    options.add_argument("--only", nargs="+", choices=list(MEASURED), default=list(MEASURED))
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--out", type=Path)
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "--quiet", other, given.commit], check=True)
        try:
            seconds = _both({"then": other, "now": ROOT}, given.only, given.rounds)
        finally:
            subprocess.run([*git, "remove", "--force", other], check=True)
    rows = [
        {"measured": name, **{code: min(values[name]) for code, values in seconds.items()}}
        for name in given.only
    ]
    for row in rows:
        row["ratio"] = row["now"] / row["then"]
        print("{measured:34s} {then:8.2f} s -> {now:8.2f} s  ratio {ratio:.2f}".format(**row))
    if given.out:
        given.out.write_text(json.dumps({"commit": given.commit, "rows": rows}, indent=1) + "\n")


def _both(codes: dict[str, Path], names: list[str], rounds: int) -> dict[str, dict[str, list]]:
    seconds: dict[str, dict[str, list]] = {code: {name: [] for name in names} for code in codes}
    for k in range(rounds):
        for name in names:
            for code, root in codes.items():
                environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(root)}
                done = subprocess.run(
                    [sys.executable, __file__, "--measure", name],
                    cwd=root,
                    env=environment,
                    check=True,
                    text=True,
                    stdout=subprocess.PIPE,
                )
                seconds[code][name].append(float(done.stdout.splitlines()[-1]))
                print(f"round {k + 1}, {name}, {code}: {seconds[code][name][-1]:.2f} s", flush=True)
    return seconds


if __name__ == "__main__":
    if sys.argv[1] == "--measure":
        # This folder must not hide the modules of the code that is measured.
        sys.path.pop(0)
        print(MEASURED[sys.argv[2]]())
    else:
        main()
