"""Leaflets as labelled voxels, for a look at them in the volume."""

from __future__ import annotations

import numpy as np

from mvest.errors import InputError
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray, IntArray


def voxelise_leaflets(
    volume: VolumeSequence,
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    thickness: FloatArray,
) -> IntArray:
    """Label the voxels whose centre lies within half the thickness of a midsurface.

    A leaflet thinner than the largest spacing between voxels is drawn that thick, so that no path
    over the faces of voxels leads through it (J. Huang et al., An accurate method for voxelizing
    polygon meshes, IEEE Symposium on Volume Visualization, 1998). Where leaflets touch, a voxel
    belongs to the one that it lies deeper in.

    Parameters
    ----------
    volume
        Gives the grid; its voxels are not looked at.
    vertices
        ``(n, 3)`` mm, LPS, in one frame.
    triangles
        ``(m, 3)``.
    region
        ``(m,)`` leaflet of each triangle, from 0.
    thickness
        ``(n,)`` mm.

    Returns
    -------
    labels
        ``(I, J, K)`` integers: 0 outside, else 1 + region.

    Raises
    ------
    InputError
        Arrays that do not fit together, vertices that are no numbers, negative thickness.
    """
    points = np.asarray(vertices, dtype=np.float64)
    _check(points, triangles, region, thickness)
    shape = np.array(volume.frames.shape[1:])
    # In mm along the axes of the volume, where a voxel's centre is its index times the spacing.
    local = (points - volume.origin) @ volume.direction
    reach = np.maximum(thickness, volume.spacing.max()) / 2
    depth = np.ones(shape)
    labels = np.zeros(shape, dtype=np.int64)
    for triangle, leaflet in zip(triangles, region, strict=True):
        corners, reaches = local[triangle], reach[triangle]
        low = np.ceil((corners.min(axis=0) - reaches.max()) / volume.spacing).astype(int)
        high = np.floor((corners.max(axis=0) + reaches.max()) / volume.spacing).astype(int) + 1
        low, high = np.maximum(low, 0), np.minimum(high, shape)
        if (low >= high).any():
            continue
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        centres = (
            np.stack(
                np.meshgrid(
                    *(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"
                ),
                axis=-1,
            )
            * volume.spacing
        )
        weights = _closest(centres.reshape(-1, 3), corners)
        gap = np.linalg.norm(centres.reshape(-1, 3) - weights @ corners, axis=1)
        ratio = (gap / (weights @ reaches)).reshape(centres.shape[:3])
        nearer = ratio < depth[box]
        depth[box][nearer] = ratio[nearer]
        labels[box][nearer] = 1 + leaflet
    return labels


def _check(
    points: FloatArray, triangles: IntArray, region: IntArray, thickness: FloatArray
) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"vertices: shape {points.shape}, expected (n, 3) finite numbers of mm")
    if np.shape(thickness) != points.shape[:1] or not (np.asarray(thickness) >= 0).all():
        raise InputError(
            f"thickness: shape {np.shape(thickness)}, expected {points.shape[:1]} numbers >= 0 mm"
        )
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(f"triangles: shape {triangles.shape}, expected (m, 3)")
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < len(points)):
        raise InputError(
            f"triangles: vertices to {triangles.max()}, expected 0 to {len(points) - 1}"
        )
    if np.shape(region) != triangles.shape[:1] or np.any(np.asarray(region) < 0):
        raise InputError(
            f"region: shape {np.shape(region)}, expected {triangles.shape[:1]} numbers from 0"
        )


def _closest(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Weights ``(p, 3)`` of a triangle's corners at its points closest to ``points`` ``(p, 3)``.

    In the triangle where the projection falls inside it, else on the closest of its edges.
    """
    best = np.empty((len(points), 3))
    distance = np.full(len(points), np.inf)
    for a in range(3):
        b = (a + 1) % 3
        edge = corners[b] - corners[a]
        length = edge @ edge
        along = (points - corners[a]) @ edge / length if length > 0 else np.zeros(len(points))
        along = np.clip(along, 0.0, 1.0)
        apart = np.linalg.norm(points - corners[a] - along[:, np.newaxis] * edge, axis=1)
        nearer = apart < distance
        distance[nearer] = apart[nearer]
        best[nearer] = 0.0
        best[nearer, a] = 1.0 - along[nearer]
        best[nearer, b] = along[nearer]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    square = normal @ normal
    if square > 0:
        weights = np.stack(
            [
                np.cross(corners[(a + 2) % 3] - corners[(a + 1) % 3], points - corners[(a + 1) % 3])
                @ normal
                / square
                for a in range(3)
            ],
            axis=1,
        )
        inside = (weights >= 0).all(axis=1)
        best[inside] = weights[inside]
    return best
