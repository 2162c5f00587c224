"""Tissue as sheets and cords that move, and the scatterers in it, fixed to the tissue.

A scatterer keeps its material coordinates in all frames, so that speckle moves as tissue does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numba as nb
import numpy as np

from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class Material:
    """What tissue does to sound.

    Attributes
    ----------
    name : str
    echo_db : float
        Echo strength, see :mod:`mvest.imaging.simulator.acquisition`.
    specular : bool
        Whether the echo depends on the angle between surface and beam.
    fineness : float
        How many times more scatterers a volume holds than in walls; for thin tissue.
    """

    name: str
    echo_db: float
    specular: bool = True
    fineness: float = 1.0


class Seeds(NamedTuple):
    """Scatterers in a part, uniform over its volume.

    Attributes
    ----------
    places : (n, 3)
        Material coordinates.
    strength : (n,)
        Amplitude relative to the material's.
    dense : (n,)
        Share of dense tissue, 0 to 1.
    """

    places: FloatArray
    strength: FloatArray
    dense: FloatArray


def _differences(points: FloatArray, axis: int, closed: bool) -> FloatArray:
    if closed:
        return np.asarray(np.roll(points, -1, axis) - np.roll(points, 1, axis))
    return np.asarray(np.gradient(points, axis=axis))


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9))


def normals(points: FloatArray) -> FloatArray:
    """Unit normals, rows x columns, of grids ``(..., R, C, 3)`` that are closed around."""
    return _unit(np.cross(_differences(points, -3, False), _differences(points, -2, True)))


@dataclass(frozen=True, slots=True, eq=False)
class TissueSheet:
    """A layer over a grid of moving points, closed along its columns.

    Attributes
    ----------
    material : Material
    points : (T, R, C, 3) mm
        In valve axes.
    thickness : (R, C) mm
    span : (float, float)
        Where the layer lies along the normal (row direction x column direction), over thickness.
    relative : (R, C)
        Amplitude relative to the material's.
    fade : float
        The amplitude falls by ``exp(-fade)`` from the grid to one thickness away.
    """

    material: Material
    points: FloatArray
    thickness: FloatArray
    span: tuple[float, float]
    relative: FloatArray
    fade: float = 0.0

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

    def sow(self, rng: np.random.Generator, count: int) -> Seeds:
        """Scatterers at rows, columns and places along the normal; none is of dense tissue."""
        cells = self._cells
        each = rng.multinomial(count, cells.ravel() / cells.sum())
        seeds = rng.random((count, 3))
        cell = np.repeat(np.arange(cells.size), each)
        seeds[:, 0] += cell // cells.shape[1]
        seeds[:, 1] += cell % cells.shape[1]
        seeds[:, 2] = self.span[0] + (self.span[1] - self.span[0]) * seeds[:, 2]
        strength = _bilinear(self.relative, seeds) * np.exp(-self.fade * np.abs(seeds[:, 2]))
        return Seeds(seeds, strength, np.zeros(count))

    def place(self, frame: int, seeds: FloatArray, apex: FloatArray) -> tuple[FloatArray, ...]:
        """Positions ``(n, 3)`` and ``|normal . line of sight|`` ``(n,)``."""
        p = self.points[frame]
        return _on_sheet(p, normals(p), self.thickness, seeds, apex)


@dataclass(frozen=True, slots=True, eq=False)
class Cord:
    """Tissue of round cross-section along a moving line.

    Attributes
    ----------
    material : Material
    line : (T, m, 3) mm
        In valve axes.
    radius : (m,) mm
    closed : bool
        Whether the last point is followed by the first.
    dense : (m,)
        Share of dense tissue, 0 to 1.
    """

    material: Material
    line: FloatArray
    radius: FloatArray
    closed: bool
    dense: FloatArray

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

    def sow(self, rng: np.random.Generator, count: int) -> Seeds:
        """Scatterers at places along the line, and across it in the unit disk."""
        cells = self._cells
        each = rng.multinomial(count, cells / cells.sum())
        seeds = rng.random((count, 3))
        radius, angle = np.sqrt(seeds[:, 1]), 2 * np.pi * seeds[:, 2]
        seeds[:, 0] += np.repeat(np.arange(len(cells)), each)
        seeds[:, 1], seeds[:, 2] = radius * np.cos(angle), radius * np.sin(angle)
        values = self._ends(self.dense)
        dense = np.interp(seeds[:, 0], np.arange(len(values)), values)
        return Seeds(seeds, np.ones(count), dense)

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
        return _on_cord(p, tangent, u, v, self._ends(self.radius), seeds, apex)


TissuePart: TypeAlias = TissueSheet | Cord
"""A piece of tissue that scatterers can be sown into."""


@nb.njit(cache=True)
def _bilinear(values: FloatArray, seeds: FloatArray) -> FloatArray:
    """Values ``(R, C)`` at rows and columns ``(n, 2 or more)``, closed along columns."""
    rows, columns = values.shape
    out = np.empty(len(seeds))
    for i in range(len(seeds)):
        a, b = min(int(seeds[i, 0]), rows - 2), int(seeds[i, 1]) % columns
        c = (b + 1) % columns
        x, y = seeds[i, 0] - a, seeds[i, 1] - int(seeds[i, 1])
        out[i] = (1 - x) * ((1 - y) * values[a, b] + y * values[a, c]) + x * (
            (1 - y) * values[a + 1, b] + y * values[a + 1, c]
        )
    return out


@nb.njit(cache=True)
def _on_sheet(
    points: FloatArray,
    normals: FloatArray,
    thickness: FloatArray,
    seeds: FloatArray,
    apex: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    rows, columns = thickness.shape
    out, facing = np.empty((len(seeds), 3)), np.empty(len(seeds))
    n = np.empty(3)
    for i in range(len(seeds)):
        a, b = min(int(seeds[i, 0]), rows - 2), int(seeds[i, 1]) % columns
        c = (b + 1) % columns
        x, y = seeds[i, 0] - a, seeds[i, 1] - int(seeds[i, 1])
        w0, w1, w2, w3 = (1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y
        t = w0 * thickness[a, b] + w1 * thickness[a, c]
        t += w2 * thickness[a + 1, b] + w3 * thickness[a + 1, c]
        size = 0.0
        for d in range(3):
            n[d] = w0 * normals[a, b, d] + w1 * normals[a, c, d]
            n[d] += w2 * normals[a + 1, b, d] + w3 * normals[a + 1, c, d]
            size += n[d] * n[d]
        size = max(np.sqrt(size), 1e-9)
        dot = square = 0.0
        for d in range(3):
            p = w0 * points[a, b, d] + w1 * points[a, c, d]
            p += w2 * points[a + 1, b, d] + w3 * points[a + 1, c, d]
            out[i, d] = p + n[d] / size * t * seeds[i, 2]
            sight = p - apex[d]
            dot += sight * n[d] / size
            square += sight * sight
        facing[i] = min(abs(dot) / max(np.sqrt(square), 1e-9), 1.0)
    return out, facing


@nb.njit(cache=True)
def _on_cord(
    points: FloatArray,
    tangent: FloatArray,
    u: FloatArray,
    v: FloatArray,
    radius: FloatArray,
    seeds: FloatArray,
    apex: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    out, facing = np.empty((len(seeds), 3)), np.empty(len(seeds))
    for i in range(len(seeds)):
        a = min(int(seeds[i, 0]), len(points) - 2)
        x = seeds[i, 0] - a
        r = (1 - x) * radius[a] + x * radius[a + 1]
        dot = square = 0.0
        for d in range(3):
            p = (1 - x) * points[a, d] + x * points[a + 1, d]
            across = seeds[i, 1] * ((1 - x) * u[a, d] + x * u[a + 1, d])
            across += seeds[i, 2] * ((1 - x) * v[a, d] + x * v[a + 1, d])
            out[i, d] = p + r * across
            sight = p - apex[d]
            dot += sight * ((1 - x) * tangent[a, d] + x * tangent[a + 1, d])
            square += sight * sight
        facing[i] = np.sqrt(max(1.0 - dot * dot / max(square, 1e-9), 0.0))
    return out, facing
