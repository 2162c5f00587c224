"""The study of designs as tables: what each observation would tell, and what it would need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.studies.identifiability.figures import write_identifiability_figures
from mvest.files import write_atomically
from mvest.reporting.expectation import alike_words
from mvest.reporting.files import provenance_line
from mvest.reporting.markup import MISSING, latex_rows, markdown_rows, number

__all__ = [
    "identifiability_frame",
    "identifiability_text",
    "write_identifiability_study",
    "write_identifiability_tables",
]

Record = Mapping[str, Any]
Rows = list[dict[str, str]]

OPEN = "open"
NO_BREAK = "\N{NO-BREAK SPACE}"


def identifiability_frame(record: Record) -> pd.DataFrame:
    """Tidy table: one row for each design, knowledge of the nuisances, and modulus."""
    target = 100 * record["settings"]["target"]
    typical = record["settings"]["typical_mm"]
    rows = []
    for row in record["designs"]:
        told: dict[str, Any] = {
            "frames": row["frames"],
            "number of frames": row["frame_count"],
            "vertices": row["vertices_words"],
            "number of vertices": row["points"],
            "errors": row["errors"],
            "knowledge of the nuisances": row["knowledge"],
            "parameter": row["parameter"],
        }
        for noise, std in row["std"].items():
            told[f"std at {noise} mm [%]"] = None if std is None else 100 * std
        told[f"noise for {target:g} % [mm]"] = row["needed_noise_mm"]
        told[f"observations of {typical:g} mm for {target:g} %"] = row["needed_repeats"]
        rows.append(told)
    return pd.DataFrame(rows)


def _design_rows(record: Record) -> Rows:
    """One row for each design, one column for each knowledge: deviations and the needed noise."""
    typical = f"{record['settings']['typical_mm']:g}"
    key = ("vertices", "errors", "frames")
    found = []
    for (_, errors, frames), group in groupby(
        record["designs"], key=lambda row: tuple(row[k] for k in key)
    ):
        rows = list(group)
        told = {
            "vertices": f"{rows[0]['vertices_words']} ({rows[0]['points']})",
            "errors": errors,
            "frames": frames,
        }
        for knowledge, same in groupby(rows, key=lambda row: row["knowledge"]):
            moduli = list(same)
            stds = " / ".join(_percent(row["std"][typical]) for row in moduli)
            needed = min(_or_any(row["needed_noise_mm"]) for row in moduli)
            told[knowledge] = f"{stds} ({_noise(needed)})"
        found.append(told)
    return found


def _percent(std: float | None) -> str:
    return MISSING if std is None else number(100 * std, 2)


def _or_any(noise: float | None) -> float:
    return np.inf if noise is None else noise


def _noise(value: float) -> str:
    if np.isinf(value):
        return "any"
    return "no noise" if value == 0.0 else number(value, 2)


def _profile_rows(record: Record) -> Rows:
    rows = []
    for found in record["profiles"]:
        at = found["parameters"].index(found["parameter"])
        values = [point[at] for point in found["path"]]
        rows.append(
            {
                "observed": found["label"],
                "parameter": found["parameter"],
                "95 % interval": f"{_end(found['low'])} to {_end(found['high'])}",
                "followed from": f"{number(values[0], 4)} to {number(values[-1], 4)}",
                "identifiable": "yes"
                if found["low"] is not None and found["high"] is not None
                else "NO: " + _why_open(found),
            }
        )
    return rows


def _end(value: float | None) -> str:
    return OPEN if value is None else number(value, 4)


def _why_open(found: Mapping[str, Any]) -> str:
    ends = zip((found["low"], found["high"]), ("below", "above"), found["ends"], strict=True)
    return "; ".join(f"{side}, {end}" for value, side, end in ends if value is None)


def _pressure_rows(record: Record) -> Rows:
    """How well the pressure must be known, with all vertices."""
    rows = []
    for found in record["pressure"]:
        if found["vertices"] != "all" or not found["needed"]:
            continue
        row = {"frames": found["frames"], "errors": found["errors"]}
        for name, needed in found["needed"].items():
            row[name] = _knowledge(needed)
        rows.append(row)
    return rows


def _knowledge(needed: float | None) -> str:
    if needed is None:
        return "need not be known"
    return "not even if known exactly" if needed == 0.0 else f"to {100 * needed:.2g} %"


def _alike(record: Record) -> list[str]:
    """Sentences on what all vertices, with independent errors, hardly tell apart."""
    lines = []
    for found in record["ellipses"]:
        if found["errors"] != "independent":
            continue
        words = [alike_words(group) for group in found["confounded"]]
        told = " ".join(words) or "The data tell all parameters apart."
        lines.append(f"* {found['frames'][0].upper()}{found['frames'][1:]}: {told}")
    return lines


def _readable(record: Record) -> list[str]:
    told = record["settings"]
    target, typical = f"{100 * told['target']:g} %", f"{told['typical_mm']:g} mm"
    moduli = [name for name in record["parameters"] if name.startswith("E_f.")]
    lines = [
        f"Cramér-Rao bounds at the assumed values ({_assumed(record)}), from one run of the model "
        f"for each set of frames. Each cell: relative standard deviation of "
        f"{' / '.join(moduli)} [%] at {typical} of noise in each coordinate, and in parentheses "
        f"the noise [mm] at which the worse of them would be known to {target} (“no noise”: not "
        f"even without noise). {_known_words(told['knowledge'])} The open frame is the model's "
        f"shape at rest, which no parameter changes, so it adds nothing. N independent "
        f"observations averaged have the noise divided by √N. Simulated.",
        "",
        markdown_rows(_design_rows(record)),
        "",
        "## What makes up for what",
        "",
        f"All vertices, independent errors of {typical}, "
        f"{_listed_known(told['known'])}, nothing known of the other nuisances:",
        "",
        *_alike(record),
        "",
    ]
    pressures = _pressure_rows(record)
    if pressures:
        lines += [
            "## How well the pressure must be known",
            "",
            f"Relative standard deviation of the pressure beforehand with which a modulus is known "
            f"to {target} ({typical}, all vertices; rest length and chordal stiffness as in “"
            f"{told['believed']}”):",
            "",
            markdown_rows(pressures),
            "",
        ]
    profiles = _profile_rows(record)
    if profiles:
        lines += [
            "## How far the valleys go",
            "",
            f"Profile likelihoods of the noise-free observation, weighed as if with independent "
            f"errors of {typical}, {_listed_known(told['known'])}. An interval is open where the "
            f"profile does not reach the threshold as far as it was followed.",
            "",
            markdown_rows(profiles),
        ]
    return lines


def _assumed(record: Record) -> str:
    return ", ".join(
        f"{name} {number(value)}"
        for name, value in zip(record["parameters"], record["assumed"], strict=True)
    )


def _known_words(knowledge: Mapping[str, Mapping[str, float]]) -> str:
    half = {
        words: {name: std for name, std in stds.items() if std > 0}
        for words, stds in knowledge.items()
    }
    told = [
        f"“{words}”: " + ", ".join(f"{name} to {100 * std:g} %" for name, std in stds.items())
        for words, stds in half.items()
        if stds
    ]
    return "; ".join(told) + "." if told else ""


def _listed_known(known: Sequence[str]) -> str:
    return f"{', '.join(known)} known" if known else "nothing known beforehand"


def identifiability_text(record: Record) -> str:
    """The tables for the terminal."""
    if not record.get("designs"):
        return f"{record['title']}: {record['reason']}"
    designs = pd.DataFrame(_design_rows(record)).to_string(index=False)
    profiles = pd.DataFrame(_profile_rows(record)).to_string(index=False)
    return f"{designs}\n\n{profiles}"


def write_identifiability_tables(folder: Path, record: Record) -> list[Path]:
    """``identifiability.csv``, ``.md`` and ``.tex`` in ``folder``; none of a failed run."""
    if not record.get("designs"):
        return []
    line = provenance_line(record)
    csv = f"# {line}\n" + identifiability_frame(record).to_csv(index=False)
    text = "\n".join([f"# {record['title']}", "", *_readable(record), "", f"<sub>{line}</sub>", ""])
    tex = f"% {line}\n{latex_rows(_design_rows(record))}"
    return [
        write_atomically(folder / "identifiability.csv", csv),
        write_atomically(folder / "identifiability.md", text),
        write_atomically(folder / "identifiability.tex", tex),
    ]


def write_identifiability_study(folder: Path, record: Record) -> list[Path]:
    """Tables and figures."""
    return [
        *write_identifiability_tables(folder, record),
        *write_identifiability_figures(folder, record),
    ]
