"""Where a valve truly is in a frame that a detector learns from, and how guesses miss it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrueValve:
    """One valve in world coordinates.

    Attributes
    ----------
    vertices : (n, 3) mm
    tips : (2, 3) mm
    pose : Poses
        One.
    """

    vertices: FloatArray
    tips: FloatArray
    pose: Poses

    @classmethod
    def of(cls, vertices: FloatArray, tips: FloatArray, model: ShapeModel) -> TrueValve:
        """With the pose that a shape model takes it to have."""
        return cls(vertices, tips, model.pose_of(vertices, tips))


@dataclass(frozen=True, slots=True)
class Misses:
    """By how much guesses miss a pose or a shape: standard deviations.

    Attributes
    ----------
    shift_mm, turn_degrees, log_scale : float
        Of the pose.
    shape : float
        Of each coefficient, over its standard deviation among valves.
    """

    shift_mm: float
    turn_degrees: float
    log_scale: float
    shape: float = 0.0


def missed_poses(true: Poses, misses: Misses, count: int, rng: np.random.Generator) -> Poses:
    """``count`` guesses of one pose."""
    std = [misses.shift_mm] * 3 + [np.deg2rad(misses.turn_degrees)] * 3 + [misses.log_scale]
    return true.repeated(count).moved(rng.standard_normal((count, 7)) * std)


def missed_shapes(
    true: TrueValve, model: ShapeModel, misses: Misses, count: int, rng: np.random.Generator
) -> FloatArray:
    """``(count, n, 3)`` mm: guesses of one valve in world coordinates."""
    poses = missed_poses(true.pose, misses, count, rng)
    exact = model.coefficients(true.pose.local(true.vertices[None]))
    by = rng.standard_normal((count, len(model.std))) * (misses.shape * model.std)
    return poses.world(model.shape(exact + by))
