"""A leaflet surface on fewer of its vertices, and its thickening into layers of quadratic wedges.

The vertices kept are spread evenly: first along both edges, then each one farthest from all others.
Their Delaunay triangulation is taken in a plane annulus to which the harmonic coordinates
(:mod:`mvest.valve.geometry.surface_coordinates`) map the band almost conformally. There both edges
are circles, so that the triangulation contains them.

Each coarse triangle gets nodes in the middle of its edges, laid on the fine surface, so that the
six-node triangle follows the curvature. Each node becomes a column of nodes along a smoothed
normal, from the atrial (``zeta = -1``) to the ventricular face. Raw normals and a jumping thickness
could invert wedges at sharp bends, such as the commissures.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.spatial import Delaunay, cKDTree

from mvest.elements import FACES
from mvest.errors import GeometryError, InputError
from mvest.typing import IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates, wrapped
from mvest.valve.geometry.triangles import arc_length, edge_table, surface_edges, unit_rows
from mvest.valve.mesh.solid_mesh import SolidMesh

LEVELS_PER_LAYER = {"wedge12": 1, "wedge18": 2}
"""Node levels that one layer of each element adds."""
MAX_BULGE = 0.2
"""Largest distance of a mid-edge node from the straight edge, over the edge length. [choice]"""
SMOOTHING = 3
"""Rounds of averaging normals and thickness with their neighbours in the sheet."""


class Remeshed(NamedTuple):
    """A coarser surface and its vertices ``kept (n,)`` of the fine one.

    ``annulus`` and ``free_edge`` are its boundary loops, in the order of the fine loops.
    """

    surface: LeafletSurface
    annulus: IntArray
    free_edge: IntArray
    kept: IntArray


def remesh(
    surface: LeafletSurface, annulus: IntArray, free_edge: IntArray, vertices: int
) -> Remeshed:
    """Coarsen a band of leaflets with the loops ``annulus`` and ``free_edge``.

    The result has ``vertices`` vertices, or fewer if all fine ones off the loops are kept.

    InputError if ``vertices`` is too small for the two loops or above the number of fine vertices.
    GeometryError if the surface is not a band, or the triangulation loses an edge of a loop.
    """
    x = surface.vertices
    if not 24 <= vertices <= len(x):
        raise InputError(
            f"remesh to {vertices} vertices: expected 24 to {len(x)}, the number of vertices of "
            "the surface given"
        )
    coordinates = surface_coordinates(x, surface.triangles, annulus, free_edge)
    arcs = [arc_length(x[np.append(loop, loop[0])]) for loop in (annulus, free_edge)]
    # Edge length h with n = A / (sqrt(3)/2 h^2) + L / (2 h): vertices on edges own half cells.
    a, b = 2 * surface.areas.sum() / np.sqrt(3), sum(arc[-1] for arc in arcs) / 2
    h = (b + np.sqrt(b * b + 4 * a * vertices)) / (2 * vertices)
    loops = []
    for loop, arc in zip((annulus, free_edge), arcs, strict=True):
        places = np.linspace(0, arc[-1], max(3, round(arc[-1] / h)), endpoint=False)
        loops.append(loop[np.unique(np.abs(arc[:-1, None] - places).argmin(axis=0))])
    kept = np.concatenate(loops)
    nearest = np.asarray(cKDTree(x[kept]).query(x)[0])
    nearest[np.concatenate([annulus, free_edge])] = 0.0
    while len(kept) < vertices and nearest.any():
        kept = np.append(kept, np.argmax(nearest))
        nearest = np.minimum(nearest, np.linalg.norm(x - x[kept[-1]], axis=1))
    rings = np.arange(len(loops[0])), len(loops[0]) + np.arange(len(loops[1]))
    theta, s = coordinates.theta[kept], coordinates.s[kept]
    radius = np.exp(coordinates.modulus * (s - 1))
    plane = radius[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])
    triangles = Delaunay(plane).simplices.astype(np.int64)
    triangles = triangles[~np.isin(triangles, rings[0]).all(axis=1)]  # the hole
    corner = plane[triangles]
    way = np.linalg.det(corner[:, 1:] - corner[:, :1]) > 0
    # The strip of theta and s has the opposite orientation of the plane annulus.
    triangles[way != coordinates.clockwise] = triangles[way != coordinates.clockwise][:, [0, 2, 1]]
    found = {frozenset(loop.tolist()) for loop in boundary_loops(triangles)}
    if found != {frozenset(ring.tolist()) for ring in rings}:
        raise GeometryError("remeshing lost edges of annulus or free edge; use more vertices")
    first = theta[triangles[:, :1]]
    middle = (first + wrapped(theta[triangles] - first)).mean(axis=1)
    hosts, _ = coordinates.locate(np.mod(middle, 2 * np.pi), s[triangles].mean(axis=1))
    coarse = LeafletSurface(
        x[kept],
        triangles,
        surface.region[hosts],
        surface.region_names,
        surface.fibre[kept],
        surface.thickness[kept],
    )
    return Remeshed(coarse, *rings, kept)


def layered_wedges(
    surface: LeafletSurface, onto: LeafletSurface, element_type: str = "wedge12", layers: int = 1
) -> SolidMesh:
    """Thicken a midsurface into layers of six-node-triangle wedges.

    InputError for an unknown element or fewer than one layer. GeometryError if elements are
    inverted: the surface bends within its thickness.

    Parameters
    ----------
    surface : LeafletSurface
        Its vertices become the corners; the surface lies halfway through the thickness.
    onto : LeafletSurface
        Finer surface on which mid-edge nodes lie (on its boundary loops for boundary edges), and
        from which normals, fibres and thickness are taken.
    element_type : {"wedge12", "wedge18"}
        Linear or quadratic through each layer.
    layers : int
    """
    if element_type not in LEVELS_PER_LAYER or layers < 1:
        raise InputError(
            f"cannot thicken into {layers} layers of {element_type!r}; expected 1 or more of "
            f"{', '.join(LEVELS_PER_LAYER)}"
        )
    _, edges, number, count = edge_table(surface.triangles)
    sheet = np.hstack([surface.triangles, len(surface.vertices) + number.reshape(-1, 3)])
    straight = surface.vertices[edges].mean(axis=1)
    middles = closest_points(straight, onto.vertices, onto.triangles).interpolate(
        onto.vertices, onto.triangles
    )
    outer = straight[count == 1]
    offsets = np.stack(
        [closest_on_loop(outer, onto.vertices[loop])[2] for loop in boundary_loops(onto.triangles)]
    )
    nearest = np.argmin(np.linalg.norm(offsets, axis=2), axis=0)
    middles[count == 1] = outer - offsets[nearest, np.arange(len(outer))]
    # Less where it would distort triangles: a free edge with scallops shorter than its edges.
    length = np.linalg.norm(np.diff(surface.vertices[edges], axis=1)[:, 0], axis=1)
    bulge = np.linalg.norm(middles - straight, axis=1)
    share = np.minimum(1.0, MAX_BULGE * length / np.maximum(bulge, 1e-12))
    middles = straight + share[:, None] * (middles - straight)
    points = np.vstack([surface.vertices, middles])
    at = closest_points(points, onto.vertices, onto.triangles)
    thickness, fibre, normals = (
        at.interpolate(values, onto.triangles)
        for values in (onto.thickness, onto.fibre, onto.normals)
    )
    # A point has the weight one half, its neighbours one half together.
    pairs = surface_edges(sheet[:, FACES["tri6"].corners].reshape(-1, 3))
    near = sp.csr_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    near = sp.csr_matrix(near + near.T)
    degree = np.asarray(near.sum(axis=1)).ravel()
    for _ in range(SMOOTHING):
        normals = unit_rows(normals + np.asarray(near @ normals) / degree[:, None])
        thickness = 0.5 * (thickness + np.asarray(near @ thickness) / degree)
    fibre = unit_rows(fibre - normals * np.sum(fibre * normals, axis=1, keepdims=True))
    per_layer = LEVELS_PER_LAYER[element_type]
    levels = layers * per_layer + 1
    offset = np.linspace(-0.5, 0.5, levels)[:, None, None] * thickness[:, None]
    return SolidMesh(
        nodes=(points + offset * normals).reshape(-1, 3),
        elements=np.vstack(
            [
                np.hstack([sheet + level * len(points) for level in range(k, k + per_layer + 1)])
                for k in range(0, levels - 1, per_layer)
            ]
        ),
        element_type=element_type,
        region=np.tile(surface.region, layers),
        region_names=surface.region_names,
        fibre=np.tile(fibre, (levels, 1)),
        pressure_faces=sheet + (levels - 1) * len(points),
    )
