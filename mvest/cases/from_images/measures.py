"""Measures of a valve from images in every frame, and its files for ParaView and 3D Slicer."""

from __future__ import annotations

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
"""Share of the annulus area from which on an orifice counts as that of an open valve.

The orifice of severe regurgitation, 40 mm² (Zoghbi et al. 2017, J. Am. Soc. Echocardiogr. 30:303),
is half of that in an annulus of 800 mm².
"""

CLOSED_ONLY = ("tenting_", "prolapse_", "billow_")
"""Beginnings of the names of measures that are defined for closed leaflets only."""


def contact_distance(sequence: ValveSequence, thickness_mm: float) -> float:
    """Distance (mm) of midsurfaces up to which leaflets from images count as touching.

    Their thickness, plus the standard deviation of the distance of two points with the median
    ``std_mm``; the thickness alone if that was never measured.

    Raises
    ------
    InputError
        The thickness is no positive number.
    """
    if not (np.isfinite(thickness_mm) and thickness_mm > 0):
        raise InputError(f"thickness_mm = {thickness_mm}, expected a finite number > 0")
    known = sequence.std_mm[np.isfinite(sequence.std_mm)]
    return float(thickness_mm + (np.sqrt(2.0) * np.median(known) if len(known) else 0.0))


def measure_sequence(sequence: ValveSequence, thickness_mm: float) -> list[Row]:
    """Measure a valve with leaflets of this thickness (mm) in every frame.

    Returns
    -------
    list of dict
        The same names for each frame: ``frame`` (from 0 on), ``time_s``, ``confidence`` (0 to 1),
        ``vertex_confidence_mean``, ``contact_distance_mm`` and those of
        `mvest.valve.measure.clinical`. None is what cannot be measured: everything in a frame
        without a valve (confidence 0) or with points that are not finite, and tenting, prolapse
        and billowing of an open valve (`OPEN_SHARE`).

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
            "confidence": finite_or_none(sequence.frame_confidence[t]),
            "vertex_confidence_mean": finite_or_none(sequence.vertex_confidence[t].mean()),
            "contact_distance_mm": reach,
        }
        measured = _measured(sequence, t, reach)
        rows.append(row | {name: finite_or_none(measured.get(name)) for name in names})
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
    """Whether a valve of these measures is open, or not known to be closed."""
    orifice, area = measures.get("orifice_mm2"), measures.get("annulus_area_mm2")
    return orifice is None or area is None or orifice >= OPEN_SHARE * area


def finite_or_none(value: Any) -> float | None:
    """A number, or None for what is none."""
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
    """Write ``measures.csv`` to an existing folder; returns its path.

    It has one row per frame, with units in the names of its columns and an empty cell for what
    could not be measured.

    Raises
    ------
    InputError
        No rows, or a file that cannot be written.
    """
    if not rows:
        raise InputError(f"{folder}: no frames to write, expected at least one")
    cells = [["" if row[key] is None else f"{row[key]:.7g}" for key in rows[0]] for row in rows]
    return write_atomically(
        folder / "measures.csv", lambda file: write_columns(file, list(rows[0]), cells)
    )


def write_surfaces(folder: Path, sequence: ValveSequence) -> Path:
    """Write the valve of every frame for ParaView and 3D Slicer; returns the index ``valve.pvd``.

    ``valve_0000.vtp``, ... hold the midsurface in LPS mm with ``confidence`` and ``std_mm`` (NaN
    where it was never measured) at its points and ``region`` in its triangles.

    Raises
    ------
    InputError
        A point that is not finite, or a file that cannot be written.
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

    The lists are ``landmarks`` (see `mvest.imaging.layout`), ``annulus`` and ``free edge`` as
    closed curves, which begin at phi = 0, and SlicerHeart's labels of the annulus.

    Raises
    ------
    InputError
        No such frame, a point that is not finite, another extension, or a file that cannot be
        written.
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
