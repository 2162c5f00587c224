"""Thick leaflets as they were segmented: label maps, or closed surfaces of each or both."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.frames import MM_PER
from mvest.cases.schema import CASE_FILE
from mvest.errors import GeometryError, InputError, MvestError
from mvest.exchange.importing.tissue import (
    REGIONS,
    Content,
    Tissue,
    muscle_points,
    paired_files,
    read_files,
    tissue_of,
)
from mvest.exchange.surfaces import write_surface
from mvest.exchange.volumes import LabelMap
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.leaflet_fields import (
    CLOSED_STEP_MM,
    STEP_MM,
    ThickLeaflets,
    fields_of_masks,
    thick_leaflets,
)
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.papillary import HEAD_MM, papillary_tip
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.thickening import thicken

OBSERVER_MM, CORRELATED_MM = 1.0, 10.0
"""Standard deviation of where a person or a network draws a leaflet's wall, and over which length
along the leaflets such errors are alike; those which a case has without any statement."""
BEND_MM = 3.0
"""Radius to which leaflets bend at the commissures."""
CLOSED_AT = 0.35
"""s after the open frame, in a generic cardiac cycle."""
MAX_AWAY = 60.0
"""mm from the leaflets to the papillary tips."""
TALLER = 1.1
"""Height of a leaflet over that of the other, from which on it is the anterior one."""
REPAIRS_MM = (0.0, 1.0, 2.0, 4.0)
"""Further smoothing that is tried where leaflets would pass through themselves."""


@dataclass(frozen=True, slots=True)
class LeafletsOptions:
    """What a label map or surfaces do not say.

    Attributes
    ----------
    anterior, posterior : names, numbers, files, or lists of these
        Which segments, labels or objects are a leaflet, such as ``anterior=2`` or
        ``posterior=[P1,P2,P3]``; or its file. Without them: SlicerHeart's terminology, names, or
        of two nameless labels the anatomy.
    leaflets : names, numbers, or a list of these
        What both leaflets are together.
    open, closed : number, file, or list of two files
        The frames: of a map over time the number, of layers that of the layer; or for the closed
        one another file, folder, or list with the file of each leaflet.
    units : str or None
        Of lengths in surfaces and of all points given here: mm, cm or m. Maps are in mm.
    tips, tips_closed : tuple of float or None
        Papillary tips, antero-lateral and postero-medial: six numbers, LPS; ``tips_closed`` where
        they have moved in the closed frame.
    muscles : list of two names or files, or None
        Segments, objects or surfaces of the papillary muscles, from which the tips follow.
    commissures, anterior_point : tuple of float or None
        Six numbers, and a point of the anterior annulus, where both leaflets are one label or
        surface; else they are shortest at the commissures, and the anterior one is the taller one.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve.
    thickness_mm, thickness_range_mm : tuple of float or None
        Of the anterior and of the posterior leaflet, instead of that between the walls; or least
        and largest one that is kept.
    seam_mm : tuple of float or None
        How far down from the annulus the leaflets are one piece at the two commissures, where the
        open frame does not show it.
    edge_mm : float
        Of the triangles of the case.
    blur_voxels, smoothing_mm : float
        Standard deviation of the smoothing of the voxels' distances, and of that of the midsurface
        round the valve (along the annulus; shorter lines are smoothed less).
    observer_mm : float
        Standard deviation of where the walls were drawn; 0 for a voxelised model.
    mirrored : bool
        Take the valve although it lies as in a mirror.
    """

    anterior: Any = None
    posterior: Any = None
    leaflets: Any = None
    open: int | None = None
    closed: Any = None
    units: str | None = None
    tips: tuple[float, ...] | None = None
    tips_closed: tuple[float, ...] | None = None
    muscles: tuple[str, ...] | None = None
    commissures: tuple[float, ...] | None = None
    anterior_point: tuple[float, ...] | None = None
    pressure_mmHg: float | None = None
    thickness_mm: tuple[float, ...] | None = None
    thickness_range_mm: tuple[float, ...] | None = None
    seam_mm: tuple[float, ...] | None = None
    edge_mm: float = 1.2
    blur_voxels: float = 0.5
    smoothing_mm: float = 0.0
    observer_mm: float = OBSERVER_MM
    mirrored: bool = False

    def __post_init__(self) -> None:
        if self.units is not None and self.units not in MM_PER:
            raise InputError(f"units={self.units}, expected {', '.join(MM_PER)}")
        counts = {"tips": 6, "tips_closed": 6, "commissures": 6, "anterior_point": 3, "muscles": 2}
        for name in ("thickness_mm", "thickness_range_mm", "seam_mm"):
            counts[name] = 2
        for name, count in counts.items():
            given = getattr(self, name)
            finite = name == "muscles" or given is None or np.isfinite(given).all()
            if given is not None and (len(given) != count or not finite):
                raise InputError(f"{name}={list(given)}, expected {count}")
        limits = {"edge_mm": (0.3, 5), "blur_voxels": (0, 2), "smoothing_mm": (0, 10)}
        for name, (low, high) in (limits | {"observer_mm": (0, 5)}).items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}={getattr(self, name)}, expected {low:g} to {high:g}")

    def points(self, name: str, scale: float) -> FloatArray | None:
        """An option's points ``(k, 3)`` in mm."""
        given = getattr(self, name)
        return None if given is None else scale * np.reshape(given, (-1, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A frame in its files: number of the frame, and of the layer if it is one layer alone."""

    files: tuple[Path, ...]
    contents: list[Content]
    role: Role
    frame: int = 0
    layer: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """A frame: its midsurface and papillary tips ``(2, 3)``, mm.

    Also what the next frame follows: the seams ``(2,)`` mm, and whether nameless leaflets were
    exchanged; and the size of a voxel in mm, 0 of a surface.
    """

    role: Role
    surface: Midsurface
    tips: FloatArray
    seams: FloatArray | None
    exchanged: bool
    voxel_mm: float


def import_leaflets(source: Path, options: LeafletsOptions) -> ValveCase:
    """Make a case of the leaflets of an open valve, or of an open and a closed one.

    Parameters
    ----------
    source : Path
        Label map (NRRD, ``.seg.nrrd``, NIfTI, MetaImage; LPS as the file states it) or closed
        surfaces (STL, PLY, OBJ, GLB, VTK); or a folder with one file of each leaflet.
    options : LeafletsOptions

    Raises
    ------
    InputError, GeometryError
        In one line what is missing, by the name of its option, or wrong: leaflets that are not
        recognised, with holes, in pieces, open, that meet nowhere, or without an orifice.
    """
    derived: list[str] = []
    frames: list[Imported] = []
    with _named(source):
        seen = _frames(source, options, derived)
        scale = _scale(seen[0].contents[0], options)
    for one in seen:
        with _named(*one.files):
            given = {name: words(getattr(options, name)) for name in ("leaflets", *REGIONS)}
            if len(one.files) == 2:
                given = dict.fromkeys(given, ())
            tissue = tissue_of(one.contents, one.frame, one.layer, given, scale, derived)
            tips = _tips(one, tissue, frames, options, scale, derived)
            frames.append(_imported(one.role, tissue, tips, frames, options, scale, derived))
    with _named(source):
        return _case(frames, options, derived)


@contextmanager
def _named(*files: Path) -> Iterator[None]:
    """Put the first file before what is wrong with it, unless a file is named already."""
    try:
        yield
    except MvestError as fault:
        known = any(str(fault).startswith(str(file)) for file in files)
        raise type(fault)(str(fault) if known else f"{files[0]}: {fault}") from fault


def words(value: Any) -> tuple[str, ...]:
    """Names, numbers or files of an option that is one or a list of them."""
    if value is None:
        return ()
    return tuple(map(str, value if isinstance(value, list | tuple) else [value]))


def _frames(source: Path, options: LeafletsOptions, derived: list[str]) -> list[Seen]:
    """The open frame, and the closed one if there is one."""
    named = words(options.closed)
    if named and options.pressure_mmHg is None:
        raise InputError("no pressure of the closed frame; give pressure_mmHg=...")
    files = _files(source, options)
    opened = Seen(files, read_files(files), Role.REFERENCE)
    first = opened.contents[0]
    numbers = [int(word) for word in named if word.isdecimal()]
    if isinstance(first, LabelMap) and first.is_layers:
        if numbers:
            opened = replace(opened, layer=options.open or 0)
            return [opened, replace(opened, role=Role.CLOSED, layer=numbers[0])]
    elif isinstance(first, LabelMap):
        filled = _filled(first)
        if options.open is None and not named and len(filled) == 2:
            numbers = filled[1:]
            if options.pressure_mmHg is None:
                raise InputError(
                    f"frames {filled[0]} and {filled[1]} hold labels: give pressure_mmHg=... of "
                    f"the second, the closed one, or open={filled[0]} for the open one alone"
                )
        opened = replace(opened, frame=filled[0] if options.open is None else options.open)
        used = [opened.frame, *numbers]
        for frame in used:
            if frame not in filled:
                raise InputError(f"frame {frame} holds no labels, expected one of {filled}")
        if len(first.frames) > 1:
            left = [frame for frame in filled if frame not in used]
            derived.append(
                f"frames: {opened.frame} open"
                + "".join(f", {frame} closed" for frame in numbers)
                + (f"; labelled ones that are not used: {left}" if left else "")
            )
        if numbers:
            return [opened, replace(opened, role=Role.CLOSED, frame=numbers[0])]
    if not named:
        return [opened]
    files = paired_files(Path(named[0])) if len(named) == 1 else tuple(map(Path, named))
    with _named(*files):
        contents = read_files(files)
        frame = _filled(contents[0])[0] if isinstance(contents[0], LabelMap) else 0
    return [opened, Seen(files, contents, Role.CLOSED, frame)]


def _files(source: Path, options: LeafletsOptions) -> tuple[Path, ...]:
    given = [words(getattr(options, region)) for region in REGIONS]
    anterior, posterior = (len(own) == 1 and Path(own[0]).is_file() for own in given)
    if posterior:
        return Path(given[0][0]) if anterior else source, Path(given[1][0])
    return (source,) if any(given) or words(options.leaflets) else paired_files(source)


def _filled(labels: LabelMap) -> list[int]:
    """Numbers of the frames with labels."""
    filled: list[int] = np.flatnonzero(labels.frames.any(axis=(1, 2, 3))).tolist()
    if not filled:
        raise InputError("no voxel has a label")
    return filled


def _scale(content: Content, options: LeafletsOptions) -> float:
    """Millimetres per unit of a source and of what the options state."""
    if isinstance(content, LabelMap):
        if options.units not in (None, "mm"):
            raise InputError(f"units={options.units}, expected none: label maps are in mm")
        return 1.0
    if options.units is None:
        raise InputError("surfaces state no unit of length; give units=mm, cm or m")
    return MM_PER[options.units]


def _tips(
    seen: Seen,
    tissue: Tissue,
    before: Sequence[Imported],
    options: LeafletsOptions,
    scale: float,
    derived: list[str],
) -> FloatArray:
    """Papillary tips ``(2, 3)`` mm as stated, from the muscles, or as in the frame before."""
    stated = options.points("tips_closed" if before else "tips", scale)
    if stated is not None:
        return stated
    if before:
        derived.append("papillary tips of the closed frame: where they are in the open one")
        return before[0].tips
    if options.muscles is None:
        raise InputError("no papillary tips; give tips=[x,y,z,x,y,z] in LPS, or muscles=[...]")
    derived.append(
        f"papillary tips: the middle of the last {HEAD_MM:g} mm of each muscle along its axis"
    )
    muscles = [muscle_points(w, seen.contents[0], seen.frame, scale) for w in options.muscles]
    return np.stack([papillary_tip(muscle, tissue.points) for muscle in muscles])


def _imported(
    role: Role,
    tissue: Tissue,
    tips: FloatArray,
    before: Sequence[Imported],
    options: LeafletsOptions,
    scale: float,
    derived: list[str],
) -> Imported:
    """The midsurface of a frame, its leaflets recognised, without a fault that can be repaired."""
    seams = before[0].seams if before else None
    if options.seam_mm is not None and not before:
        seams = np.array(options.seam_mm, dtype=np.float64)
    label, voxel, front = None, 0.0, options.points("anterior_point", scale)
    try:
        if tissue.surface is None:
            voxel = float(np.prod(tissue.spacing) ** (1 / 3))
            step = STEP_MM if seams is None else CLOSED_STEP_MM
            blur = options.blur_voxels
            fields, first = fields_of_masks(tissue.masks, tissue.spacing, blur, step)
            origin = tissue.origin + tissue.direction @ (tissue.spacing * first)

            def local(points: FloatArray) -> FloatArray:
                return np.asarray((points - origin) @ tissue.direction)

            def nearer(points: FloatArray) -> IntArray:
                return fields.label(local(points))

            solid = thick_leaflets(fields, local(tips), seams)
            seams, label = solid.seams, nearer if len(tissue.masks) == 2 else None
            derived += _cuts(solid)
            walls = origin + solid.vertices @ tissue.direction.T, solid.triangles
        else:
            walls = tissue.surface
        if label is None and front is None and before:
            quarter = len(before[0].surface.annulus) // 4
            front = before[0].surface.vertices[before[0].surface.annulus[quarter]]
        surface = midsurface(
            *walls,
            tips=tips,
            commissures=options.points("commissures", scale),
            anterior=None if front is None else front.ravel(),
            label=label,
            edge_mm=options.edge_mm,
        )
    except GeometryError as fault:
        if not tissue.titles:
            raise
        raise GeometryError(
            f"{fault}; {' and '.join(tissue.titles)} were taken as the leaflets: give anterior=N "
            "posterior=N, or leaflets=N if one of them is both"
        ) from fault
    if tissue.surface is None:
        thick = fields.true_thickness(surface.thickness - 2 * solid.grown_mm)
        surface = replace(surface, thickness=thick)
    derived += [line for line in surface.derived if line not in derived]
    exchanged = before[0].exchanged if before else False
    unknown = tissue.titles or (label is None and front is None)
    if unknown and not before:
        exchanged = _posterior_first(surface, tissue.titles, derived)
    surface = surface.exchanged() if exchanged else surface
    if not options.mirrored:
        check_handedness(surface, tips)
    surface = _sound(_thick(surface, options, derived), role, options, derived)
    return Imported(role, surface, tips, seams, exchanged, voxel)


def _cuts(solid: ThickLeaflets) -> Iterator[str]:
    """What was done to draw leaflets as one closed surface."""
    if solid.pieces:
        yield f"{solid.pieces} loose pieces of the leaflets left out"
    if solid.grown_mm:
        yield f"walls drawn {solid.grown_mm:.2g} mm farther out, so that no hole is left"
    if solid.contact_mm2:
        lengths = " and ".join(f"{length:.1f}" for length in solid.seams)
        yield (
            f"leaflets cut apart where they touch, over {solid.contact_mm2:.0f} mm^2, and one "
            f"piece within {lengths} mm of the annulus at the commissures, as in the open frame"
        )


def _posterior_first(surface: Midsurface, titles: tuple[str, ...], derived: list[str]) -> bool:
    """Whether the second of two nameless leaflets is the anterior one: the taller one is.

    Raises
    ------
    InputError
        Both are about as tall.
    """
    heights = surface.heights
    second = bool(heights[1] > heights[0])
    said = f"{heights.max():.1f} mm tall, the other {heights.min():.1f} mm"
    if heights.max() < TALLER * heights.min():
        raise InputError(
            f"the anterior leaflet is not recognised, one is {said}; give "
            + ("anterior=N posterior=N" if titles else "anterior_point=[x,y,z]")
        )
    if titles:
        derived.append(
            f"{titles[second]} taken as anterior and {titles[not second]} as posterior leaflet: "
            f"the anterior one is {said}"
        )
    return second


def check_handedness(surface: Midsurface, tips: FloatArray) -> None:
    """Raise where tips have other axes than the leaflets, or the valve is its own mirror image.

    Raises
    ------
    InputError
        Seen from the atrium, the antero-lateral commissure is not on the left of the anterior
        leaflet; tips are farther from the leaflets than any.
    """
    centre = surface.vertices.mean(axis=0)
    away = float(np.linalg.norm(tips - centre, axis=1).max())
    if away > MAX_AWAY:
        other = float(np.linalg.norm(tips * (-1, -1, 1) - centre, axis=1).max())
        hint = (
            f" (with x and y turned it would be {other:.0f} mm: tips are in RAS, not in LPS)"
            if other < MAX_AWAY
            else ""
        )
        raise InputError(
            f"tips: {away:.0f} mm from the leaflets, expected at most {MAX_AWAY:g} mm{hint}"
        )
    halves = [
        surface.vertices[surface.triangles[surface.region == k]].mean(axis=(0, 1)) for k in (0, 1)
    ]
    sides = np.stack([tips[0] - tips[1], halves[0] - halves[1], tips.mean(axis=0) - centre])
    if np.linalg.det(sides) < 0:
        heights = surface.heights
        what = (
            "the leaflets are exchanged, as the posterior one is the taller one"
            if heights[1] > TALLER * heights[0]
            else "the postero-medial tip is given first, or an axis is turned"
        )
        raise InputError(
            "tips and leaflets: seen from the atrium the first, antero-lateral tip is on the right "
            f"of the anterior leaflet, as in a mirror; perhaps {what} (mirrored=true takes it so)"
        )


def _thick(surface: Midsurface, options: LeafletsOptions, derived: list[str]) -> Midsurface:
    """The same with the thickness that is stated, that of the posterior leaflet on their border."""
    thickness = surface.thickness
    if options.thickness_mm is not None:
        of_vertex = np.ones(len(thickness), dtype=np.int64)
        of_vertex[surface.triangles[surface.region == 0]] = 0
        thickness = np.array(options.thickness_mm)[of_vertex]
    if options.thickness_range_mm is not None:
        low, high = options.thickness_range_mm
        thin, thick = (100 * np.mean(outside) for outside in (thickness < low, thickness > high))
        derived.append(
            f"thickness: kept between {low:g} mm ({thin:.0f} % of the vertices are thinner) and "
            f"{high:g} mm ({thick:.0f} % are thicker, up to {thickness.max():.1f} mm)"
        )
        thickness = np.clip(thickness, low, high)
    return replace(surface, thickness=thickness)


def _sound(
    surface: Midsurface, role: Role, options: LeafletsOptions, derived: list[str]
) -> Midsurface:
    """The surface smoothed round the valve as given, and further if it passes through itself.

    The open one is meshed, so its two walls must not meet either.
    """
    faults = []
    for extra in REPAIRS_MM:
        smooth, moved = surface.smoothed(options.smoothing_mm + extra)
        try:
            check_surface(smooth.vertices, smooth.triangles, name="midsurface")
            if role is Role.REFERENCE:
                fibre = np.tile([0.0, 0.0, 1.0], (len(smooth.vertices), 1))
                band = smooth.vertices, smooth.triangles, smooth.region, REGIONS
                thicken(LeafletSurface(*band, fibre, smooth.thickness))
        except GeometryError as fault:
            faults.append(fault)
            continue
        if moved:
            derived.append(
                f"midsurface of the {'open' if role is Role.REFERENCE else 'closed'} frame: "
                f"smoothed round the valve over {options.smoothing_mm + extra:g} mm, which moves "
                f"it by at most {moved:.1f} mm"
                + (", as it passes through itself with less" if extra else "")
            )
        return smooth
    raise faults[0]


def segmentation_std(voxel_mm: float, blur_mm: float, observer_mm: float) -> float:
    """Standard deviation (mm) of a coordinate of the midsurface of a segmentation.

    A wall lies anywhere within a voxel, with a standard deviation of ``voxel / sqrt(12)``, and the
    midsurface is the mean of two walls. Smoothing a signed distance by a normal distribution moves
    a surface of curvature k by ``blur^2 k / 2`` (mean curvature flow: Merriman, Bence and Osher
    1994, J. Comput. Phys. 112:334). Whoever drew the walls was in error as well.
    """
    return float(np.sqrt(voxel_mm**2 / 24 + (blur_mm**2 / (2 * BEND_MM)) ** 2 + observer_mm**2))


def _case(frames: Sequence[Imported], options: LeafletsOptions, derived: list[str]) -> ValveCase:
    """The frames written as a folder and read: the checks and rules of every case."""
    correlated = CORRELATED_MM if options.observer_mm > 0 else 2 * BEND_MM
    voxel = max(frame.voxel_mm for frame in frames)
    std = segmentation_std(voxel, options.blur_voxels * voxel, options.observer_mm)
    derived.append(
        f"observation: {std:.3g} mm by voxels, smoothing and observer_mm={options.observer_mm:g}, "
        f"alike over {correlated:g} mm"
    )
    if len(frames) > 1:
        derived.append(f"time of the closed frame: {CLOSED_AT:g} s of a generic cardiac cycle")
    document: dict[str, Any] = {
        "version": 1,
        "name": "segmented valve",  # names of files may be those of patients
        "units": {"length": "mm", "pressure": "mmHg", "time": "s"},
        "regions": list(REGIONS),
        "thickness": {"point_data": "thickness"},
        "observation": {"std_mm": std, "correlation_length_mm": correlated},
        "frames": [],
        "derived": derived,
    }
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for frame, name in zip(frames, ("open", "closed"), strict=False):
            surface, closed = frame.surface, name == "closed"
            write_surface(
                folder / f"{name}.vtp",
                surface.vertices,
                surface.triangles,
                {"thickness": surface.thickness},
                {"region": np.asarray(surface.region)},
            )
            document["frames"].append(
                {
                    "name": name,
                    "time": CLOSED_AT if closed else 0.0,
                    "role": frame.role.value,
                    "surface": f"{name}.vtp",
                    "papillary_tips": frame.tips.tolist(),
                    "pressure": float(options.pressure_mmHg or 0.0) if closed else 0.0,
                    **({"corresponds": False} if closed else {}),
                }
            )
        return read_back(folder, document)


def read_back(folder: Path, document: dict[str, Any]) -> ValveCase:
    """Write a case's document beside its files and read it: the checks and rules of every case.

    Raises
    ------
    InputError, GeometryError
        As `mvest.cases.folder.read_case`, without the name of the folder.
    """
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    (folder / CASE_FILE).write_text(text, encoding="utf-8")
    try:
        return replace(read_case(folder), sha256="")
    except MvestError as fault:
        said = str(fault).replace(f"{folder / CASE_FILE}: ", "").replace(f"{folder}/", "")
        raise type(fault)(said) from fault
