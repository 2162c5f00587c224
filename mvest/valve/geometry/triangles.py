"""What all code about triangulations starts from: edges, areas and normals of triangles."""

from __future__ import annotations

import numpy as np

from mvest.typing import FloatArray, IntArray


def area_vectors(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Normals ``(m, 3)`` of triangles, as long as their area in mm²."""
    corner = vertices[triangles]
    return 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def areas(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Areas ``(m,)`` mm² of triangles."""
    return np.asarray(np.linalg.norm(area_vectors(vertices, triangles), axis=1))


def area_vectors_change(vertices: FloatArray, triangles: IntArray, moves: FloatArray) -> FloatArray:
    """Change ``(m, 3, q)`` mm² of `area_vectors` by displacements ``(n, 3, q)`` of vertices."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    da, db, dc = np.moveaxis(moves[triangles], 1, 0)
    change = np.cross(db - da, (c - a)[..., None], axis=1)
    change += np.cross((b - a)[..., None], dc - da, axis=1)
    return np.asarray(0.5 * change)


def directed_edges(triangles: IntArray) -> IntArray:
    """Edges ``(3 m, 2)`` as triangles run through them: first all from corner 0, then 1, then 2."""
    return np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def surface_edges(triangles: IntArray) -> IntArray:
    """Undirected edges ``(n_edges, 2)`` of a triangulation, each once, lower number first."""
    return np.unique(np.sort(directed_edges(triangles), axis=1), axis=0)


def unit_normals(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Unit normals ``(m, 3)`` of triangles."""
    return unit_rows(area_vectors(vertices, triangles))


def unit_rows(vectors: FloatArray) -> FloatArray:
    """Vectors ``(n, 3)`` at length one; those of no length stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
