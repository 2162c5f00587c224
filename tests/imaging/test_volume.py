"""World positions of voxels, for axes that are neither along the world's nor right-handed."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.volume import VolumeSequence
from tests.exchange.volumes.volumes import MIRRORED, ROTATION


def volume(direction, shape=(1, 3, 4, 5), times=(0.0,)):
    return VolumeSequence(
        np.zeros(shape, np.uint8),
        np.array([0.5, 1.0, 2.0]),
        direction,
        np.array([10.0, -20.0, 30.0]),
        np.asarray(times),
    )


@pytest.mark.parametrize("direction", [ROTATION, MIRRORED])
def test_a_step_along_an_axis_is_its_column_times_its_spacing(direction):
    # Rows taken for columns, or the spacing of another axis, are seen here.
    v = volume(direction)
    for axis in range(3):
        step = v.world(np.eye(3)[axis]) - v.world(np.zeros(3))
        np.testing.assert_allclose(step, v.spacing[axis] * direction[:, axis], atol=1e-12)
    np.testing.assert_allclose(v.world(np.zeros(3)), v.origin)


def test_frames_and_times_must_agree():
    with pytest.raises(InputError, match=r"frames: shape \(3, 4, 5\)"):
        volume(ROTATION, (3, 4, 5))
    with pytest.raises(InputError, match=r"times: shape \(2,\)"):
        volume(ROTATION, times=(0.0, 0.1))
