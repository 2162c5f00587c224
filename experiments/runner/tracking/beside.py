"""MLflow in a process beside a run: importing it takes seconds, in which the run computes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

from experiments.runner.tracking.upload import REMEDY, is_due, track_job
from mvest.errors import MvestError
from mvest.processes import Program, environment, python

LOGGING = "experiments.runner.tracking.beside"
"""Module that the other process runs."""


@contextmanager
def logging_beside(config: Mapping[str, Any]) -> Iterator[Callable[[Path], None]]:
    """What logs the result in a folder as `track_job` does, and waits until that is done.

    Another process does it, which begins here and ends with this context; where the run is not to
    be logged there is none.

    Parameters
    ----------
    config : mapping
        Of the run.
    """
    if not config["tracking"]["enabled"] or config["check"]:
        yield lambda _: None
        return
    with Program(
        python(LOGGING),
        stdin=PIPE,
        stderr=PIPE,
        text=True,
        encoding="utf-8",
        env=environment(),
    ) as program:
        yield partial(
            _order, program.process, {name: config[name] for name in ("name", "paths", "tracking")}
        )


def _order(process: Popen[str], config: Mapping[str, Any], folder: Path) -> None:
    try:
        if not is_due(folder, config):
            return
    except MvestError as error:
        print(f"warning: {error}; {REMEDY}", file=sys.stderr)
        return
    _, said = process.communicate(json.dumps({"folder": str(folder), "config": config}))
    print(said, end="", file=sys.stderr)
    if process.returncode:
        print(
            f"warning: uploading to MLflow ended with status {process.returncode}; {REMEDY}",
            file=sys.stderr,
        )


def main() -> int:
    """Import MLflow, wait for an order on standard input, and log that run."""
    from experiments.runner.tracking.store import load_client

    load_client()
    order = sys.stdin.read()
    if order:
        read = json.loads(order)
        track_job(Path(read["folder"]), read["config"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
