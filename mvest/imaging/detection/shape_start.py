"""The shape to begin with: leading modes and papillary tips, read off at a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.sampling import SamplePattern, features
from mvest.imaging.learning.truth import Misses, TrueValve, missed_poses
from mvest.typing import FloatArray

MODES = 8
"""Leading modes that are read off; among them how far the valve is open."""

MISSES = Misses(1.5, 5.0, 0.04)


def _pattern() -> SamplePattern:
    rng = np.random.default_rng(3)
    offsets = rng.standard_normal((260, 3)) * np.array([10.0, 9.0, 9.0]) + [0, 0, -8.0]
    offsets[200:] = rng.standard_normal((60, 3)) * 6.0 + [0, 0, -22.0]
    offsets[200:, 0] += np.repeat([15.0, -15.0], 30)  # about where papillary tips are
    return SamplePattern.paired(offsets, np.where(rng.random(260) < 0.5, 1, 2), 120, 3)


PATTERN = _pattern()


def shape_start_samples(
    frame: StandardFrame, true: TrueValve, model: ShapeModel, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], FloatArray]:
    """Missed poses, with the coefficients and tips ``(P, MODES + 6)`` seen from them."""
    poses = missed_poses(true.pose, MISSES, count, rng)
    local = poses.local(np.broadcast_to(true.vertices, (count, *true.vertices.shape)))
    tips = poses.local(np.broadcast_to(true.tips, (count, 2, 3)))
    # Over their deviation, so that all outputs are of one size.
    y = model.coefficients(local)[:, :MODES] / model.std[:MODES]
    return (
        features(frame, PATTERN, poses.centre, poses.axes),
        np.concatenate([y, (tips - model.tips).reshape(count, 6)], axis=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class ShapeStart:
    """Reads shape and tips off at a pose.

    Attributes
    ----------
    boosters : Boosters
        Coefficients over their deviation, then both tips (mm at the size of the mean valve).
    """

    boosters: Boosters

    def __call__(
        self, frame: StandardFrame, poses: Poses, model: ShapeModel
    ) -> tuple[FloatArray, FloatArray]:
        """Coefficients ``(P, MODES)`` and tips ``(P, 2, 3)`` in world mm."""
        answers = self.boosters(features(frame, PATTERN, poses.centre, poses.axes))
        tips = model.tips + answers[:, MODES:].reshape(-1, 2, 3)
        return answers[:, :MODES] * model.std[:MODES], poses.world(tips)
