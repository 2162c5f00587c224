"""Layered solid meshes of valves in material coordinates: bricks, or prisms split into tetrahedra.

Every node lies on the exact surface, so that refined meshes converge to one and the same body.
"""

import numpy as np

from mvest.errors import InputError
from mvest.valve.anatomy.valve import MaterialSurface
from mvest.valve.mesh.cells import lattice_elements, local_faces, numbered
from mvest.valve.mesh.solid_mesh import SolidMesh


def structured_mesh(
    shape: MaterialSurface,
    element: str = "hex18",
    columns: int = 36,
    rows: int = 4,
    layers: int = 1,
) -> SolidMesh:
    """Mesh of ``columns x rows x layers`` cells of a valve.

    InputError if the element cannot be laid out in layers, or the numbers are too small or do not
    divide among the leaflets. GeometryError if cells are inverted.

    Parameters
    ----------
    shape : MaterialSurface
        The template, or any valve in material coordinates.
    element : str
        ``hex18``, ``hex27`` (one brick per cell) or ``tet4``, ``tet10`` (six tetrahedra per cell).
    columns : int
        Cells around the valve, as many for each leaflet: leaflets meet at cell boundaries.
    rows, layers : int
        Cells along the leaflets and through the thickness.
    """
    leaflets = len(shape.sections)
    if columns < 6 or columns % leaflets or rows < 1 or layers < 1:
        raise InputError(
            f"mesh of {columns} x {rows} x {layers} cells, expected a multiple of {leaflets} >= 6 "
            "of columns, rows >= 1 and layers >= 1"
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
    region = np.array(shape.sections)[leaflets * grid[..., 0].min(axis=1) // steps[0]]
    of_node = np.broadcast_to(region[:, None], elements.shape)
    fibre = shape.fibre(360.0 * grid[..., 0] / steps[0], grid[..., 1] / steps[1], of_node)
    on_top = at[:, 2] == steps[2]
    faces = [elements[:, local] for local in local_faces(element)]
    top = np.concatenate([face[on_top[face].all(axis=1)] for face in faces])
    return SolidMesh(nodes, elements, element, region, shape.region_names, fibre, top)
