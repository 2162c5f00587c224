"""MLflow in a process beside a run: importing it takes seconds, in which the run computes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from subprocess import PIPE
from types import TracebackType
from typing import Any

import experiments
from experiments.runner.tracking.upload import REMEDY, is_due, track_job
from mvest.errors import MvestError
from mvest.processes import Program

__all__ = ["Uploader", "main"]

LOGGING = "experiments.runner.tracking.beside"
"""Module that the other process runs."""


class Uploader(AbstractContextManager["Uploader"]):
    """A process that logs one run once it is on disk; as a context it ends with it.

    Parameters
    ----------
    config : mapping
        Of the run; where it is not to be logged, no process is started.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = {name: config[name] for name in ("name", "paths", "tracking")}
        self._program: Program | None = None
        if config["tracking"]["enabled"] and not config["check"]:
            places = [
                str(Path(experiments.__file__).resolve().parents[1]),
                os.environ.get("PYTHONPATH", ""),
            ]
            self._program = Program(
                [sys.executable, "-m", LOGGING],
                stdin=PIPE,
                stderr=PIPE,
                text=True,
                encoding="utf-8",
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places))},
            )

    def track(self, folder: Path) -> None:
        """Log the result in a folder, as `track_job` does, and wait until that is done."""
        if self._program is None:
            return
        try:
            if not is_due(folder, self._config):
                return
        except MvestError as error:
            print(f"warning: {error}; {REMEDY}", file=sys.stderr)
            return
        process = self._program.process
        order = {"folder": str(folder), "config": self._config}
        _, said = process.communicate(json.dumps(order))
        print(said, end="", file=sys.stderr)
        if process.returncode:
            print(
                f"warning: uploading to MLflow ended with status {process.returncode}; {REMEDY}",
                file=sys.stderr,
            )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._program is not None:
            self._program.close()


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
