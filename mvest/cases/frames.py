"""One frame of a case: its files read and checked, its annulus matched to the reference frame's."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvest.cases.band import (
    check_annulus_size,
    check_band,
    check_normals,
    check_tips,
    find_loops,
    match_annulus,
    ventricular_side,
    without_ears,
)
from mvest.cases.case import Frame
from mvest.cases.schema import CaseFolder, FrameEntry
from mvest.errors import InputError
from mvest.exchange.surfaces import read_regions
from mvest.reading.text import read_numbers, read_vertices
from mvest.typing import FloatArray, IntArray

MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
SECONDS_PER = {"s": 1.0, "ms": 1e-3}
LOOPS = ("annulus", "free_edge")


class SeenFrame(NamedTuple):
    """One entry of ``frames`` with its files, unchecked; lengths in mm."""

    entry: FrameEntry
    where: str  #: field
    vertices: FloatArray
    triangles: IntArray
    ears: IntArray  #: triangles whose inner edge was flipped (`mvest.cases.band`)
    region: IntArray | None
    point_data: Mapping[str, NDArray[np.generic]]
    loops: Mapping[str, FloatArray | IntArray | None]  #: vertices (k,) or points (k, 3)
    tips: FloatArray


class CheckedFrame(NamedTuple):
    """A frame whose surface is a band of leaflets, with its labels and boundary loops."""

    seen: SeenFrame
    region: IntArray
    annulus: IntArray
    free_edge: IntArray

    @property
    def labelled(self) -> tuple[FloatArray, IntArray, IntArray]:
        """Vertices, triangles and the region of each triangle."""
        return self.seen.vertices, self.seen.triangles, self.region


def read_frame(folder: CaseFolder, number: int) -> SeenFrame:
    """Read the files of one entry of ``frames``."""
    entry, where = folder.document.frames[number], f"frames.{number}"
    scale, given = MM_PER[folder.document.units.length], entry.surface
    files: Path | dict[str, list[Path]]
    if isinstance(given, str):
        files = folder.file(given, f"{where}.surface")
    else:
        listed = {name: [one] if isinstance(one, str) else one for name, one in given.items()}
        files = {
            name: [folder.file(one, f"{where}.surface.{name}") for one in own]
            for name, own in listed.items()
        }
    with folder.at(f"{where}.surface"):
        surface = read_regions(files, folder.document.regions)
    triangles, ears = without_ears(surface.triangles)
    loops = {
        name: _read_loop(folder, getattr(entry, name), f"{where}.{name}", scale) for name in LOOPS
    }
    tips = scale * np.array(entry.papillary_tips, dtype=np.float64)
    shape = scale * surface.vertices, triangles, ears, surface.region
    return SeenFrame(entry, where, *shape, surface.point_data, loops, tips)


def _read_loop(
    folder: CaseFolder, given: str | list[int] | None, where: str, scale: float
) -> FloatArray | IntArray | None:
    """Vertex numbers ``(k,)`` or points ``(k, 3)`` mm, depending on the table's header."""
    if not isinstance(given, str):
        return None if given is None else np.array(given, dtype=np.int64)
    file = folder.file(given, where)
    with folder.at(where):
        if file.suffix.lower() != ".csv":
            raise InputError(f"{given}: extension {file.suffix!r}, expected .csv")
        with file.open("rb") as stream:
            by_number = stream.readline().strip().removeprefix(b"\xef\xbb\xbf") == b"vertex"
        if by_number:
            return read_vertices(file)
        points = scale * read_numbers(file, ("x", "y", "z"))
        if len(points) < 3:
            raise InputError(f"{given}: {len(points)} points, expected three or more of a curve")
        return points


def reference_band(folder: CaseFolder, seen: SeenFrame) -> CheckedFrame:
    """The checked reference frame with its loops."""
    for name, given in seen.loops.items():
        if given is not None and given.ndim != 1:
            what = "holds points; expected vertex numbers of the reference surface"
            raise folder.wrong(f"{seen.where}.{name}", what)
    band = _band(folder, seen, self_intersections=True)
    missing = [name for name, loop in seen.loops.items() if loop is None]
    if missing:
        folder.derived.append(
            "annulus and free edge: the two boundary loops of the reference surface"
            + (", the free edge nearer to the papillary tips" if "annulus" in missing else "")
        )
    return band


def _band(folder: CaseFolder, seen: SeenFrame, *, self_intersections: bool) -> CheckedFrame:
    """Check that a frame is a band, and find its loops."""
    with folder.at(f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=self_intersections)
        if seen.region is None:
            raise InputError(
                "leaflets without labels; expected cell data 'region', OBJ groups with the names "
                "of the regions, or one file for every region"
            )
    numbers = (
        loop.astype(np.int64) if loop is not None and loop.ndim == 1 else None
        for loop in seen.loops.values()
    )
    with folder.at(seen.where):
        loops = find_loops(seen.vertices, seen.triangles, seen.tips, *numbers)
    if len(seen.ears):
        folder.derived.append(
            f"surface of frame {seen.entry.name!r}: inner edge flipped of triangles "
            f"{seen.ears[:5].tolist()} ({len(seen.ears)} in all), which had all three corners on "
            "one edge of the valve"
        )
    return CheckedFrame(seen, seen.region, *loops)


def place_frame(
    folder: CaseFolder, reference: CheckedFrame, seen: SeenFrame, pressure_mmhg: float
) -> tuple[Frame, CheckedFrame]:
    """A frame with its annulus and free edge; its annulus, tips and normals are checked."""
    corresponds = _corresponds(folder, reference.seen, seen)
    if seen is reference.seen:
        band = reference
    elif corresponds:
        _check_same_valve(folder, seen, reference)
        band = reference._replace(seen=seen)
    else:
        band = _band(folder, seen, self_intersections=False)
    stated, edge = (
        None if loop is None or loop.ndim == 1 else loop.astype(np.float64)
        for loop in seen.loops.values()
    )
    with folder.at(f"{seen.where}.surface"):
        if stated is None:
            check_annulus_size(seen.vertices[band.annulus])
        check_normals(seen.vertices, seen.triangles, band.annulus, seen.tips)
    with folder.at(f"{seen.where}.annulus"):
        if stated is not None:
            annulus = stated
        elif corresponds:
            annulus = seen.vertices[reference.annulus]
        else:
            labelled = reference.labelled, reference.annulus, band.labelled, band.annulus
            annulus = match_annulus(*labelled)
            folder.derived.append(
                f"annulus of frame {seen.entry.name!r}: matched to the reference by its share of "
                "the arc length between the commissures"
            )
        if len(annulus) != len(reference.annulus):
            raise InputError(
                f"{len(annulus)} points, expected {len(reference.annulus)}: one for every annulus "
                "vertex of the reference frame, in its order"
            )
        check_annulus_size(annulus)
    with folder.at(f"{seen.where}.papillary_tips"):
        x = reference.seen.vertices
        side = ventricular_side(x[reference.annulus], x[reference.free_edge])
        check_tips(annulus, side, seen.tips)
    frame = Frame(
        name=seen.entry.name,
        time=SECONDS_PER[folder.document.units.time] * seen.entry.time,
        role=seen.entry.role,
        pressure_mmHg=pressure_mmhg,
        vertices=seen.vertices,
        triangles=seen.triangles,
        region=band.region,
        annulus=annulus,
        free_edge=seen.vertices[band.free_edge] if edge is None else edge,
        papillary_tips=seen.tips,
        corresponds=corresponds,
    )
    return frame, band


def _corresponds(folder: CaseFolder, first: SeenFrame, seen: SeenFrame) -> bool:
    same = len(seen.vertices) == len(first.vertices)
    same = same and np.array_equal(seen.triangles, first.triangles)
    stated = seen.entry.corresponds
    if stated is None or seen is first:
        return same
    if stated and not same:
        what = f"true, but the triangles of frame {seen.entry.name!r} differ from the reference's"
        raise folder.wrong(f"{seen.where}.corresponds", f"{what}; expected identical triangles")
    return stated


def _check_same_valve(folder: CaseFolder, seen: SeenFrame, reference: CheckedFrame) -> None:
    """Raise unless a corresponding frame is a band with the labels and loops of the reference."""
    with folder.at(f"{seen.where}.surface"):
        check_band(seen.vertices, seen.triangles, self_intersections=False)
        if seen.region is not None and not np.array_equal(seen.region, reference.region):
            odd = np.flatnonzero(seen.region != reference.region)
            raise InputError(
                f"triangles {odd[:5].tolist()} ({len(odd)} in all) belong to another region than "
                "in the reference frame, to which they correspond"
            )
    for name, own in seen.loops.items():
        if own is not None and own.ndim == 1 and sorted(own) != sorted(getattr(reference, name)):
            raise folder.wrong(
                f"{seen.where}.{name}",
                "other vertices than in the reference frame, to which this frame corresponds",
            )
