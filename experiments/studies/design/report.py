"""The study of frames and pressures as tables, words and a figure; medians over patients."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.common.records.report import heading
from experiments.studies.design.findings import Findings, Tried
from mvest.files import write_atomically
from mvest.personalisation.design import ERRORS_MMHG, HALF, KIND_WORDS
from mvest.reporting.figures import save_figure_with
from mvest.reporting.style import SMALL, headline, panels

__all__ = ["design_answer", "design_figure", "design_table", "design_words", "write_design"]

Records = Mapping[str, Record[Findings]]

SHADES = ("#00204C", "#31446B", "#666870", "#A69D75", "#E3C85B")
"""From exact pressures to the worst."""


def design_table(records: Records) -> pd.DataFrame:
    """One row for each patient, design and modulus."""
    return pd.DataFrame(
        [
            {
                "patient": record.row,
                "geometry": "considered" if row.geometry else "exact",
                "errors": row.kind,
                "error_mmHg": row.mmhg,
                "frames": row.frames,
                "known": row.known,
                "modulus": modulus,
                "left": share,
            }
            for record in records.values()
            for row in record.findings.left
            for modulus, share in zip(record.findings.moduli, row.shares, strict=True)
        ]
    )


def _tried(records: Records) -> list[tuple[str, Tried]]:
    return [(record.row, row) for record in records.values() for row in record.findings.tried]


def _median(table: pd.DataFrame, count: int, chosen: Mapping[str, object]) -> float:
    """Of what is left, over patients and moduli of a design."""
    for column, value in {"frames": count, **chosen}.items():
        table = table[table[column] == value]
    return float(table["left"].median())


def design_answer(records: Records) -> str:
    """What frames do against each kind of error of the pressures."""
    table = design_table(records)
    largest = max(row.frames for record in records.values() for row in record.findings.left)

    def from_to(kind: str, geometry: str = "exact", mmhg: float = 0.0) -> str:
        own = {"geometry": geometry, "errors": kind, "known": "", "error_mmHg": mmhg}
        return " to ".join(f"{100 * _median(table, count, own):.0f}" for count in (1, largest))

    worst = ERRORS_MMHG[-1]
    said = (
        f"From one closed frame to {largest}, what is left of the generic guess's error goes from "
        f"{from_to('each')} % with exact pressures, {from_to('each', mmhg=worst)} % where each is "
        f"off by {worst:g} mmHg, {from_to('offset', mmhg=worst)} % where all have such an offset, "
        f"and {from_to('factor', mmhg=worst)} % where a factor on all of them is as uncertain: "
        "frames do not tell it, only the chordae's prior and the moduli's hold it"
    )
    if (table["geometry"] == "considered").any():
        said += (
            f". With a geometry that is itself in doubt, {from_to('stated', 'considered')} % with "
            "pressures as stated"
        )
    tried = [
        f"{100 * error:.0f} ({100 * predicted:.0f}) with {corner}"
        for corner, (predicted, _, error, _) in _deviations(records).items()
        if predicted is not None and error is not None
    ]
    if tried:
        said += (
            ". Tried, the root mean square error in percent of the prior's deviation, and what was "
            f"predicted: {', '.join(tried)}"
        )
    return said + "."


def design_words(records: Records) -> str:
    """Markdown of the tables and the words around them."""
    table = design_table(records)
    counts = sorted(map(int, table["frames"].unique()))
    lines = [
        f"**{design_answer(records)}**",
        "",
        f"What is left of the generic guess's error, in percent of it (median over {len(records)} "
        f"valves and both moduli; {100 * HALF:.0f}: half of it). Errors of pressures are of one "
        "kind at a time.",
    ]
    for geometry in table["geometry"].unique():
        lines += [
            "",
            f"Geometry {geometry}:",
            "",
            "| errors of the pressures | "
            + " | ".join(f"{n} frame{'s' * (n > 1)}" for n in counts)
            + " |",
            "|---" * (1 + len(counts)) + "|",
        ]
        own = table[table["geometry"] == geometry]
        rows: list[tuple[str, dict[str, object]]] = [
            ("as stated", {"errors": "stated", "known": ""})
        ]
        rows += [
            (f"as stated, {known} known", {"errors": "stated", "known": known})
            for known in own["known"].unique()
            if known
        ]
        rows += [
            (f"{mmhg:g} mmHg {words}", {"errors": kind, "error_mmHg": mmhg, "known": ""})
            for kind, words in KIND_WORDS.items()
            for mmhg in ERRORS_MMHG
        ]
        for label, chosen in rows:
            cells = (f"{100 * _median(own, n, chosen):.0f}" for n in counts)
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, *_tried_words(records)])


def _tried_words(records: Records) -> list[str]:
    tried = _tried(records)
    if not tried:
        return []
    lines = [
        "",
        "Some designs tried: the patient is simulated with errors of pressures, chordae, "
        "displacement and image as stated, and estimated. Percent of the prior's standard "
        "deviation (of logarithms).",
        "",
        "| design | patient | modulus | predicted SD | reported SD | error | generic guess |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in tried:
        cells = map(_cell, (row.predicted, row.reported, row.error, row.generic))
        modulus = row.modulus.partition(".")[2]
        lines.append(f"| {row.corner} | {name} | {modulus} | {' | '.join(cells)} |")
    lines += [
        "",
        "| design | predicted SD | reported SD | root mean square error | that of the guess |",
        "|---|---|---|---|---|",
    ]
    for corner, rms in _deviations(records).items():
        lines.append(f"| {corner} | {' | '.join(map(_cell, rms))} |")
    return lines


def _deviations(records: Records) -> dict[str, list[float | None]]:
    """Root mean squares over what was tried: predicted, reported, achieved, and of the guess."""
    tried, found = [row for _, row in _tried(records)], {}
    for corner in dict.fromkeys(row.corner for row in tried):
        own = [row for row in tried if row.corner == corner and row.error is not None]
        columns = [
            [value for row in own if (value := getattr(row, name)) is not None]
            for name in ("predicted", "reported", "error", "generic")
        ]
        found[corner] = [float(np.sqrt(np.mean(np.square(c)))) if c else None for c in columns]
    return found


def _cell(share: float | None) -> str:
    return "no estimate" if share is None else f"{100 * share:.0f}"


def design_figure(records: Records) -> Figure:
    """What is left against the number of frames: a panel for each kind of error and geometry."""
    table = design_table(records)
    geometries = list(table["geometry"].unique())
    figure, axes = panels(len(geometries), 3, 2.5 * len(geometries) + 1.1, sharex=True, sharey=True)
    counts = sorted(map(int, table["frames"].unique()))
    for row, geometry in enumerate(geometries):
        for column, (kind, words) in enumerate(KIND_WORDS.items()):
            one = axes[row, column]
            for mmhg, shade in zip(ERRORS_MMHG, SHADES, strict=True):
                chosen: dict[str, object] = {
                    "geometry": geometry,
                    "errors": kind,
                    "error_mmHg": mmhg,
                    "known": "",
                }
                left = [100 * _median(table, n, chosen) for n in counts]
                one.plot(counts, left, color=shade, marker="o", ms=3.5, label=f"{mmhg:g} mmHg")
            one.axhline(100 * HALF, color="0.5", lw=0.9, ls="--")
            one.set_ylim(0, None)
            one.set_xticks(counts)
            if row == 0:
                one.set_title(f"error {words}", fontsize=SMALL + 0.5, loc="left")
            if row == len(geometries) - 1:
                one.set_xlabel("closed frames")
        axes[row, 0].set_ylabel(f"left of the guess's error (%)\ngeometry {geometry}")
    axes[-1, -1].legend(
        fontsize=SMALL - 1, frameon=False, title="SD", title_fontsize=SMALL - 1, loc="best", ncols=2
    )
    headline(
        figure,
        "More frames cure an offset and errors of each pressure, not a factor on all",
        "What is left of the generic guess's error of the moduli, 120 to 60 mmHg; dashed: half. "
        "Simulated.",
    )
    return figure


def write_design(folder: Path, records: Records, _arrays: Mapping[str, Path]) -> list[Path]:
    """Write table, words and figure of all patients together.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    whole = {name: record for name, record in records.items() if record.findings.left}
    if not whole:
        return []
    first = next(iter(whole.values()))
    base = folder / first.table
    table = design_table(whole)
    lines = "  \n".join(f"{name}: {record.line}" for name, record in whole.items())
    text = f"{heading(*whole.values())}{design_words(whole)}\n\n{lines}\n"
    return [
        write_atomically(base.with_suffix(".csv"), lambda path: table.to_csv(path, index=False)),
        write_atomically(base.with_suffix(".md"), text),
        *save_figure_with(base, design_figure(whole), first.line),
    ]
