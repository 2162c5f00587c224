"""Training of the detectors on simulated volumes with known valves.

Every volume is simulated, sampled for all stages at once and discarded. Each stage makes its own
hypotheses with errors of a given size, so that no stage waits for the one before it.

Half of the volumes are degraded at random, so that detectors do not depend on one scanner: by blur,
noise that grows with the distance from one side, and a threshold, none of which is a setting of the
simulator. Kinds and amounts are a choice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.leaflets import RIMS, boundary_samples, landmark_samples, rim_samples
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.pose_search import (
    MODES,
    REFINED,
    REFINEMENTS,
    coarse_samples,
    fine_samples,
    position_samples,
    refinement_samples,
    search_poses,
    shape_start_samples,
)
from mvest.imaging.detection.shape_model import Examples, LabelledFrame, ShapeModel
from mvest.imaging.detection.trained_model import STAGES
from mvest.imaging.learning.boosting import Boosters, BoostSettings, Trees, train_boosters
from mvest.imaging.simulator.acquisition import Acquisition, Setting, draw_acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import LANDMARKS, MovingValve, ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.quantities import Count, within

MANY_TREES = ("pose_coarse", "pose_fine", "boundary")
"""Stages with ``TrainingSettings.many_trees``."""

SEARCH_STAGES = tuple(name for name in STAGES if name.startswith(("position", "pose_")))
"""Stages of the pose search. A draft of them is trained on the first volumes."""


@dataclass(frozen=True, slots=True)
class SampleCounts:
    """Number of samples from one volume for each stage."""

    position: Count = 160
    pose_rating: Count = 120
    pose_refinement: Count = 70
    shape: Count = 60
    landmark: Count = 50
    rim: Count = 240
    boundary: Count = 720
    mistaken: Count = 30


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How detectors are trained."""

    #: Modes of the shape model.
    modes: Annotated[int, within(MODES, 1000, "", "as many as are regressed, or more")] = 40
    samples: SampleCounts = field(default_factory=SampleCounts)
    boosting: BoostSettings = field(default_factory=BoostSettings)
    many_trees: Count = 130  #: for the ratings of poses and the boundary
    volumes: Count = 480  #: one simulated frame each, of the valves in turn
    draft_volumes: Count = (
        60  #: the first volumes; others also give samples of the draft's mistakes
    )
    acquisition: Acquisition = field(default_factory=Acquisition)  #: others are drawn about it


def draw_samples(
    seen: LabelledFrame, counts: SampleCounts, draft: Trees | None = None
) -> Mapping[str, Examples]:
    """Samples of all stages from one frame, by the stage's name.

    The final rating also gets poses that a draft finds: half of them the best rated, half drawn
    from the others.
    """
    mistaken = None
    if draft is not None:
        poses, _ = search_poses(seen.frame, draft, REFINED)
        count, best = counts.mistaken, counts.mistaken // 2
        others = best + seen.rng.choice(len(poses) - best, count - best, replace=False)
        mistaken = poses[np.concatenate([np.arange(best), others])]
    samples = {
        "position": position_samples(seen, counts.position),
        "pose_coarse": coarse_samples(seen, counts.pose_rating),
        "pose_fine": fine_samples(seen, counts.pose_rating, mistaken),
        "shape": shape_start_samples(seen, counts.shape),
        **{rim: rim_samples(seen, rim, counts.rim) for rim in RIMS},
        "boundary": boundary_samples(seen, counts.boundary),
    }
    for k in range(len(REFINEMENTS)):
        samples[f"pose_refine_{k}"] = refinement_samples(seen, k, counts.pose_refinement)
    for k in range(len(LANDMARKS)):
        samples[f"landmark_{k}"] = landmark_samples(seen, k, counts.landmark)
    return samples


def render_frame(
    valve: MovingValve,
    which: int,
    base: Acquisition,
    spread: Setting,
    seed: np.random.SeedSequence,
    *,
    degraded: bool = False,
) -> tuple[VolumeSequence, ValveSequence]:
    """A simulated volume of one frame of a valve, and the valve in it.

    Acquisition and probe are drawn at random; ``degraded`` applies `degrade`.
    """
    rng = np.random.default_rng(seed)
    acquisition = draw_acquisition(rng, base, spread)
    probe = draw_probe(rng, acquisition)
    volume = simulate_volume(valve, acquisition, probe, int(rng.integers(2**31)), frames=[which])
    return degrade(volume, rng) if degraded else volume, true_sequence(valve, probe, [which])


def volume_samples(
    valve: MovingValve,
    number: int,
    shape: ShapeModel,
    settings: TrainingSettings,
    seed: int,
    draft: Trees | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Simulate one training volume and sample it for all stages.

    It depends on the ``number`` of the volume and the ``seed`` of the training, not on the number
    of volumes. A ``draft`` of `SEARCH_STAGES` is given for all but the first volumes. Returns
    ``STAGE.x`` and ``STAGE.y`` (`mvest.imaging.detection.shape_model.Examples`).
    """
    render, sample = np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2)
    which = int(np.random.default_rng(sample).integers(len(valve.times)))
    volume, seen = render_frame(
        valve, which, settings.acquisition, "training", render, degraded=True
    )
    true = seen.vertices[0], seen.tips[0]
    pose = pose_of(*true, shape.layout, shape.size_mm)
    rng = np.random.default_rng(sample.spawn(1)[0])
    labelled = LabelledFrame(standard_frame(volume, 0), *true, pose, shape, rng)
    samples = draw_samples(labelled, settings.samples, draft)
    found: dict[str, NDArray[np.float32]] = {}
    for name, (x, y) in samples.items():
        found |= {f"{name}.x": x, f"{name}.y": y.astype(np.float32)}
    return found


def train_stage(
    name: str, x: NDArray[np.float32], y: NDArray[np.float32], settings: TrainingSettings, seed: int
) -> Boosters:
    """Trees of a stage from samples ``x (P, F)`` and ``y (P, outputs)`` of all volumes."""
    boosting, seed = settings.boosting, seed + 1000 * STAGES.index(name)
    if name in MANY_TREES:
        boosting = replace(boosting, trees=settings.many_trees)
    objective = "cross_entropy" if name == "boundary" else "regression"
    return train_boosters(x, y.astype(np.float64), boosting, seed, objective)


SHARE = 0.5
"""Share of the volumes that are degraded, and of each kind of degradation among those."""

MAX_BLUR_VOXELS, MAX_NOISE, MAX_CUT = 1.3, 45.0, 70.0
"""Largest blur; largest standard deviation and threshold in grey values of 255."""


def degrade(volume: VolumeSequence, rng: np.random.Generator) -> VolumeSequence:
    """A volume of grey values from 0 to 255 (uint8), degraded at random; 0 stays 0."""
    if rng.random() >= SHARE:
        return volume
    blurs, noises, cuts = rng.random(3) < SHARE
    seen = np.asarray(volume.frames) > 0
    grey = np.asarray(volume.frames, dtype=np.float32)
    if blurs:
        sigma = rng.uniform(0.0, MAX_BLUR_VOXELS, 3)
        grey = np.stack([ndimage.gaussian_filter(frame, sigma) for frame in grey])
    if noises:
        axis, flip = int(rng.integers(1, 4)), bool(rng.random() < 0.5)
        along = np.linspace(0.0, 1.0, grey.shape[axis], dtype=np.float32)
        level = rng.uniform(0.0, MAX_NOISE) * (along[::-1] if flip else along) ** rng.uniform(0, 2)
        shape = [1, 1, 1, 1]
        shape[axis] = -1
        noise = rng.standard_normal(grey.shape, dtype=np.float32)
        noise = np.stack([ndimage.gaussian_filter(frame, 0.6) for frame in noise])
        grey = grey + 2.0 * level.reshape(shape) * noise
    if cuts:
        grey = grey - np.float32(rng.uniform(0.0, MAX_CUT))
    frames = np.where(seen, np.clip(grey, 0.0, 255.0), 0.0).astype(np.uint8)
    return replace(volume, frames=frames)
