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

from typing import Protocol

import numpy as np
import scipy.sparse as sp

from mvest.elements import FACES, element
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.triangles import directed_edges, unit_rows
from mvest.valve.mesh.solid_mesh import SolidMesh, jacobian_determinants


class MaterialSurface(Protocol):
    """A valve with two leaflets in material coordinates, as template and band are.

    Attributes
    ----------
    region_names : tuple of str
        The leaflet of phi in (0, 180) degrees, and that of (180, 360).
    """

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of the two leaflets."""
        ...

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(..., 3)`` mm of material points."""
        ...

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(..., 3)`` as seen from the leaflet ``region``."""
        ...


# A prism 0 1 2 (bottom) 3 4 5 (top) as three tetrahedra. The diagonal of each quadrilateral side
# runs from the bottom node with the smaller rank; ranks increase 0 < 1 < 2, so neighbours agree.
_PRISM = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])


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
    if element in ("hex18", "hex27"):
        return _bricks(shape, element, columns, rows, layers)
    if element in ("tet4", "tet10"):
        return _tetrahedra(shape, element, columns, rows, layers)
    raise InputError(f"no structured mesh of {element!r}; known: hex18, hex27, tet4, tet10")


def _grid(*sizes: int) -> tuple[IntArray, ...]:
    """Raveled index grids of the ``sizes``, the last index fastest."""
    return tuple(v.ravel() for v in np.meshgrid(*map(np.arange, sizes), indexing="ij"))


def _region(columns: int, cell: IntArray) -> IntArray:
    return np.where(2 * cell < columns, 0, 1)


def _element_fibre(
    shape: MaterialSurface, phi: FloatArray, s: FloatArray, region: IntArray
) -> FloatArray:
    """Fibres ``(m, k, 3)`` at element nodes given per element and node."""
    return shape.fibre(phi, s, np.broadcast_to(region[:, None], phi.shape))


def _bricks(
    shape: MaterialSurface, element: str, columns: int, rows: int, layers: int
) -> SolidMesh:
    n_phi, n_s = 2 * columns, 2 * rows + 1
    per_cell = 2 if element == "hex27" else 1
    n_z = per_cell * layers + 1
    k, j, i = _grid(n_z, n_s, n_phi)
    phi, s, zeta = 360.0 * i / n_phi, j / (n_s - 1), -1 + 2.0 * k / (n_z - 1)
    nodes = shape.position(phi, s, zeta)
    # xi runs against phi so that (xi, eta, zeta) is right-handed with zeta to the ventricle.
    cz, cj, ci = _grid(layers, rows, columns)
    lk, lj, li = _grid(per_cell + 1, 3, 3)
    at_i = 2 * ci[:, None] + (2 - li)
    at_j = 2 * cj[:, None] + lj
    at_k = per_cell * cz[:, None] + lk
    elements = (at_k * n_s + at_j) * n_phi + at_i % n_phi
    region = _region(columns, ci)
    fibre = _element_fibre(shape, 360.0 * at_i / n_phi, at_j / (n_s - 1), region)
    top = elements[cz == layers - 1][:, -9:]
    return SolidMesh(nodes, elements, element, region, shape.region_names, fibre, top)


def _tetrahedra(
    shape: MaterialSurface, element: str, columns: int, rows: int, layers: int
) -> SolidMesh:
    # Everything on the twice finer parameter grid, so that midside nodes lie on the exact surface.
    n_phi, n_s, n_z = 2 * columns, 2 * rows + 1, 2 * layers + 1
    cz, cj, ci = _grid(layers, rows, columns)

    def corner(di: int, dj: int, dk: int) -> IntArray:
        return np.stack([2 * (ci + di), 2 * (cj + dj), 2 * (cz + dk)], axis=-1)

    tets = []
    # Two prisms per cell; corners ordered so that the ranks increase towards larger i + j.
    for triangle in ([(0, 0), (1, 1), (1, 0)], [(0, 0), (0, 1), (1, 1)]):
        prism = np.stack([corner(a, b, dk) for dk in (0, 1) for a, b in triangle], axis=1)
        tets.append(prism[:, _ranked(triangle)])
    corners = np.concatenate(tets).reshape(-1, 4, 3)
    region = _region(columns, np.tile(np.repeat(ci, 3), 2))
    a, b, c, d = (corners[:, q] for q in range(4))
    pairs = [(a, b), (b, c), (a, c), (a, d), (b, d), (c, d)]
    grid = np.stack(
        [a, b, c, d] + ([(p + q) // 2 for p, q in pairs] if element == "tet10" else []), 1
    )
    number = (grid[..., 2] * n_s + grid[..., 1]) * n_phi + grid[..., 0] % n_phi
    used, elements = np.unique(number, return_inverse=True)
    elements = elements.reshape(number.shape)
    at_i, rest = used % n_phi, used // n_phi
    at_j, at_k = rest % n_s, rest // n_s
    nodes = shape.position(360.0 * at_i / n_phi, at_j / (n_s - 1), -1 + 2.0 * at_k / (n_z - 1))
    volume = np.linalg.det(nodes[elements[:, 1:4]] - nodes[elements[:, :1]])
    elements = _turned(elements, volume < 0)
    grid = np.where((volume < 0)[:, None, None], grid[:, _swap(grid.shape[1])], grid)
    fibre = _element_fibre(shape, 360.0 * grid[..., 0] / n_phi, grid[..., 1] / (n_s - 1), region)
    faces = _top_faces(elements, nodes, at_k == n_z - 1)
    return SolidMesh(nodes, elements, element, region, shape.region_names, fibre, faces)


def _ranked(triangle: list[tuple[int, int]]) -> IntArray:
    """Tetrahedra of a prism whose corners are ranked by i + j (ties by i)."""
    order = np.argsort([a + b + 0.1 * a for a, b in triangle])
    rank = np.concatenate([order, order + 3])
    return rank[_PRISM]


def _swap(width: int) -> IntArray:
    """Node order of a tetrahedron with corners 2 and 3 exchanged."""
    return np.array([0, 1, 3, 2] if width == 4 else [0, 1, 3, 2, 4, 8, 7, 6, 5, 9])


def _turned(elements: IntArray, wrong: IntArray) -> IntArray:
    out = elements.copy()
    out[wrong] = elements[wrong][:, _swap(elements.shape[1])]
    return out


def _top_faces(elements: IntArray, nodes: FloatArray, on_top: IntArray) -> IntArray:
    """Faces whose corners all lie on the ventricular side, normals out of the solid."""
    local = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    middle = np.array([[6, 5, 4], [4, 8, 7], [5, 9, 8], [7, 9, 6]])
    faces = []
    for corners, mids in zip(local, middle, strict=True):
        chosen = on_top[elements[:, corners]].all(axis=1)
        columns = np.concatenate([corners, mids]) if elements.shape[1] == 10 else corners
        faces.append(elements[chosen][:, columns])
    return np.concatenate(faces)


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
    edges, number, count = np.unique(
        np.sort(directed_edges(triangles), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    middle = int(triangles.max()) + 1 + number.reshape(3, -1).T
    return np.hstack([triangles, middle]), edges, count == 1


def _lay_on(fine: LeafletSurface, middles: FloatArray, on_boundary: IntArray) -> FloatArray:
    """Move interior points to the closest points of the surface, boundary ones to its loops."""
    at = closest_points(middles, fine.vertices, fine.triangles)
    result = at.interpolate(fine.vertices, fine.triangles)
    loops = boundary_loops(fine.triangles)
    start = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1) for loop in loops])
    a, along = fine.vertices[start], fine.vertices[end] - fine.vertices[start]
    for i in np.flatnonzero(on_boundary):
        t = np.clip(
            np.einsum("ij,ij->i", middles[i] - a, along) / np.einsum("ij,ij->i", along, along), 0, 1
        )
        candidate = a + t[:, None] * along
        result[i] = candidate[np.argmin(np.linalg.norm(candidate - middles[i], axis=1))]
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
