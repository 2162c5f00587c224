"""Sampling and meshing of a valve that is given as a surface.

In material coordinates it is meshed in layers like the template, or its thickened leaflets are
meshed with tetrahedra. That mesher keeps neither vertices nor labels, so these are transferred by
nearness: regions and fibres from the midsurface, pressure faces from the closed surface.
"""

from pathlib import Path

import numpy as np

from mvest.errors import GeometryError, InputError, MeshingError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.band import Band
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.thickening import FACE_KINDS, ClosedSurface, thicken
from mvest.valve.geometry.triangles import area_vectors, areas, mean_fibre
from mvest.valve.mesh.cells import boundary, local_faces, with_middles
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import structured_mesh
from mvest.valve.mesh.tetwild import tetrahedralize


class GivenValve(Band):
    """An imported valve in any resolution, and its meshes in layers."""

    def layers(self, element: str, columns: int, rows: int, layers: int = 1) -> SolidMesh:
        """A mesh of ``columns x rows x layers`` cells. GeometryError if cells are folded."""
        try:
            return structured_mesh(self, element, columns, rows, layers)
        except GeometryError as fault:
            raise GeometryError(
                f"structured mesh of {columns} x {rows} cells: {fault}; the reference "
                "surface or a line between its leaflets is too jagged: smooth it, change the "
                "number of cells, or take mesh source tetwild"
            ) from fault


PRESSURE_AREA_TOLERANCE = 0.1
"""Largest relative difference between the pressure faces' area and the ventricular side's."""


def tetrahedral_leaflets(
    surface: LeafletSurface,
    edge_length: float,
    element_type: str = "tet10",
    store: Path | None = None,
    normals: FloatArray | None = None,
) -> SolidMesh:
    """Thicken leaflets, mesh them with pytetwild, and transfer labels, fibres and faces.

    An element has the region of the midsurface triangle nearest to its centroid. Fibres are those
    of the nearest midsurface point, projected on its tangent plane. Pressure faces are the outer
    faces nearest to ventricular triangles of the closed surface that face the same way.

    InputError if the element type is neither ``tet4`` nor ``tet10``. MeshingError as
    `tetrahedralize`, or the area of the pressure faces is not that of the ventricular side.

    Parameters
    ----------
    surface
        Midsurface with thickness.
    edge_length, store
        See `mvest.valve.mesh.tetwild.tetrahedralize`.
    element_type
        ``"tet10"`` or ``"tet4"``.
    normals
        Offset directions of `mvest.valve.geometry.thickening.thicken`.
    """
    if element_type not in ("tet4", "tet10"):
        raise InputError(f"element_type {element_type!r}: pytetwild meshes are 'tet4' or 'tet10'")
    closed = thicken(surface, normals)
    nodes, elements = tetrahedralize(closed.vertices, closed.triangles, edge_length, store)
    owner, which = boundary(elements, "tet4")
    faces = elements[owner[:, None], local_faces("tet4")[which]]
    pressure = _ventricular(nodes, faces, closed)
    ventricular = closed.triangles[closed.kind == FACE_KINDS.index("ventricular")]
    wanted = areas(closed.vertices, ventricular).sum()
    area = areas(nodes, faces[pressure]).sum()
    if abs(area - wanted) > PRESSURE_AREA_TOLERANCE * wanted:
        raise MeshingError(
            f"pressure faces cover {area:.1f} mm^2 of the {wanted:.1f} mm^2 of the ventricular "
            f"side; give a shorter edge_length"
        )
    centroids = nodes[elements].mean(axis=1)
    nearest = closest_points(centroids, surface.vertices, surface.triangles)
    if element_type == "tet10":
        nodes, elements = with_middles(nodes, elements)
        faces = elements[owner[:, None], local_faces("tet10")[which]]
    fibre = _fibres(nodes, surface)[elements]
    # Elements interpolate between their nodes, whose fibres must therefore agree in sign.
    fibre = np.where((fibre * fibre[:, :1]).sum(axis=2, keepdims=True) < 0, -fibre, fibre)
    return SolidMesh(
        nodes=nodes,
        elements=elements,
        element_type=element_type,
        region=surface.region[nearest.triangle],
        region_names=surface.region_names,
        fibre=fibre,
        pressure_faces=faces[pressure],
    )


def _ventricular(nodes: FloatArray, faces: IntArray, closed: ClosedSurface) -> IntArray:
    """Outer faces whose nearest triangle that faces the same way is ventricular."""
    centroids = nodes[faces].mean(axis=1)
    normals = area_vectors(nodes, faces)
    distance = np.full((len(faces), len(FACE_KINDS)), np.inf)
    closed_normals = area_vectors(closed.vertices, closed.triangles)
    for kind in range(len(FACE_KINDS)):
        numbers = np.flatnonzero(closed.kind == kind)
        if len(numbers) == 0:
            continue
        nearest = closest_points(centroids, closed.vertices, closed.triangles[numbers])
        facing = (normals * closed_normals[numbers[nearest.triangle]]).sum(axis=1) > 0
        # Triangles that face the other way count only if there is no other.
        distance[:, kind] = nearest.distance + np.where(facing, 0.0, 1e6)
    return np.flatnonzero(distance.argmin(axis=1) == FACE_KINDS.index("ventricular"))


def _fibres(nodes: FloatArray, surface: LeafletSurface) -> FloatArray:
    """Fibre of the nearest midsurface point, in the tangent plane there, ``(n, 3)`` unit."""
    nearest = closest_points(nodes, surface.vertices, surface.triangles)
    corners = surface.triangles[nearest.triangle]
    mixed = mean_fibre(surface.fibre[corners], nearest.barycentric)
    normal = area_vectors(surface.vertices, surface.triangles)[nearest.triangle]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = mixed - (mixed * normal).sum(axis=1, keepdims=True) * normal
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    bad = np.flatnonzero(length[:, 0] < 1e-3)
    if len(bad):
        raise InputError(
            f"fibres stand upright on the leaflet near {np.round(nodes[bad[0]], 2)} mm; they must "
            f"lie in it"
        )
    return np.asarray(tangent / length)
