"""Layered solid meshes of the template: bricks, or prisms split into tetrahedra.

Every node is placed on the exact surface in material coordinates, so that refined meshes converge
to one and the same body.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import SolidMesh


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
        ``hex18``, ``hex18_thin``, ``hex27`` (one brick per cell) or ``tet4``, ``tet10`` (six
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
    if element in ("hex18", "hex18_thin", "hex27"):
        return _bricks(shape, element, columns, rows, layers)
    if element in ("tet4", "tet10"):
        return _tetrahedra(shape, element, columns, rows, layers)
    raise InputError(
        f"no structured mesh of {element!r}; known: hex18, hex18_thin, hex27, tet4, tet10"
    )


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
