"""From segmented leaflets and papillary muscles to the midsurface, its error, and the tips."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from mvest.errors import CrossingError, GeometryError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.leaflet_fields import (
    fields_of_masks,
    thick_leaflets,
)
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.thickening import thicken

BEND_MM = 3.0
"""Bending radius of the leaflets at the commissures."""
REPAIR_MM, REPAIRS = 1.0, 16
"""Length over which leaflets are smoothed near places where they pass through themselves, which is
also that of the neighbourhood, and largest number of times."""
HEAD_MM = 5.0
"""Height of a muscle's head, from which its chordae arise."""
MIN_SLENDER = 1.5
"""Smallest ratio of a muscle's length to its width; a rounder muscle has no identifiable tip."""
MAX_AWAY = 60.0
"""Largest distance (mm) from the leaflets to the papillary tips."""
TALLER = 1.1
"""A leaflet that is this many times as tall as the other is the anterior one."""


def masks_midsurface(
    masks: Sequence[BoolArray],
    grid: tuple[FloatArray, FloatArray, FloatArray],
    tips: FloatArray,
    *,
    seams: Sequence[float] | FloatArray | None = None,
    blur: float = 0.5,
    **known: Any,
) -> tuple[Midsurface, FloatArray]:
    """Compute the midsurface of labelled voxels, and the lengths ``(2,)`` mm of the seams.

    GeometryError as raised by the functions named below.

    Parameters
    ----------
    masks
        ``(I, J, K)`` each: both leaflets together, or anterior and posterior separately.
    grid
        Spacing ``(3,)`` mm, direction ``(3, 3)`` (columns along i, j and k) and origin ``(3,)`` mm.
    tips : (2, 3) mm
    seams, blur
        See `thick_leaflets` and `fields_of_masks`.
    known
        See `mvest.valve.geometry.midsurface.midsurface`.
    """
    spacing, direction, origin = grid
    fields, first = fields_of_masks(masks, spacing, blur)
    start = origin + direction @ (spacing * first)

    def local(points: FloatArray) -> FloatArray:
        return np.asarray((points - start) @ direction)

    def label(points: FloatArray) -> IntArray:
        return fields.label(local(points))

    known_seams = None if seams is None else np.array(seams, dtype=np.float64)
    solid = thick_leaflets(fields, local(tips), known_seams)
    surface = midsurface(
        start + solid.vertices @ direction.T,
        solid.triangles,
        tips=tips,
        label=label if len(masks) == 2 else None,
        **known,
    )
    thickness = fields.true_thickness(surface.thickness - 2 * solid.grown_mm)
    rims = thickness.reshape(-1, len(surface.annulus))[[0, -1]]
    surface = surface.extended(fields.lost_rim(rims) - solid.grown_mm).unblurred(fields.blur_mm)
    derived = (*solid.derived, *surface.derived)
    return replace(surface, thickness=thickness, derived=derived), solid.seams


def without_crossings(
    surface: Midsurface, smoothing_mm: float, *, thickened: bool
) -> tuple[Midsurface, str]:
    """Smooth the surface around the valve, and smooth it further where it passes through itself.

    CrossingError if it still does after `REPAIRS` rounds, GeometryError for other faults.

    Parameters
    ----------
    surface
    smoothing_mm
        See `mvest.valve.geometry.midsurface.Midsurface.smoothed`.
    thickened
        Whether the thickened surface must not pass through itself either (for meshing).

    Returns
    -------
    Midsurface
    str
        Description of the smoothing; empty if there was none.
    """
    smooth, moved = surface.smoothed(smoothing_mm)
    around = f"smoothed around the valve over {smoothing_mm:g} mm, which moves it by at most"
    done = [f"{around} {moved:.1f} mm"] * bool(moved)
    given = smooth.vertices
    fault: CrossingError | None = None
    for _ in range(REPAIRS + 1):
        try:
            _check(smooth, thickened)
        except CrossingError as found:
            fault, n = fault or found, len(given)
            wrong = smooth.vertices[np.array(found.vertices) % n]
            near = cdist(smooth.vertices, wrong).min(axis=1)
            further, _ = smooth.smoothed(REPAIR_MM)
            share = np.exp(-0.5 * (near / REPAIR_MM) ** 2)[:, None]
            changed = smooth.vertices + share * (further.vertices - smooth.vertices)
            smooth = replace(smooth, vertices=changed)
            continue
        if fault is not None:
            moved = float(np.linalg.norm(smooth.vertices - given, axis=1).max())
            done.append(f"moved by at most {moved:.1f} mm where it passed through itself")
        return smooth, "; ".join(done)
    assert fault is not None
    raise fault


def _check(surface: Midsurface, thickened: bool) -> None:
    """Raise a GeometryError unless a surface, and its walls if ``thickened``, are valid."""
    check_surface(surface.vertices, surface.triangles)
    if thickened:
        fibre = np.tile([0.0, 0.0, 1.0], (len(surface.vertices), 1))
        band = surface.vertices, surface.triangles, surface.region, ("anterior", "posterior")
        thicken(LeafletSurface(*band, fibre, surface.thickness))


def segmentation_std(voxel_mm: float, blur_mm: float, observer_mm: float) -> float:
    """Standard deviation (mm) of a midsurface coordinate from a segmentation.

    A wall is uniformly distributed within a voxel (standard deviation ``voxel / sqrt(12)``), and
    the midsurface is the mean of two walls. Gaussian smoothing of a signed distance moves a surface
    of curvature k by ``blur^2 k / 2`` (mean curvature flow: Merriman, Bence and Osher 1994, J.
    Comput. Phys. 112:334). `Midsurface.unblurred` undoes this to first order; it is still
    counted, for bends that voxels do not resolve. The observer's error is added.
    """
    return float(np.sqrt(voxel_mm**2 / 24 + (blur_mm**2 / (2 * BEND_MM)) ** 2 + observer_mm**2))


def papillary_tip(muscle: FloatArray, leaflets: FloatArray) -> FloatArray:
    """Centre ``(3,)`` mm of a muscle's head: its last `HEAD_MM` along the long axis.

    GeometryError if the muscle is not slender (`MIN_SLENDER`).

    Parameters
    ----------
    muscle
        ``(n, 3)`` mm, points of the muscle.
    leaflets
        ``(m, 3)`` mm; the head is the end nearer to their centre.
    """
    middle = muscle.mean(axis=0)
    _, _, axes = np.linalg.svd(muscle - middle, full_matrices=False)
    length, width = (float(np.ptp((muscle - middle) @ axis)) for axis in axes[:2])
    if length < MIN_SLENDER * width:
        raise GeometryError(
            f"papillary muscle near {np.round(middle, 1).tolist()}: {length:.1f} mm long and "
            f"{width:.1f} mm wide, so which end is its tip is not known; give tips instead"
        )
    axis = axes[0] * np.sign((leaflets.mean(axis=0) - middle) @ axes[0])
    along = (muscle - middle) @ axis
    return np.asarray(muscle[along >= along.max() - HEAD_MM].mean(axis=0))


def check_tips_of(surface: Midsurface, tips: FloatArray) -> None:
    """Raise an error if tips and leaflets seem to use different axes.

    GeometryError if a tip is farther than `MAX_AWAY` from the leaflets.

    ``tips``: ``(2, 3)`` mm, LPS, antero-lateral tip first.
    """
    centre = surface.vertices.mean(axis=0)
    away, turned = (
        float(np.linalg.norm(tips * axes - centre, axis=1).max()) for axes in (1, (-1, -1, 1))
    )
    if away > MAX_AWAY:
        hint = f" (with x and y turned {turned:.0f} mm: they are in RAS where LPS is expected)"
        raise GeometryError(
            f"tips: {away:.0f} mm from the leaflets, expected at most {MAX_AWAY:g} mm"
            + (hint if turned < MAX_AWAY else "")
        )
