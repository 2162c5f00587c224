"""Tables of the image step on simulated TEE volumes: how far it is off, and what moduli follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from experiments.common.cases.tables import interval_words, write_table
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
    "volume_table",
    "volume_words",
    "write_imaging_tables",
    "write_volume_tables",
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
TRUTH_OF_MODULI: Final = (
    "Moduli estimated from simulated transoesophageal echo (TEE) volumes of simulated valves. The "
    "truth is the modulus with which the valve was simulated; the known geometry is that valve's "
    "own midsurface in every frame, in place of what the image step found. Errors have a sign: "
    "that from known geometry and the part from the images add up to the whole. Nothing here was "
    "measured in patients."
)

SHARE: Final = f"surface below {LIMITS_MM[-1]:g} mm [%]"
AT_LEAST: Final = (SHARE, "valve found [%]")
"""Columns in which more is better."""


# -- the image step -------------------------------------------------------------------------------
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
    table = _checked(rows, wanted, "volumes of the image step")
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
        told = []
        for column, limit in wanted.items():
            if setting not in measured or column not in table.columns:
                raise InputError(
                    f"targets: {setting}, {column}; expected of {', '.join(measured)}, "
                    f"{', '.join(table.columns[2:])}"
                )
            value = float(measured[setting][column])
            more = column in AT_LEAST
            met = value >= limit if more else value <= limit
            told.append(
                f"{column} {number(value)} (target {'≥' if more else '≤'} {number(limit)}: "
                f"{'met' if met else 'missed'})"
            )
        out.append(f"{setting.capitalize()}: " + ", ".join(told) + ".")
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


# -- from volumes to moduli -----------------------------------------------------------------------
def volume_table(rows: Sequence[Row]) -> pd.DataFrame:
    """One row for each patient and modulus E_f estimated from a volume, MPa and %.

    Parameters
    ----------
    rows : sequence of mapping
        ``patient``, ``modulus``, ``truth``, ``estimate``, ``low`` and ``high`` (95 % interval) and
        ``known_geometry`` (the estimate from the true geometry), all MPa; None where an estimation
        found none.

    Raises
    ------
    InputError
        No rows, an entry that is missing, or a truth that is not positive.
    """
    wanted = ("patient", "modulus", "truth", "estimate", "low", "high", "known_geometry")
    table = _checked(rows, wanted, "moduli from volumes")
    numbers = table[list(wanted[2:])].astype(float)
    truth = numbers["truth"]
    if not (truth > 0).all():
        raise InputError(f"moduli from volumes: truth {truth.min()} MPa, expected > 0")
    error = 100.0 * (numbers["estimate"] - truth) / truth
    known = 100.0 * (numbers["known_geometry"] - truth) / truth
    inside = (numbers["low"] <= truth) & (truth <= numbers["high"])
    has_interval = numbers["low"].notna() & numbers["high"].notna()
    return pd.DataFrame(
        {
            "patient": table["patient"],
            "modulus": table["modulus"],
            "truth [MPa]": truth,
            "estimate [MPa]": numbers["estimate"],
            "95 % low [MPa]": numbers["low"],
            "95 % high [MPa]": numbers["high"],
            "inside": inside.astype(object).where(has_interval, None),
            "error [%]": error,
            "error from known geometry [%]": known,
            "part from the images [%]": error - known,
        }
    )


def volume_words(table: pd.DataFrame) -> list[str]:
    """What a table of `volume_table` says, in numbers."""
    known = table[table["inside"].notna()]
    inside = int(known["inside"].astype(bool).sum())
    out = [f"The 95 % interval contains the truth for {inside} of {len(known)} moduli."]
    lost = int(table["estimate [MPa]"].isna().sum())
    if lost:
        out.append(f"For {lost} of {len(table)} moduli no estimate was found.")
    sizes = {
        words: table[column].abs().median()
        for words, column in (
            ("from the volume", "error [%]"),
            ("from the known geometry", "error from known geometry [%]"),
            ("part from the images", "part from the images [%]"),
        )
    }
    told = ", ".join(f"{words} {v:.1f} %" for words, v in sizes.items() if np.isfinite(v))
    if told:
        out.append(f"Median size of the error: {told}.")
    width = (known["95 % high [MPa]"] - known["95 % low [MPa]"]) / known["estimate [MPa]"]
    if len(known):
        out.append(f"Width of the interval over the estimate: median {width.median():.2f}.")
    return out


def write_volume_tables(results: Path, record: Record) -> list[Path]:
    """``volume.*`` from a record with ``rows`` as for `volume_table`.

    Raises
    ------
    InputError
        As `volume_table`, or a file that cannot be written.
    """
    table = volume_table(record["rows"])
    readable = []
    for _, row in table.iterrows():
        readable.append(
            {
                "patient (simulated)": str(row["patient"]).replace("_", " "),
                "modulus": str(row["modulus"]),
                "truth [MPa]": number(row["truth [MPa]"]),
                "estimate, 95 % [MPa]": MISSING
                if pd.isna(row["estimate [MPa]"])
                else interval_words(
                    {
                        "estimate": row["estimate [MPa]"],
                        "low": row["95 % low [MPa]"],
                        "high": row["95 % high [MPa]"],
                        "inside": row["inside"],
                    }
                ),
                **{
                    name: MISSING if pd.isna(row[name]) else f"{row[name]:+.1f}"
                    for name in table.columns[-3:]
                },
            }
        )
    notes = [TRUTH_OF_MODULI, *volume_words(table)]
    return write_table(results / "volume", table, readable, provenance_line(record), notes)


def _checked(rows: Sequence[Row], wanted: Sequence[str], what: str) -> pd.DataFrame:
    if not rows:
        raise InputError(f"{what}: no rows, expected at least one")
    for k, row in enumerate(rows):
        missing = [name for name in wanted if name not in row]
        if missing:
            raise InputError(
                f"{what}: row {k} has no {', '.join(missing)}, expected {', '.join(wanted)}"
            )
    return pd.DataFrame(list(rows))
