"""Tables of the image step on simulated TEE volumes: how far it is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from experiments.common.records.tables import write_table
from experiments.studies.imaging.findings import DetectedVolume, Evaluation
from mvest.errors import InputError
from mvest.reporting.images.figures import LIMITS_MM, SETTINGS
from mvest.reporting.markup import MISSING, number

__all__ = [
    "imaging_table",
    "imaging_words",
    "write_imaging_table",
]

Targets = Mapping[str, Mapping[str, float]]

SIZES: Final = (
    "surface_mm",
    "point_mm",
    "tips_mm",
    "annulus_area_error_percent",
    "ap_error_mm",
    "seconds",
)
"""Of a volume, which the table summarises."""

TRUTH_OF_VALVES: Final = (
    "Simulated transoesophageal echo (TEE) volumes of simulated valves that no training saw. The "
    "truth is the midsurface, with its points of tissue, from which each volume was simulated; "
    "surface distances are means over a volume's frames and points, both ways. In distribution: "
    "drawn as the training volumes were; shifted: outside of their ranges. Nothing here was "
    "measured in patients."
)
SHARE: Final = f"surface below {LIMITS_MM[-1]:g} mm [%]"
AT_LEAST: Final = (SHARE, "valve detected [%]")
"""Columns in which more is better."""


def imaging_table(rows: Sequence[DetectedVolume]) -> pd.DataFrame:
    """One row for each setting that summarises its volumes.

    Sizes of errors are means over the volumes with a valve detected; the shares are of all.

    Raises
    ------
    InputError
        No rows, or another setting.
    """
    if not rows:
        raise InputError("volumes of the image step: no rows, expected at least one")
    table = pd.DataFrame(map(asdict, rows))
    wrong = sorted(set(map(str, table["setting"])) - set(SETTINGS))
    if wrong:
        raise InputError(
            f"volumes of the image step: setting {wrong[0]}, expected {' or '.join(SETTINGS)}"
        )
    summaries = []
    for setting in SETTINGS:
        own = table[table["setting"] == setting]
        if own.empty:
            continue
        values = own[list(SIZES)].astype(float)
        surface = values["surface_mm"]
        summaries.append(
            {
                "setting": setting,
                "volumes": len(own),
                "valve detected [%]": 100.0 * surface.notna().mean(),
                "surface mean [mm]": surface.mean(),
                "surface median [mm]": surface.median(),
                "surface 90 % [mm]": surface.quantile(0.9),
                SHARE: 100.0 * (surface < LIMITS_MM[-1]).mean(),
                "point to point [mm]": values["point_mm"].mean(),
                "papillary tips [mm]": values["tips_mm"].mean(),
                "annulus area error [%]": values["annulus_area_error_percent"].abs().mean(),
                "annulus area bias [%]": values["annulus_area_error_percent"].mean(),
                "AP diameter error [mm]": values["ap_error_mm"].abs().mean(),
                "AP diameter bias [mm]": values["ap_error_mm"].mean(),
                "time per volume [s]": values["seconds"].median(),
            }
        )
    return pd.DataFrame(summaries)


def imaging_words(table: pd.DataFrame, targets: Targets | None = None) -> list[str]:
    """What a table of `imaging_table` says beside its targets.

    These are by setting and column, an upper limit, but a lower one for shares.

    Raises
    ------
    InputError
        A target for a setting or a column that the table does not have.
    """
    out = []
    measured = {row["setting"]: row for _, row in table.iterrows()}
    for setting, wanted in (targets or {}).items():
        compared = []
        for column, limit in wanted.items():
            if setting not in measured or column not in table.columns:
                raise InputError(
                    f"targets: {setting}, {column}; expected of {', '.join(measured)}, "
                    f"{', '.join(table.columns[2:])}"
                )
            value = float(measured[setting][column])
            more = column in AT_LEAST
            met = value >= limit if more else value <= limit
            compared.append(
                f"{column} {number(value)} (target {'≥' if more else '≤'} {number(limit)}: "
                f"{'met' if met else 'missed'})"
            )
        out.append(f"{setting.capitalize()}: " + ", ".join(compared) + ".")
    return out


def write_imaging_table(
    base: Path, tested: Evaluation, targets: Targets, notes: Sequence[str], line: str
) -> list[Path]:
    """Write the table, and below each of its rows the targets, if there are any."""
    table = imaging_table(tested.rows)
    readable = []
    for _, row in table.iterrows():
        own = targets.get(row["setting"], {})
        readable.append({name: _cell(name, row[name]) for name in table.columns})
        if own:
            goal = dict.fromkeys(table.columns, MISSING) | {"setting": "– its target"}
            for name, limit in own.items():
                goal[name] = f"{'≥' if name in AT_LEAST else '≤'} {number(limit)}"
            readable.append(goal)
    said = [TRUTH_OF_VALVES, *imaging_words(table, targets), *notes]
    return write_table(base, table, readable, line, said)


def _cell(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name == "volumes":
        return str(int(value))
    if not np.isfinite(value):
        return MISSING
    return f"{value:.0f}" if name in AT_LEAST else number(value)
