import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import Acquisition, Probe, draw_probe


def test_drawn_probes_look_at_the_valve_from_the_atrium():
    rng, acquisition = np.random.default_rng(0), Acquisition()
    probes = [draw_probe(rng, acquisition) for _ in range(300)]
    apex = np.array([p.apex_in_valve for p in probes])
    distance = np.linalg.norm(apex, axis=1)
    tilt = np.degrees(np.arccos(apex[:, 2] / distance))
    assert distance.min() >= 35 - 1e-9
    assert distance.max() <= 75 + 1e-9
    assert np.ptp(distance) > 35
    assert tilt.max() <= 55 + 1e-4
    assert np.ptp(tilt) > 45
    # Roll: where the valve's x axis points across the beam.
    x = np.array([p.rotation[:2, 0] for p in probes])
    turned = np.histogram(np.arctan2(x[:, 1], x[:, 0]), 8, (-np.pi, np.pi))[0]
    assert turned.min() > 10
    for probe in probes:
        assert np.linalg.det(probe.rotation) == pytest.approx(1)
        np.testing.assert_allclose(probe.rotation.T @ probe.rotation, np.eye(3), atol=1e-12)


def test_the_valve_lies_in_the_pyramid():
    rng, acquisition = np.random.default_rng(1), Acquisition()
    ring = 2 * np.pi * np.arange(36) / 36
    annulus = np.stack([18 * np.cos(ring), 14 * np.sin(ring), 0 * ring], axis=1)
    for _ in range(200):
        p = draw_probe(rng, acquisition).to_world(annulus)
        azimuth, elevation = np.degrees(np.arctan(p[:, :2] / p[:, 2:])).T
        assert np.mean(np.abs(azimuth) <= acquisition.azimuth_deg / 2) > 0.8
        assert np.mean(np.abs(elevation) <= acquisition.elevation_span_deg / 2) > 0.8


def test_coordinates_lead_from_valve_to_world():
    turn = Rotation.from_euler("zyx", [30, -50, 110], degrees=True).as_matrix()
    probe = Probe(turn, np.array([3.0, -4.0, 50.0]))
    np.testing.assert_allclose(probe.to_world(probe.apex_in_valve), 0, atol=1e-12)
    np.testing.assert_allclose(
        probe.to_world(np.array([0.0, 2.0, 0.0])), probe.translation + 2 * turn[:, 1]
    )


def test_ranges_without_meaning_are_refused():
    with pytest.raises(InputError, match="tilt"):
        draw_probe(np.random.default_rng(0), tilt_deg=(0.0, 120.0))
    with pytest.raises(InputError, match="distance_mm"):
        draw_probe(np.random.default_rng(0), distance_mm=(60.0, 40.0))
