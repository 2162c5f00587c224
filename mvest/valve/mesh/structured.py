"""Layered solid meshes, of the template or of a triangulated midsurface.

The template is meshed in bricks, or prisms split into tetrahedra. Every node is placed on the exact
surface in material coordinates, so that refined meshes converge to one and the same body.

A triangulated midsurface is thickened into layers of quadratic wedges. Each triangle gets nodes in
the middle of its edges, laid on a finer surface, so that the six-node triangle follows the
curvature. Where that would distort a triangle (a free edge with scallops shorter than its edges),
the middles are pulled back towards the straight edge. Every point of this sheet becomes a column of
nodes along a smoothed normal, from the atrial side (``zeta = -1``) to the ventricular side (``zeta
= +1``). Raw normals and a jumping thickness can invert wedges where a surface bends sharply, at
commissures above all; both are smoothed, and an element that is still inverted is an error.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from mvest.elements import FACES, element
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface, MaterialSurface
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import edge_table, unit_rows
from mvest.valve.mesh.cells import lattice_elements, local_faces, numbered
from mvest.valve.mesh.solid_mesh import SolidMesh, jacobian_determinants


def structured_mesh(
    shape: MaterialSurface,
    element: str = "hex18",
    columns: int = 36,
    rows: int = 4,
    layers: int = 1,
) -> SolidMesh:
    """Mesh of ``columns x rows x layers`` cells of the template.

    Parameters
    ----------
    shape : MaterialSurface
        The template, or any valve in material coordinates.
    element : str
        ``hex18``, ``hex27`` (one brick per cell) or ``tet4``, ``tet10`` (six
        tetrahedra per cell).
    columns : int
        Cells around the valve; even, so that the leaflets meet at cell boundaries.
    rows, layers : int
        Cells along the leaflets and through the thickness.

    Raises
    ------
    InputError
        For an element that cannot be laid out in layers or numbers that are too small.
    """
    if columns < 6 or columns % 2 or rows < 1 or layers < 1:
        raise InputError(
            f"mesh of {columns} x {rows} x {layers} cells, expected an even number >= 6 of "
            "columns, rows >= 1 and layers >= 1"
        )
    if element not in ("hex18", "hex27", "tet4", "tet10"):
        raise InputError(f"no structured mesh of {element!r}; known: hex18, hex27, tet4, tet10")
    # (phi, s, zeta), with zeta to the ventricle, is left-handed.
    grid = lattice_elements(element, (columns, rows, layers), left_handed=True)
    steps = np.array([2 * columns, 2 * rows, 2 * layers])
    around = grid.copy()
    around[..., 0] %= steps[0]
    elements, at = numbered(around, (int(steps[0]), int(steps[1]) + 1, int(steps[2]) + 1))
    nodes = shape.position(
        360.0 * at[:, 0] / steps[0], at[:, 1] / steps[1], -1 + 2.0 * at[:, 2] / steps[2]
    )
    # Cells beyond half the way around are of the second leaflet.
    region = (grid[..., 0].min(axis=1) >= columns).astype(np.int64)
    of_node = np.broadcast_to(region[:, None], elements.shape)
    fibre = shape.fibre(360.0 * grid[..., 0] / steps[0], grid[..., 1] / steps[1], of_node)
    on_top = at[:, 2] == steps[2]
    faces = [elements[:, local] for local in local_faces(element)]
    top = np.concatenate([face[on_top[face].all(axis=1)] for face in faces])
    return SolidMesh(nodes, elements, element, region, shape.region_names, fibre, top)


LEVELS_PER_LAYER = {"wedge12": 1, "wedge18": 2}
"""Node levels that one layer of each element adds."""
MIN_AREA_RATIO = 0.5
"""Smallest accepted ratio of least to greatest area factor in a six-node triangle. [choice]"""

SMOOTHING = 3
"""Rounds of averaging normals and thickness with their neighbours in the sheet."""


def layered_wedges(
    surface: LeafletSurface,
    onto: LeafletSurface,
    element_type: str = "wedge12",
    layers: int = 1,
) -> SolidMesh:
    """Thicken a midsurface into layers of six-node-triangle wedges.

    Node ``level * n_points + point`` lies on level ``level`` (0 is the atrial face) above a point
    of the sheet: first the vertices of the surface, then the middles of its edges.

    Parameters
    ----------
    surface : LeafletSurface
        Its vertices become the corners; the surface lies halfway through the thickness.
    onto : LeafletSurface
        Finer surface that the edge middles are laid on (its boundary loops for boundary edges), and
        from which normals, fibre and thickness are taken.
    element_type : {"wedge12", "wedge18"}
        Linear or quadratic through each layer.
    layers : int
        Number of layers.

    Raises
    ------
    InputError
        For an unknown element or fewer than one layer.
    GeometryError
        If elements are inverted at a quadrature point or node; the message names them.
    """
    if element_type not in LEVELS_PER_LAYER:
        raise InputError(
            f"cannot thicken into {element_type!r}; known: {', '.join(LEVELS_PER_LAYER)}"
        )
    if layers < 1:
        raise InputError(f"{layers} layers, expected at least 1")
    sheet, edges, on_boundary = _quadratic_sheet(surface.triangles)
    middles = surface.vertices[edges].mean(axis=1)
    curved = _lay_on(onto, middles, on_boundary)
    middles = _pull_back(surface.vertices, middles, curved, sheet)
    points = np.vstack([surface.vertices, middles])
    small = sheet[:, FACES["tri6"].corners].reshape(-1, 3)
    at = closest_points(points, onto.vertices, onto.triangles)
    thickness, fibre, normals = (
        at.interpolate(values, onto.triangles)
        for values in (onto.thickness, onto.fibre, onto.normals)
    )
    average = _neighbour_average(small, len(points))
    for _ in range(SMOOTHING):
        normals = unit_rows(average @ normals)
        thickness = average @ thickness
    fibre = unit_rows(fibre - normals * np.einsum("ij,ij->i", fibre, normals)[:, None])

    per_layer = LEVELS_PER_LAYER[element_type]
    levels = layers * per_layer + 1
    offset = np.linspace(-0.5, 0.5, levels)[:, None, None] * thickness[None, :, None]
    nodes = (points[None] + offset * normals[None]).reshape(-1, 3)
    elements = np.vstack(
        [
            np.hstack(
                [sheet + level * len(points) for level in range(first, first + per_layer + 1)]
            )
            for first in range(0, levels - 1, per_layer)
        ]
    )
    _reject_inverted(nodes, elements, element_type)
    return SolidMesh(
        nodes=nodes,
        elements=elements,
        element_type=element_type,
        region=np.tile(surface.region, layers),
        region_names=surface.region_names,
        fibre=np.tile(fibre, (levels, 1)),
        pressure_faces=sheet + (levels - 1) * len(points),
    )


def _quadratic_sheet(triangles: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Six-node triangles, the edges ``(e, 2)`` whose middles are the new points, boundary flags."""
    _, edges, number, count = edge_table(triangles)
    middle = int(triangles.max()) + 1 + number.reshape(-1, 3)
    return np.hstack([triangles, middle]), edges, count == 1


def _lay_on(fine: LeafletSurface, middles: FloatArray, on_boundary: IntArray) -> FloatArray:
    """Move interior points to the closest points of the surface, boundary ones to its loops."""
    at = closest_points(middles, fine.vertices, fine.triangles)
    result = at.interpolate(fine.vertices, fine.triangles)
    outer = middles[on_boundary]
    offsets = np.stack(
        [closest_on_loop(outer, fine.vertices[loop])[2] for loop in boundary_loops(fine.triangles)]
    )
    nearest = np.argmin(np.linalg.norm(offsets, axis=2), axis=0)
    result[on_boundary] = outer - offsets[nearest, np.arange(len(outer))]
    return result


def _pull_back(
    vertices: FloatArray, straight: FloatArray, curved: FloatArray, sheet: IntArray
) -> FloatArray:
    """Edge middles between ``straight`` and ``curved`` that distort no six-node triangle."""
    reference = element("wedge12")
    places = np.vstack([reference.points[:6], reference.node_coordinates[:6]])
    gradient = reference.gradient(places * [1.0, 1.0, 0.0])
    gradient = gradient[:, :6, :2] + gradient[:, 6:, :2]
    share = np.ones(len(straight))
    for _ in range(8):
        middles = straight + share[:, None] * (curved - straight)
        points = np.vstack([vertices, middles])
        tangent = np.einsum("mai,qaj->mqij", points[sheet], gradient)
        normal = np.cross(tangent[..., 0], tangent[..., 1])
        mean = unit_rows(normal.mean(axis=1))
        area = np.einsum("mqi,mi->mq", normal, mean)
        bad = area.min(axis=1) < MIN_AREA_RATIO * area.max(axis=1)
        edges = np.unique(sheet[bad, 3:] - len(vertices))
        if not edges.size:
            break
        share[edges] *= 0.5
    return middles


def _neighbour_average(triangles: IntArray, n: int) -> sp.csr_matrix:
    """Matrix that averages a point (weight one half) with its neighbours (one half together)."""
    a = np.concatenate([triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()])
    b = np.concatenate([triangles[:, [1, 2, 0]].ravel(), triangles[:, [0, 1, 2]].ravel()])
    adjacency = sp.csr_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
    adjacency.data[:] = 1.0
    share = 0.5 / np.asarray(adjacency.sum(axis=1)).ravel()
    return sp.csr_matrix(0.5 * sp.identity(n) + sp.diags(share) @ adjacency)


def _reject_inverted(nodes: FloatArray, elements: IntArray, element_type: str) -> None:
    reference = element(element_type)
    places = np.vstack([reference.points, reference.node_coordinates])
    smallest = jacobian_determinants(nodes, elements, reference, places).min(axis=1)
    inverted = np.flatnonzero(smallest <= 0)
    if inverted.size:
        names = ", ".join(str(i) for i in inverted[:10]) + (", ..." if inverted.size > 10 else "")
        raise GeometryError(
            f"{inverted.size} of {len(elements)} {element_type} elements are inverted (numbers "
            f"{names}; smallest Jacobian determinant {smallest.min():.3g} mm^3, expected > 0): the "
            "surface bends within its thickness; smooth it, or use smaller triangles or less "
            "thickness"
        )
