"""What must hold of a case beyond the kinds of its fields, each fault one clear error.

The errors raised here say what is wrong and what would be right; `mvest.cases.folder` puts the file
and the field before them.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist

from mvest.cases.rims import loop_vector_area
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.triangles import directed_edges, surface_edges

ANNULUS_DIAMETER = (15.0, 80.0)
"""mm, largest extent of an annulus between a small child's and the most dilated adult's."""
CLOSING_PRESSURE = (20.0, 250.0)
"""mmHg, transmitral pressure on a closed valve."""
LARGEST_THICKNESS = 5.0
"""mm."""
FARTHEST_TIP = 100.0
"""mm from the centre of the annulus."""


def check_band(vertices: FloatArray, triangles: IntArray, *, self_intersections: bool) -> None:
    """Raise unless a surface is a connected, oriented manifold of which every vertex is used.

    How many boundary loops it has is for `mvest.cases.rims.find_rims`, handles for here.
    """
    check_surface(vertices, triangles, self_intersections=False)
    unused = np.setdiff1d(np.arange(len(vertices)), triangles)
    if len(unused):
        raise GeometryError(
            f"vertices {unused[:5].tolist()} ({len(unused)} in all) belong to no triangle; remove "
            "them"
        )
    edges = surface_edges(triangles)
    n = len(vertices)
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), edges.T), shape=(n, n))
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        sizes = np.bincount(label).tolist()
        raise GeometryError(
            f"{pieces} pieces that do not touch ({', '.join(map(str, sizes[:5]))} vertices); "
            "expected one surface round the valve, its parts sharing the vertices of their seams"
        )
    # Last, since parts with double vertices along their seams pass through each other there.
    if self_intersections:
        check_surface(vertices, triangles)


def check_no_handle(vertices: FloatArray, triangles: IntArray) -> None:
    """Raise unless a surface with two boundary loops is a plain band (Euler number 0)."""
    euler = len(vertices) - len(surface_edges(triangles)) + len(triangles)
    if euler != 0:
        raise GeometryError(
            f"Euler number {euler}, expected 0: the surface has {-euler // 2} handles, where "
            "leaflets that only touch were joined"
        )


def check_annulus_size(annulus: FloatArray) -> None:
    """Raise where the largest extent (mm) of the annulus is none of a valve."""
    size = float(pdist(annulus).max())
    low, high = ANNULUS_DIAMETER
    if not low <= size <= high:
        fits = [
            unit
            for unit, factor in (("m", 1000.0), ("cm", 10.0), ("mm", 0.1), ("mm", 0.001))
            if low <= size * factor <= high
        ]
        guess = f" (its numbers would fit {fits[0]} instead)" if fits else ""
        raise GeometryError(
            f"the annulus is {size:.3g} mm across, expected {low:g} to {high:g} mm: is "
            f"units.length right?{guess}"
        )


def ventricular_side(annulus: FloatArray, free_edge: FloatArray) -> float:
    """1 where the vector area of an annulus (in its order) points to the free edge, else -1."""
    down = free_edge.mean(axis=0) - annulus.mean(axis=0)
    return 1.0 if down @ loop_vector_area(annulus) > 0 else -1.0


def check_tips(annulus: FloatArray, side: float, tips: FloatArray) -> None:
    """Raise where a papillary tip is not on the ventricular side of the annulus, or far away.

    ``side`` is that of `ventricular_side` in the open frame; the annulus has the same order here.
    """
    centre = annulus.mean(axis=0)
    normal = side * loop_vector_area(annulus)
    below = (tips - centre) @ (normal / np.linalg.norm(normal))
    if below.min() <= 0:
        k = int(np.argmin(below))
        raise GeometryError(
            f"tip {k} at {np.round(tips[k], 2).tolist()} mm lies {-below[k]:.1f} mm above the "
            "annulus, on the atrial side; expected below it, on the side of the free edge"
        )
    distance = np.linalg.norm(tips - centre, axis=1)
    if distance.max() > FARTHEST_TIP:
        k = int(np.argmax(distance))
        raise GeometryError(
            f"tip {k} is {distance[k]:.0f} mm from the centre of the annulus, expected at most "
            f"{FARTHEST_TIP:g} mm: is it in the same unit and the same axes as the surface?"
        )


def check_normals(
    vertices: FloatArray, triangles: IntArray, annulus: IntArray, tips: FloatArray
) -> None:
    """Raise unless the triangles face the ventricle.

    The annulus runs as the triangles at it do, so its vector area has their side, however the
    leaflets lie and however wide the orifice is. Edges within the surface are run along both ways.
    """
    edges = directed_edges(triangles)
    start, end = np.moveaxis(vertices[edges[np.isin(edges, annulus).all(axis=1)]], 1, 0)
    area = np.cross(start, end).sum(axis=0)
    towards = tips.mean(axis=0) - vertices[annulus].mean(axis=0)
    if area @ towards <= 0:
        raise GeometryError(
            "flipped normals: the triangles face the atrium, expected the ventricle, where the "
            "papillary tips are; reverse every triangle"
        )


def check_thickness(thickness: FloatArray) -> None:
    """Raise unless every thickness (mm) is positive and that of a leaflet."""
    bad = np.flatnonzero(~((thickness > 0) & (thickness <= LARGEST_THICKNESS)))
    if len(bad):
        k = int(bad[0])
        raise GeometryError(
            f"{thickness[k]:g} mm at vertex {k} ({len(bad)} vertices in all), expected above 0 and "
            f"at most {LARGEST_THICKNESS:g} mm"
        )


def check_closing_pressure(pressure_mmhg: float, unit: str) -> None:
    """Raise where the pressure on the closed valve is not one that closes a mitral valve."""
    low, high = CLOSING_PRESSURE
    if not low <= pressure_mmhg <= high:
        other = "kPa" if unit == "mmHg" else "mmHg"
        raise InputError(
            f"{pressure_mmhg:g} mmHg on the closed valve, expected {low:g} to {high:g} mmHg: is it "
            f"in {other} (units.pressure says {unit})? It is positive where it closes the valve"
        )
