"""Closed surfaces of thick leaflets (STL, PLY, OBJ, GLB, VTK): one for all or one for each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.cases.frames import MM_PER
from mvest.errors import GeometryError, InputError, MvestError
from mvest.exchange.importing.segmented import (
    OBSERVER_MM,
    SegmentedFrame,
    check_handedness,
    segmentation_std,
    segmented_case,
    stated_tips,
)
from mvest.exchange.regions import read_regions
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.leaflet_fields import (
    CLOSED_STEP_MM,
    STEP_MM,
    fields_of_masks,
    inside_surfaces,
    thick_leaflets,
)
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume

BLUR_VOXELS = 0.5
"""Smoothing of the grid on which two leaflets are joined."""


@dataclass(frozen=True, slots=True)
class SolidOptions:
    """What surfaces do not say.

    Attributes
    ----------
    units : str or None
        Of lengths in the files: mm, cm or m, which it is by the standard of GLB.
    posterior : str or None
        File with the posterior leaflet; the source is then the anterior one alone. Without it the
        source holds both, closed round one orifice.
    closed, closed_posterior : str or None
        The same of the closed frame.
    part, posterior_part : str or None
        Names of the objects that are the source and the posterior leaflet, where files hold
        several (OBJ, GLB); both leaflets may be of one file.
    tips, tips_closed : tuple of float or None
        Papillary tips, antero-lateral and postero-medial: six numbers, in `units`.
    commissures : tuple of float or None
        Six numbers, in `units`; without them, where leaflets of one surface are shortest.
    anterior_point : tuple of float or None
        Three numbers, in `units`: a point of the annulus of the anterior leaflet; without it that
        is the taller one.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve.
    thickness_mm : tuple of float or None
        Of the anterior and of the posterior leaflet, instead of that between the walls.
    seam_mm : tuple of float or None
        How far down from the annulus two leaflets are one piece, where the open frame does not
        show it.
    edge_mm : float
        Of the triangles of the case.
    observer_mm : float
        Standard deviation of where the walls were drawn.
    mirrored : bool
        Take the valve although it lies as in a mirror.
    """

    units: str | None = None
    posterior: str | None = None
    closed: str | None = None
    closed_posterior: str | None = None
    part: str | None = None
    posterior_part: str | None = None
    tips: tuple[float, ...] | None = None
    tips_closed: tuple[float, ...] | None = None
    commissures: tuple[float, ...] | None = None
    anterior_point: tuple[float, ...] | None = None
    pressure_mmHg: float | None = None
    thickness_mm: tuple[float, ...] | None = None
    seam_mm: tuple[float, ...] | None = None
    edge_mm: float = 1.2
    observer_mm: float = OBSERVER_MM
    mirrored: bool = False

    def __post_init__(self) -> None:
        if self.units is not None and self.units not in MM_PER:
            raise InputError(f"units={self.units}, expected {', '.join(MM_PER)}")
        for name, count in (
            ("commissures", 6),
            ("anterior_point", 3),
            ("thickness_mm", 2),
            ("seam_mm", 2),
        ):
            given = getattr(self, name)
            if given is not None and (len(given) != count or not np.isfinite(given).all()):
                raise InputError(f"{name}={list(given)}, expected {count} numbers")
        for name, low, high in (("edge_mm", 0.3, 5.0), ("observer_mm", 1e-3, 5.0)):
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}={getattr(self, name)}, expected {low:g} to {high:g}")


def import_solid(source: Path, options: SolidOptions) -> ValveCase:
    """Make a case of closed surfaces of thick leaflets.

    Parameters
    ----------
    source : Path
    options : SolidOptions

    Raises
    ------
    InputError, GeometryError
        In one line what is missing, by the name of its option, or wrong: an open surface, several
        pieces, no orifice, thickness of no leaflets, lengths of no valve.
    """
    if options.units is None:
        raise InputError(f"{source}: surfaces state no unit of length; give units=mm, cm or m")
    scale = MM_PER[options.units]
    tips = stated_tips("tips", options.tips)
    if tips is None:
        raise InputError(f"{source}: no papillary tips; give tips=[x,y,z,x,y,z] in {options.units}")
    if options.closed is not None and options.pressure_mmHg is None:
        raise InputError(f"{source}: no pressure of the closed frame; give pressure_mmHg=...")
    if options.closed is not None and (options.posterior is None) != (
        options.closed_posterior is None
    ):
        raise InputError(f"{source}: give posterior=FILE and closed_posterior=FILE, or neither")
    tips, derived = scale * tips, []
    seen: list[tuple[Path, str | None, Role, FloatArray]] = [
        (source, options.posterior, Role.REFERENCE, tips)
    ]
    if options.closed is not None:
        moved = stated_tips("tips_closed", options.tips_closed)
        if moved is None:
            derived.append("papillary tips of the closed frame: where they are in the open one")
        own = tips if moved is None else scale * moved
        seen.append((Path(options.closed), options.closed_posterior, Role.CLOSED, own))
    seams = None if options.seam_mm is None else np.array(options.seam_mm, dtype=np.float64)
    frames, voxel = [], 0.0
    for path, posterior, role, own in seen:
        try:
            if posterior is None:
                surface = _whole(path, own, options, scale)
            else:
                surface, seams = _joined((path, Path(posterior)), own, seams, options, scale)
                voxel = STEP_MM
                if not options.mirrored:
                    check_handedness(surface, own)
        except MvestError as fault:
            start = "" if str(fault).startswith(str(path)) else f"{path}: "
            raise type(fault)(f"{start}{fault}") from fault
        derived += [line for line in surface.derived if line not in derived]
        if options.thickness_mm is not None:
            surface = _stated_thickness(surface, options.thickness_mm)
        pressure = 0.0 if role is Role.REFERENCE else float(options.pressure_mmHg or 0.0)
        frames.append(SegmentedFrame(role, surface, own, pressure))
    std = segmentation_std(voxel, BLUR_VOXELS * voxel, options.observer_mm)
    return segmented_case(source, frames, std, options.observer_mm, derived)


def _read(path: Path, scale: float, part: str | None) -> tuple[FloatArray, IntArray]:
    """One closed surface in mm, its normals outwards and coincident vertices one."""
    surface = read_regions({"leaflets": path}, {0: "leaflets"}, part)
    vertices, triangles = scale * surface.vertices, surface.triangles
    size = float(np.ptp(vertices, axis=0).max())
    if not 10 <= size <= 120:
        raise GeometryError(
            f"{size:.3g} mm across, expected a valve of 10 to 120 mm: is units= right?"
        )
    if enclosed_volume(vertices, triangles) < 0:
        triangles = triangles[:, ::-1]
    check_surface(vertices, triangles, self_intersections=False, name="leaflets")
    return vertices, triangles


def _whole(path: Path, tips: FloatArray, options: SolidOptions, scale: float) -> Midsurface:
    vertices, triangles = _read(path, scale, options.part)
    where = options.commissures
    point = options.anterior_point
    return midsurface(
        vertices,
        triangles,
        tips=tips,
        commissures=None if where is None else scale * np.array(where).reshape(2, 3),
        anterior=None if point is None else scale * np.array(point),
        edge_mm=options.edge_mm,
    )


def _joined(
    paths: tuple[Path, Path],
    tips: FloatArray,
    seams: FloatArray | None,
    options: SolidOptions,
    scale: float,
) -> tuple[Midsurface, FloatArray]:
    parts = options.part, options.posterior_part
    read = [_read(path, scale, part) for path, part in zip(paths, parts, strict=True)]
    masks, origin = inside_surfaces(read, STEP_MM)
    step = STEP_MM if seams is None else CLOSED_STEP_MM
    spacing = np.full(3, STEP_MM)
    fields, first = fields_of_masks((masks[0], masks[1]), spacing, BLUR_VOXELS, step)
    origin = origin + STEP_MM * first
    solid = thick_leaflets(fields, tips - origin, seams)

    def label(points: FloatArray) -> IntArray:
        return fields.label(points - origin)

    surface = midsurface(
        origin + solid.vertices, solid.triangles, tips=tips, label=label, edge_mm=options.edge_mm
    )
    thickness = fields.true_thickness(surface.thickness - 2 * solid.grown_mm)
    line = f"leaflets joined where they meet, on a grid of {STEP_MM:g} mm"
    return dataclasses.replace(surface, thickness=thickness, derived=(line,)), solid.seams


def _stated_thickness(surface: Midsurface, thickness: tuple[float, ...]) -> Midsurface:
    """The same with one thickness for each leaflet, that of the posterior one on their border."""
    of_vertex = np.ones(len(surface.vertices), dtype=np.int64)
    of_vertex[surface.triangles[surface.region == 0]] = 0
    return dataclasses.replace(surface, thickness=np.array(thickness)[of_vertex])
