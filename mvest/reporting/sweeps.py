"""Tables of sweeps: one row for each run, failures included with their reason."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvest.reporting.files import write_text

__all__ = ["write_sweep"]


def write_sweep(results: Path, sweep: Mapping[str, Any]) -> list[Path]:
    """Write ``sweep_NAME.csv``, one row for each seed of each job.

    Parameters
    ----------
    results : Path
    sweep : mapping
        The contents of a ``sweep.json``.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    names = list(sweep["parameters"])
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    kinds = ("estimate", "std", "relative_error")
    columns = [f"{kind}.{name}" for kind in kinds for name in names]
    table.writerow(["hash", "row", "factors", "seed", "status", "reason", *columns])
    for job in sweep["jobs"]:
        factors = json.dumps(job["factors"], sort_keys=True)
        lost = {"seed": None, "status": job["status"], "reason": job["reason"]}
        for run in job["runs"] or [lost]:
            numbers = [v for kind in kinds for v in run.get(kind) or [None] * len(names)]
            about = [job["hash"], job["row"], factors, run["seed"], run["status"], run["reason"]]
            table.writerow([*about, *numbers])
    return [write_text(results / f"sweep_{sweep['sweep']['name']}.csv", text.getvalue())]
