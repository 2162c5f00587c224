"""Measures of a valve from images in every frame, and its files for ParaView and 3D Slicer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.surfaces import Surface, region_arrays, write_surface_series
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import (
    ANNULUS_LABELS,
    TIPS,
    ValveSequence,
    landmarks,
    slicerheart_labels,
)
from mvest.reading.text import write_columns
from mvest.valve.measure.clinical import clinical_measurements, clinical_names

Row: TypeAlias = dict[str, float | None]

OPEN_SHARE = 0.1
"""A valve counts as open if its orifice is at least this share of the annulus area.

The orifice of severe regurgitation, 40 mm² (Zoghbi et al. 2017, J. Am. Soc. Echocardiogr. 30:303),
is half of that in an annulus of 800 mm².
"""

CLOSED_ONLY = ("tenting_", "prolapse_", "billow_")
"""Prefixes of the measures that are defined for closed leaflets only."""


def measure_sequence(sequence: ValveSequence, thickness_mm: float) -> list[Row]:
    """Measure a valve with leaflets of this thickness (mm) in every frame.

    Leaflets touch if their midsurfaces are nearer than ``contact_distance_mm``: their thickness,
    plus the standard deviation of the distance of two points with the median ``std_mm`` (nothing if
    that was never measured).

    InputError if the thickness is not a positive number.

    Returns the same names for each frame: ``frame`` (from 0), ``time_s``,
    ``confidence`` (0 to 1), ``vertex_confidence_mean``, ``contact_distance_mm`` and those of
    `mvest.valve.measure.clinical`. None stands for what cannot be measured: everything in a frame
    without a valve (confidence 0) or with points that are not finite, and tenting, prolapse and
    billowing of an open valve (`OPEN_SHARE`).
    """
    if not (np.isfinite(thickness_mm) and thickness_mm > 0):
        raise InputError(f"thickness_mm = {thickness_mm}, expected a finite number > 0")
    layout, std = sequence.layout, sequence.std_mm[np.isfinite(sequence.std_mm)]
    reach = float(thickness_mm + (np.sqrt(2.0) * np.median(std) if len(std) else 0.0))
    rows = []
    for t, time in enumerate(sequence.times):
        x, tips, confidence = sequence.vertices[t], sequence.tips[t], sequence.frame_confidence[t]
        row: Row = {
            "frame": t,
            "time_s": float(time),
            "confidence": finite_or_none(confidence),
            "vertex_confidence_mean": finite_or_none(sequence.vertex_confidence[t].mean()),
            "contact_distance_mm": reach,
        }
        row |= dict.fromkeys(clinical_names(layout.region_names, TIPS))
        if np.isfinite(x).all() and np.isfinite(tips).all() and confidence > 0:
            annulus = x[layout.annulus]
            measured = clinical_measurements(x, layout, annulus, tips, reach, tip_names=TIPS)
            hidden = CLOSED_ONLY if is_open(measured) else ()
            for name, value in measured.items():
                if not name.startswith(hidden):
                    row[name] = finite_or_none(value)
        rows.append(row)
    return rows


def is_open(measures: Mapping[str, float | None]) -> bool:
    """Whether a valve of these measures is open, or not known to be closed."""
    orifice, area = measures.get("orifice_mm2"), measures.get("annulus_area_mm2")
    return orifice is None or area is None or orifice >= OPEN_SHARE * area


def finite_or_none(value: Any) -> float | None:
    """A finite number, otherwise None."""
    return float(value) if value is not None and np.isfinite(value) else None


def closed_frame(rows: Sequence[Row]) -> int | None:
    """Frame in which the leaflets touch over the largest area.

    If they touch in none, the one with the smallest orifice; None if no frame has either.
    """
    known = [row for row in rows if row["coaptation_area_mm2"] is not None]
    known = [row for row in known if row["orifice_mm2"] is not None]
    if not known:
        return None
    best = min(known, key=lambda row: (-(row["coaptation_area_mm2"] or 0.0), row["orifice_mm2"]))
    return int(best["frame"] or 0)


# -- files ----------------------------------------------------------------------------------------
def write_measures(folder: Path, rows: Sequence[Row]) -> Path:
    """Write ``measures.csv`` to an existing folder and return its path.

    It has one row per frame, units in the names of its columns, and an empty cell for None.
    InputError if the file cannot be written.
    """
    cells = [["" if row[key] is None else f"{row[key]:.7g}" for key in rows[0]] for row in rows]
    return write_atomically(
        folder / "measures.csv", lambda file: write_columns(file, list(rows[0]), cells)
    )


def write_surfaces(folder: Path, sequence: ValveSequence) -> Path:
    """Write the valve of every frame for ParaView and 3D Slicer; returns the index ``valve.pvd``.

    ``valve_0000.vtp``, ... hold the midsurface in LPS mm with ``confidence`` and ``std_mm`` (NaN
    if it was never measured) at its points and ``region`` in its triangles. InputError if a point
    is not finite or a file cannot be written.
    """
    layout, std = sequence.layout, sequence.std_mm
    cells = region_arrays(layout.region, layout.region_names)
    states = [
        Surface(x, layout.triangles, {"confidence": confidence, "std_mm": std}, cells)
        for x, confidence in zip(sequence.vertices, sequence.vertex_confidence, strict=True)
    ]
    return write_surface_series(folder / "valve.pvd", sequence.times.tolist(), states)


def write_landmarks(path: Path, valve: ValveSequence, frame: int) -> Path:
    """Write the named points of one frame as markups of 3D Slicer (``.mrk.json``).

    The lists are ``landmarks`` (`mvest.imaging.valve_sequence`), ``annulus`` and ``free edge`` as
    closed curves, which begin at phi = 0, and SlicerHeart's labels of the annulus. InputError if
    there is no such frame, a point is not finite, or the file cannot be written.
    """
    named = landmarks(valve, frame)
    down = valve.tips[frame].mean(axis=0) - valve.annulus[frame].mean(axis=0)
    half = valve.annulus.shape[1] // 2
    labels = slicerheart_labels(valve.annulus[frame], half, down)
    return write_markups(
        path,
        {
            "landmarks": PointList(tuple(named), np.stack(list(named.values()))),
            "annulus": PointList.numbered("annulus", valve.annulus[frame], "ClosedCurve"),
            "free edge": PointList.numbered("edge", valve.free_edge[frame], "ClosedCurve"),
            ANNULUS_LABELS: PointList(tuple(labels), np.stack(list(labels.values()))),
        },
    )
