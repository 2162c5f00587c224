"""Settings of the scanner, the probe, and scatterers that move with the tissue."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import (
    RANGES,
    Acquisition,
    draw_acquisition,
    draw_probe,
)
from mvest.imaging.simulator.scatterers import Cord, Material, TissueSheet
from tests.imaging.simulator.made_up_valve import SMALL

# Echo strengths and compensation may be those of training in both.
BOTH = {"wall_db", "chord_db", "papillary_db", "vessel_db", "compensation_db_per_cm_mhz"}


BAD = {
    "frequency_mhz": 0.0, "blood_db": math.nan, "depth_mm": (50.0, 20.0), "shape": (4, 40, 40),
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


MATERIAL = Material("tissue", 0.0)
TURN = Rotation.from_euler("xyz", [20, 50, -70], degrees=True).as_matrix()
SHIFT = np.array([3.0, -2.0, 7.0])
FAR = np.array([0.0, 0.0, 1000.0])


def tube(radius: float = 20.0, length: float = 30.0, thickness: float = 2.0) -> TissueSheet:
    """A cylinder about z, in a second frame turned and moved."""
    angle = 2 * np.pi * np.arange(90) / 90
    z = np.linspace(0, -length, 11)
    points = np.empty((2, 11, 90, 3))
    points[0, ..., 0], points[0, ..., 1] = radius * np.cos(angle), radius * np.sin(angle)
    points[0, ..., 2] = z[:, None]
    points[1] = points[0] @ TURN.T + SHIFT
    flat = np.full((11, 90), thickness)
    return TissueSheet(MATERIAL, points, flat, (0.0, 1.0), np.ones_like(flat), fade=2.0)


def ring() -> Cord:
    angle = 2 * np.pi * np.arange(60) / 60
    line = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle], axis=1)
    lines = np.stack([line, line @ TURN.T + SHIFT])
    return Cord(MATERIAL, lines, np.full(60, 1.5), True, np.cos(angle) ** 2)


@pytest.mark.parametrize("part", [tube(), ring()])
def test_scatterers_move_with_the_tissue(part):
    seeds, *_ = part.sow(np.random.default_rng(0), 500)
    first, _ = part.place(0, seeds, FAR)
    second, _ = part.place(1, seeds, FAR)
    # The ring's reference direction stays in space: along its axis, turned ones stay on it.
    if isinstance(part, TissueSheet):
        np.testing.assert_allclose(second, first @ TURN.T + SHIFT, atol=1e-9)
    else:
        back = (second - SHIFT) @ TURN
        along = np.linalg.norm(back - first, axis=1)
        assert along.max() <= 2 * 1.5


def test_a_sheet_fills_its_thickness_outside_of_its_grid_and_fades():
    sheet = tube()
    seeds, strength, dense = sheet.sow(np.random.default_rng(0), 500)
    np.testing.assert_allclose(strength, np.exp(-2 * seeds[:, 2]))
    assert np.ptp(seeds[:, 2]) > 0.9
    assert not dense.any()
    place, _ = sheet.place(0, sheet.sow(np.random.default_rng(0), 4000)[0], FAR)
    radius = np.linalg.norm(place[:, :2], axis=1)
    assert radius.min() > 19.9
    assert 21.8 < radius.max() < 22.01
    assert sheet.volume == pytest.approx(2 * np.pi * 20 * 30 * 2, rel=0.01)
    # Facing is the cosine between normal and line of sight.
    seeds = np.array([[5.0, 0.0, 0.0], [5.0, 22.5, 0.0]])
    _, facing = sheet.place(0, seeds, np.array([1000.0, 0.0, -15.0]))
    np.testing.assert_allclose(facing, [1.0, 0.0], atol=0.05)


def test_a_cord_is_round_and_seen_best_from_the_side():
    cord = ring()
    seeds, *_ = cord.sow(np.random.default_rng(0), 3000)
    place, facing = cord.place(0, seeds, FAR)
    across = np.hypot(np.linalg.norm(place[:, :2], axis=1) - 10, place[:, 2])
    assert across.max() < 1.51
    assert np.median(across) == pytest.approx(1.5 / np.sqrt(2), rel=0.05)
    np.testing.assert_allclose(facing, 1, atol=0.01)
    _, edge_on = cord.place(0, np.array([[15.0, 0, 0], [0.0, 0, 0]]), np.array([1000.0, 0, 0]))
    np.testing.assert_allclose(edge_on, [0, 1], atol=0.05)
    assert cord.volume == pytest.approx(2 * np.pi * 10 * np.pi * 1.5**2, rel=0.01)
