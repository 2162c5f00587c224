"""Where in a volume there may be a valve: every place is rated, whatever the orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.sampling import SamplePattern, directions, features
from mvest.imaging.learning.truth import TrueValve
from mvest.typing import FloatArray

PLACES = 24
"""Places at which orientations are tried."""

RADII_MM = (3.0, 7.0, 11.0, 15.0, 19.0, 24.0, 30.0, 38.0)
"""mm of the shells about a place."""

SHELL_LEVELS = (1, 1, 1, 2, 2, 2, 3, 3)
DIRECTIONS = 20

GRID_LEVEL = 2
"""Places are the voxels of this level, every second one along each axis."""

NEAR_MM = 6.0
"""mm, the rating of a place falls off over: exp(-d^2 / (2 NEAR^2))."""


def _pattern() -> SamplePattern:
    offsets = np.concatenate([radius * directions(DIRECTIONS) for radius in RADII_MM])
    levels = np.repeat(np.array(SHELL_LEVELS), DIRECTIONS)
    return SamplePattern(offsets, levels, np.zeros((0, 2), dtype=np.int64))


PATTERN = _pattern()


def _shell_features(frame: StandardFrame, points: FloatArray) -> NDArray[np.float32]:
    """Mean, spread and extremes over each shell ``(P, 5 * shells)``: no orientation in them."""
    axes = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    values = features(frame, PATTERN, points, axes).reshape(len(points), -1, DIRECTIONS)
    ordered = np.sort(values, axis=2)
    parts = [
        values.mean(axis=2),
        values.std(axis=2),
        ordered[..., 1],
        ordered[..., DIRECTIONS // 2],
        ordered[..., -2],
    ]
    return np.concatenate(parts, axis=1)


def position_samples(
    frame: StandardFrame, true: TrueValve, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], FloatArray]:
    """Places near a valve and anywhere, with their ratings ``(P, 1)``."""
    centre = true.pose.centre[0]
    anywhere = _places(frame)
    near = centre + rng.standard_normal((count // 2, 3)) * rng.choice([3.0, 8.0], (count // 2, 1))
    far = anywhere[rng.integers(len(anywhere), size=count - len(near))]
    points = np.concatenate([near, far])
    distance = np.linalg.norm(points - centre, axis=1)
    return _shell_features(frame, points), np.exp(-0.5 * (distance / NEAR_MM) ** 2)[:, None]


def _places(frame: StandardFrame) -> FloatArray:
    """``(P, 3)`` mm within the field of view."""
    level = frame.level(GRID_LEVEL)
    every = np.zeros(level.shape, dtype=np.bool_)
    every[::2, ::2, ::2] = True
    return frame.centres(GRID_LEVEL)[(every & (level > 0)).ravel()]


@dataclass(frozen=True, slots=True, eq=False)
class PositionDetector:
    """Rates places.

    Attributes
    ----------
    boosters : Boosters
        One output: the rating, 1 at a valve's centre.
    """

    boosters: Boosters

    def __call__(self, frame: StandardFrame, count: int) -> tuple[FloatArray, FloatArray]:
        """The best places ``(count, 3)`` mm that are apart from one another, and their ratings."""
        places = _places(frame)
        if not len(places):
            return np.zeros((0, 3)), np.zeros(0)
        rating = self.boosters(_shell_features(frame, places))[:, 0]
        kept: list[int] = []
        left = rating.copy()
        for _ in range(count):
            k = int(np.argmax(left))
            if not np.isfinite(left[k]):
                break
            kept.append(k)
            left[np.linalg.norm(places - places[k], axis=1) < 0.8 * NEAR_MM] = -np.inf
        return places[kept], rating[kept]
