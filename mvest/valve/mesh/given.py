"""A valve that is given as a surface, laid out and meshed as the template is."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray
from mvest.valve.anatomy.band import Band, leaflet_normals
from mvest.valve.anatomy.valve import Valve, band_grid
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import structured_mesh
from mvest.valve.mesh.tetrahedral.leaflets import tetrahedral_leaflets
from mvest.valve.mesh.tetrahedral.tetwild import TetwildSettings

ENVELOPE_SHARE = 0.05
"""Envelope of an unstructured mesh over its edge length."""


class GivenValve:
    """A valve from outside in every resolution, and its meshes.

    With two leaflets it has material coordinates (`mvest.valve.anatomy.band.Band`) and may be
    meshed in layers; otherwise it is what was given, and its meshes are unstructured.

    Parameters
    ----------
    given : Valve
    """

    def __init__(self, given: Valve) -> None:
        self.given = given
        self.region_names = given.surface.region_names

    @cached_property
    def band(self) -> Band | None:
        """Material coordinates, of two leaflets.

        Raises
        ------
        GeometryError
            If the leaflets do not meet along two lines from annulus to free edge.
        """
        return Band(self.given) if len(self.region_names) == 2 else None

    def valve(self, columns: int, rows: int) -> Valve:
        """The valve sampled on ``columns x rows`` vertices; as it was given without coordinates."""
        return self.given if self.band is None else self.band.sampled(columns, rows)

    def normals(self, columns: int, rows: int) -> FloatArray:
        """Directions ``(n, 3)`` of the thickness at the vertices of `valve`."""
        if self.band is None:
            return leaflet_normals(self.given.surface)
        grid = band_grid(columns, rows)
        return self.band.normal(grid.phi, grid.s)

    def layers(self, element: str, columns: int, rows: int, layers: int = 1) -> SolidMesh:
        """A mesh of ``columns x rows x layers`` cells.

        Raises
        ------
        InputError
            If there are not two leaflets.
        GeometryError
            If cells are folded.
        """
        if self.band is None:
            raise InputError(
                "a structured mesh needs a valve with two leaflets; expected mesh source tetwild"
            )
        try:
            return structured_mesh(self.band, element, columns, rows, layers)
        except GeometryError as fault:
            raise GeometryError(
                f"structured mesh of {columns} x {rows} cells: {fault}; the reference "
                "surface or the line between its leaflets is too jagged: smooth it, change the "
                "number of cells, or take mesh source tetwild"
            ) from fault

    def tetrahedra(self, edge_length: float, element: str, store: Path | None) -> SolidMesh:
        """An unstructured mesh of the surface as it was given, made once and kept in ``store``.

        Parameters
        ----------
        edge_length
            mm.
        element
            ``tet10`` or ``tet4``.
        """
        settings = TetwildSettings(edge_length, ENVELOPE_SHARE * edge_length)
        return tetrahedral_leaflets(self.given.surface, settings, element, store)
