"""Where along its normal a leaflet is: the probability of its midsurface, place by place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.sampling import SamplePattern, features
from mvest.imaging.learning.truth import Misses, TrueValve, missed_shapes
from mvest.typing import FloatArray, IntArray

MISSES = Misses(1.2, 3.0, 0.03, 0.4)
STEP_MM = 0.5
"""mm between places along a normal."""

WIDTH_MM = 0.6
"""mm, standard deviation of the label about the midsurface: exp(-d^2 / (2 WIDTH^2))."""

GUESSES = 6
"""Missed shapes that training places of one frame are taken from."""

REACH = (3, 2)
"""Columns and rows about a vertex among which its nearest true counterpart is looked for."""


def _pattern() -> SamplePattern:
    along = np.arange(-6.0, 6.1, 1.0)
    rows = [(0.0, 0.0, z, 0) for z in along] + [(0.0, 0.0, z, 1) for z in along[::2]]
    for x, y in ((2, 0), (-2, 0), (0, 2), (0, -2), (4.5, 0), (-4.5, 0), (0, 4.5), (0, -4.5)):
        rows += [(x, y, z, 1) for z in (-4.5, -1.5, 0.0, 1.5, 4.5)]
        rows += [(x, y, z, 0) for z in (-0.8, 0.8)]
    rows += [(0.0, 0.0, z, 2) for z in (-12.0, -8.0, 8.0, 12.0)]
    table = np.array(rows)
    return SamplePattern.paired(table[:, :3], table[:, 3].astype(np.int64), 70, 6)


PATTERN = _pattern()


def leaflet_axes(vertices: FloatArray, layout: ValveLayout) -> FloatArray:
    """``(n, 3, 3)``: at every vertex around the valve, along the leaflet, and its normal."""
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    around = np.roll(grid, -1, 1) - np.roll(grid, 1, 1)
    along: FloatArray = np.asarray(np.gradient(grid, axis=0))
    normal = np.cross(along, around)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    around = around / np.maximum(np.linalg.norm(around, axis=2, keepdims=True), 1e-9)
    along = np.asarray(np.cross(around, normal))
    return np.stack([around, along, normal], axis=3).reshape(-1, 3, 3)


def _with_place(
    values: NDArray[np.float32], layout: ValveLayout, which: IntArray
) -> NDArray[np.float32]:
    phi = np.deg2rad(layout.phi[which])
    place = np.stack([np.abs(np.cos(phi)), np.sin(phi), layout.s[which]], axis=1)
    return np.concatenate([values, place.astype(np.float32)], axis=1)


def _gap(
    points: FloatArray, normals: FloatArray, which: IntArray, true: TrueValve, layout: ValveLayout
) -> FloatArray:
    """``(P,)`` mm along the normals from points to the true leaflet near their vertices."""
    shape = (layout.rows, layout.columns, 3)
    grid: FloatArray = true.vertices.reshape(shape)
    true_normals = leaflet_axes(true.vertices, layout)[:, :, 2].reshape(shape)
    row, column = which // layout.columns, which % layout.columns
    di, dj = np.meshgrid(
        np.arange(-REACH[0], REACH[0] + 1), np.arange(-REACH[1], REACH[1] + 1), indexing="ij"
    )
    rows = np.clip(row[:, None] + dj.ravel(), 0, layout.rows - 1)
    columns = (column[:, None] + di.ravel()) % layout.columns
    near = grid[rows, columns]
    best = np.argmin(np.linalg.norm(near - points[:, None], axis=2), axis=1)
    pick = np.arange(len(points))
    there = near[pick, best]
    facing = true_normals[rows[pick, best], columns[pick, best]]
    slope = (facing * normals).sum(axis=1)
    slope = np.where(np.abs(slope) < 0.4, np.where(slope < 0, -0.4, 0.4), slope)
    return np.asarray(((there - points) * facing).sum(axis=1) / slope)


def boundary_samples(
    frame: StandardFrame, true: TrueValve, model: ShapeModel, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], FloatArray]:
    """Places along normals of missed shapes, with the label of each ``(P, 1)``."""
    layout = model.layout
    xs, ys = [], []
    for guess in missed_shapes(true, model, MISSES, GUESSES, rng):
        which = rng.integers(layout.size, size=count // GUESSES)
        axes = leaflet_axes(guess, layout)[which]
        off = rng.uniform(-6.0, 6.0, len(which))
        normal = axes[:, :, 2]
        gap = _gap(guess[which], normal, which, true, layout)
        # Half of the places are near the leaflet, where there is something to tell.
        close = rng.random(len(which)) < 0.5
        off = np.where(close, gap + rng.standard_normal(len(which)) * 1.2, off)
        points = guess[which] + off[:, None] * normal
        gap = _gap(points, normal, which, true, layout)
        xs.append(_with_place(features(frame, PATTERN, points, axes), layout, which))
        ys.append(np.exp(-0.5 * (gap / WIDTH_MM) ** 2))
    return np.concatenate(xs), np.concatenate(ys)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryDetector:
    """Finds the midsurface along the normals of a shape that is near.

    Attributes
    ----------
    boosters : Boosters
        One output: how likely a place is on the midsurface.
    """

    boosters: Boosters

    def __call__(
        self, frame: StandardFrame, vertices: FloatArray, layout: ValveLayout, reach_mm: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The leaflets as seen from a shape ``(n, 3)`` mm.

        Parameters
        ----------
        reach_mm : float
            How far to both sides of the shape it is looked; places are believed less the farther
            they are (normal, standard deviation half of this).

        Returns
        -------
        normals : (n, 3)
        offset : (n,) mm
            Expected place along the normal.
        std : (n,) mm
            Of this place.
        confidence : (n,)
            Probability at the best place, 0 to 1.
        """
        axes = leaflet_axes(vertices, layout)
        normals = axes[:, :, 2]
        steps = int(reach_mm / STEP_MM + 1e-9)
        off = STEP_MM * np.arange(-steps, steps + 1)
        points = vertices[:, None] + off[:, None] * normals[:, None]
        which = np.repeat(np.arange(layout.size), len(off))
        values = features(frame, PATTERN, points.reshape(-1, 3), np.repeat(axes, len(off), 0))
        p = self.boosters(_with_place(values, layout, which))[:, 0].reshape(layout.size, -1)
        odds = np.maximum(p, 1e-4) ** 2 * np.exp(-0.5 * (off / (0.5 * reach_mm)) ** 2)
        odds /= odds.sum(axis=1, keepdims=True)
        offset = odds @ off
        std = np.sqrt(np.maximum((odds * (off - offset[:, None]) ** 2).sum(axis=1), 0.04))
        return normals, offset, std, p.max(axis=1)
