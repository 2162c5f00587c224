"""Midsurfaces of segmented leaflets, frame by frame, as a case."""

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
from mvest.cases.paths import CASE_FILE
from mvest.errors import InputError, MvestError
from mvest.typing import FloatArray
from mvest.valve.geometry.midsurface import Midsurface
from mvest.valve.io.leaflet_surfaces import write_surface

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
