"""Material coordinates of the leaflets' vertices, the same in every frame and valve.

``phi`` in degrees runs once around the valve, 0 and 180 on the lines between the leaflets, the
first leaflet in between; ``s`` runs from the annulus (0) to the free edge (1). Vertex ``j * columns
+ i`` is column i, row j: the first row is the annulus, the last one the free edge.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import BandGrid, band_grid


@dataclass(frozen=True)
class ValveLayout:
    """A band of two leaflets in columns and rows.

    Its columns include the lines between the leaflets and the middles of both.
    """

    columns: int = 64  #: vertices around the valve, a multiple of 4, at least 8
    rows: int = 15  #: vertices from annulus to free edge, at least 3
    region_names: ClassVar[tuple[str, str]] = ("anterior", "posterior")
    """Names of the leaflet with phi in (0, 180), and of the other one."""

    def __post_init__(self) -> None:
        if self.columns < 8 or self.columns % 4 or self.rows < 3:
            raise InputError(
                f"layout of {self.columns} x {self.rows} vertices, expected a multiple of 4 >= 8, "
                "and >= 3"
            )

    @property
    def size(self) -> int:
        """Number of vertices n."""
        return self.columns * self.rows

    @cached_property
    def _grid(self) -> BandGrid:
        return band_grid(self.columns, self.rows)

    @property
    def phi(self) -> FloatArray:
        """Angles ``(n,)``, degrees."""
        return self._grid.phi

    @property
    def s(self) -> FloatArray:
        """Coordinate ``(n,)`` from annulus (0) to free edge (1)."""
        return self._grid.s

    @property
    def triangles(self) -> IntArray:
        """Triangles ``(m, 3)``, with normals to the ventricle if phi runs as in the template."""
        return self._grid.triangles

    @property
    def region(self) -> IntArray:
        """Leaflet ``(m,)`` of each triangle."""
        return self._grid.region

    @property
    def annulus(self) -> IntArray:
        """``(columns,)`` vertices in loop order, beginning at phi = 0."""
        return np.arange(self.columns)

    @property
    def free_edge(self) -> IntArray:
        """``(columns,)`` vertices in loop order, beginning at phi = 0."""
        return np.arange(self.columns) + (self.rows - 1) * self.columns

    def column(self, phi: float) -> int:
        """The column at an angle in degrees; InputError if there is none."""
        exact = phi / 360.0 * self.columns
        if abs(exact - round(exact)) > 1e-9:
            raise InputError(f"no column of {self.columns} lies at {phi:g} degrees")
        return round(exact) % self.columns

    def vertex(self, phi: float, row: int) -> int:
        """Number of the vertex at an angle and a row (negative: from the free edge)."""
        return (row % self.rows) * self.columns + self.column(phi)

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Corners and weights ``(k, 3)`` of the triangles that contain points ``phi``, ``s (k,)``.

        phi (degrees) and s (0 to 1) are linear between the corners.
        """
        across, down = np.mod(phi, 360.0) / 360.0 * self.columns, s * (self.rows - 1)
        column = np.floor(across).astype(np.int64)
        row = np.minimum(np.floor(down).astype(np.int64), self.rows - 2)
        u, v = across - column, down - row
        begin, end = row * self.columns, (row + 1) * self.columns
        here, beside = column % self.columns, (column + 1) % self.columns
        # The diagonal of a cell runs from its first corner to the opposite one.
        a, b, c, d = begin + here, begin + beside, end + beside, end + here
        lower = v >= u
        corners = np.stack([a, np.where(lower, d, c), np.where(lower, c, b)], axis=1)
        weights = np.stack(
            [1.0 - np.maximum(u, v), np.where(lower, v - u, v), np.where(lower, u, u - v)], axis=1
        )
        return corners, weights
