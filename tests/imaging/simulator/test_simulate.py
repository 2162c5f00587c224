"""Simulated volumes: bright leaflets at the true positions, beats, tissue, scan conversion."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import Probe
from mvest.imaging.simulator.beams import BeamGrid
from mvest.imaging.simulator.scene import make_scene
from mvest.imaging.simulator.simulate import (
    compress,
    scan_convert,
    simulate_volume,
    true_sequence,
    volume_origin,
)
from mvest.imaging.volume import VolumeSequence
from tests.imaging.simulator.made_up_valve import SMALL, made_up_valve

VALVE = made_up_valve()
# Half way tilted.
TILTED = Rotation.from_euler("xz", [155, 40], degrees=True).as_matrix()
PROBE = Probe(TILTED, np.array([2.0, -1.0, 50.0]))
STILL = replace(SMALL, beat_shift_mm=0.0, beat_turn_deg=0.0, contact_db=0.0)


def seen(volume, world, frame=0):
    index = np.moveaxis(volume.index(world), -1, 0)
    return map_coordinates(volume.frames[frame].astype(float), index, order=1)


def test_leaflets_are_bright_where_the_truth_says_in_every_frame():
    volume = simulate_volume(VALVE, STILL, PROBE, 3)
    truth = true_sequence(VALVE, PROBE)
    assert volume.frames.shape == (3, *SMALL.shape)
    assert volume.frames.dtype == np.uint8
    np.testing.assert_array_equal(volume.times, VALVE.times)
    for k in range(3):
        bright = seen(volume, truth.vertices[k], k).mean()
        # As a mirror image, or in another place, they would not be.
        mirrored = PROBE.to_world(VALVE.vertices[k] * [1, -1, 1] + [0, 8, 0])
        blood = PROBE.to_world(VALVE.vertices[k] * 0.2 + [0, -3, 10])
        assert bright > 110
        assert bright > seen(volume, mirrored, k).mean() + 30
        assert seen(volume, blood, k).mean() < 60

    truth = true_sequence(VALVE, PROBE, [0, 2])
    np.testing.assert_allclose(truth.vertices[1], PROBE.to_world(VALVE.vertices[2]))
    np.testing.assert_allclose(truth.tips[1], PROBE.to_world(VALVE.tips[2]))
    np.testing.assert_array_equal(truth.times, VALVE.times[[0, 2]])


def test_a_seed_gives_one_volume_whichever_frames_are_asked_for():
    both = simulate_volume(VALVE, SMALL, PROBE, 7, frames=[0, 2])
    last = simulate_volume(VALVE, SMALL, PROBE, 7, frames=[2])
    np.testing.assert_array_equal(both.frames[1], last.frames[0])
    assert simulate_volume(VALVE, SMALL, PROBE, 8, frames=[2]).sha256 != last.sha256
    assert "simulated" in last.source


def test_beats_that_are_displaced_leave_seams():
    seam = simulate_volume(VALVE, replace(SMALL, beat_shift_mm=3.0), PROBE, 1, frames=[0])
    plain = simulate_volume(VALVE, replace(SMALL, beat_shift_mm=0.0), PROBE, 1, frames=[0])
    assert np.mean(seam.frames != plain.frames) > 0.05


def test_tissue_is_as_dense_and_attenuates_as_much_as_set():
    acquisition = replace(SMALL, frequency_mhz=4.0, shadow_db_per_cm=0.0)
    scene = make_scene(VALVE, acquisition, PROBE, np.random.default_rng(0))
    wall = next(sown for sown in scene if sown.part.material.name == "wall")
    volume = wall.part.volume
    # (0.5 - 0.15) dB/cm/MHz at 4 MHz.
    assert wall.loss.sum() == pytest.approx(1.4 * volume, rel=1e-6)
    distance = np.linalg.norm(PROBE.apex_in_valve)
    cell = 2.2 * np.deg2rad(4.0) * np.deg2rad(5.0) * distance**2
    assert len(wall.seeds) * cell / volume == pytest.approx(10, rel=0.01)
    dense = make_scene(
        VALVE, replace(acquisition, shadow_db_per_cm=30.0), PROBE, np.random.default_rng(0)
    )
    more = [a.part for a, b in zip(scene, dense, strict=True) if b.loss.sum() > a.loss.sum()]
    assert [part.material.name for part in more] == ["annulus"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed"),
        ({"frames": [1, 0]}, "increasing"),
        ({"probe": Probe(np.eye(3), np.array([0.0, 0.0, -50.0]))}, "along the beam"),
    ],
)
def test_what_cannot_be_simulated_is_refused(change, message):
    arguments = {"valve": VALVE, "acquisition": SMALL, "probe": PROBE, "seed": 0, **change}
    with pytest.raises(InputError, match=message):
        simulate_volume(**arguments)


def test_levels_land_where_the_beams_run_in_the_world():
    # A smooth pattern over the world, sampled along the beams, must return in the voxels.
    grid = BeamGrid.of(SMALL)
    a, e, d = (x.start + x.step * np.arange(x.count) for x in
               (grid.azimuth, grid.elevation, grid.distance))  # fmt: skip
    sight = np.stack(np.broadcast_arrays(np.tan(a)[:, None], np.tan(e)[None], 1.0), axis=-1)
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    world = d[:, None] * sight[:, :, None]

    def pattern(x):
        return 120 + x @ np.array([0.5, -0.3, 0.7])

    volume = scan_convert(pattern(world).astype(np.float32), grid)
    spacing = np.full(3, SMALL.voxel_mm)
    sequence = VolumeSequence(volume[None], spacing, np.eye(3), volume_origin(SMALL), np.zeros(1))
    index = np.argwhere(volume > 0)
    expected = pattern(sequence.world(index.astype(float)))
    assert len(index) > 10_000
    np.testing.assert_allclose(volume[tuple(index.T)], expected, atol=1.2)


def test_beats_that_are_not_displaced_leave_no_seam():
    # What is stitched from four sub-sectors must be what one sweep gives, but for the noise.
    quiet = replace(STILL, blood_db=-200.0, electronics_db=-200.0, haze_db=-200.0)
    stitched = simulate_volume(VALVE, quiet, PROBE, 1, frames=[0]).frames.astype(int)
    swept = simulate_volume(VALVE, replace(quiet, beats=1), PROBE, 1, frames=[0]).frames
    # Where echoes cancel, rounding shows.
    assert np.mean(np.abs(stitched - swept) > 1) < 1e-4


def test_log_compression():
    acquisition = replace(SMALL, dynamic_range_db=60.0, gain_db=6.0)
    envelope = np.array([10.0 ** (-6 / 20), 10.0 ** (-36 / 20), 10 ** (-66 / 20), 0.0, 100.0])
    levels = compress(envelope.astype(np.float32), acquisition)
    np.testing.assert_allclose(levels, [255, 127.5, 0, 0, 255], atol=2e-3)
