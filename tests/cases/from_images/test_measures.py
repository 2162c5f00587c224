"""Measures of every frame with their bands, and the files of a valve from images."""

import dataclasses
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from mvest.cases.from_images.detector_errors import valve_axes, with_bands
from mvest.cases.from_images.measures import (
    closed_frame,
    measure_sequence,
    write_landmarks,
    write_surfaces,
)
from mvest.errors import InputError
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import LANDMARKS
from tests import made_up_sequence

SMALL = ValveLayout(32, 9)


@pytest.fixture(scope="module")
def valve():
    return made_up_sequence.sequence((1.0, 0.0))


@pytest.fixture(scope="module")
def rows(valve):
    return measure_sequence(valve, 1.0)


def test_the_closed_frame_has_all_and_the_open_one_no_tenting(rows):
    closed, opened = rows
    assert closed.keys() == opened.keys()
    assert [name for name, value in closed.items() if value is None] == []
    missing = {name for name, value in opened.items() if value is None}
    assert missing == {
        f"{what}_{part}"
        for what in ("tenting", "prolapse", "billow")
        for part in ("height_mm", "volume_mm3")
    }
    assert opened["orifice_mm2"] > 100 > closed["orifice_mm2"]
    # The annulus stands still, the tips come 0.8 mm nearer.
    assert closed["annulus_area_mm2"] == pytest.approx(opened["annulus_area_mm2"])
    assert opened["tip_0_depth_mm"] - closed["tip_0_depth_mm"] == pytest.approx(0.8, abs=0.02)
    assert closed["coaptation_length_mm"] == pytest.approx(made_up_sequence.COAPTATION, abs=1.0)
    assert opened["coaptation_length_mm"] == 0.0


def test_leaflets_touch_within_their_thickness_and_their_error():
    valve = made_up_sequence.sequence((1.0,), SMALL)
    for std, reach in ((0.3, 1.0 + 0.3 * np.sqrt(2)), (np.nan, 1.0)):
        seen = dataclasses.replace(valve, std_mm=np.full(SMALL.size, std))
        assert measure_sequence(seen, 1.0)[0]["contact_distance_mm"] == pytest.approx(reach)
    with pytest.raises(InputError, match="thickness_mm = nan"):
        measure_sequence(valve, np.nan)


def test_a_frame_without_a_valve_is_empty():
    valve = made_up_sequence.sequence((1.0, 1.0, 1.0), SMALL)
    valve.frame_confidence[1] = 0.0
    valve.vertices[2, 5] = np.nan
    rows = measure_sequence(valve, 1.0)
    own = {"frame", "time_s", "confidence", "vertex_confidence_mean", "contact_distance_mm"}
    for row in rows[1:]:
        assert {name for name, value in row.items() if value is not None} == own
    assert rows[0]["ap_diameter_mm"] is not None


def test_the_closed_frame_is_where_most_touches(rows):
    assert closed_frame(rows) == 0

    def row(frame, touching, orifice):
        return {"frame": frame, "coaptation_area_mm2": touching, "orifice_mm2": orifice}

    nothing = row(0, None, None)
    assert closed_frame([nothing, row(1, 5.0, 2.0), row(2, 9.0, 8.0)]) == 2
    assert closed_frame([nothing, row(1, 0.0, 20.0), row(2, 0.0, 8.0)]) == 2
    assert closed_frame([nothing]) is None


def test_the_surfaces_carry_their_times_confidence_and_leaflets(tmp_path):
    valve = made_up_sequence.sequence((1.0, 0.0), SMALL)
    valve.std_mm[3] = np.nan
    index = write_surfaces(tmp_path, valve)
    entries = ET.parse(index).findall("Collection/DataSet")
    assert [float(entry.get("timestep", "")) for entry in entries] == [0.0, 0.04]
    second = read_surface(tmp_path / entries[1].get("file", ""))
    np.testing.assert_allclose(second.vertices, valve.vertices[1])
    np.testing.assert_array_equal(second.triangles, SMALL.triangles)
    np.testing.assert_allclose(second.point_data["confidence"], valve.vertex_confidence[1])
    np.testing.assert_allclose(second.point_data["std_mm"], valve.std_mm)
    np.testing.assert_array_equal(second.cell_data["region"], SMALL.region)
    assert "region.posterior" in second.cell_data


def test_landmarks_are_read_back_in_place(tmp_path):
    valve = made_up_sequence.sequence((1.0, 0.0), SMALL)
    lists = read_markups(write_landmarks(tmp_path / "points.mrk.json", valve, 1))
    assert lists["AnnulusLabelsMarkup"].labels == ("A", "P", "AL", "PM", "ALC", "PMC", "MC")
    named = lists["landmarks"]
    assert named.labels == LANDMARKS
    middle = valve.vertices[1, SMALL.vertex(90, -1)]
    points = dict(zip(named.labels, named.points, strict=True))
    np.testing.assert_allclose(points["free_edge_anterior"], middle)
    np.testing.assert_allclose(points["tip_180"], valve.tips[1, 1])
    assert lists["annulus"].kind == "ClosedCurve"
    np.testing.assert_allclose(lists["annulus"].points, valve.annulus[1])
    np.testing.assert_allclose(lists["free edge"].points, valve.free_edge[1])


CLOSED, OPEN = 0, 1
LENGTHS = ("ap_diameter_mm", "commissural_diameter_mm", "annulus_height_mm", "tip_separation_mm",
           "tip_depth_mm")  # fmt: skip


def swollen(valve, shares):
    """Errors of detectors that see a valve larger, all of it alike, by these shares (K, 2) of it.

    Of each sample in the open and in the closed frame.
    """
    errors = np.zeros((len(shares), 2, SMALL.size, 3))
    tips = np.zeros((len(shares), 2, 2, 3))
    for which, frame in enumerate((OPEN, CLOSED)):
        axes, centre = valve_axes(valve, frame), valve.annulus[frame].mean(axis=0)
        share = np.asarray(shares)[:, which, None, None]
        errors[:, which] = share * ((valve.vertices[frame] - centre) @ axes)
        tips[:, which] = share * ((valve.tips[frame] - centre) @ axes)
    return DetectionAccuracy(np.ones(SMALL.size), 5.0, errors, tips)


def test_a_valve_seen_larger_or_smaller_gives_lengths_a_band_of_that_share():
    valve = made_up_sequence.sequence((1.0, 0.0), SMALL)
    rows = measure_sequence(valve, 1.0)
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
    # Without the mean error, where the valve is.
    centred = with_bands(valve, rows, swollen(valve, np.full((3, 2), 0.1)))
    for row, own in zip(rows, centred, strict=True):
        for end in ("low", "high"):
            found = own[f"annulus_area_mm2_{end}"]
            assert found == pytest.approx(0.9**2 * row["annulus_area_mm2"])
