"""One frame of a case: its files read and checked, its annulus matched to the reference frame's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.cases.case import Frame, Role
from mvest.cases.checks import (
    check_annulus_size,
    check_band,
    check_no_handle,
    check_normals,
    check_tips,
    ventricular_side,
)
from mvest.cases.rims import Rims, find_rims, match_annulus, two_loops, without_ears
from mvest.cases.schema import CaseFolder, FrameEntry
from mvest.errors import InputError
from mvest.exchange.surfaces import Surface, read_regions
from mvest.reading.text import read_numbers, read_vertices
from mvest.typing import FloatArray, IntArray

MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
SECONDS_PER = {"s": 1.0, "ms": 1e-3}
POINT_COLUMNS = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """One entry of ``frames`` with its files read; lengths in mm, all else as in `Frame`.

    Loops are vertex numbers ``(k,)``, points ``(k, 3)`` mm, or None where they were not given.
    ``ears`` are the triangles whose inner edge was turned (`mvest.cases.rims`).
    """

    entry: FrameEntry
    where: str
    vertices: FloatArray
    triangles: IntArray
    ears: IntArray
    region: IntArray | None
    point_data: Mapping[str, NDArray[np.generic]]
    annulus: FloatArray | IntArray | None
    free_edge: FloatArray | IntArray | None
    tips: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFrame:
    """The reference frame after its checks.

    ``side`` is that of `mvest.cases.checks.ventricular_side`.
    """

    seen: SeenFrame
    region: IntArray
    rims: Rims
    side: float


def read_frame(folder: CaseFolder, number: int) -> SeenFrame:
    """Read the files of one entry of ``frames``; what they hold is not yet checked."""
    entry, where = folder.document.frames[number], f"frames.{number}"
    scale = MM_PER[folder.document.units.length]
    surface = _read_surface(folder, entry, where)
    tips = scale * np.array(entry.papillary_tips, dtype=np.float64)
    triangles, ears = without_ears(surface.triangles)
    return SeenFrame(
        entry,
        where,
        scale * surface.vertices,
        triangles,
        ears,
        surface.region,
        surface.point_data,
        _read_curve(folder, entry.annulus, f"{where}.annulus", scale),
        _read_curve(folder, entry.free_edge, f"{where}.free_edge", scale),
        tips,
    )


def _read_surface(folder: CaseFolder, entry: FrameEntry, where: str) -> Surface:
    where = f"{where}.surface"
    files: Path | dict[str, Path]
    if isinstance(entry.surface, str):
        files = folder.file(entry.surface, where)
    else:
        files = {name: folder.file(file, f"{where}.{name}") for name, file in entry.surface.items()}
    with folder.at(where):
        return read_regions(files, folder.document.region_names())


def _read_curve(
    folder: CaseFolder, given: str | list[int] | None, where: str, scale: float
) -> FloatArray | IntArray | None:
    """Vertex numbers ``(k,)`` or points ``(k, 3)`` mm, as the table's header says."""
    if given is None:
        return None
    if isinstance(given, list):
        return np.array(given, dtype=np.int64)
    file = folder.file(given, where)
    with folder.at(where):
        if file.suffix.lower() != ".csv":
            raise InputError(f"{given}: extension {file.suffix!r}, expected .csv")
        with file.open("rb") as stream:
            by_number = stream.readline().strip().removeprefix(b"\xef\xbb\xbf") == b"vertex"
        if by_number:
            return read_vertices(file)
        points = scale * read_numbers(file, POINT_COLUMNS)
        if len(points) < 3:
            raise InputError(f"{given}: {len(points)} points, expected three or more of a curve")
        return points


def check_reference(folder: CaseFolder, seen: SeenFrame) -> ReferenceFrame:
    """The reference frame with its loops, or the first thing that is wrong with it."""
    for name, given in (("annulus", seen.annulus), ("free_edge", seen.free_edge)):
        if given is not None and given.ndim != 1:
            what = "holds points; expected vertex numbers of the reference surface"
            raise folder.wrong(f"{seen.where}.{name}", what)
    region, rims = _band(folder, seen, self_intersections=True)
    if seen.annulus is None or seen.free_edge is None:
        folder.derived.append(
            "annulus and free edge: the two boundary loops of the reference surface"
            + ("" if seen.annulus is not None else ", the free edge nearer to the papillary tips")
        )
    annulus = seen.vertices[rims.annulus]
    side = ventricular_side(annulus, seen.vertices[rims.free_edge])
    _check_place(folder, seen, annulus, rims, side, "surface")
    return ReferenceFrame(seen, region, rims, side)


def _band(
    folder: CaseFolder, seen: SeenFrame, *, self_intersections: bool
) -> tuple[IntArray, Rims]:
    """Regions and loops of a frame that is checked to be a band."""
    with folder.at(f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=self_intersections)
        two_loops(seen.vertices, seen.triangles)
        check_no_handle(seen.vertices, seen.triangles)
        if seen.region is None:
            raise InputError(
                "leaflets without labels; expected cell data 'region', OBJ groups with the names "
                "of the regions, or one file for every region"
            )
    numbers = (
        loop.astype(np.int64) if loop is not None and loop.ndim == 1 else None
        for loop in (seen.annulus, seen.free_edge)
    )
    with folder.at(seen.where):
        rims = find_rims(seen.vertices, seen.triangles, seen.tips, *numbers)
    if len(seen.ears):
        folder.derived.append(
            f"surface of frame {seen.entry.name!r}: inner edge turned of triangles "
            f"{seen.ears[:5].tolist()} ({len(seen.ears)} in all), which had all three corners on "
            "one edge of the valve"
        )
    return seen.region, rims


def _check_place(
    folder: CaseFolder, seen: SeenFrame, annulus: FloatArray, rims: Rims, side: float, field: str
) -> None:
    """Raise unless annulus, tips and triangles lie to each other as in a valve."""
    with folder.at(f"{seen.where}.{field}"):
        check_annulus_size(annulus)
    with folder.at(f"{seen.where}.papillary_tips"):
        check_tips(annulus, side, seen.tips)
    with folder.at(f"{seen.where}.surface"):
        check_normals(seen.vertices, seen.triangles, rims.annulus, seen.tips)


def place_frame(
    folder: CaseFolder, reference: ReferenceFrame, seen: SeenFrame, pressure_mmhg: float
) -> tuple[Frame, Rims]:
    """A frame with its annulus and free edge where they are, and its loops."""
    first = reference.seen
    corresponds = _corresponds(folder, first, seen)
    rims, region = reference.rims, reference.region
    if seen is not first and corresponds:
        _check_alike(folder, seen, reference)
    elif seen is not first:
        region, rims = _band(folder, seen, self_intersections=False)
        with folder.at(f"{seen.where}.surface"):
            check_annulus_size(seen.vertices[rims.annulus])
            check_normals(seen.vertices, seen.triangles, rims.annulus, seen.tips)
    annulus = _frame_annulus(folder, reference, seen, rims, region, corresponds)
    _check_place(folder, seen, annulus, rims, reference.side, "annulus")
    edge = seen.free_edge
    if edge is None or edge.ndim == 1:
        edge = seen.vertices[rims.free_edge]
    frame = Frame(
        name=seen.entry.name,
        time=SECONDS_PER[folder.document.units.time] * seen.entry.time,
        role=Role(seen.entry.role),
        pressure_mmHg=pressure_mmhg,
        vertices=seen.vertices,
        triangles=seen.triangles,
        region=region,
        annulus=annulus,
        free_edge=np.asarray(edge, dtype=np.float64),
        papillary_tips=seen.tips,
        corresponds=corresponds,
    )
    return frame, rims


def _check_alike(folder: CaseFolder, seen: SeenFrame, reference: ReferenceFrame) -> None:
    """Raise unless a corresponding frame is in good order and has the reference's labels."""
    region, rims = reference.region, reference.rims
    with folder.at(f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=False)
        if seen.region is not None and not np.array_equal(seen.region, region):
            odd = np.flatnonzero(seen.region != region)
            raise InputError(
                f"triangles {odd[:5].tolist()} ({len(odd)} in all) belong to another region than "
                "in the reference frame, to which they correspond"
            )
    given = {"annulus": (seen.annulus, rims.annulus), "free_edge": (seen.free_edge, rims.free_edge)}
    for name, (own, loop) in given.items():
        if own is not None and own.ndim == 1 and sorted(own) != sorted(loop):
            raise folder.wrong(
                f"{seen.where}.{name}",
                "other vertices than in the reference frame, to which this frame corresponds",
            )


def _corresponds(folder: CaseFolder, first: SeenFrame, seen: SeenFrame) -> bool:
    if seen is first:
        return True
    same = len(seen.vertices) == len(first.vertices) and np.array_equal(
        seen.triangles, first.triangles
    )
    own, of_all = seen.entry.corresponds, folder.document.corresponds
    asked, where = (of_all, "corresponds") if own is None else (own, f"{seen.where}.corresponds")
    if asked == "auto":
        return same
    if asked and not same:
        raise folder.wrong(
            where,
            f"true, but frame {seen.entry.name!r} has {len(seen.vertices)} vertices and "
            f"{len(seen.triangles)} triangles and the reference {len(first.vertices)} and "
            f"{len(first.triangles)}, or others; expected identical triangles",
        )
    return asked


def _frame_annulus(
    folder: CaseFolder,
    reference: ReferenceFrame,
    seen: SeenFrame,
    rims: Rims,
    region: IntArray,
    corresponds: bool,
) -> FloatArray:
    first, loop = reference.seen, reference.rims.annulus
    with folder.at(f"{seen.where}.annulus"):
        if seen.annulus is not None and seen.annulus.ndim == 2:
            if len(seen.annulus) != len(loop):
                raise InputError(
                    f"{len(seen.annulus)} points, expected {len(loop)}: one for every annulus "
                    "vertex of the reference frame, in its order"
                )
            return seen.annulus.astype(np.float64)
        if corresponds:
            return seen.vertices[loop]
        matched = match_annulus(
            (first.vertices, first.triangles, reference.region),
            loop,
            (seen.vertices, seen.triangles, region),
            rims.annulus,
        )
    folder.derived.append(
        f"annulus of frame {seen.entry.name!r}: matched to the reference by its share of the arc "
        "length between the commissures"
    )
    return matched
