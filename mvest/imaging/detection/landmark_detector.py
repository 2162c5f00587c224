"""Single points of the valve, each found by votes of trees of its own.

Every candidate says where the point lies from it, and most are right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.pose import Poses
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.sampling import SamplePattern, features
from mvest.imaging.learning.truth import Misses, TrueValve, missed_poses
from mvest.imaging.valve_sequence import landmark_vertices
from mvest.typing import FloatArray, IntArray

ROUNDS = 4


def consensus(votes: FloatArray, width_mm: float = 1.5) -> tuple[FloatArray, FloatArray]:
    """Where votes agree.

    Parameters
    ----------
    votes : (P, V, d) mm
        V votes for each of P points.
    width_mm : float
        Votes farther than this from the consensus count little (Cauchy weights).

    Returns
    -------
    points : (P, d) mm
    spread : (P,) mm
        Weighted root mean square distance of the votes: how much they disagree.
    """
    centre = np.median(votes, axis=1)
    for _ in range(ROUNDS):
        gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
        weight = 1 / (1 + gap / width_mm**2)
        weight /= weight.sum(axis=1, keepdims=True)
        centre = (weight[..., None] * votes).sum(axis=1)
    gap = ((votes - centre[:, None]) ** 2).sum(axis=2)
    return centre, np.sqrt((weight * gap).sum(axis=1))


MISSES = Misses(0.0, 4.0, 0.03)
START_MM = 4.0
"""mm, standard deviation of each coordinate of candidates about a point, in training."""

GRIDS_MM = (2.6, 1.3)
"""mm between candidates in the first and second round."""


def _pattern() -> SamplePattern:
    rng = np.random.default_rng(4)
    offsets = rng.standard_normal((130, 3)) * np.repeat([3.0, 7.0, 12.0], [50, 50, 30])[:, None]
    return SamplePattern.paired(offsets, np.repeat([0, 1, 2], [50, 50, 30]), 70, 4)


PATTERN = _pattern()


def landmark_points(true: TrueValve, layout: ValveLayout) -> FloatArray:
    """``(L, 3)`` mm, in the order of :data:`mvest.imaging.layout.LANDMARKS`."""
    return np.concatenate([true.vertices[list(landmark_vertices(layout).values())], true.tips])


def landmark_samples(
    frame: StandardFrame,
    true: TrueValve,
    layout: ValveLayout,
    which: int,
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], FloatArray]:
    """Candidates about one landmark, and where it lies from them ``(P, 3)`` in their axes."""
    poses = missed_poses(true.pose, MISSES, count, rng)
    point = landmark_points(true, layout)[which]
    candidates = point + rng.standard_normal((count, 3)) * START_MM
    gap = np.einsum("pij,pi->pj", poses.rotation, point - candidates)
    return features(frame, PATTERN, candidates, poses.axes), gap


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkDetector:
    """Finds landmarks from where they are guessed to be.

    Attributes
    ----------
    boosters : tuple of Boosters
        One per landmark, three outputs: where it lies from a candidate, mm in the valve's axes.
    """

    boosters: tuple[Boosters, ...]

    def __call__(
        self, frame: StandardFrame, pose: Poses, points: FloatArray, which: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Landmarks ``(L, 3)`` mm, and how much votes for each disagree ``(L,)`` mm.

        Parameters
        ----------
        pose : Poses
            One.
        points : (L, 3) mm
            Guesses.
        which : (L,)
            Their numbers.
        """
        refined, spread = np.array(points), np.zeros(len(points))
        for step in GRIDS_MM:
            ticks = step * np.arange(-2, 3)
            grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
            axes = np.broadcast_to(pose.axes, (len(grid), 3, 3))
            for k, number in enumerate(which):
                candidates = refined[k] + grid @ pose.rotation[0].T
                gap = self.boosters[number](features(frame, PATTERN, candidates, axes))
                votes = candidates + gap @ pose.rotation[0].T
                point, width = consensus(votes[None])
                refined[k], spread[k] = point[0], width[0]
        return refined, spread
