"""Validity checks of triangulated surfaces, and the volume they enclose.

Each fault raises a `GeometryError` that names the fault and the triangles, edges or vertices.
"""

import numpy as np

from mvest.errors import CrossingError, GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import (
    has_intersections,
    intersecting_triangles,
    overlapping_boxes,
)
from mvest.valve.geometry.triangles import connected_pieces, edge_table

MAX_LOOKED_AT = 100_000
"""Number of candidate pairs searched for the intersections named in a message."""
MAX_OVERLAPS = 1e7
"""Largest number of overlapping bounding boxes (0.3 GB); 50 000 valid triangles have 1e6."""


def listed(numbers: IntArray) -> str:
    """The first eight numbers as text."""
    shown = ", ".join(str(int(i)) for i in numbers[:8])
    return shown + (f", ... ({len(numbers)} in all)" if len(numbers) > 8 else "")


def check_surface(
    vertices: FloatArray,
    triangles: IntArray,
    *,
    closed: bool = False,
    self_intersections: bool = True,
    name: str = "surface",
) -> None:
    """Raise unless a triangulation is a valid, oriented manifold surface.

    GeometryError for the first of these faults: wrong shape, not finite, no triangles, index out of
    range, degenerate triangle, duplicate triangle, non-manifold edge, inconsistent orientation,
    non-manifold vertex, open surface, inward normals, self-intersection (a CrossingError).

    Parameters
    ----------
    vertices : (n, 3) mm
    triangles
        ``(m, 3)`` vertex numbers.
    closed
        Also require that it has no boundary and that its normals point outwards.
    self_intersections
        Also require that no triangle passes through another.
    name
        Name of the surface in the message.
    """
    points = np.asarray(vertices, dtype=np.float64)
    faces = np.asarray(triangles)
    _check_arrays(points, faces, name)
    _check_triangles(points, faces, name)
    _check_edges(faces, closed, name)
    _check_vertex_fans(faces, name)
    if closed and enclosed_volume(points, faces) <= 0:
        raise GeometryError(
            f"{name}: inward normals: the enclosed volume is {enclosed_volume(points, faces):.4g} "
            f"mm^3, expected positive; reverse every triangle"
        )
    if self_intersections:
        overlaps = overlapping_boxes(points, faces)
        if overlaps > MAX_OVERLAPS:
            raise GeometryError(
                f"{name}: self-intersection: triangles lie across each other almost everywhere, "
                f"about {overlaps:.2g} times; are its vertices in another order?"
            )
        if has_intersections(points, faces):
            pairs = intersecting_triangles(points, faces, most=MAX_LOOKED_AT)
            raise CrossingError(
                f"{name}: self-intersection: triangles pass through each other, among them "
                f"{pairs[:5].tolist()}",
                np.unique(faces[pairs]).tolist(),
            )


def _check_arrays(points: FloatArray, faces: IntArray, name: str) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise GeometryError(f"{name}: wrong shape: vertices {points.shape}, expected (n, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise GeometryError(
            f"{name}: wrong shape: triangles {faces.shape} of {faces.dtype}, expected (m, 3) "
            f"integers"
        )
    if len(faces) == 0:
        raise GeometryError(f"{name}: no triangles; expected at least one")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise GeometryError(f"{name}: not finite: vertices {listed(bad)}; expected numbers in mm")
    bad = np.flatnonzero(((faces < 0) | (faces >= len(points))).any(axis=1))
    if len(bad):
        raise GeometryError(
            f"{name}: index out of range: triangles {listed(bad)} name vertices outside 0 to "
            f"{len(points) - 1}"
        )


def _check_triangles(points: FloatArray, faces: IntArray, name: str) -> None:
    corners = points[faces]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    doubled_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    # Flat to a part in a million: its normal is then round-off.
    bad = np.flatnonzero(doubled_area <= 1e-6 * longest**2)
    if len(bad):
        raise GeometryError(
            f"{name}: degenerate triangle: triangles {listed(bad)} have no area or repeat a "
            f"vertex; remove them"
        )
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    if (count > 1).any():
        raise GeometryError(
            f"{name}: duplicate triangle: triangles {listed(first[count > 1])} occur again with "
            f"the same three vertices; keep one of each"
        )


def _check_edges(faces: IntArray, closed: bool, name: str) -> None:
    half, edges, inverse, count = edge_table(faces)
    if (count > 2).any():
        bad = np.flatnonzero(count > 2)
        owners = np.flatnonzero(np.isin(inverse, bad)) // 3
        raise GeometryError(
            f"{name}: non-manifold edge: {len(bad)} edges belong to more than two triangles, "
            f"among them {edges[bad[:3]].tolist()} (triangles {listed(np.unique(owners))})"
        )
    forward = np.bincount(inverse, half[:, 0] < half[:, 1], minlength=len(edges))
    bad = np.flatnonzero((count == 2) & (forward != 1))
    if len(bad):
        owners = np.flatnonzero(np.isin(inverse, bad)) // 3
        raise GeometryError(
            f"{name}: inconsistent orientation: neighbours run the same way along {len(bad)} "
            f"edges (triangles {listed(np.unique(owners))}); orient all triangles alike"
        )
    if closed and (count == 1).any():
        bad = np.flatnonzero(count == 1)
        owners = np.flatnonzero(np.isin(inverse, bad)) // 3
        raise GeometryError(
            f"{name}: open surface: {len(bad)} boundary edges, at triangles "
            f"{listed(np.unique(owners))}; expected none"
        )


def _check_vertex_fans(faces: IntArray, name: str) -> None:
    """Raise if the triangles around a vertex form several fans (sheets meeting at a point)."""
    _, _, inverse, count = edge_table(faces)
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(count)
    second = order[ends[count == 2] - 1]
    first = order[ends[count == 2] - 2]
    # Half-edge 3 t + i starts at corner 3 t + i; neighbours traverse their edge in opposite ways.
    after_first, after_second = (k - k % 3 + (k + 1) % 3 for k in (first, second))
    rows = np.concatenate([first, after_first])
    columns = np.concatenate([after_second, second])
    _, label = connected_pieces(np.column_stack([rows, columns]), 3 * len(faces))
    fans = np.unique(np.column_stack([faces.ravel(), label]), axis=0)
    vertex, number = np.unique(fans[:, 0], return_counts=True)
    if (number > 1).any():
        raise GeometryError(
            f"{name}: non-manifold vertex: sheets touch only in vertices "
            f"{listed(vertex[number > 1])}; split or remove them"
        )


def enclosed_volume(vertices: FloatArray, triangles: IntArray) -> float:
    """Volume (mm³) inside a closed surface, positive when its normals point outwards.

    Sums the tetrahedra that the triangles form with the centre of the vertices.
    """
    points = np.asarray(vertices, dtype=np.float64)
    a, b, c = np.moveaxis((points - points.mean(axis=0))[triangles], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
