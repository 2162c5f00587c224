"""Moving tissue as sheets and cords, with scatterers fixed to it.

Scatterers have the same material coordinates in all frames, so that speckle moves with the tissue.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class Material:
    """Acoustic properties of tissue."""

    name: str
    echo_db: float  #: echo strength (`mvest.imaging.simulator.acquisition`)
    specular: bool = True  #: whether the echo depends on the angle between surface and beam
    fineness: float = 1.0  #: density of scatterers over that in walls, for thin tissue


Sowing: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Scatterers, uniform over a part: material coordinates ``(n, 3)``, amplitudes relative to the
material's ``(n,)`` and shares of dense tissue ``(n,)``, 0 to 1."""


def _differences(points: FloatArray, axis: int, closed: bool) -> FloatArray:
    if closed:
        return np.asarray(np.roll(points, -1, axis) - np.roll(points, 1, axis))
    return np.asarray(np.gradient(points, axis=axis))


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9))


def _sum(vectors: FloatArray) -> FloatArray:
    """Sum of the three components."""
    return np.asarray(vectors[:, 0] + vectors[:, 1] + vectors[:, 2])


def _in_cells(
    grid: FloatArray, seeds: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[FloatArray, ...]]:
    """Coordinates of seeds in the cells of a grid, closed along columns, and the cells' corners.

    Rows and columns of ``grid (R, C, ...)`` are the first two coordinates of the seeds.
    """
    rows, columns = grid.shape[:2]
    row, column = np.minimum(seeds[:, 0].astype(np.int64), rows - 2), seeds[:, 1].astype(np.int64)
    shape = (len(seeds), *[1] * (grid.ndim - 2))
    x, y = (seeds[:, 0] - row).reshape(shape), (seeds[:, 1] - column).reshape(shape)
    a, b = column % columns, (column + 1) % columns
    return x, y, (grid[row, a], grid[row, b], grid[row + 1, a], grid[row + 1, b])


def normals(points: FloatArray) -> FloatArray:
    """Unit normals, rows x columns, of grids ``(..., R, C, 3)`` that are closed around."""
    return _unit(np.cross(_differences(points, -3, False), _differences(points, -2, True)))


@dataclass(frozen=True, slots=True, eq=False)
class TissueSheet:
    """A layer over a grid of moving points, closed along its columns; mm in valve axes."""

    material: Material
    points: FloatArray  #: (T, R, C, 3)
    thickness: FloatArray  #: (R, C)
    span: tuple[float, float]  #: along the normal (row x column direction), over thickness
    relative: FloatArray  #: (R, C) amplitude relative to the material's
    fade: float = 0.0  #: the amplitude falls by exp(-fade) from the grid to one thickness away

    @property
    def _cells(self) -> FloatArray:
        """``(R - 1, C)`` mm^3."""
        p = self.points[0]
        d_row = np.diff(p + np.roll(p, -1, 1), axis=0) / 2
        along = np.roll(p, -1, 1) - p
        area = np.linalg.norm(np.cross(d_row, 0.5 * (along[1:] + along[:-1])), axis=-1)
        t = self.thickness + np.roll(self.thickness, -1, 1)
        return np.asarray(area * (t[1:] + t[:-1]) / 4 * (self.span[1] - self.span[0]))

    @property
    def volume(self) -> float:
        """mm^3 in the first frame."""
        return float(self._cells.sum())

    def sow(self, rng: np.random.Generator, count: int) -> Sowing:
        """Scatterers at rows, columns and distances along the normal; none is of dense tissue."""
        cells = self._cells
        each = rng.multinomial(count, cells.ravel() / cells.sum())
        seeds = rng.random((count, 3))
        cell = np.repeat(np.arange(cells.size), each)
        seeds[:, 0] += cell // cells.shape[1]
        seeds[:, 1] += cell % cells.shape[1]
        seeds[:, 2] = self.span[0] + (self.span[1] - self.span[0]) * seeds[:, 2]
        x, y, (a, b, c, d) = _in_cells(self.relative, seeds)
        relative = (1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d)
        return seeds, relative * np.exp(-self.fade * np.abs(seeds[:, 2])), np.zeros(count)

    def place(self, frame: int, seeds: FloatArray, apex: FloatArray) -> tuple[FloatArray, ...]:
        """Positions ``(n, 3)`` and ``|normal . line of sight|`` ``(n,)``."""
        points = self.points[frame]
        grid = np.concatenate([points, normals(points), self.thickness[..., None]], axis=-1)
        x, y, (a, b, c, d) = _in_cells(grid, seeds)
        here = (1 - x) * (1 - y) * a + (1 - x) * y * b + (x * (1 - y) * c + x * y * d)
        on_grid, normal, thickness = np.split(here, [3, 6], axis=1)
        size = np.maximum(np.sqrt(_sum(normal * normal)), 1e-9)
        sight = on_grid - apex
        cosine = np.abs(_sum(sight * normal / size[:, None]))
        cosine /= np.maximum(np.sqrt(_sum(sight * sight)), 1e-9)
        away = normal / size[:, None] * thickness * seeds[:, 2:]
        return on_grid + away, np.minimum(cosine, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Cord:
    """Tissue of round cross-section along a moving line; mm in valve axes."""

    material: Material
    line: FloatArray  #: (T, m, 3)
    radius: FloatArray  #: (m,)
    closed: bool  #: whether the first point follows the last
    dense: FloatArray  #: (m,) share of dense tissue, 0 to 1

    def _ends(self, values: FloatArray) -> FloatArray:
        """Values at the points, the first repeated at the end of a closed line."""
        return np.concatenate([values, values[:1]]) if self.closed else values

    @property
    def _cells(self) -> FloatArray:
        p, r = self._ends(self.line[0]), self._ends(self.radius)
        area = np.pi * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2) / 3
        return np.asarray(area * np.linalg.norm(np.diff(p, axis=0), axis=1))

    @property
    def volume(self) -> float:
        """mm^3 in the first frame."""
        return float(self._cells.sum())

    def sow(self, rng: np.random.Generator, count: int) -> Sowing:
        """Scatterers at distances along the line, and across it in the unit disk."""
        cells = self._cells
        each = rng.multinomial(count, cells / cells.sum())
        seeds = rng.random((count, 3))
        radius, angle = np.sqrt(seeds[:, 1]), 2 * np.pi * seeds[:, 2]
        seeds[:, 0] += np.repeat(np.arange(len(cells)), each)
        seeds[:, 1], seeds[:, 2] = radius * np.cos(angle), radius * np.sin(angle)
        values = self._ends(self.dense)
        dense = np.interp(seeds[:, 0], np.arange(len(values)), values)
        return seeds, np.ones(count), dense

    def place(self, frame: int, seeds: FloatArray, apex: FloatArray) -> tuple[FloatArray, ...]:
        """Positions ``(n, 3)`` and the sine between cord and line of sight ``(n,)``."""
        p = self.line[frame]
        tangent = _unit(_differences(p, 0, self.closed))
        # One reference direction for the whole cord and all frames.
        first = _unit(_differences(self.line[0], 0, self.closed))
        axis = np.eye(3)[np.argmin(np.abs(first).max(axis=0))]
        u = _unit(np.cross(tangent, axis))
        v = np.cross(tangent, u)
        p, tangent, u, v = (self._ends(x) for x in (p, tangent, u, v))
        a = np.minimum(seeds[:, 0].astype(np.int64), len(p) - 2)
        x = seeds[:, :1] - a[:, None]

        def at(values: FloatArray) -> FloatArray:
            return np.asarray((1 - x) * values[a] + x * values[a + 1])

        across = seeds[:, 1:2] * at(u) + seeds[:, 2:] * at(v)
        sight = at(p) - apex
        cosine = _sum(sight * at(tangent))
        sine = np.sqrt(np.maximum(1 - cosine**2 / np.maximum(_sum(sight * sight), 1e-9), 0.0))
        return at(p) + at(self._ends(self.radius)[:, None]) * across, sine


TissuePart: TypeAlias = TissueSheet | Cord
"""A piece of tissue that scatterers can be sown into."""
