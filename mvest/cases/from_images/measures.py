"""Measures of a valve from images in every frame, and the tables that hold them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import TIPS, ValveSequence
from mvest.reading.text import write_columns
from mvest.valve.measure.clinical import (
    clinical_meaning,
    clinical_measurements,
    clinical_names,
)

Row: TypeAlias = dict[str, float | None]

OPEN_SHARE = 0.1
"""Share of the annulus area from which on an orifice counts as that of an open valve.

The orifice of severe regurgitation, 40 mm² (Zoghbi et al. 2017, J. Am. Soc. Echocardiogr. 30:303),
is half of that in an annulus of 800 mm².
"""

CLOSED_ONLY = ("tenting_", "prolapse_", "billow_")
"""What is defined for closed leaflets only, by the beginning of its name."""

BOUNDS = {"low": "lower bound", "high": "upper bound"}
"""Endings of names of what bounds a measure."""

_OWN = {
    "frame": ("", "number of the frame from 0 on"),
    "time_s": ("s", "time of the frame"),
    "confidence": ("", "how sure the image step is of this frame, 0 (no valve) to 1"),
    "vertex_confidence_mean": ("", "mean over the leaflets' points of their confidence, 0 to 1"),
    "contact_distance_mm": ("mm", "distance of midsurfaces up to which leaflets count as touching"),
}


def contact_distance(sequence: ValveSequence, thickness_mm: float) -> float:
    """Distance (mm) of midsurfaces up to which leaflets from images count as touching.

    Their thickness, and one standard deviation of the distance of two points that are each wrong
    by the median of ``std_mm``; the thickness alone where that was never measured.
    """
    if not (np.isfinite(thickness_mm) and thickness_mm > 0):
        raise InputError(f"thickness_mm = {thickness_mm}, expected a finite number > 0")
    known = sequence.std_mm[np.isfinite(sequence.std_mm)]
    return float(thickness_mm + (np.sqrt(2.0) * np.median(known) if len(known) else 0.0))


def measure_sequence(sequence: ValveSequence, thickness_mm: float) -> list[Row]:
    """Measure a valve in every frame.

    Parameters
    ----------
    sequence : ValveSequence
    thickness_mm : float
        Of the leaflets.

    Returns
    -------
    list of dict
        For each frame the same names, which `measure_meaning` explains. None is what the shape
        defies: everything in a frame without a valve (confidence 0) or with points that are not
        finite numbers, and tenting, prolapse and billowing of an open valve (`OPEN_SHARE`).

    Raises
    ------
    InputError
        The thickness is no positive number.
    """
    reach = contact_distance(sequence, thickness_mm)
    layout = sequence.layout
    names = clinical_names(layout.region_names, TIPS)
    rows = []
    for t, time in enumerate(sequence.times):
        row: Row = {
            "frame": t,
            "time_s": float(time),
            "confidence": _finite(sequence.frame_confidence[t]),
            "vertex_confidence_mean": _finite(sequence.vertex_confidence[t].mean()),
            "contact_distance_mm": reach,
        }
        measured = _measured(sequence, t, reach)
        rows.append(row | {name: _finite(measured.get(name)) for name in names})
    return rows


def _measured(sequence: ValveSequence, t: int, reach: float) -> Mapping[str, float | None]:
    x, tips = sequence.vertices[t], sequence.tips[t]
    if not (np.isfinite(x).all() and np.isfinite(tips).all() and sequence.frame_confidence[t] > 0):
        return {}
    layout = sequence.layout
    measures = clinical_measurements(x, layout, x[layout.annulus], tips, reach, tip_names=TIPS)
    if is_open(measures):
        return {name: v for name, v in measures.items() if not name.startswith(CLOSED_ONLY)}
    return measures


def is_open(measures: Mapping[str, float | None]) -> bool:
    """Whether a valve of these measures is open, as it is called where they tell nothing."""
    orifice, area = measures.get("orifice_mm2"), measures.get("annulus_area_mm2")
    return orifice is None or area is None or orifice >= OPEN_SHARE * area


def _finite(value: Any) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


def closed_frame(rows: Sequence[Row]) -> int | None:
    """Frame in which the leaflets touch over the largest area, of the measures of all frames.

    Where they touch in none the one with the smallest orifice; None if no frame has either. The
    orifice alone would take leaflets for closed that only overlap in the line of sight.
    """
    known = [row for row in rows if row["coaptation_area_mm2"] is not None]
    known = [row for row in known if row["orifice_mm2"] is not None]
    if not known:
        return None
    best = min(known, key=lambda row: (-(row["coaptation_area_mm2"] or 0.0), row["orifice_mm2"]))
    return int(best["frame"] or 0)


def measure_meaning(name: str) -> tuple[str, str]:
    """Unit (empty for pure numbers) and meaning of an entry of `measure_sequence`.

    Or of a bound of one (`mvest.cases.from_images.detector_errors`).
    """
    for end, words in BOUNDS.items():
        if name.endswith(f"_{end}"):
            unit, meaning = measure_meaning(name.removesuffix(f"_{end}"))
            return unit, f"{words} of the 95 % band of: {meaning}"
    return _OWN[name] if name in _OWN else clinical_meaning(name)


def write_measures(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """Write the measures of every frame; returns the paths.

    ``measures.csv`` has one row per frame, the units in its columns, an empty cell for what could
    not be measured; ``measures.json`` the same (null), with unit and meaning of every name.

    Parameters
    ----------
    folder : Path
        Exists.
    rows : sequence of dict
        From `measure_sequence`.

    Raises
    ------
    InputError
        No rows, or a file that cannot be written.
    """
    if not rows:
        raise InputError(f"{folder}: no frames to write, expected at least one")
    table, document = folder / "measures.csv", folder / "measures.json"

    cells = [["" if row[key] is None else f"{row[key]:.7g}" for key in rows[0]] for row in rows]
    meanings = {
        key: dict(zip(("unit", "meaning"), measure_meaning(key), strict=True)) for key in rows[0]
    }
    text = json.dumps({"measures": meanings, "frames": list(rows)}, indent=1, allow_nan=False)
    return [
        write_atomically(table, lambda file: write_columns(file, list(rows[0]), cells)),
        write_atomically(document, text + "\n"),
    ]
