"""Everything that is published of a sweep: tidy table, paper-style table, figures, costs.

All of it follows from the collected sweep alone (``results/sweeps/NAME.json``), so that it can be
made again without running anything.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments.sweeps.collected import Sweep, check_sweep
from experiments.sweeps.conclusions import conclusions, question
from experiments.sweeps.noise_figures import calibration_figure, noise_figure
from experiments.sweeps.rows import (
    cost_rows,
    csv_text,
    factor_label,
    factor_names,
    kind_of,
    sweep_line,
    tidy_rows,
)
from experiments.sweeps.setting_figures import (
    cost_figure,
    covariance_figure,
    discrepancy_figure,
    filter_figure,
)
from experiments.sweeps.start_figures import basin_figure, paths_figure
from experiments.sweeps.tables import summary, table_note
from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.provenance import require_sealed
from mvest.reading.json_file import read_mapping
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import latex_rows, latex_text, markdown_rows, markdown_text

__all__ = ["COST", "SWEEPS", "Picture", "pictures_of", "read_sweeps", "write_sweep"]

SWEEPS = "sweeps"
"""Folder of the collected sweeps within the results."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of a sweep: end of its file name, what it shows, and how it is drawn.

    ``draw`` returns None if the sweep holds nothing to draw.
    """

    ending: str
    caption: str
    draw: Callable[[Sweep], Figure | None]


COST = Picture(
    "_cost",
    "Forward solves of each run and seconds of each job, on the machine that ran the sweep.",
    cost_figure,
)
PICTURES: dict[str, tuple[Picture, ...]] = {
    "initial_guess": (
        Picture("", "Largest error of the moduli against the initial guess.", basin_figure),
        Picture("_paths", "Estimates after each iteration, from every start.", paths_figure),
    ),
    "covariance": (
        Picture(
            "",
            "Largest error of a modulus and largest standard deviation that the filter reports, "
            "along each covariance.",
            covariance_figure,
        ),
    ),
    "noise": (
        Picture("", "Error of each modulus against the noise of the observation.", noise_figure),
        Picture(
            "_calibration",
            "How often the filter's intervals contain the truth, against what they promise.",
            calibration_figure,
        ),
    ),
    "discrepancy": (
        Picture(
            "",
            "Signed error of each modulus when the truth differs from the filter's model.",
            discrepancy_figure,
        ),
    ),
    "filter": (Picture("", "Error, coverage and forward solves of each filter.", filter_figure),),
}


def pictures_of(sweep: Sweep) -> tuple[Picture, ...]:
    """The figures that a sweep of this kind may have, its cost last."""
    return (*PICTURES.get(kind_of(sweep), ()), COST)


def read_sweeps(results: Path) -> list[Sweep]:
    """Every published sweep in the order of its file names; none if nothing was published.

    Raises
    ------
    InputError
        If a file cannot be read or is no collected sweep.
    """
    found = []
    for path in sorted((results / SWEEPS).glob("*.json")):
        data = read_mapping(path)
        found.append(check_sweep(data, str(path)))
        require_sealed(data, str(path))
    return found


def write_sweep(results: Path, sweep: Sweep) -> list[Path]:
    """Write the tables and figures of one sweep; returns their paths.

    Parameters
    ----------
    results : Path
        Existing folder; gets ``sweep_NAME.csv`` (one row per run), ``sweep_NAME_table.csv``,
        ``.md`` and ``.tex``, ``sweep_NAME_cost.csv``, and each figure as PNG and PDF.
    sweep : Sweep

    Raises
    ------
    InputError
        If its name is none for a file, or a file cannot be written.
    """
    name = sweep.name
    if not name.replace("_", "").replace("-", "").isalnum():
        raise InputError(f"a sweep's name must be letters, digits, - and _, not {name!r}")
    base = results / f"sweep_{name}"
    return [*_write_tables(base, sweep), *_write_pictures(base, sweep)]


def _write_tables(base: Path, sweep: Sweep) -> list[Path]:
    rows, reading = summary(sweep)
    line = sweep_line(sweep)
    notes = ("simulated", line)
    factors = [factor_label(name) for name in factor_names(sweep)]
    tidy, cost = tidy_rows(sweep), cost_rows(sweep)
    texts = {
        ".csv": _csv(tidy, [*factors, "run", "job", "seed", "status", "reason"], notes),
        "_table.csv": _csv(rows, ["setting"], (*notes, table_note(sweep))),
        "_table.md": _markdown(sweep, reading, line),
        "_table.tex": _latex(sweep, reading, line),
        "_cost.csv": _csv(cost, [*factors, "run", "job"], notes),
    }
    return [write_atomically(base.with_name(base.name + end), text) for end, text in texts.items()]


def _csv(rows: list[dict[str, Any]], otherwise: list[str], notes: tuple[str, ...]) -> str:
    """Columns are those of the rows; a table without rows still has its first columns."""
    return csv_text(rows, list(rows[0]) if rows else otherwise, notes)


def _markdown(sweep: Sweep, reading: list[dict[str, str]], line: str) -> str:
    table = markdown_rows(reading) if reading else "The sweep has no jobs."
    found = "\n".join(f"- {markdown_text(sentence)}" for sentence in conclusions(sweep))
    return (
        f"# {markdown_text(sweep.title)}\n\n{markdown_text(question(sweep))}\n\n{found}\n\n"
        f"{table}\n\n{markdown_text(table_note(sweep))}\n\n<sub>{markdown_text(line)}</sub>\n"
    )


def _latex(sweep: Sweep, reading: list[dict[str, str]], line: str) -> str:
    comments = f"% {' '.join(line.split())}\n% {table_note(sweep)}\n"
    if not reading:
        return f"{comments}% {latex_text(sweep.title)}: the sweep has no jobs.\n"
    return comments + latex_rows(reading)


def _write_pictures(base: Path, sweep: Sweep) -> list[Path]:
    written = []
    for picture in pictures_of(sweep):
        target = base.with_name(base.name + picture.ending)
        figure = picture.draw(sweep)
        if figure is not None:
            written += save_figure_with(target, figure, f"simulated; {sweep_line(sweep)}")
            continue
        # An older sweep's picture would contradict the tables beside it.
        for suffix in (".png", ".pdf"):
            target.with_name(target.name + suffix).unlink(missing_ok=True)
    return written
