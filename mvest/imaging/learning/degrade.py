"""Volumes made worse at random, so that detectors do not count on one scanner's image.

What a simulated scanner does is one way of many to make an image. Half of all training volumes are
changed further by what no setting of the simulator does: blur, noise that grows with the distance
from one side, and a threshold. What is done, and how much, is a choice.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from mvest.imaging.volume import VolumeSequence

SHARE = 0.5
"""Of the volumes that are changed at all, and of each change among those."""

MAX_BLUR_VOXELS = 1.3
MAX_NOISE = 45.0
"""Grey values of 255, standard deviation where noise is largest."""

MAX_CUT = 70.0
"""Grey values below which an image is cut off, at most."""


def degrade(volume: VolumeSequence, rng: np.random.Generator) -> VolumeSequence:
    """A volume of grey values from 0 to 255 (uint8), changed at random; 0 stays 0.

    Parameters
    ----------
    volume : VolumeSequence
    rng : numpy.random.Generator
    """
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
