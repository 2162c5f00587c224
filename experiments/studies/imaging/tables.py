"""Tables of the image step on simulated TEE volumes: how far it is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from experiments.common.tables import checked_rows, write_table
from mvest.errors import InputError
from mvest.reporting.figures import save_figure
from mvest.reporting.files import provenance_line
from mvest.reporting.images.figures import (
    LIMITS_MM,
    SETTINGS,
    distance_figure,
    training_figure,
)
from mvest.reporting.markup import MISSING, number

__all__ = [
    "imaging_table",
    "imaging_words",
    "write_imaging_tables",
]

Record = Mapping[str, Any]
Row = Mapping[str, Any]

TRUTH_OF_VALVES: Final = (
    "Simulated transoesophageal echo (TEE) volumes of simulated valves that no training saw. The "
    "truth is the midsurface, with its points of tissue, from which each volume was simulated; "
    "surface distances are means over a volume's frames and points, both ways. In distribution: "
    "drawn as the training volumes were; shifted: outside of their ranges. Nothing here was "
    "measured in patients."
)
SHARE: Final = f"surface below {LIMITS_MM[-1]:g} mm [%]"
AT_LEAST: Final = (SHARE, "valve found [%]")
"""Columns in which more is better."""


def imaging_table(rows: Sequence[Row]) -> pd.DataFrame:
    """One row for each setting that summarises its volumes.

    Parameters
    ----------
    rows : sequence of mapping
        For each volume: ``setting`` (see `SETTINGS`), ``surface_mm`` (mean surface distance),
        ``point_mm`` (mean distance of the same points of tissue), ``tips_mm`` (mean error of the
        papillary tips), ``annulus_area_error_percent`` and ``ap_error_mm`` (with sign), and
        ``seconds``. All but the setting and the seconds are None where no valve was found.

    Returns
    -------
    DataFrame
        Sizes of errors are means over the volumes with a valve found; the shares are of all.

    Raises
    ------
    InputError
        No rows, an entry that is missing, or another setting.
    """
    wanted = (
        "setting",
        "surface_mm",
        "point_mm",
        "tips_mm",
        "annulus_area_error_percent",
        "ap_error_mm",
        "seconds",
    )
    table = checked_rows(rows, wanted, "volumes of the image step")
    wrong = sorted(set(map(str, table["setting"])) - set(SETTINGS))
    if wrong:
        raise InputError(
            f"volumes of the image step: setting {wrong[0]}, expected {' or '.join(SETTINGS)}"
        )
    found = []
    for setting in SETTINGS:
        own = table[table["setting"] == setting]
        if own.empty:
            continue
        values = {name: own[name].astype(float) for name in wanted[1:]}
        surface = values["surface_mm"]
        found.append(
            {
                "setting": setting,
                "volumes": len(own),
                "valve found [%]": 100.0 * surface.notna().mean(),
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
    return pd.DataFrame(found)


def imaging_words(
    table: pd.DataFrame, targets: Mapping[str, Mapping[str, float]] | None = None
) -> list[str]:
    """What a table of `imaging_table` says beside its targets.

    Parameters
    ----------
    table : DataFrame
    targets : mapping, optional
        Setting -> column of the table -> value; an upper limit, but a lower one for shares.

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


def write_imaging_tables(results: Path, record: Record) -> list[Path]:
    """``imaging.*`` (table), ``imaging_distance.*`` and, if there are, ``imaging_training.*``.

    Parameters
    ----------
    results : Path
    record : mapping
        ``rows`` as for `imaging_table`, ``targets`` as for `imaging_words` (may be missing),
        ``training`` rows as for `training_figure` (may be missing), ``notes`` (sentences, may be
        missing), ``experiment`` and ``provenance``.

    Raises
    ------
    InputError
        As `imaging_table` and `imaging_words`, or a file that cannot be written.
    """
    table = imaging_table(record["rows"])
    targets = record.get("targets") or {}
    readable = []
    for _, row in table.iterrows():
        own = targets.get(row["setting"], {})
        readable.append({name: _cell(name, row[name]) for name in table.columns})
        if own:
            goal = dict.fromkeys(table.columns, MISSING) | {"setting": "– its target"}
            for name, limit in own.items():
                goal[name] = f"{'≥' if name in AT_LEAST else '≤'} {number(limit)}"
            readable.append(goal)
    notes = [TRUTH_OF_VALVES, *imaging_words(table, targets), *record.get("notes", ())]
    line = provenance_line(record)
    written = write_table(results / "imaging", table, readable, line, notes)
    figure = distance_figure(record["rows"])
    written += save_figure(results / "imaging_distance", figure, record)
    if record.get("training"):
        figure = training_figure(pd.DataFrame(list(record["training"])))
        written += save_figure(results / "imaging_training", figure, record)
    return written


def _cell(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name == "volumes":
        return str(int(value))
    if not np.isfinite(value):
        return MISSING
    return f"{value:.0f}" if name in AT_LEAST else number(value)
