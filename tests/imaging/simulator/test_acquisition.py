import math
from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import (
    RANGES,
    Acquisition,
    draw_acquisition,
    draw_probe,
)
from tests.imaging.simulator.made_up_valve import SMALL

# Echo strengths and compensation may be those of training in both.
BOTH = {"wall_db", "chord_db", "papillary_db", "vessel_db", "compensation_db_per_cm_mhz"}


BAD = {
    "frequency_mhz": 0.0, "axial_mm": 40.0, "elevation_deg": 30.0, "dropout_db": 3.0,
    "blood_db": math.nan, "depth_mm": (50.0, 20.0), "shape": (4, 40, 40),
}  # fmt: skip


@pytest.mark.parametrize("setting", BAD)
def test_a_setting_out_of_range_is_refused_by_name(setting):
    with pytest.raises(InputError, match=f"acquisition {setting} = .*expected"):
        replace(SMALL, **{setting: BAD[setting]})


def test_shifted_acquisitions_lie_outside_of_all_training_ranges():
    for name, (_, (low, high), shifted) in RANGES.items():
        outside = [b < low or a > high for a, b in shifted]
        assert all(outside) or name in BOTH, name


@pytest.mark.parametrize("spread", ["training", "wide", "shifted"])
def test_what_is_drawn_lies_in_the_ranges_and_fills_them(spread):
    rng, base = np.random.default_rng(0), Acquisition()
    drawn = [draw_acquisition(rng, base, spread) for _ in range(200)]
    for name, (how, own, beyond) in RANGES.items():
        intervals = {"training": [own], "wide": [own, *beyond], "shifted": beyond}[spread]
        before = getattr(base, name)
        values = np.array([getattr(a, name) for a in drawn])
        values = values / before if how == "times" else values - before
        inside = [(values >= a - 1e-9) & (values <= b + 1e-9) for a, b in intervals]
        assert np.all(np.any(inside, axis=0)), name
        assert all(np.any(i) for i in inside), name
        width = max(b for _, b in intervals) - min(a for a, _ in intervals)
        assert np.ptp(values) > 0.8 * width, name
    assert {a.shape for a in drawn} == {base.shape}


def test_unknown_spreads_and_draws_out_of_range_are_refused():
    with pytest.raises(InputError, match="spread 'wild', expected one of training, wide, shifted"):
        draw_acquisition(np.random.default_rng(0), spread="wild")
    with pytest.raises(InputError, match="dropout"):
        draw_acquisition(np.random.default_rng(0), replace(SMALL, dropout=0.6), "shifted")


# -- the probe ------------------------------------------------------------------------------------
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


def test_ranges_without_meaning_are_refused():
    with pytest.raises(InputError, match="tilt"):
        draw_probe(np.random.default_rng(0), tilt_deg=(0.0, 120.0))
    with pytest.raises(InputError, match="distance_mm"):
        draw_probe(np.random.default_rng(0), distance_mm=(60.0, 40.0))
