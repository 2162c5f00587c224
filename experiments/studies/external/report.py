"""Parameters of an external model as a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from mvest.files import write_atomically
from mvest.reporting.figures import iterates_figure, save_figure
from mvest.reporting.files import provenance_line
from mvest.reporting.markup import MISSING, markdown_rows, with_std

__all__ = ["external_text", "write_external_tables"]

Record = Mapping[str, Any]


def _rows(record: Record) -> list[dict[str, str]]:
    absent = [None] * len(record["parameters"])
    return [
        {
            "parameter": name,
            "unit": unit or MISSING,
            "prior": with_std(mean, spread),
            "estimate": with_std(estimate, std),
        }
        for name, unit, mean, spread, estimate, std in zip(
            record["parameters"],
            record["units"],
            record["initial"],
            record["prior_std"],
            record["estimate"] or absent,
            record["std"] or absent,
            strict=True,
        )
    ]


def _words(record: Record) -> str:
    """What is to be said below the table."""
    program = record["program"]
    own = program["own_jacobian"]
    lines = [
        record["reason"] + (f" ({record['detail']})" if record["detail"] else "") + ".",
        f"{record['iterations']} iterations, {record['forward_solves']} predictions; the program "
        f"ran {program['runs']} times in {program['seconds']:.3g} s, {program['reused']} finished "
        "runs served again.",
        f"Derivatives: {'of the program' if own else 'differences of its predictions'}.",
    ]
    if record["distance_mm"] is not None:
        distance = record["distance_mm"]
        lines.append(
            f"Distance of the {program['points']} points from where they were observed: mean "
            f"{distance['mean']:.3g} mm, largest {distance['max']:.3g} mm."
        )
    if record["innovation"] is not None:
        low, high = record["innovation"]["nis_band"]
        lines.append(
            f"Innovation in units of what model, prior and noise explain: "
            f"{record['innovation']['nis']:.4g}, expected between {low:.4g} and {high:.4g}."
        )
    return "\n\n".join(lines)


def external_text(record: Record) -> str:
    """Table and words for the terminal."""
    table = pd.DataFrame(_rows(record)).to_string(index=False)
    return f"{table}\n{_words(record).replace(chr(10) * 2, chr(10))}"


def write_external_tables(folder: Path, record: Record) -> list[Path]:
    """``external.csv``, ``external.md`` and the figure of the iterates in ``folder``."""
    rows = _rows(record)
    absent = [None] * len(rows)
    table = pd.DataFrame(
        {
            "parameter": record["parameters"],
            "unit": record["units"],
            "prior_mean": record["initial"],
            "prior_std": record["prior_std"],
            "estimate": record["estimate"] or absent,
            "std": record["std"] or absent,
        }
    )
    text = (
        f"# {record['title']}\n\n{markdown_rows(rows)}\n\n{_words(record)}\n\n"
        f"{provenance_line(record)}\n"
    )
    written = [
        write_atomically(folder / "external.csv", lambda path: table.to_csv(path, index=False)),
        write_atomically(folder / "external.md", text),
    ]
    if record["iterates"]:
        written += save_figure(folder / "iterates", iterates_figure(record), record)
    return written
