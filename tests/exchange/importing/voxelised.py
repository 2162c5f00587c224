"""Thick leaflets as a label map, drawn by SimpleITK: no code of the reader's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import SimpleITK

from mvest.simulation.arrival import FINE_MM, drawn_leaflets
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.thickening import smooth_vertex_normals


def voxelised(surface: LeafletSurface, voxel_mm: float) -> SimpleITK.Image:
    """A label map of leaflets: 1 anterior, 2 posterior, 0 elsewhere; LPS.

    A voxel belongs to the leaflets if more than half of it does, to the larger part of the two.
    """
    normals = smooth_vertex_normals(surface.vertices, surface.triangles)
    drawn, low = drawn_leaflets(surface, normals, surface.thickness)
    parts = []
    for label in (1, 2):
        image = SimpleITK.GetImageFromArray((drawn == label).astype(np.float32).transpose(2, 1, 0))
        image.SetSpacing([FINE_MM] * 3)
        image.SetOrigin(low.tolist())
        # The mean over a voxel, as far as a normal distribution of its variance is one.
        image = SimpleITK.SmoothingRecursiveGaussian(image, voxel_mm / np.sqrt(12))
        count = [int(np.ceil(n * FINE_MM / voxel_mm)) for n in drawn.shape]
        origin = (low + 0.37 * voxel_mm).tolist()
        parts.append(
            SimpleITK.Resample(
                image,
                count,
                SimpleITK.Transform(),
                SimpleITK.sitkLinear,
                origin,
                [voxel_mm] * 3,
                np.eye(3).ravel().tolist(),
                0.0,
                SimpleITK.sitkFloat32,
            )
        )
    either = SimpleITK.Cast(SimpleITK.Greater(parts[0] + parts[1], 0.5), SimpleITK.sitkUInt8)
    second = SimpleITK.Cast(SimpleITK.Greater(parts[1], parts[0]), SimpleITK.sitkUInt8)
    return either * (1 + second)


def write_slicer(image: SimpleITK.Image, path: Path) -> None:
    """The map as 3D Slicer's ``.seg.nrrd``, with SlicerHeart's terminology."""
    for number, letter in enumerate("ap"):
        name = ("mitral_anterior_leaflet", "mitral_posterior_leaflet")[number]
        image.SetMetaData(f"Segment{number}_Name", name)
        image.SetMetaData(f"Segment{number}_LabelValue", str(number + 1))
        image.SetMetaData(f"Segment{number}_Layer", "0")
        image.SetMetaData(
            f"Segment{number}_Tags",
            f"TerminologyEntry:SlicerHeart~SCT^123037004^Anatomical Structure~SCT^91134007^Mitral "
            f"Valve~99^sh-leaflet-mv-{letter}^Leaflet~Anatomic codes~^^~^^|",
        )
    SimpleITK.WriteImage(image, str(path))
