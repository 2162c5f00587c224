"""Thick leaflets as a label map; no code of the importer takes part."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import SimpleITK
from scipy.interpolate import PchipInterpolator

from mvest.simulation.arrival import _write_label_map
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import BandGrid, LeafletSurface, band_grid

THICKNESS = 1.4
HALF_LENGTH, HALF_WIDTH, DEPTH = 9.0, 6.0, 8.0
TOUCHING_FROM = 3.5
"""mm below the annulus."""
POCKET = 2.8
"""mm, half of the width of the pocket that stays open beside each commissure."""
COLUMNS, ROWS = 96, 15


def small_valve(closed: bool, taller: float = 0.0) -> LeafletSurface:
    """A tube; closed, its leaflets touch all along but for a pocket beside each commissure.

    It narrows from commissure to commissure, so that its free edge encloses less than its annulus.
    The middle of the anterior leaflet is taller by a share of its height, that of the posterior
    one by half of it; the tube narrows between the leaflets as well then.
    """
    grid = band_grid(COLUMNS, ROWS)
    turn = np.radians(grid.phi)
    leaflet = np.where(np.sin(turn) > 0, 1.0, 0.5) * np.abs(np.sin(turn))
    depth = DEPTH * grid.s * (1 + taller * leaflet)
    # From 0 at the commissures to 1 in the middle of a leaflet.
    inwards = 1 - np.abs(np.mod(grid.phi, 180.0) - 90.0) / 90.0
    open_at = HALF_WIDTH * np.abs(np.sin(turn))
    touching = PchipInterpolator(
        [0.0, 0.25, 0.6, 1.0], [0.0, POCKET, 0.5 * THICKNESS, 0.5 * THICKNESS]
    )(inwards)
    share = np.clip(depth / TOUCHING_FROM, 0, 1) if closed else np.zeros_like(depth)
    away = (1 - share) * open_at + share * touching
    points = np.stack([HALF_LENGTH * np.cos(turn), np.sign(np.sin(turn)) * away, -depth], axis=1)
    narrowing = 1 - 0.15 * grid.s
    points[:, 0] *= narrowing
    if taller:
        points[:, 1] *= narrowing
    return on_grid(points, grid)


def on_grid(points: FloatArray, grid: BandGrid) -> LeafletSurface:
    """Two leaflets with vertices ``(n, 3)`` mm on a grid."""
    fibre, thickness = np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.full(len(points), THICKNESS)
    names = ("anterior", "posterior")
    return LeafletSurface(points, grid.triangles, grid.region, names, fibre, thickness)


def voxelised(surface: LeafletSurface, voxel_mm: float) -> SimpleITK.Image:
    """A label map of leaflets: 1 anterior, 2 posterior, 0 elsewhere; LPS."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.nii.gz"
        _write_label_map(file, surface, surface.thickness, voxel_mm)
        return SimpleITK.ReadImage(str(file))


def write_slicer(
    image: SimpleITK.Image,
    path: Path,
    names: tuple[str, str] = ("mitral_anterior_leaflet", "mitral_posterior_leaflet"),
    tags: bool = True,
) -> None:
    """The map as 3D Slicer's ``.seg.nrrd``, with SlicerHeart's terminology if it has tags."""
    for number, letter in enumerate("ap"):
        image.SetMetaData(f"Segment{number}_Name", names[number])
        image.SetMetaData(f"Segment{number}_LabelValue", str(number + 1))
        image.SetMetaData(f"Segment{number}_Layer", "0")
        if not tags:
            continue
        image.SetMetaData(
            f"Segment{number}_Tags",
            f"TerminologyEntry:SlicerHeart~SCT^123037004^Anatomical Structure~SCT^91134007^Mitral "
            f"Valve~99^sh-leaflet-mv-{letter}^Leaflet~Anatomic codes~^^~^^|",
        )
    SimpleITK.WriteImage(image, str(path))
