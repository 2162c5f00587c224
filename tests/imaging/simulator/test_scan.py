import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.simulator import SMALL, Probe
from mvest.imaging.simulator.beams import BeamGrid
from mvest.imaging.simulator.scan import compress, scan_convert, volume_frame
from mvest.imaging.volume import VolumeSequence


def test_log_compression():
    acquisition = replace(SMALL, dynamic_range_db=60.0, gain_db=6.0)
    envelope = np.array([10.0 ** (-6 / 20), 10.0 ** (-36 / 20), 10 ** (-66 / 20), 0.0, 100.0])
    levels = compress(envelope.astype(np.float32), acquisition)
    np.testing.assert_allclose(levels, [255, 127.5, 0, 0, 255], atol=2e-3)


def test_levels_land_where_the_beams_run_in_the_world():
    # A smooth pattern over the world, sampled along the beams, must return in the voxels.
    axes = Rotation.from_euler("xyz", [20, -35, 130], degrees=True).as_matrix()
    probe = Probe(np.eye(3), np.zeros(3), np.array([7.0, -20.0, 3.0]), axes[:, 2], axes[:, 0])
    grid = BeamGrid.of(SMALL)
    a, e, d = (x.start + x.step * np.arange(x.count) for x in
               (grid.azimuth, grid.elevation, grid.distance))  # fmt: skip
    sight = np.stack(np.broadcast_arrays(np.tan(a)[:, None], np.tan(e)[None], 1.0), axis=-1)
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    world = probe.apex + (d[:, None] * sight[:, :, None]) @ axes.T

    def pattern(x):
        return 120 + x @ np.array([0.5, -0.3, 0.7])

    volume = scan_convert(pattern(world).astype(np.float32), grid)
    spacing, direction, origin = volume_frame(SMALL, probe)
    sequence = VolumeSequence(volume[None], spacing, direction, origin, np.zeros(1))
    index = np.argwhere(volume > 0)
    expected = pattern(sequence.world(index.astype(float)))
    assert len(index) > 10_000
    np.testing.assert_allclose(volume[tuple(index.T)], expected, atol=1.2)
    assert np.linalg.det(direction) == pytest.approx(1)


def test_it_is_dark_outside_the_pyramid_only():
    grid = BeamGrid.of(SMALL)
    volume = scan_convert(np.full(grid.shape, 200, dtype=np.float32), grid)
    spacing, _, origin = volume_frame(SMALL, Probe(np.eye(3), np.array([0, 0, 50.0])))
    x, y, z = np.moveaxis(origin + np.indices(SMALL.shape).T.swapaxes(0, 2) * spacing, -1, 0)
    r = np.sqrt(x**2 + y**2 + z**2)
    inside = (
        (np.abs(np.arctan2(x, z)) <= math.radians(SMALL.azimuth_deg) / 2)
        & (np.abs(np.arctan2(y, z)) <= math.radians(SMALL.elevation_span_deg) / 2)
        & (r >= SMALL.depth_mm[0])
        & (r <= SMALL.depth_mm[1])
    )
    np.testing.assert_array_equal(volume, np.where(inside, 200, 0))
