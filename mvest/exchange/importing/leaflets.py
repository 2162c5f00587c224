"""Imports thick segmented leaflets: label maps, or closed surfaces of one or both leaflets."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from mvest.cases.band import LARGEST_THICKNESS
from mvest.cases.case import Role, ValveCase
from mvest.cases.frames import MM_PER
from mvest.errors import GeometryError, InputError
from mvest.exchange.importing.leaflet_parts import Content, Tissue, filled_frames, tissue_of
from mvest.exchange.importing.written import REGIONS, FoundFrame, Pair, Tips, case_of_frames
from mvest.exchange.surfaces import SURFACE_SUFFIXES, read_surface
from mvest.exchange.volumes import LabelMap, read_labels
from mvest.quantities import Place, Pressure, within
from mvest.reading.text import named
from mvest.typing import FloatArray
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.segmented import (
    BEND_MM,
    HEAD_MM,
    TALLER,
    check_tips_of,
    masks_midsurface,
    papillary_tip,
    segmentation_std,
    without_crossings,
)

OBSERVER_MM, CORRELATED_MM = 1.0, 10.0
"""Defaults for a case: standard deviation of walls drawn by a person or a network, and the length
along the leaflets over which these errors are correlated."""
BLUR_VOXELS = 0.5
"""Standard deviation of the voxel smoothing."""
CLOSED_AT = 0.35
"""Time (s) after the open frame, in a generic cardiac cycle."""


@dataclass(frozen=True, slots=True)
class LeafletsOptions:
    """Values that a label map or surfaces do not state.

    Attributes
    ----------
    anterior, posterior : name, number or file, or list of names and numbers
        Segments, labels or objects of a leaflet (``anterior=2``, ``posterior=[P1,P2,P3]``), or its
        file. By default SlicerHeart's terminology and the names decide. The taller of two nameless
        leaflets is the anterior one.
    leaflets : name or number, or list of them
        Both leaflets together.
    open, closed : number, file, or list of two files
        Frames of a map over time, or layers of a segmentation. The closed frame may be in another
        file, or in one file for each leaflet.
    units : str or None
        Length unit of surfaces and of points given here: mm, cm or m. Maps are in mm.
    tips, tips_closed : tuple of float or None
        Papillary tips, antero-lateral and postero-medial: six numbers, LPS.
    muscles : list of two names or files
        Papillary muscles in the same order; the tips are derived from their shapes.
    anterior_point : tuple of float or None
        A point of the anterior annulus, if both leaflets are one label or surface. By default the
        anterior leaflet is the taller one. The commissures are where the leaflets are shortest.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve.
    thickness_mm : tuple of float or None
        Thickness of the anterior and posterior leaflets; replaces the distance between walls.
    thickness_range_mm : tuple of float or None
        Smallest and largest thickness; values outside are clipped.
    edge_mm : float
        Edge length of the triangles of the case.
    smoothing_mm : float
        Standard deviation of the midsurface smoothing around the valve.
    observer_mm : float
        Standard deviation of the drawn walls; 0 for a voxelised model.
    mirrored : bool
        Accept a mirrored valve.
    """

    anterior: Any = None
    posterior: Any = None
    leaflets: Any = None
    open: int | None = None
    closed: Any = None
    units: str | None = None
    tips: Tips | None = None
    tips_closed: Tips | None = None
    muscles: Annotated[tuple[str, ...], Field(min_length=2, max_length=2)] | None = None
    anterior_point: tuple[Place, Place, Place] | None = None
    pressure_mmHg: Pressure | None = None
    thickness_mm: Pair | None = None
    thickness_range_mm: Pair | None = None
    edge_mm: Annotated[float, within(0.3, 5, "mm", "")] = 1.2
    smoothing_mm: Annotated[float, within(0, 10, "mm", "")] = 0.0
    observer_mm: Annotated[float, within(0, 5, "mm", "")] = OBSERVER_MM
    mirrored: bool = False

    def words(self, name: str) -> tuple[str, ...]:
        """Names, numbers or files of an option, which may be a single one or a list."""
        given = getattr(self, name)
        many = given if isinstance(given, list | tuple) else [] if given is None else [given]
        return tuple(map(str, many))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame: its role, its file or the files of both leaflets, and its index there."""

    role: Role
    files: tuple[Path, ...]
    contents: tuple[Content, ...]
    frame: int | None


def import_leaflets(source: Path, options: LeafletsOptions) -> ValveCase:
    """Make a case from the leaflets of an open valve, or of an open and a closed valve.

    InputError or GeometryError if a required option is missing (the message names it); leaflets are
    not recognised, have holes, are in pieces, not closed surfaces, apart, or without an orifice.

    ``source``: label map (NRRD, ``.seg.nrrd``, NIfTI, MetaImage; converted to LPS) or closed
    surfaces (STL, PLY, OBJ, GLB, VTK). If the file name contains ``anterior``, the other leaflet is
    read from the same name with ``posterior``, and vice versa.
    """
    derived: list[str] = []
    frames: list[FoundFrame] = []
    with named(source):
        seen = _frames(source, options, derived)
        scale = _scale(seen[0].contents[0], options)
    anterior = options.anterior_point and scale * np.array(options.anterior_point)
    known: dict[str, Any] = {"edge_mm": options.edge_mm}
    given = {name: options.words(name) for name in ("leaflets", *REGIONS)}
    seams: Any = None
    exchanged, voxel = False, 0.0
    for one in seen:
        with named(*one.files):
            tissue = tissue_of(one.contents, one.frame, given, scale, derived)
            stated = options.tips_closed if frames else options.tips
            if stated is not None:
                tips = scale * np.reshape(stated, (2, 3))
            else:
                tips = frames[0].tips if frames else _tips(one, tissue, options, scale, derived)
            known |= {"tips": tips, "anterior": anterior}
            if tissue.surface is None:
                voxel = float(np.prod(tissue.grid[0]) ** (1 / 3))
                how = {"blur": BLUR_VOXELS, "seams": seams}
                surface, seams = masks_midsurface(tissue.masks, tissue.grid, **how, **known)
            else:
                surface = midsurface(*tissue.surface, **known)
            derived += [line for line in surface.derived if line not in derived]
            if not frames and (tissue.nameless or (anterior is None and len(tissue.masks) < 2)):
                exchanged = _posterior_first(surface, tissue.nameless, derived)
            surface = surface.exchanged() if exchanged and tissue.nameless else surface
            check_tips_of(surface, tips)
            surface = _thick(surface, options, derived)
            surface, done = without_crossings(
                surface, options.smoothing_mm, thickened=one.role is Role.REFERENCE
            )
            name = "closed" if frames else "open"
            derived += [f"{name} frame: {done}"] * bool(done)
            anterior = surface.vertices[surface.annulus[len(surface.annulus) // 4]]
            load = (CLOSED_AT, options.pressure_mmHg or 0.0) if frames else (0.0, 0.0)
            data = {"thickness": surface.thickness}
            frames.append(FoundFrame(name, one.role, *load, surface, tips, data))
    if len(frames) > 1:
        derived.append(f"time of the closed frame: {CLOSED_AT:g} s of a generic cardiac cycle")
        if options.tips_closed is None:
            derived.append("papillary tips of the closed frame: those of the open frame")
    std = segmentation_std(voxel, BLUR_VOXELS * voxel, options.observer_mm)
    correlated = CORRELATED_MM if options.observer_mm > 0 else 2 * BEND_MM
    derived.append(
        f"observation: {std:.3g} mm by voxels, smoothing and observer_mm={options.observer_mm:g}, "
        f"correlated over {correlated:g} mm"
    )
    document = {
        "name": "segmented valve",  # file names may contain patients' names
        "thickness": {"point_data": "thickness"},
        "observation": {"std_mm": std, "correlation_length_mm": correlated},
        "derived": derived,
    }
    with named(source):
        return case_of_frames(frames, document, mirrored=options.mirrored)


def _read(files: tuple[Path, ...]) -> tuple[Content, ...]:
    return tuple(
        (read_surface if file.suffix.lower() in SURFACE_SUFFIXES else read_labels)(file)
        for file in files
    )


def _paired(source: Path) -> tuple[Path, ...]:
    """A file, or the anterior and posterior files of one folder."""
    pair = [source.with_name(re.sub("|".join(REGIONS), name, source.name)) for name in REGIONS]
    return tuple(pair) if pair[0] != pair[1] and all(p.is_file() for p in pair) else (source,)


def _scale(content: Content, options: LeafletsOptions) -> float:
    """Millimetres per length unit of a source and of points in the options."""
    if isinstance(content, LabelMap) and options.units not in (None, "mm"):
        raise InputError(f"units={options.units}, but a label map is in mm")
    if not isinstance(content, LabelMap) and options.units not in MM_PER:
        raise InputError("surfaces state no unit of length; give units=mm, cm or m")
    return MM_PER[options.units or "mm"]


def _frames(source: Path, options: LeafletsOptions, derived: list[str]) -> list[_Seen]:
    """The open frame, and the closed frame if there is one."""
    anterior, posterior, closed = map(options.words, (*REGIONS, "closed"))
    if len(posterior) == 1 and Path(*posterior).is_file():
        files: tuple[Path, ...] = (Path(*anterior) if anterior else source, Path(*posterior))
    else:
        files = (source,) if anterior or posterior or options.leaflets else _paired(source)
    if closed and options.pressure_mmHg is None:
        raise InputError("no pressure of the closed frame; give pressure_mmHg=...")
    opened = _Seen(Role.REFERENCE, files, _read(files), options.open)
    content, number = opened.contents[0], None
    if isinstance(content, LabelMap):
        number = int(*closed) if len(closed) == 1 and closed[0].isdecimal() else None
        filled = [0] if content.is_layers else filled_frames(content)
        if options.open is None and not closed and len(filled) == 2:
            number = filled[1]
            if options.pressure_mmHg is None:
                raise InputError(
                    f"frames {filled} hold labels: give pressure_mmHg=... of the second, the "
                    f"closed one, or open={filled[0]} for the open one alone"
                )
        if options.open is None and (number is not None or not content.is_layers):
            opened = replace(opened, frame=filled[0])
        if len(content.frames) > 1 and not content.is_layers:
            derived.append(
                f"of the frames with labels, {filled}, {opened.frame} is taken as the open one"
                + ("" if number is None else f" and {number} as the closed one")
            )
    if number is not None:
        return [opened, replace(opened, role=Role.CLOSED, frame=number)]
    if not closed:
        return [opened]
    files = _paired(Path(*closed)) if len(closed) == 1 else tuple(map(Path, closed))
    with named(*files):
        shut = _Seen(Role.CLOSED, files, _read(files), None)
        if type(shut.contents[0]) is not type(content):
            raise InputError("one frame is a label map, the other surfaces; expected one kind")
    return [opened, shut]


def _tips(
    seen: _Seen, tissue: Tissue, options: LeafletsOptions, scale: float, derived: list[str]
) -> FloatArray:
    """Papillary tips ``(2, 3)`` mm, derived from the muscles."""
    if options.muscles is None:
        raise InputError("no papillary tips; give tips=[x,y,z,x,y,z] in LPS, or muscles=[...]")
    derived.append(
        f"papillary tips: the middle of the last {HEAD_MM:g} mm of each muscle along its axis"
    )
    tips = []
    for word in options.muscles:
        own = Path(word).is_file()
        contents = _read((Path(word),)) if own else seen.contents[:1]
        muscle = tissue_of(contents, seen.frame, {} if own else {"leaflets": (word,)}, scale, [])
        tips.append(papillary_tip(muscle.points, tissue.points))
    return np.stack(tips)


def _posterior_first(surface: Midsurface, nameless: Sequence[str], derived: list[str]) -> bool:
    """Whether the second leaflet is taller and therefore the anterior one."""
    heights = surface.heights
    sizes = f"{heights.max():.1f} mm tall, the other {heights.min():.1f} mm"
    if heights.max() < TALLER * heights.min():
        options = "anterior=N posterior=N" if nameless else "anterior_point=[x,y,z]"
        raise InputError(f"which leaflet is the anterior one? one is {sizes}; give {options}")
    second = bool(heights[1] > heights[0])
    if nameless:
        derived.append(
            f"{nameless[second]} taken as the anterior and {nameless[not second]} as the posterior "
            f"leaflet: it is {sizes}, and on the anterior side of the tips"
        )
    return second


def _thick(surface: Midsurface, options: LeafletsOptions, derived: list[str]) -> Midsurface:
    """The surface with the stated thickness, clipped to the stated limits."""
    thickness = surface.thickness
    if options.thickness_mm is not None:
        of_vertex = np.ones(len(thickness), dtype=np.int64)
        of_vertex[surface.triangles[surface.region == 0]] = 0
        thickness = np.array(options.thickness_mm)[of_vertex]
    if options.thickness_range_mm is not None:
        low, high = options.thickness_range_mm
        if low > high:
            raise InputError(f"thickness_range_mm=[{low:g},{high:g}], expected the smaller first")
        thin, thick = (100 * np.mean(outside) for outside in (thickness < low, thickness > high))
        derived.append(
            f"thickness: clipped to {low:g} mm ({thin:.0f} % of the vertices are thinner) and "
            f"{high:g} mm ({thick:.0f} % are thicker, up to {thickness.max():.1f} mm)"
        )
        thickness = np.clip(thickness, low, high)
    if thickness.max() > LARGEST_THICKNESS:
        raise GeometryError(
            f"thickness of {thickness.max():.1f} mm, expected at most {LARGEST_THICKNESS:g} mm of "
            "leaflets; thickness_range_mm=[LOW,HIGH] limits it"
        )
    return replace(surface, thickness=thickness)
