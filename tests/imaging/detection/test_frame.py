"""Frames as detectors see them: ranks do not depend on grey levels, resampling keeps positions.

Features are interpolated at a hypothesis; a ramp, which is known everywhere, tests them.
"""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.detection.frame import (
    SamplePattern,
    StandardFrame,
    features,
    standard_frame,
)
from tests.exchange.volumes.volumes import MIRRORED, ROTATION
from tests.imaging.detection.made_up import ball_volume, poses

POINT = np.array([12.0, -31.0, 84.0])


def about(point, spacing, direction, shape):
    """Origin that lays a world point somewhere inside, off all middles."""
    return point - np.asarray(direction) @ (np.asarray(spacing) * (np.array(shape) * 0.43 + 0.3))


def cube(spacing=(0.8, 0.8, 0.8), direction=ROTATION, shape=(38, 43, 41), width_mm=2.0):
    origin = about(POINT, spacing, direction, shape)
    return ball_volume(spacing, direction, origin, shape, [POINT], width_mm)


def framed(volume, frames=None):
    """The standard frame of a volume, or of other grey values in its place."""
    return standard_frame(volume if frames is None else replace(volume, frames=frames), 0)


# --- ranks --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "to",
    [
        lambda g: (g // 2 + 100).astype(np.uint8),
        lambda g: 7 * g.astype(np.int16) - 1000,
        lambda g: 0.001 * g.astype(np.float32) + 0.5,
    ],
    ids=["gain and offset", "int16", "float32"],
)
def test_gain_offset_and_type_make_no_difference(to):
    # Grey values instead of ranks, or a fixed range of them.
    volume = cube()
    dark = np.maximum(volume.frames // 2 * 2, 6)
    expected = framed(volume, dark)
    np.testing.assert_array_equal(framed(volume, to(dark)).data, expected.data)


def test_dark_blood_is_within_the_field_of_view_and_what_lies_beyond_is_not():
    # A pyramid of echo with a black pool in it: the pool is dark, the corners are nothing.
    volume = cube(shape=(48, 48, 48))
    i, j, k = np.indices((48, 48, 48))
    wide = np.hypot(i - 24, j - 24) < 4 + 0.4 * k
    pool = (i - 24) ** 2 + (j - 24) ** 2 + (k - 34) ** 2 < 7**2
    frames = np.where(wide & ~pool, np.maximum(volume.frames[0], 1), 0)[None]
    ranks = framed(volume, frames.astype(np.uint8)).level(0)
    core = (i - 24) ** 2 + (j - 24) ** 2 + (k - 34) ** 2 < 5**2
    assert np.all(ranks[core] > 0)
    assert np.all(ranks[core] == ranks[ranks > 0].min())
    far = np.hypot(i - 24, j - 24) > 16 + 0.4 * k
    assert np.all(ranks[far] == 0)
    assert np.all(ranks[wide] > 0)


@pytest.mark.parametrize(
    ("to", "message"),
    [
        (lambda g: np.where(g == g.max(), np.nan, g), "made up, frame 0"),
        (np.zeros_like, "made up, frame 0: all voxels are 0"),
        (lambda g: (g % 3).astype(np.uint8), "3 different grey values"),
    ],
)
def test_what_is_no_image_is_refused(to, message):
    volume = cube()
    with pytest.raises(InputError, match=message) as told:
        framed(volume, to(volume.frames))
    assert "\n" not in str(told.value)


# --- places -------------------------------------------------------------------------------------

GRIDS = [
    ((0.8, 0.8, 0.8), (38, 43, 41)),
    ((0.5, 0.9, 1.4), (61, 35, 27)),  # resampled finer and coarser
    ((1.7, 0.4, 0.8), (21, 83, 40)),
]


@pytest.mark.parametrize(("spacing", "shape"), GRIDS)
@pytest.mark.parametrize("direction", [ROTATION, MIRRORED])
def test_a_bright_ball_is_at_its_place_in_every_level(spacing, shape, direction):
    # Half a voxel of some level, of the old or the new grid, or transposed axes, fail here.
    frame = standard_frame(cube(spacing, direction, shape, 2.5), 0)
    for number in range(3):
        ranks = frame.level(number).ravel().astype(float)
        centres = frame.centres(number)
        assert len(centres) == len(ranks)
        near = np.linalg.norm(centres - POINT, axis=1) < 7.0
        weight = np.where(near, np.maximum(ranks - np.percentile(ranks, 90), 0), 0)
        middle = (weight[:, None] * centres).sum(axis=0) / weight.sum()
        tolerance = 0.1 * 0.8 * 2**number
        assert np.linalg.norm(middle - POINT) < max(0.12, tolerance), number


# --- features -----------------------------------------------------------------------------------
SPACING = np.array([0.7, 0.8, 0.9])
ORIGIN = np.array([-8.0, 5.0, 40.0])
SHAPE = (48, 40, 44)
NO_PAIRS = np.zeros((0, 2), np.int64)


def frame_of(level0, direction=ROTATION, levels=3):
    """A frame with the given voxels, coarser levels by plain means (sides are powers of two)."""
    parts = [np.asarray(level0, float)]
    for _ in range(levels - 1):
        i, j, k = parts[-1].shape
        parts.append(parts[-1].reshape(i // 2, 2, j // 2, 2, k // 2, 2).mean(axis=(1, 3, 5)))
    shapes = np.array([part.shape for part in parts])
    sizes = np.prod(shapes, axis=1)
    return StandardFrame(
        np.concatenate([np.rint(part).ravel() for part in parts]).astype(np.uint8),
        np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        shapes,
        np.diag(1 / SPACING) @ direction.T,
        ORIGIN,
    )


def ramp(direction, base=30.0):
    """Rises along all axes of the voxels; also what it is at world points."""
    slope = np.array([1.3, 1.1, 0.9])
    index = np.stack(np.meshgrid(*(np.arange(k) for k in SHAPE), indexing="ij"), -1)

    def value(world):
        return base + ((world - ORIGIN) @ direction / SPACING) @ slope

    return frame_of(base + index @ slope, direction), value


def at_points(frame, pattern, points):
    """Features along the axes of the world."""
    return features(frame, pattern, np.array(points), np.tile(np.eye(3), (len(points), 1, 1)))


def middle(direction):
    return ORIGIN + direction @ (SPACING * (np.array(SHAPE) - 1) / 2)


@pytest.mark.parametrize("direction", [np.eye(3), ROTATION, MIRRORED])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_ramp_is_read_at_turned_and_scaled_offsets(direction, level):
    # Axes transposed, scale left out, or a level off by half a voxel differ by several grey values.
    frame, value = ramp(direction)
    some = poses(6, 1, 1.0)
    points = middle(direction) + some.centre
    offsets = np.random.default_rng(0).uniform(-4, 4, (12, 3))
    pattern = SamplePattern(offsets, np.full(12, level), NO_PAIRS)
    at = points[:, None] + np.einsum("pij,fj->pfi", some.axes, offsets)
    # A byte is rounded to within 0.5.
    np.testing.assert_allclose(features(frame, pattern, points, some.axes), value(at), atol=0.51)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_outside_the_volume_features_are_zero(level):
    frame = frame_of(np.full(SHAPE, 200.0))
    pattern = SamplePattern(np.zeros((1, 3)), np.array([level]), NO_PAIRS)
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T * np.array(SHAPE) - 0.5
    inwards = np.sign(np.array(SHAPE) / 2 - corners)
    for axis in range(3):
        step = np.zeros((8, 3))
        step[:, axis] = 0.2 * inwards[:, axis]
        outside = corners + inwards * 0.2 - 2 * step
        for index, value in ((corners + inwards * 0.2, 200.0), (outside, 0.0)):
            world = ORIGIN + (index * SPACING) @ ROTATION.T
            np.testing.assert_allclose(at_points(frame, pattern, world)[:, 0], value)
    # A comparison with NaN is false, so "outside" has to be asked the right way round.
    assert at_points(frame, pattern, [[np.nan] * 3])[0, 0] == 0


def test_a_side_of_a_single_voxel_is_read_within_its_bounds():
    # Interpolation towards a neighbour that is not there reads what lies behind in memory.
    data = np.concatenate([np.full(16, 100), np.full(200, 250)]).astype(np.uint8)
    one = np.array([0])
    frame = StandardFrame(data, one, np.array([[4, 4, 1]]), np.eye(3), np.zeros(3))
    places = [[1.2, 1.7, 0.0], [3.0, 3.0, 0.3], [3.4, 3.4, -0.4]]
    found = at_points(frame, SamplePattern(np.zeros((1, 3)), one, NO_PAIRS), places)
    np.testing.assert_allclose(found[:, 0], 100, atol=1e-3)
