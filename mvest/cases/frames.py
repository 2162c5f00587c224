"""One frame of a case: its files read and checked, its annulus matched to the reference frame's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.cases.case import Frame, Role
from mvest.cases.checks import (
    at,
    check_annulus_size,
    check_band,
    check_no_handle,
    check_normals,
    check_tips,
    ventricular_side,
)
from mvest.cases.rims import Rims, find_rims, match_annulus, two_loops, without_ears
from mvest.cases.schema import CaseFile, CaseFolder, FrameEntry, wrong
from mvest.errors import InputError
from mvest.exchange.regions import RegionSurface, read_regions
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


def read_frame(folder: CaseFolder, document: CaseFile, number: int) -> SeenFrame:
    """Read the files of one entry of ``frames``; what they hold is not yet checked."""
    entry, where = document.frames[number], f"frames.{number}"
    scale = MM_PER[document.units.length]
    surface = _read_surface(folder, document, entry, where)
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


def _read_surface(
    folder: CaseFolder, document: CaseFile, entry: FrameEntry, where: str
) -> RegionSurface:
    where = f"{where}.surface"
    files: Path | dict[str, Path]
    if isinstance(entry.surface, str):
        files = folder.file(entry.surface, where)
    else:
        files = {name: folder.file(file, f"{where}.{name}") for name, file in entry.surface.items()}
    with at(folder.case, where):
        return read_regions(files, document.region_names())


def _read_curve(
    folder: CaseFolder, given: str | list[int] | None, where: str, scale: float
) -> FloatArray | IntArray | None:
    """Vertex numbers ``(k,)`` or points ``(k, 3)`` mm, as the table's header says."""
    if given is None:
        return None
    if isinstance(given, list):
        return np.array(given, dtype=np.int64)
    file = folder.file(given, where)
    with at(folder.case, where):
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


def check_reference(file: Path, seen: SeenFrame, derived: list[str]) -> ReferenceFrame:
    """The reference frame with its loops, or the first thing that is wrong with it."""
    surface = f"{seen.where}.surface"
    with at(file, surface):
        check_band(seen.vertices, seen.triangles, self_intersections=True)
        two_loops(seen.vertices, seen.triangles)
        check_no_handle(seen.vertices, seen.triangles)
    for name, given in (("annulus", seen.annulus), ("free_edge", seen.free_edge)):
        if given is not None and given.ndim != 1:
            raise wrong(
                file,
                f"{seen.where}.{name}",
                "holds points; expected vertex numbers of the reference surface",
            )
    region = _required_region(file, seen)
    rims = _rims(file, seen)
    _tell_ears(seen, derived)
    if seen.annulus is None or seen.free_edge is None:
        derived.append(
            "annulus and free edge: the two boundary loops of the reference surface"
            + ("" if seen.annulus is not None else ", the free edge nearer to the papillary tips")
        )
    annulus = seen.vertices[rims.annulus]
    side = ventricular_side(annulus, seen.vertices[rims.free_edge])
    with at(file, surface):
        check_annulus_size(annulus)
    with at(file, f"{seen.where}.papillary_tips"):
        check_tips(annulus, side, seen.tips)
    with at(file, surface):
        check_normals(seen.vertices, seen.triangles, rims.annulus, seen.tips)
    return ReferenceFrame(seen, region, rims, side)


def _tell_ears(seen: SeenFrame, derived: list[str]) -> None:
    if len(seen.ears):
        derived.append(
            f"surface of frame {seen.entry.name!r}: inner edge turned of triangles "
            f"{seen.ears[:5].tolist()} ({len(seen.ears)} in all), which had all three corners on "
            "one edge of the valve"
        )


def _required_region(file: Path, seen: SeenFrame) -> IntArray:
    if seen.region is None:
        raise wrong(
            file,
            f"{seen.where}.surface",
            "leaflets without labels; expected cell data 'region', OBJ groups with the names of "
            "the regions, or one file for every region",
        )
    return seen.region


def _rims(file: Path, seen: SeenFrame) -> Rims:
    loops = [
        loop.astype(np.int64) if loop is not None and loop.ndim == 1 else None
        for loop in (seen.annulus, seen.free_edge)
    ]
    with at(file, seen.where):
        return find_rims(seen.vertices, seen.triangles, seen.tips, *loops)


def place_frame(
    file: Path,
    document: CaseFile,
    reference: ReferenceFrame,
    seen: SeenFrame,
    pressure_mmhg: float,
    derived: list[str],
) -> tuple[Frame, Rims]:
    """A frame with its annulus and free edge where they are, and its loops."""
    first = reference.seen
    corresponds = _corresponds(file, document, first, seen)
    rims, region = reference.rims, reference.region
    if seen is not first and corresponds:
        _check_alike(file, seen, reference)
    elif seen is not first:
        rims, region = _own_band(file, seen)
        _tell_ears(seen, derived)
    annulus = _frame_annulus(file, reference, seen, rims, region, corresponds, derived)
    with at(file, f"{seen.where}.annulus"):
        check_annulus_size(annulus)
    with at(file, f"{seen.where}.papillary_tips"):
        check_tips(annulus, reference.side, seen.tips)
    with at(file, f"{seen.where}.surface"):
        check_normals(seen.vertices, seen.triangles, rims.annulus, seen.tips)
    edge = seen.free_edge
    if edge is None or edge.ndim == 1:
        edge = seen.vertices[rims.free_edge]
    frame = Frame(
        name=seen.entry.name,
        time=SECONDS_PER[document.units.time] * seen.entry.time,
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


def _check_alike(file: Path, seen: SeenFrame, reference: ReferenceFrame) -> None:
    """Raise unless a corresponding frame is in good order and has the reference's labels."""
    region, rims = reference.region, reference.rims
    with at(file, f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=False)
        if seen.region is not None and not np.array_equal(seen.region, region):
            odd = np.flatnonzero(seen.region != region)
            raise InputError(
                f"triangles {odd[:5].tolist()} ({len(odd)} in all) belong to another region than "
                "in the reference frame, to which they correspond"
            )

    for name, given, loop in (
        ("annulus", seen.annulus, rims.annulus),
        ("free_edge", seen.free_edge, rims.free_edge),
    ):
        if given is not None and given.ndim == 1 and sorted(given) != sorted(loop):
            raise wrong(
                file,
                f"{seen.where}.{name}",
                "other vertices than in the reference frame, to which this frame corresponds",
            )


def _own_band(file: Path, seen: SeenFrame) -> tuple[Rims, IntArray]:
    """Loops and regions of a frame that does not correspond to the reference."""
    with at(file, f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=False)
        two_loops(seen.vertices, seen.triangles)
        check_no_handle(seen.vertices, seen.triangles)
    region = _required_region(file, seen)
    rims = _rims(file, seen)
    with at(file, f"{seen.where}.surface"):
        check_annulus_size(seen.vertices[rims.annulus])
        check_normals(seen.vertices, seen.triangles, rims.annulus, seen.tips)
    return rims, region


def _corresponds(file: Path, document: CaseFile, first: SeenFrame, seen: SeenFrame) -> bool:
    if seen is first:
        return True
    same = len(seen.vertices) == len(first.vertices) and np.array_equal(
        seen.triangles, first.triangles
    )
    asked = seen.entry.corresponds
    where = f"{seen.where}.corresponds"
    if asked is None:
        asked, where = (
            document.corresponds if document.corresponds != "auto" else None,
            "corresponds",
        )
    if asked and not same:
        raise wrong(
            file,
            where,
            f"true, but frame {seen.entry.name!r} has {len(seen.vertices)} vertices and "
            f"{len(seen.triangles)} triangles and the reference {len(first.vertices)} and "
            f"{len(first.triangles)}, or others; expected identical triangles",
        )
    return same if asked is None else bool(asked)


def _frame_annulus(
    file: Path,
    reference: ReferenceFrame,
    seen: SeenFrame,
    rims: Rims,
    region: IntArray,
    corresponds: bool,
    derived: list[str],
) -> FloatArray:
    where = f"{seen.where}.annulus"
    count = len(reference.rims.annulus)
    if seen.annulus is not None and seen.annulus.ndim == 2:
        if len(seen.annulus) != count:
            raise wrong(
                file,
                where,
                f"{len(seen.annulus)} points, expected {count}: one for every annulus vertex of "
                "the reference frame, in its order",
            )
        return seen.annulus.astype(np.float64)
    if corresponds:
        return seen.vertices[reference.rims.annulus]
    first = reference.seen
    with at(file, where):
        matched = match_annulus(
            (first.vertices, first.triangles, reference.region),
            reference.rims.annulus,
            (seen.vertices, seen.triangles, region),
            rims.annulus,
        )
    derived.append(
        f"annulus of frame {seen.entry.name!r}: matched to the reference by its share of the arc "
        "length between the commissures"
    )
    return matched
