"""A small volume over time, and checks of what is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import VolumeSequence
from tests.exchange.volume_variants import DIRECTION as ROTATION
from tests.exchange.volume_variants import MIRRORED, ORIGIN, SHAPE, SPACING, frames

__all__ = ["MIRRORED", "ORIGIN", "ROTATION", "SHAPE", "SPACING", "frames"]

TIMES = np.array([0.0, 0.03, 0.08])


def sequence(dtype: str = "uint8", direction: NDArray[np.float64] = ROTATION) -> VolumeSequence:
    return VolumeSequence(frames(dtype), SPACING, direction, ORIGIN, TIMES, source="made up")


def assert_same(found: VolumeSequence, expected: VolumeSequence) -> None:
    """Same voxels at the same places and times."""
    np.testing.assert_array_equal(found.frames, expected.frames)
    np.testing.assert_allclose(found.times, expected.times, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.spacing, expected.spacing, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.direction, expected.direction, rtol=0, atol=1e-6)
    corner = np.array(found.frames.shape[1:]) - 1.0
    np.testing.assert_allclose(found.world(corner), expected.world(corner), rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.index(found.world(corner)), corner, rtol=0, atol=1e-9)


def assert_refused(path: Path, field: str, expected: str = "", **given: Any) -> None:
    """In one line that names the file, the field, and what was expected of it."""
    with pytest.raises(InputError) as caught:
        read_volume(path, **given)
    message = str(caught.value)
    assert message.startswith(f"{path}: {field}")
    assert expected in message.partition(", expected ")[2]
    assert "\n" not in message
    assert len(message) < 700
