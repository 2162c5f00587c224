"""Thick leaflets as a label map, drawn by SimpleITK: no code of the reader's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import SimpleITK
from numpy.typing import NDArray

from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.thickening import smooth_vertex_normals

FINE_MM = 0.2
"""Of the grid on which leaflets are drawn before they are sampled at voxels."""
MARGIN_MM = 6.0


def voxelised(
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    thickness: FloatArray,
    voxel_mm: float,
) -> SimpleITK.Image:
    """A label map of leaflets: 1 anterior, 2 posterior, 0 elsewhere; LPS.

    A voxel belongs to the leaflets if more than half of it does, to the larger part of the two.
    """
    normals = smooth_vertex_normals(vertices, triangles)
    corner = vertices[triangles]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max()
    k = int(np.ceil(longest / (0.8 * FINE_MM)))
    i, j = np.meshgrid(np.arange(k + 1), np.arange(k + 1))
    inside = i + j <= k
    weights = np.column_stack([i[inside], j[inside], k - i[inside] - j[inside]]) / k
    points = np.einsum("ka,tai->tki", weights, corner).reshape(-1, 3)
    along = np.einsum("ka,tai->tki", weights, normals[triangles]).reshape(-1, 3)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Points are drawn as cells of the fine grid, half of one beyond where they are.
    reach = np.einsum("ka,ta->tk", weights, thickness[triangles]).ravel() - FINE_MM
    leaflet = np.repeat(region + 1, len(weights)).astype(np.uint8)
    low = vertices.min(axis=0) - MARGIN_MM
    shape = np.ceil((np.ptp(vertices, axis=0) + 2 * MARGIN_MM) / FINE_MM).astype(int) + 1
    drawn: NDArray[np.uint8] = np.zeros(shape, dtype=np.uint8)
    for zeta in np.linspace(-0.5, 0.5, int(np.ceil(thickness.max() / (0.8 * FINE_MM))) + 1):
        cell = np.round((points + zeta * reach[:, None] * along - low) / FINE_MM).astype(int)
        drawn[tuple(cell.T)] = leaflet
    parts = []
    for label in (1, 2):
        image = SimpleITK.GetImageFromArray((drawn == label).astype(np.float32).transpose(2, 1, 0))
        image.SetSpacing([FINE_MM] * 3)
        image.SetOrigin(low.tolist())
        # The mean over a voxel, as far as a normal distribution of its variance is one.
        image = SimpleITK.SmoothingRecursiveGaussian(image, voxel_mm / np.sqrt(12))
        count = [int(np.ceil(n * FINE_MM / voxel_mm)) for n in shape]
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
