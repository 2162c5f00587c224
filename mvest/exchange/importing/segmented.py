"""Midsurfaces of segmented leaflets, frame by frame, as a case.

One door are label maps: segmentations of thick leaflets in NRRD (``.seg.nrrd``) or NIfTI.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.schema import CASE_FILE
from mvest.errors import InputError, MvestError
from mvest.exchange.surfaces import write_surface
from mvest.exchange.volumes import LabelMap, read_labels
from mvest.reading.text import one_line
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.leaflet_fields import (
    CLOSED_STEP_MM,
    STEP_MM,
    fields_of_masks,
    thick_leaflets,
)
from mvest.valve.geometry.midsurface import Midsurface, midsurface

REGIONS = ("anterior", "posterior")
OBSERVER_MM = 1.0
"""Standard deviation of where a person or a network draws a leaflet's wall; that which a case has
without any statement."""
CORRELATED_MM = 10.0
"""Along the leaflets over which such errors are alike."""
BEND_MM = 3.0
"""Radius to which leaflets bend at the commissures."""
CLOSED_AT = 0.35
"""s after the open frame, in a generic cardiac cycle."""
MAX_AWAY = 60.0
"""mm from the leaflets to the papillary tips."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedFrame:
    """One frame: its midsurface (mm, LPS), papillary tips ``(2, 3)`` mm, and pressure (mmHg)."""

    role: Role
    surface: Midsurface
    tips: FloatArray
    pressure: float


def segmentation_std(voxel_mm: float, blur_mm: float, observer_mm: float) -> float:
    """Standard deviation (mm) of a coordinate of the midsurface of a segmentation.

    A wall lies anywhere within a voxel, with a standard deviation of ``voxel / sqrt(12)``, and the
    midsurface is the mean of two walls. Smoothing a signed distance by a normal distribution moves
    a surface of curvature k by ``blur^2 k / 2`` (mean curvature flow: Merriman, Bence and Osher
    1994, J. Comput. Phys. 112:334). Whoever drew the walls was in error as well.
    """
    return float(np.sqrt(voxel_mm**2 / 24 + (blur_mm**2 / (2 * BEND_MM)) ** 2 + observer_mm**2))


def stated_tips(name: str, given: tuple[float, ...] | None) -> FloatArray | None:
    """Papillary tips ``(2, 3)`` mm of an option, antero-lateral first.

    Raises
    ------
    InputError
        Other than six finite numbers.
    """
    if given is None:
        return None
    if len(given) != 6 or not np.isfinite(given).all():
        raise InputError(f"{name}={list(given)}, expected six numbers: x,y,z of both tips in mm")
    return np.array(given, dtype=np.float64).reshape(2, 3)


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
            " (with x and y turned it would be "
            f"{other:.0f} mm: tips are in RAS where LPS is expected)"
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
        raise InputError(
            "tips: seen from the atrium the first, the antero-lateral one, is on the right of the "
            "anterior leaflet, as in a mirror: give it first, or mirrored=true if this is right"
        )


def segmented_case(
    source: Path,
    frames: Sequence[SegmentedFrame],
    std_mm: float,
    observer_mm: float,
    derived: list[str],
) -> ValveCase:
    """A case of frames, the reference first; its folder is written and read for all checks.

    Raises
    ------
    InputError, GeometryError
        As `mvest.cases.folder.read_case`, with the source in place of its folder.
    """
    correlated = CORRELATED_MM if observer_mm > 0 else 2 * BEND_MM
    derived.append(
        f"observation: {std_mm:.3g} mm by voxels, smoothing and observer_mm={observer_mm:g}, alike "
        f"over {correlated:g} mm"
    )
    if any(frame.pressure for frame in frames):
        derived.append(f"time of the closed frame: {CLOSED_AT:g} s of a generic cardiac cycle")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        entries = []
        for number, frame in enumerate(frames):
            surface, open_frame = frame.surface, frame.role is Role.REFERENCE
            write_surface(
                folder / f"{number}.vtp",
                surface.vertices,
                surface.triangles,
                {"thickness": surface.thickness},
                {"region": np.asarray(surface.region)},
            )
            entries.append(
                {
                    "name": "open" if open_frame else "closed",
                    "time": 0.0 if open_frame else CLOSED_AT,
                    "role": frame.role.value,
                    "surface": f"{number}.vtp",
                    "papillary_tips": frame.tips.tolist(),
                    "pressure": float(frame.pressure),
                    **({} if open_frame else {"corresponds": False}),
                }
            )
        document = {
            "version": 1,
            # Names of files may be those of patients.
            "name": "segmented valve",
            "units": {"length": "mm", "pressure": "mmHg", "time": "s"},
            "regions": list(REGIONS),
            "thickness": {"point_data": "thickness"},
            "observation": {"std_mm": float(std_mm), "correlation_length_mm": correlated},
            "frames": entries,
            "derived": derived,
        }
        text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
        (folder / CASE_FILE).write_text(text, encoding="utf-8")
        try:
            case = read_case(folder)
        except MvestError as fault:
            words = str(fault).replace(f"{folder / CASE_FILE}: ", "").replace(str(folder), "")
            raise type(fault)(f"{source}: {words}") from fault
    return dataclasses.replace(case, sha256="")


TERMS = {"anterior": "sh-leaflet-mv-a", "posterior": "sh-leaflet-mv-p"}
"""Codes of SlicerHeart's terminology for the leaflets of the mitral valve."""
PLAIN = {"anterior": 1, "posterior": 2}
"""Labels of a map that names none."""


@dataclass(frozen=True, slots=True)
class LabelsOptions:
    """What a label map does not say.

    Attributes
    ----------
    anterior, posterior : str or None
        Name or number of each leaflet's segment. Without them it is that with SlicerHeart's
        terminology, that with the word in its name, or label 1 and 2 of a map without names.
    closed : str or None
        The closed frame: another file, or the number of a frame of this one.
    open : int
        Number of the frame with the open valve.
    tips, tips_closed : tuple of float or None
        Papillary tips, antero-lateral and postero-medial: six numbers, LPS mm; ``tips_closed``
        those of the closed frame, where they have moved.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve.
    seam_mm : tuple of float or None
        How far down from the annulus the leaflets are one piece at the two commissures, where the
        open frame does not show it.
    edge_mm : float
        Of the triangles of the case.
    blur_voxels : float
        Standard deviation of the smoothing of the voxels' distances.
    observer_mm : float
        Standard deviation of where the walls were drawn; 0 for a voxelised model.
    mirrored : bool
        Take the valve although it lies as in a mirror.
    """

    anterior: str | None = None
    posterior: str | None = None
    closed: str | None = None
    open: int = 0
    tips: tuple[float, ...] | None = None
    tips_closed: tuple[float, ...] | None = None
    pressure_mmHg: float | None = None
    seam_mm: tuple[float, ...] | None = None
    edge_mm: float = 1.2
    blur_voxels: float = 0.5
    observer_mm: float = OBSERVER_MM
    mirrored: bool = False

    def __post_init__(self) -> None:
        for name, low, high in (
            ("edge_mm", 0.3, 5.0),
            ("blur_voxels", 0.0, 2.0),
            ("observer_mm", 0.0, 5.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}={getattr(self, name)}, expected {low:g} to {high:g}")
        if self.seam_mm is not None and len(self.seam_mm) != 2:
            raise InputError(f"seam_mm={list(self.seam_mm)}, expected two lengths")


def import_labels(source: Path, options: LabelsOptions) -> ValveCase:
    """Make a case of one label map, or of an open and a closed one.

    Parameters
    ----------
    source : Path
        NRRD or NIfTI whose voxels are labels; LPS as the file states it.
    options : LabelsOptions

    Raises
    ------
    InputError, GeometryError
        In one line what is missing, by the name of its option, or wrong: no such segment, leaflets
        with holes or in several pieces, that meet nowhere, or that have no orifice.
    """
    tips = stated_tips("tips", options.tips)
    if tips is None:
        raise InputError(
            f"{source}: no papillary tips in a label map; give tips=[x,y,z,x,y,z] in LPS mm"
        )
    if options.closed is not None and options.pressure_mmHg is None:
        raise InputError(f"{source}: no pressure of the closed frame; give pressure_mmHg=...")
    derived: list[str] = []
    maps = [(source, options.open, Role.REFERENCE, tips)]
    if options.closed is not None:
        number = options.closed.isdecimal()
        moved = stated_tips("tips_closed", options.tips_closed)
        if moved is None:
            derived.append("papillary tips of the closed frame: where they are in the open one")
        maps.append(
            (
                source if number else Path(options.closed),
                int(options.closed) if number else 0,
                Role.CLOSED,
                tips if moved is None else moved,
            )
        )
    frames, seams, std = [], None, 0.0
    if options.seam_mm is not None:
        seams = np.array(options.seam_mm, dtype=np.float64)
    for path, frame, role, own in maps:
        volume = read_labels(path)
        masks = _masks(path, volume, frame, options, derived)
        try:
            surface, seams = _surface(volume, masks, own, seams, options, derived)
            if not options.mirrored:
                check_handedness(surface, own)
        except MvestError as fault:
            raise type(fault)(f"{path}: {fault}") from fault
        pressure = 0.0 if role is Role.REFERENCE else float(options.pressure_mmHg or 0.0)
        frames.append(SegmentedFrame(role, surface, own, pressure))
        voxel = float(np.prod(volume.spacing) ** (1 / 3))
        std = max(std, segmentation_std(voxel, options.blur_voxels * voxel, options.observer_mm))
    return segmented_case(source, frames, std, options.observer_mm, derived)


def _masks(
    path: Path,
    volume: LabelMap,
    frame: int,
    options: LabelsOptions,
    derived: list[str],
) -> tuple[BoolArray, BoolArray]:
    segments = volume.segments
    masks = []
    for region in REGIONS:
        given = getattr(options, region)
        layer, label = frame, PLAIN[region]
        if given is not None and given.isdecimal():
            label = int(given)
        elif given is not None or segments:
            chosen = [
                s
                for s in segments
                if (s.name == given if given is not None else TERMS[region] in s.tags)
            ]
            if not chosen and given is None:
                chosen = [s for s in segments if region in s.name.lower()]
            if len(chosen) != 1:
                names = one_line(", ".join(s.name for s in segments) or "none", 80)
                raise InputError(
                    f"{path}: {len(chosen)} segments of the {region} leaflet among {names}; "
                    f"give {region}=NAME or its number"
                )
            label = chosen[0].label
            layer = chosen[0].layer if volume.is_layers else frame
            derived.append(
                f"{region} leaflet: segment {one_line(chosen[0].name, 80)}, label {label}"
            )
        else:
            derived.append(f"{region} leaflet: label {label}, as the file names none")
        if not 0 <= layer < len(volume.frames):
            raise InputError(
                f"{path}: frame {layer}, expected one of {len(volume.frames)} from 0 on"
            )
        mask = volume.frames[layer] == label
        if not mask.any():
            values = np.unique(volume.frames[layer])
            listed = ", ".join(f"{v:g}" for v in values[:8])
            raise InputError(
                f"{path}: no voxel has the label {label} of the {region} leaflet (labels "
                f"{listed}{', ...' if len(values) > 8 else ''}); give {region}=LABEL"
            )
        masks.append(mask)
    return masks[0], masks[1]


def _surface(
    volume: LabelMap,
    masks: tuple[BoolArray, BoolArray],
    tips: FloatArray,
    seams: FloatArray | None,
    options: LabelsOptions,
    derived: list[str],
) -> tuple[Midsurface, FloatArray]:
    """The midsurface of a frame in LPS mm, and the lengths of its seams."""
    step = STEP_MM if seams is None else CLOSED_STEP_MM
    fields, first = fields_of_masks(masks, volume.spacing, options.blur_voxels, step)
    origin = volume.origin + volume.direction @ (volume.spacing * first)

    def local(points: FloatArray) -> FloatArray:
        return np.asarray((points - origin) @ volume.direction)

    def label(points: FloatArray) -> IntArray:
        return fields.label(local(points))

    solid = thick_leaflets(fields, local(tips), seams)
    if solid.pieces:
        derived.append(f"{solid.pieces} loose pieces of the leaflets left out")
    if solid.grown_mm:
        derived.append(f"walls drawn {solid.grown_mm:.2g} mm farther out, so that no hole is left")
    if solid.contact_mm2:
        lengths = " and ".join(f"{length:.1f}" for length in solid.seams)
        derived.append(
            f"leaflets cut apart where they touch, over {solid.contact_mm2:.0f} mm^2, and one "
            f"piece within {lengths} mm of the annulus at the commissures, as in the open frame"
        )
    surface = midsurface(
        origin + solid.vertices @ volume.direction.T,
        solid.triangles,
        tips=tips,
        label=label,
        edge_mm=options.edge_mm,
    )
    thickness = fields.true_thickness(surface.thickness - 2 * solid.grown_mm)
    return dataclasses.replace(surface, thickness=thickness), solid.seams
