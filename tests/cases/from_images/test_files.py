"""Surfaces, landmarks and segmentations of a valve from images, read back."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from mvest.cases.from_images.measures import write_landmarks, write_surfaces
from mvest.errors import InputError
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_surface
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import LANDMARKS
from tests import made_up_sequence

SMALL = ValveLayout(32, 9)


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
    assert list(lists) == ["landmarks", "annulus", "free edge", "AnnulusLabelsMarkup"]
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


def test_a_frame_that_does_not_exist_is_refused(tmp_path):
    valve = made_up_sequence.sequence((1.0,), SMALL)
    with pytest.raises(InputError, match="frame 1, expected 0 to 0"):
        write_landmarks(tmp_path / "points.mrk.json", valve, 1)
    assert list(tmp_path.iterdir()) == []
