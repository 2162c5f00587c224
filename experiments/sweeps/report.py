"""Files of a published sweep: tidy runs, statistics by setting, figures.

They follow from the collected sweep alone (``results/sweeps/NAME.json``), so they can be made again
without running anything.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from experiments.common.records.writer import LONGEST, write_page
from experiments.sweeps.collected import Sweep
from experiments.sweeps.runs import by_setting, runs_of, shortened
from mvest.errors import InputError

CAPTIONS = {
    "": "Errors and intervals along each factor.",
    "matrix": "Errors over two factors.",
}
"""End of the file name of a figure -> its caption."""


SHOWN = ("setting", "parameter", "runs", "failed", "estimate", "median error", "largest error")
"""Columns of the table by settings that a terminal has room for."""


def text_of(sweep: Sweep) -> str:
    """The table of a sweep for a terminal: what was estimated in each setting, and how well."""
    # Imports for a second.
    from pandas import DataFrame

    table = by_setting(sweep)
    if len(table) > LONGEST:
        return f"{len(table)} settings and parameters: too many for a terminal"
    shown = {name: table.values[name] for name in (*SHOWN, "SD over runs")}
    return str(DataFrame(replace(table, values=shown).readable()).to_string(index=False))


def write_sweep(results: Path, sweep: Sweep) -> list[Path]:
    """Write the tables and figures of one sweep; returns their paths.

    Parameters
    ----------
    results : Path
        Existing folder; gets ``sweep_NAME.csv`` (a row for each run), ``sweep_NAME_table.csv`` and
        ``.tex`` (a row for each setting), the page ``sweep_NAME.md`` and figures.
    sweep : Sweep

    Raises
    ------
    InputError
        If its name is none for a file, or a file cannot be written.
    """
    if not re.fullmatch(r"[\w-]+", sweep.name):
        raise InputError(f"a sweep's name must be letters, digits, - and _, not {sweep.name!r}")
    from experiments.sweeps.figures import figures_of

    base, drawn = results / f"sweep_{sweep.name}", figures_of(sweep)
    for part in CAPTIONS.keys() - drawn:
        name = f"{base.name}_{part}" if part else base.name
        if (older := base.with_name(f"{name}.png")).is_file():
            older.unlink()  # it would contradict the tables
    return write_page(
        base,
        sweep.title,
        {"": shortened(runs_of(sweep))},
        {"table": shortened(by_setting(sweep))},
        sweep.records,
        figures=drawn,
        captions=CAPTIONS,
        latex=(f"{base.name}_table",),
    )
