"""Thickness, fibres and chordae of a case, as given or as derived."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mvest.cases.case import Frame, Role
from mvest.cases.checks import check_chordae, check_thickness
from mvest.cases.chord_layout import (
    CLOSED_DEPTH,
    SEEN_ON_BAND,
    LeafletBand,
    assumed_closure,
    lay_out_chordae,
)
from mvest.cases.frames import MM_PER, ReferenceFrame, SeenFrame
from mvest.cases.rims import Rims
from mvest.cases.schema import CaseFolder, ChordaeEntry, PointData
from mvest.errors import GeometryError, InputError
from mvest.reading.text import indices, numbers, read_columns
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.valve import Chordae, LeafletSurface
from mvest.valve.geometry.surface_coordinates import surface_coordinates

CHORD_COLUMNS = ("tip", "x", "y", "z", "family", "rest_length_mm", "stiffness_n")
GENERIC_THICKNESS = {"anterior": 1.32, "posterior": 1.26}
"""mm, the method paper's values (ISBI 2013)."""


def read_leaflets(folder: CaseFolder, reference: ReferenceFrame) -> LeafletSurface:
    """The midsurface of the reference frame; what was not given is added to ``derived``."""
    seen, names = reference.seen, tuple(folder.document.region_names().values())
    n = len(seen.vertices)
    shape = seen.vertices, seen.triangles, reference.region, names
    bare = LeafletSurface(*shape, np.tile([1.0, 0.0, 0.0], (n, 1)), np.ones(n))
    with folder.at("thickness"):
        thickness = _thickness(folder, seen, names, bare.vertex_region)
        check_thickness(thickness)
    with folder.at("fibre"):
        fibre = _fibre(folder, reference)
    return LeafletSurface(*shape, fibre, thickness)


def _thickness(
    folder: CaseFolder, seen: SeenFrame, names: tuple[str, ...], vertex_region: IntArray
) -> FloatArray:
    given = folder.document.thickness
    if isinstance(given, PointData):
        return MM_PER[folder.document.units.length] * point_data(seen, given.point_data, 1)[:, 0]
    if isinstance(given, float):
        return np.full(len(seen.vertices), given)
    by_name: Mapping[str, float] = GENERIC_THICKNESS if given is None else given
    missing = [name for name in names if name not in by_name]
    if missing:
        raise InputError(f"none for the region {', '.join(missing)}; give one in mm")
    unknown = [name for name in by_name if name not in names]
    if given is None:
        listed = ", ".join(f"{by_name[name]:g} mm ({name})" for name in names)
        folder.derived.append(f"thickness: {listed} assumed")
    elif unknown:
        raise InputError(f"unknown region {unknown[0]!r}; known are {', '.join(names)}")
    return np.array([by_name[name] for name in names])[vertex_region]


def _fibre(folder: CaseFolder, reference: ReferenceFrame) -> FloatArray:
    seen, rims = reference.seen, reference.rims
    if folder.document.fibre is not None:
        return point_data(seen, folder.document.fibre, 3)
    folder.derived.append(
        "fibre: circumferential, perpendicular to the gradient from annulus to free edge"
    )
    return surface_coordinates(
        seen.vertices, seen.triangles, rims.annulus, rims.free_edge
    ).circumferential


def point_data(seen: SeenFrame, name: str, components: int) -> FloatArray:
    """Finite point data ``(n, components)`` of the reference surface."""
    if name not in seen.point_data:
        listed = ", ".join(sorted(seen.point_data)) or "none"
        raise InputError(
            f"the reference surface has no point data {name!r}; found {listed} (only .vtp, .vtu, "
            ".vtk and .ply hold any)"
        )
    values = np.asarray(seen.point_data[name], dtype=np.float64).reshape(len(seen.vertices), -1)
    if values.shape[1] != components:
        raise InputError(
            f"point data {name!r} has {values.shape[1]} components, expected {components}"
        )
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise GeometryError(f"point data {name!r} is not finite at vertices {bad[:5].tolist()}")
    return values


def read_chordae(
    folder: CaseFolder, reference: ReferenceFrame, placed: list[tuple[Frame, Rims]]
) -> Chordae:
    """The chordae of the table, or those laid out; then this is added to ``derived``."""
    given = folder.document.chordae
    if given is None:
        with folder.at("chordae"):
            return _laid_out(folder, reference, placed)
    entry = given if isinstance(given, ChordaeEntry) else ChordaeEntry(file=given)  # type: ignore[call-arg]
    file = folder.file(entry.file, "chordae")
    with folder.at("chordae"):
        chordae = _chord_table(file, entry, MM_PER[folder.document.units.length])
        check_chordae(chordae, reference.seen.vertices, len(reference.seen.tips))
    if isinstance(given, str):
        folder.derived.append(f"chordae: toe strain {entry.toe_strain:g} assumed")
    return chordae


def _chord_table(file: Path, entry: ChordaeEntry, scale: float) -> Chordae:
    columns = read_columns(file, CHORD_COLUMNS)
    names = entry.families or list(dict.fromkeys(columns["family"]))
    for row, name in enumerate(columns["family"]):
        if name not in names:
            raise InputError(
                f"{file}: family of row {row} is {name!r}; known are {', '.join(names)}"
            )
    measured = ("x", "y", "z", "rest_length_mm", "stiffness_n")
    values = {name: numbers(file, name, columns[name]) for name in measured}
    return Chordae(
        tip=indices(file, "tip", columns["tip"]),
        insertion=scale * np.column_stack([values[name] for name in ("x", "y", "z")]),
        family=np.array([names.index(name) for name in columns["family"]], dtype=np.int64),
        family_names=tuple(names),
        rest_length=values["rest_length_mm"],
        axial_stiffness=values["stiffness_n"],
        toe_strain=entry.toe_strain,
    )


def _laid_out(
    folder: CaseFolder, reference: ReferenceFrame, placed: list[tuple[Frame, Rims]]
) -> Chordae:
    names = list(folder.document.region_names().values())
    seen = reference.seen
    if len(names) != 2 or "anterior" not in names or len(seen.tips) != 2:
        raise InputError(
            f"missing; it can be left out only for two regions, one of them named anterior, and "
            f"two papillary tips (here: {', '.join(names)}; {len(seen.tips)} tips)"
        )

    def band(x: FloatArray, triangles: IntArray, region: IntArray, rims: Rims) -> LeafletBand:
        loops = rims.annulus, rims.free_edge
        return LeafletBand.of(x, triangles, region, *loops, names.index("anterior"))

    opened = band(seen.vertices, seen.triangles, reference.region, reference.rims)
    seen_closed = [p for p in placed if p[0].role is Role.CLOSED]
    closed, rims = seen_closed[0] if seen_closed else placed[0]
    goal: LeafletBand | FloatArray
    if not seen_closed:
        how = (
            "an assumed closure: the free edges meet half-way between where they are open, at "
            f"{CLOSED_DEPTH:g} of their depth below the annulus"
        )
        goal = assumed_closure(opened, closed.annulus, closed.papillary_tips)
    elif closed.corresponds:
        how, goal = "the closed frame (through its vertices)", closed.vertices
    else:
        how = "the closed frame (through the same material coordinates in it)"
        goal = band(closed.vertices, closed.triangles, closed.region, rims)
    layout = SEEN_ON_BAND if seen_closed else ChordLayout()
    chordae = lay_out_chordae(opened, seen.tips, goal, closed.papillary_tips, layout)
    folder.derived.append(
        f"chordae: {len(chordae)} laid out as in the template, each to its nearer papillary tip, "
        f"rest lengths from {how}"
    )
    return chordae
