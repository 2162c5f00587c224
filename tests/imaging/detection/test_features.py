"""Features where a hypothesis lies: interpolation against a ramp that is known everywhere."""

import numpy as np
import pytest

from mvest.imaging.detection.frame import SamplePattern, StandardFrame, directions, features
from tests.exchange.volumes.volumes import MIRRORED, ROTATION
from tests.imaging.detection.made_up import poses

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


def test_levels_of_one_pattern_are_not_mixed_up():
    rng = np.random.default_rng(1)
    frame = frame_of(rng.uniform(0, 255, SHAPE))
    centre = np.array([3, 4, 5])
    points, levels = [], [0, 1, 2]
    for level in levels:
        points.append(ORIGIN + ROTATION @ (SPACING * ((centre + 0.5) * 2**level - 0.5)))
    for point, level in zip(points, levels, strict=True):
        pattern = SamplePattern(np.zeros((3, 3)), np.array(levels), NO_PAIRS)
        found = features(frame, pattern, point[None], np.eye(3)[None])[0]
        assert found[level] == pytest.approx(frame.level(level)[3, 4, 5], abs=1e-3)


def test_pairs_are_differences_of_first_minus_second():
    frame, _ = ramp(ROTATION)
    pattern = SamplePattern(
        np.array([[0.0, 0, 0], [3.0, 0, 0], [0, 3.0, 0]]), np.zeros(3, np.int64),
        np.array([[0, 1], [2, 1]]),
    )  # fmt: skip
    found = features(frame, pattern, middle(ROTATION)[None], np.eye(3)[None])
    assert found.shape == (1, 5)
    np.testing.assert_allclose(found[0, 3], found[0, 0] - found[0, 1])
    np.testing.assert_allclose(found[0, 4], found[0, 2] - found[0, 1])


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
            axes = np.tile(np.eye(3), (8, 1, 1))
            np.testing.assert_allclose(features(frame, pattern, world, axes)[:, 0], value)


def test_a_side_of_a_single_voxel_is_read_within_its_bounds():
    # Interpolation towards a neighbour that is not there reads what lies behind in memory.
    shape = (4, 4, 1)
    frame = StandardFrame(
        np.concatenate([np.full(16, 100), np.full(200, 250)]).astype(np.uint8),
        np.array([0]),
        np.array([shape]),
        np.eye(3),
        np.zeros(3),
    )
    pattern = SamplePattern(np.zeros((1, 3)), np.array([0]), NO_PAIRS)
    places = np.array([[1.2, 1.7, 0.0], [3.0, 3.0, 0.3], [3.4, 3.4, -0.4]])
    found = features(frame, pattern, places, np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_allclose(found[:, 0], 100, atol=1e-3)


def test_places_that_are_no_numbers_are_outside():
    # A comparison with NaN is false, so "outside" has to be asked the right way round.
    frame = frame_of(np.full(SHAPE, 200.0))
    pattern = SamplePattern(np.zeros((1, 3)), np.array([0]), NO_PAIRS)
    found = features(frame, pattern, np.full((1, 3), np.nan), np.eye(3)[None])
    assert found[0, 0] == 0


def test_no_hypotheses_give_no_features():
    frame, _ = ramp(ROTATION)
    pattern = SamplePattern.paired(np.ones((4, 3)) * np.arange(4)[:, None], np.zeros(4, int), 3, 0)
    assert features(frame, pattern, np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0, 7)


def test_pairs_are_of_two_samples_and_rather_near_ones():
    rng = np.random.default_rng(2)
    offsets = rng.standard_normal((60, 3)) * 8
    pattern = SamplePattern.paired(offsets, np.zeros(60, np.int64), 400, 5)
    first, second = pattern.pairs.T
    assert np.all(first != second)
    assert pattern.pairs.min() >= 0
    assert pattern.pairs.max() < 60
    gap = np.linalg.norm(offsets[first] - offsets[second], axis=1)
    every = np.linalg.norm(offsets[:, None] - offsets, axis=2)[~np.eye(60, dtype=bool)]
    assert gap.mean() < 0.9 * every.mean()
    np.testing.assert_array_equal(
        pattern.pairs, SamplePattern.paired(offsets, pattern.levels, 400, 5).pairs
    )


def test_directions_are_unit_vectors_all_around():
    d = directions(40)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1)
    np.testing.assert_allclose(d.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(d.T @ d / 40, np.eye(3) / 3, atol=0.03)
