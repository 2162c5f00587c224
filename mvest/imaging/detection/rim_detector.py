"""The annulus hinge and the free edge, column by column.

A rim lies where a leaflet ends: along the leaflet as well as across it there is something to see,
so candidates vote in the plane perpendicular to the rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.landmark_detector import consensus
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.sampling import SamplePattern, features
from mvest.imaging.learning.truth import Misses, TrueValve, missed_shapes
from mvest.typing import FloatArray

MISSES = Misses(1.5, 4.0, 0.04, 0.5)
GRIDS_MM = (1.6, 0.9)
"""mm between candidates in the first and second round."""

GUESSES = 6
"""Missed shapes that training candidates of one frame are taken from."""


def _pattern() -> SamplePattern:
    rng = np.random.default_rng(5)
    offsets = rng.standard_normal((120, 3)) * np.repeat([2.2, 5.0, 10.0], [50, 45, 25])[:, None]
    return SamplePattern.paired(offsets, np.repeat([0, 1, 2], [50, 45, 25]), 80, 5)


PATTERN = _pattern()


def rim_axes(vertices: FloatArray, layout: ValveLayout, row: int) -> FloatArray:
    """``(columns, 3, 3)``: at every column along the rim, away from the leaflet, and across it."""
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    inner = 2 if row == 0 else layout.rows - 3
    along = np.roll(grid[row], -1, 0) - np.roll(grid[row], 1, 0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away = grid[row] - grid[inner]
    away -= (away * along).sum(axis=1, keepdims=True) * along
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([along, away, np.cross(along, away)], axis=2)


def _with_place(
    values: NDArray[np.float32], layout: ValveLayout, columns: NDArray[np.int64], size: float
) -> NDArray[np.float32]:
    """Features with where around the valve they are from."""
    phi = np.deg2rad(360.0 * columns / layout.columns)
    place = np.stack([np.abs(np.cos(phi)), np.sin(phi), np.full(len(phi), size)], axis=1)
    return np.concatenate([values, place.astype(np.float32)], axis=1)


def rim_samples(
    frame: StandardFrame,
    true: TrueValve,
    model: ShapeModel,
    row: int,
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], FloatArray]:
    """Candidates about one rim (row 0 or -1), and where it lies from them ``(P, 2)`` mm."""
    layout = model.layout
    row %= layout.rows
    target = true.vertices.reshape(layout.rows, layout.columns, 3)[row]
    xs, ys = [], []
    for guess in missed_shapes(true, model, MISSES, GUESSES, rng):
        columns = rng.integers(layout.columns, size=count // GUESSES)
        axes = rim_axes(guess, layout, row)[columns]
        about = guess.reshape(layout.rows, layout.columns, 3)[row][columns]
        off = rng.standard_normal((len(columns), 3)) * [0.0, 2.0, 2.0]
        points = about + np.einsum("pij,pj->pi", axes, off)
        gap = np.einsum("pij,pi->pj", axes, target[columns] - points)[:, 1:]
        values = features(frame, PATTERN, points, axes)
        xs.append(_with_place(values, layout, columns, float(true.pose.log_scale[0])))
        ys.append(np.clip(gap, -8.0, 8.0))
    return np.concatenate(xs), np.concatenate(ys)


@dataclass(frozen=True, slots=True, eq=False)
class RimDetector:
    """Finds one rim from a shape that is near.

    Attributes
    ----------
    row : int
        0: annulus; -1: free edge.
    boosters : Boosters
        Two outputs: how far away from the leaflet, and across it, the rim lies from a candidate.
    """

    row: int
    boosters: Boosters

    def __call__(
        self, frame: StandardFrame, vertices: FloatArray, layout: ValveLayout, log_scale: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The rim as seen from a shape ``(n, 3)`` mm.

        Returns
        -------
        axes : (columns, 3, 3)
            See :func:`rim_axes`.
        offset : (columns, 2) mm
            Where the rim lies from the shape's, away from the leaflet and across it.
        spread : (columns,) mm
            How much the votes disagree.
        """
        row = self.row % layout.rows
        axes = rim_axes(vertices, layout, row)
        about = vertices.reshape(layout.rows, layout.columns, 3)[row]
        offset, spread = np.zeros((layout.columns, 2)), np.zeros(layout.columns)
        for step in GRIDS_MM:
            ticks = step * np.arange(-2, 3)
            grid = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
            local = offset[:, None] + grid  # (columns, G, 2)
            points = about[:, None] + np.einsum("cij,cgj->cgi", axes[:, :, 1:], local)
            many = np.repeat(axes, len(grid), 0)
            values = features(frame, PATTERN, points.reshape(-1, 3), many)
            columns = np.repeat(np.arange(layout.columns), len(grid))
            gap = self.boosters(_with_place(values, layout, columns, log_scale))
            offset, spread = consensus(local + gap.reshape(local.shape))
        return axes, offset, spread
