"""Detectors of landmarks, rims and leaflets, which start from a shape nearby.

Candidates around a guess vote for a landmark or a rim: trees predict its position relative to each.
The candidates of a rim are in the plane perpendicular to it. Leaflets are found by the probability
of the midsurface along their normals. Rims are the annulus and the free edge.
"""

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import SamplePattern, StandardFrame, features
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.shape_model import Examples, LabelledFrame, Misses
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Trees
from mvest.imaging.valve_sequence import landmark_vertices
from mvest.typing import FloatArray, IntArray

ROUNDS = 4


def consensus(votes: FloatArray, width_mm: float = 1.5) -> tuple[FloatArray, FloatArray]:
    """Robust means ``(P, d)`` mm of votes ``(P, V, d)``, and their spread ``(P,)`` mm.

    Votes farther than ``width_mm`` from the mean have little weight (Cauchy). The spread is the
    weighted root mean square distance of the votes.
    """
    centre = np.median(votes, axis=1)
    for _ in range(ROUNDS):
        gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
        weight = 1 / (1 + gap / width_mm**2)
        weight /= weight.sum(axis=1, keepdims=True)
        centre = (weight[..., None] * votes).sum(axis=1)
    gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
    return centre, np.sqrt((weight * gap).sum(axis=1))


def _cloud(seed: int, spreads: tuple[float, ...], counts: list[int], pairs: int) -> SamplePattern:
    """Samples about a candidate: normal, with the standard deviation ``spreads[k]`` at scale k."""
    rng = np.random.default_rng(seed)
    offsets = rng.standard_normal((sum(counts), 3)) * np.repeat(spreads, counts)[:, None]
    return SamplePattern.paired(offsets, np.repeat([0, 1, 2], counts), pairs, seed)


def _candidates(step: float, dimensions: int) -> FloatArray:
    """``(5^d, d)`` mm: a grid about a guess."""
    ticks = step * np.arange(-2, 3)
    grid = np.meshgrid(*[ticks] * dimensions, indexing="ij")
    return np.stack(grid, -1).reshape(-1, dimensions)


def _with_place(
    values: NDArray[np.float32], phi: FloatArray, third: FloatArray | float
) -> NDArray[np.float32]:
    """Features with the position around the valve (``phi``, degrees) and a third value."""
    phi = np.deg2rad(phi)
    place = np.stack([np.abs(np.cos(phi)), np.sin(phi), np.broadcast_to(third, phi.shape)], axis=1)
    return np.concatenate([values, place.astype(np.float32)], axis=1)


# -- landmarks ------------------------------------------------------------------------------------
LANDMARK_MISSES = Misses(0.0, 4.0, 0.03)
LANDMARK_START_MM = 4.0
"""mm, standard deviation of each coordinate of training candidates about a point."""

LANDMARK_STEPS_MM = (2.6, 1.3)
"""mm between candidates in both rounds."""

LANDMARK_PATTERN = _cloud(4, (3.0, 7.0, 12.0), [50, 50, 30], 70)


def landmark_points(vertices: FloatArray, tips: FloatArray, layout: ValveLayout) -> FloatArray:
    """Points ``(L, 3)`` mm in the order of :data:`mvest.imaging.valve_sequence.LANDMARKS`."""
    return np.concatenate([vertices[list(landmark_vertices(layout).values())], tips])


def landmark_samples(seen: LabelledFrame, which: int, count: int) -> Examples:
    """Candidates about one landmark, and its position relative to them ``(P, 3)`` in their axes."""
    poses = seen.missed_poses(LANDMARK_MISSES, count)
    point = landmark_points(seen.vertices, seen.tips, seen.model.layout)[which]
    candidates = point + seen.rng.standard_normal((count, 3)) * LANDMARK_START_MM
    gap = np.einsum("pij,pi->pj", poses.rotation, point - candidates)
    return features(seen.frame, LANDMARK_PATTERN, candidates, poses.axes), gap


def find_landmarks(
    frame: StandardFrame, boosters: Trees, pose: Poses, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """All landmarks ``(L, 3)`` mm and the spread of their votes ``(L,)`` mm.

    The search starts at ``points (L, 3)``. The three outputs of the trees are the position of a
    landmark relative to a candidate, mm in the axes of the ``pose`` (one).
    """
    refined, spread = np.array(points), np.zeros(len(points))
    for step in LANDMARK_STEPS_MM:
        grid = _candidates(step, 3)
        axes = np.broadcast_to(pose.axes, (len(grid), 3, 3))
        for k in range(len(points)):
            candidates = refined[k] + grid @ pose.rotation[0].T
            values = features(frame, LANDMARK_PATTERN, candidates, axes)
            votes = candidates + boosters[f"landmark_{k}"](values) @ pose.rotation[0].T
            (refined[k],), (spread[k],) = consensus(votes[None])
    return refined, spread


# -- rims -----------------------------------------------------------------------------------------
RIMS = {"annulus": 0, "free_edge": -1}
"""Row of each rim."""

GUESSES = 6
"""Number of shapes around which the training candidates of one frame are taken."""

RIM_MISSES = Misses(1.5, 4.0, 0.04, 0.5)
RIM_STEPS_MM = (1.6, 0.9)
"""mm between candidates in both rounds."""

RIM_PATTERN = _cloud(5, (2.2, 5.0, 10.0), [50, 45, 25], 80)


def rim_axes(vertices: FloatArray, layout: ValveLayout, row: int) -> FloatArray:
    """Axes ``(columns, 3, 3)``: along the rim, away from the leaflet, and across it."""
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    inner = 2 if row == 0 else layout.rows - 3
    along = np.roll(grid[row], -1, 0) - np.roll(grid[row], 1, 0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away = grid[row] - grid[inner]
    away -= (away * along).sum(axis=1, keepdims=True) * along
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([along, away, np.cross(along, away)], axis=2)


def rim_samples(seen: LabelledFrame, which: str, count: int) -> Examples:
    """Candidates about one of `RIMS`, and its position relative to them ``(P, 2)`` mm."""
    layout, rng = seen.model.layout, seen.rng
    row = RIMS[which] % layout.rows
    target = seen.vertices.reshape(layout.rows, layout.columns, 3)[row]
    xs, ys = [], []
    for guess in seen.missed_shapes(RIM_MISSES, GUESSES):
        columns = rng.integers(layout.columns, size=count // GUESSES)
        axes = rim_axes(guess, layout, row)[columns]
        about = guess.reshape(layout.rows, layout.columns, 3)[row][columns]
        off = rng.standard_normal((len(columns), 3)) * [0.0, 2.0, 2.0]
        points = about + np.einsum("pij,pj->pi", axes, off)
        gap = np.einsum("pij,pi->pj", axes, target[columns] - points)[:, 1:]
        values = features(seen.frame, RIM_PATTERN, points, axes)
        phi = 360.0 * columns / layout.columns
        xs.append(_with_place(values, phi, float(seen.pose.log_scale[0])))
        ys.append(np.clip(gap, -8.0, 8.0))
    return np.concatenate(xs), np.concatenate(ys)


def find_rim(
    frame: StandardFrame,
    boosters: Trees,
    which: str,
    vertices: FloatArray,
    layout: ValveLayout,
    log_scale: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Detect one of `RIMS` near that of a shape ``(n, 3)`` mm.

    The two outputs of the trees are the distances of the rim from a candidate, away from the
    leaflet and across it.

    Returns
    -------
    axes : (columns, 3, 3)
        See :func:`rim_axes`.
    offset : (columns, 2) mm
        From the shape's rim to the detected one, away from the leaflet and across it.
    spread : (columns,) mm
        Of the votes.
    """
    row = RIMS[which] % layout.rows
    axes = rim_axes(vertices, layout, row)
    about = vertices.reshape(layout.rows, layout.columns, 3)[row]
    offset, spread = np.zeros((layout.columns, 2)), np.zeros(layout.columns)
    for step in RIM_STEPS_MM:
        grid = _candidates(step, 2)
        local = offset[:, None] + grid  # (columns, G, 2)
        points = about[:, None] + np.einsum("cij,cgj->cgi", axes[:, :, 1:], local)
        many = np.repeat(axes, len(grid), 0)
        values = features(frame, RIM_PATTERN, points.reshape(-1, 3), many)
        phi = np.repeat(360.0 * np.arange(layout.columns) / layout.columns, len(grid))
        gap = boosters[which](_with_place(values, phi, log_scale))
        offset, spread = consensus(local + gap.reshape(local.shape))
    return axes, offset, spread


# -- leaflets -------------------------------------------------------------------------------------
BOUNDARY_MISSES = Misses(1.2, 3.0, 0.03, 0.4)
BOUNDARY_STEP_MM = 0.5
"""mm between samples along a normal."""

BOUNDARY_WIDTH_MM = 0.6
"""mm, standard deviation of the label about the midsurface: exp(-d^2 / (2 WIDTH^2))."""

REACH = (3, 2)
"""Columns and rows around a vertex among which the nearest true vertex is searched."""


def _boundary_pattern() -> SamplePattern:
    along = np.arange(-6.0, 6.1, 1.0)
    rows = [(0.0, 0.0, z, 0) for z in along] + [(0.0, 0.0, z, 1) for z in along[::2]]
    for x, y in ((2, 0), (-2, 0), (0, 2), (0, -2), (4.5, 0), (-4.5, 0), (0, 4.5), (0, -4.5)):
        rows += [(x, y, z, 1) for z in (-4.5, -1.5, 0.0, 1.5, 4.5)]
        rows += [(x, y, z, 0) for z in (-0.8, 0.8)]
    rows += [(0.0, 0.0, z, 2) for z in (-12.0, -8.0, 8.0, 12.0)]
    table = np.array(rows)
    return SamplePattern.paired(table[:, :3], table[:, 3].astype(np.int64), 70, 6)


BOUNDARY_PATTERN = _boundary_pattern()


def leaflet_axes(vertices: FloatArray, layout: ValveLayout) -> FloatArray:
    """Axes ``(n, 3, 3)`` at the vertices: around the valve, along the leaflet, and normal to it."""
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    around = np.roll(grid, -1, 1) - np.roll(grid, 1, 1)
    along: FloatArray = np.asarray(np.gradient(grid, axis=0))
    normal = np.cross(along, around)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    around = around / np.maximum(np.linalg.norm(around, axis=2, keepdims=True), 1e-9)
    along = np.asarray(np.cross(around, normal))
    return np.stack([around, along, normal], axis=3).reshape(-1, 3, 3)


def _gap(
    points: FloatArray, normals: FloatArray, which: IntArray, true: FloatArray, layout: ValveLayout
) -> FloatArray:
    """Distances ``(P,)`` mm along normals from points to the leaflet ``true (n, 3)``."""
    shape = (layout.rows, layout.columns, 3)
    grid: FloatArray = true.reshape(shape)
    true_normals = leaflet_axes(true, layout)[:, :, 2].reshape(shape)
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


def boundary_samples(seen: LabelledFrame, count: int) -> Examples:
    """Points along normals of shapes about the true one, and their labels ``(P, 1)``."""
    layout, rng = seen.model.layout, seen.rng
    xs, ys = [], []
    for guess in seen.missed_shapes(BOUNDARY_MISSES, GUESSES):
        which = rng.integers(layout.size, size=count // GUESSES)
        axes = leaflet_axes(guess, layout)[which]
        off = rng.uniform(-6.0, 6.0, len(which))
        normal = axes[:, :, 2]
        gap = _gap(guess[which], normal, which, seen.vertices, layout)
        # Half of the points are near the leaflet.
        close = rng.random(len(which)) < 0.5
        off = np.where(close, gap + rng.standard_normal(len(which)) * 1.2, off)
        points = guess[which] + off[:, None] * normal
        gap = _gap(points, normal, which, seen.vertices, layout)
        values = features(seen.frame, BOUNDARY_PATTERN, points, axes)
        xs.append(_with_place(values, layout.phi[which], layout.s[which]))
        ys.append(np.exp(-0.5 * (gap / BOUNDARY_WIDTH_MM) ** 2))
    return np.concatenate(xs), np.concatenate(ys)[:, None]


def find_boundary(
    frame: StandardFrame,
    boosters: Trees,
    vertices: FloatArray,
    layout: ValveLayout,
    reach_mm: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Detect the leaflets within ``reach_mm`` along the normals of a shape ``(n, 3)`` mm.

    The output of the trees is the probability that a point is on the midsurface. The prior of its
    distance is normal, with a standard deviation of half the reach.

    Returns
    -------
    normals : (n, 3)
    offset, std : (n,) mm
        Expected distance along the normal, and its standard deviation.
    confidence : (n,)
        Probability at the best point, 0 to 1.
    """
    axes = leaflet_axes(vertices, layout)
    normals = axes[:, :, 2]
    steps = int(reach_mm / BOUNDARY_STEP_MM + 1e-9)
    off = BOUNDARY_STEP_MM * np.arange(-steps, steps + 1)
    points = vertices[:, None] + off[:, None] * normals[:, None]
    which = np.repeat(np.arange(layout.size), len(off))
    values = features(frame, BOUNDARY_PATTERN, points.reshape(-1, 3), np.repeat(axes, len(off), 0))
    values = _with_place(values, layout.phi[which], layout.s[which])
    p = boosters["boundary"](values)[:, 0].reshape(layout.size, -1)
    odds = np.maximum(p, 1e-4) ** 2 * np.exp(-0.5 * (off / (0.5 * reach_mm)) ** 2)
    odds /= odds.sum(axis=1, keepdims=True)
    offset = odds @ off
    std = np.sqrt(np.maximum((odds * (off - offset[:, None]) ** 2).sum(axis=1), 0.04))
    return normals, offset, std, p.max(axis=1)
