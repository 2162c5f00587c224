"""Bands of measures over time, from errors whose effect on a measure is known."""

import numpy as np
import pytest

from mvest.cases.from_images.detector_errors import BANDED, valve_axes, with_bands
from mvest.cases.from_images.measures import measure_sequence
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from tests import made_up_sequence

LAYOUT = ValveLayout(32, 9)
CLOSED, OPEN = 0, 1
LENGTHS = ("ap_diameter_mm", "commissural_diameter_mm", "annulus_height_mm", "tip_separation_mm",
           "tip_depth_mm")  # fmt: skip


@pytest.fixture(scope="module")
def valve():
    return made_up_sequence.sequence((1.0, 0.0), LAYOUT)


@pytest.fixture(scope="module")
def rows(valve):
    return measure_sequence(valve, 1.0)


def swollen(valve, shares):
    """Errors of detectors that see a valve larger, all of it alike, by these shares (K, 2) of it.

    Of each sample in the open and in the closed frame.
    """
    errors = np.zeros((len(shares), 2, LAYOUT.size, 3))
    tips = np.zeros((len(shares), 2, 2, 3))
    for which, frame in enumerate((OPEN, CLOSED)):
        axes, centre = valve_axes(valve, frame), valve.annulus[frame].mean(axis=0)
        share = np.asarray(shares)[:, which, None, None]
        errors[:, which] = share * ((valve.vertices[frame] - centre) @ axes)
        tips[:, which] = share * ((valve.tips[frame] - centre) @ axes)
    return DetectionAccuracy(np.ones(LAYOUT.size), 5.0, errors, tips)


def test_a_valve_seen_larger_or_smaller_gives_lengths_a_band_of_that_share(valve, rows):
    shares = np.array([-0.04, -0.02, 0.0, 0.02, 0.04])
    banded = with_bands(valve, rows, swollen(valve, np.stack([shares, 0 * shares], axis=1)))
    # Student's bound of four degrees of freedom, for one further number (any table of it).
    half = 2.776 * np.std(shares, ddof=1) * np.sqrt(1 + 1 / 5)
    for name in LENGTHS:
        seen = rows[OPEN][name]
        assert banded[OPEN][f"{name}_low"] == pytest.approx(seen * (1 - half), rel=1e-4), name
        assert banded[OPEN][f"{name}_high"] == pytest.approx(seen * (1 + half), rel=1e-4), name
        # In closed frames there is no error.
        assert banded[CLOSED][f"{name}_low"] == pytest.approx(rows[CLOSED][name])
        assert banded[CLOSED][f"{name}_high"] == pytest.approx(rows[CLOSED][name])
    assert [{name: row[name] for name in rows[0]} for row in banded] == rows


def test_a_band_lies_where_the_valve_is_without_the_mean_error(valve, rows):
    banded = with_bands(valve, rows, swollen(valve, np.full((3, 2), 0.1)))
    for row, own in zip(rows, banded, strict=True):
        assert own["annulus_area_mm2_low"] == pytest.approx(0.9**2 * row["annulus_area_mm2"])
        assert own["annulus_area_mm2_high"] == pytest.approx(0.9**2 * row["annulus_area_mm2"])


def test_a_frame_without_a_valve_has_no_band():
    valve = made_up_sequence.sequence((1.0, 1.0), LAYOUT)
    valve.frame_confidence[1] = 0.0
    rows = measure_sequence(valve, 1.0)
    empty = with_bands(valve, rows, swollen(valve, np.full((3, 2), 0.1)))[1]
    assert {empty[f"{name}_{end}"] for name in BANDED for end in ("low", "high")} == {None}
