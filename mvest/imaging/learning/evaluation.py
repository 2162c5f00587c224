"""How far a detected valve is from the true one, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mvest.imaging.detection.boundary import leaflet_axes
from mvest.imaging.detection.detect import FrameValve
from mvest.imaging.detection.landmark_detector import landmark_points
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.truth import TrueValve
from mvest.typing import FloatArray

FINER = 4
"""Times as many points as vertices in each direction stand for a surface."""


@dataclass(frozen=True, slots=True)
class FrameErrors:
    """Distances in mm, angles in degrees.

    Attributes
    ----------
    surface : float
        Mean symmetric distance of the leaflets' surfaces.
    points : float
        Mean distance of corresponding vertices.
    tips : float
        Mean of both papillary tips.
    annulus, free_edge : float
        Mean distance of the rims across their course.
    position, turn, log_scale : float
        Of the pose that the fit began with.
    stages : dict
        Mean distance of corresponding points after each stage that has vertices, and of the
        landmarks.
    """

    surface: float
    points: float
    tips: float
    annulus: float
    free_edge: float
    position: float
    turn: float
    log_scale: float
    stages: dict[str, float]


def frame_errors(
    detected: FrameValve,
    vertices: FloatArray,
    tips: FloatArray,
    true: TrueValve,
    layout: ValveLayout,
) -> FrameErrors:
    """Errors of one frame.

    Parameters
    ----------
    detected : FrameValve
        For the stages.
    vertices, tips : (n, 3), (2, 3) mm
        As finally handed on (smoothed in time, for instance).
    true : TrueValve
    """
    by = detected.start.towards(true.pose)[0]
    stages = {}
    for name, points in detected.stages.items():
        whole = len(points) == layout.size
        right = true.vertices if whole else landmark_points(true, layout)
        stages[name] = float(np.linalg.norm(points - right, axis=1).mean())
    there, back = surface_distances(vertices, true.vertices, layout)
    rims = [
        _across(vertices[rim], true.vertices[rim]) for rim in (layout.annulus, layout.free_edge)
    ]
    return FrameErrors(
        surface=float(0.5 * (there.mean() + back.mean())),
        points=float(np.linalg.norm(vertices - true.vertices, axis=1).mean()),
        tips=float(np.linalg.norm(tips - true.tips, axis=1).mean()),
        annulus=rims[0],
        free_edge=rims[1],
        position=float(np.linalg.norm(by[:3])),
        turn=float(np.rad2deg(np.linalg.norm(by[3:6]))),
        log_scale=float(abs(by[6])),
        stages=stages,
    )


def surface_distances(
    detected: FloatArray, true: FloatArray, layout: ValveLayout
) -> tuple[FloatArray, FloatArray]:
    """Distances ``(n,)`` mm of the vertices of each surface from the other.

    A surface is stood for by its tangent planes at four times as many points in each direction.
    """
    return _to_surface(detected, true, layout), _to_surface(true, detected, layout)


def _to_surface(points: FloatArray, surface: FloatArray, layout: ValveLayout) -> FloatArray:
    fine = ValveLayout(FINER * layout.columns, FINER * (layout.rows - 1) + 1, layout.region_names)
    grid = surface.reshape(layout.rows, layout.columns, 3)
    u = np.arange(fine.columns) / FINER
    left, share = u.astype(np.int64), (u % 1.0)[:, None]
    around = grid[:, left] * (1 - share) + grid[:, (left + 1) % layout.columns] * share
    v = np.arange(fine.rows) / FINER
    upper = np.minimum(v.astype(np.int64), layout.rows - 2)
    share = (v - upper)[:, None, None]
    flat = (around[upper] * (1 - share) + around[upper + 1] * share).reshape(-1, 3)
    gap, near = cKDTree(flat).query(points)
    normal = leaflet_axes(flat, fine)[near, :, 2]
    off = np.abs(((points - flat[near]) * normal).sum(axis=1))
    # Beyond a rim the nearest point is on the rim itself.
    row = near // fine.columns
    inside = (row > 0) & (row < fine.rows - 1)
    return np.where(inside, off, gap)


def _across(points: FloatArray, true: FloatArray) -> float:
    """Mean distance (mm) of a closed curve's points from another one, seen as segments."""
    a, b = true, np.roll(true, -1, 0)
    along = b - a
    t = ((points[:, None] - a) * along).sum(axis=2) / (along**2).sum(axis=1)
    foot = a + np.clip(t, 0, 1)[..., None] * along
    return float(np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1).mean())


def best_threshold(right: FloatArray, wrong: FloatArray) -> float:
    """The confidence that separates right detections from wrong ones best.

    It maximises the share of ``right`` at or above it plus the share of ``wrong`` below it; of
    equally good thresholds the middle one is taken.
    """
    edges = np.unique(np.concatenate([right, wrong]))
    tried = np.concatenate([edges[:1] - 1e-3, 0.5 * (edges[1:] + edges[:-1]), edges[-1:] + 1e-3])
    score = [(right >= t).mean() + (wrong < t).mean() for t in tried]
    best = tried[np.isclose(score, max(score))]
    return float(best[len(best) // 2])
