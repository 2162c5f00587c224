"""Pictures of a valve in images: where planes lie, what is drawn where, gaps and limits."""

import dataclasses

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.reporting.images import (
    ALONG,
    COLUMNS,
    OVER_TIME,
    STEP_MM,
    chosen_frames,
    measures_figure,
    montage_figure,
    resample,
    valve_planes,
)
from mvest.valve.anatomy.dimensions import TemplateParameters
from tests import made_up_sequence


@pytest.fixture(scope="module")
def valve():
    return made_up_sequence.sequence((1.0, 0.0), ValveLayout(64, 15))


@pytest.fixture(scope="module")
def volume(valve):
    return made_up_sequence.volume(valve, spacing=1.2)


def test_planes_are_right_handed_and_hold_what_they_are_named_for(valve):
    planes = valve_planes(valve, 1)
    assert tuple(planes) == tuple(COLUMNS)
    for plane in planes.values():
        assert np.linalg.det(plane.axes) == pytest.approx(1)
    layout, x = valve.layout, valve.vertices[1]
    pair = x[[layout.vertex(0, 0), layout.vertex(180, 0)]]
    middle = valve.tips[1].mean(axis=0)
    for point in (*pair, middle):
        assert abs(planes["commissural"].coordinates(point)[2]) < 1e-9
    front_and_back = x[[layout.vertex(90, 0), layout.vertex(270, 0)]]
    np.testing.assert_allclose(
        planes["anteroposterior"].coordinates(front_and_back)[:, 2], 0, atol=1e-9
    )
    # phi = 0 and the anterior side are to the right and up, the atrium above, the tips below.
    turn, _ = made_up_sequence.pose()
    for name in tuple(COLUMNS)[2:]:
        assert planes[name].right @ turn[:, 0] > 0.99
        assert planes[name].up @ turn[:, 1] > 0.99
    assert planes["commissural"].right @ turn[:, 0] > 0.99
    assert planes["anteroposterior"].right @ turn[:, 1] > 0.99
    for name in ALONG:
        assert planes[name].up @ turn[:, 2] > 0.9
        assert planes[name].coordinates(middle)[1] < -15


def test_a_slice_shows_a_known_gradient(volume):
    plane = valve_planes(made_up_sequence.sequence((1.0,)), 0)["at the annulus"]
    count = np.array(volume.frames.shape[1:])
    i = np.arange(count[0], dtype=np.float32)[:, None, None] * np.ones(count[1:], np.float32)
    ramp = dataclasses.replace(volume, frames=i[None], times=volume.times[:1])
    image = resample(ramp, 0, plane, (-4.0, 4.0, -3.0, 3.0))
    assert image.shape == (15, 20)
    for row, column in ((0, 0), (9, 16)):
        right, up = STEP_MM * (column + 0.5) - 4.0, STEP_MM * (row + 0.5) - 3.0
        at = plane.origin + right * plane.right + up * plane.up
        assert image[row, column] == pytest.approx(volume.index(at)[0], rel=1e-5)
    assert np.isnan(resample(ramp, 0, plane, (500.0, 504.0, 0.0, 4.0))).all()


def panel(figure, row, column):
    return figure.axes[row * len(COLUMNS) + column]


def drawn(axes, label):
    return next(line for line in axes.lines if line.get_label() == label)


def test_the_montage_has_frames_in_rows_and_draws_the_valve_on_them(valve, volume):
    valve = dataclasses.replace(valve, frame_confidence=np.array([0.9, 0.2]))
    figure = montage_figure(volume, valve, title="made up", closed=0)
    assert "LOW CONFIDENCE" in panel(figure, 1, 0).get_ylabel()
    axes = panel(figure, 1, 1)
    # The open anterior leaflet in the middle section begins at its annulus, half of its
    # anteroposterior diameter away, and hangs down by most of its length.
    lines = [c for c in axes.collections if isinstance(c, LineCollection)]
    assert [line.get_label() for line in lines] == ["anterior leaflet", "posterior leaflet"]
    places = np.concatenate(lines[0].get_segments())
    diameter = TemplateParameters().annulus.anteroposterior_diameter
    assert places[:, 0].max() == pytest.approx(0.5 * diameter, abs=0.3)
    assert np.ptp(places[:, 1]) > 20


def test_a_frame_without_a_valve_keeps_its_row(volume):
    valve = made_up_sequence.sequence((1.0, 0.0))
    valve.vertices[1, 3] = np.nan
    with pytest.raises(GeometryError, match="frame 1"):
        valve_planes(valve, 1)
    figure = montage_figure(volume, valve, title="made up")
    assert [t.get_text() for t in panel(figure, 1, 2).texts] == ["no valve"]
    assert not panel(figure, 1, 2).images


def test_a_valve_at_other_times_is_refused(valve, volume):
    other = dataclasses.replace(valve, times=np.array([0.0, 0.05]))
    with pytest.raises(InputError, match="same times"):
        montage_figure(volume, other, title="made up")


# -- measures over time ---------------------------------------------------------------------------
def measures(t, **changes):
    names = [name for curves in OVER_TIME.values() for name in curves]
    return {"time_s": 0.05 * t, "confidence": 0.9, **dict.fromkeys(names, 800.0 + t), **changes}


def titled(figure, title):
    return next(axes for axes in figure.axes if axes.get_title(loc="left") == title)


def test_measures_over_time_have_gaps_hollow_frames_and_bands():
    bounds = {"ap_diameter_mm_low": 20.0, "ap_diameter_mm_high": 31.0}
    rows = [
        measures(0, **bounds),
        measures(1, tenting_height_mm=None, confidence=0.2, **dict.fromkeys(bounds)),
        measures(2, **bounds),
        measures(3, **bounds),
    ]
    figure = measures_figure(rows, title="made up", low_confidence=0.7)
    area = titled(figure, "Annulus area")
    curves = {line.get_label(): line for line in area.lines}
    np.testing.assert_allclose(curves["projected"].get_xdata(), [0, 50, 100, 150])
    hollow = [line for line in area.lines if line.get_markerfacecolor() == "white"]
    assert [list(line.get_xdata()) for line in hollow] == [[50.0], [50.0]]
    tenting = drawn(titled(figure, "Closed leaflets"), "tenting height")
    assert np.isnan(tenting.get_ydata()).tolist() == [False, True, False, False]
    diameters = titled(figure, "Annulus diameters")
    (band,) = diameters.collections
    corners = np.concatenate([path.vertices for path in band.get_paths()])
    assert (corners[:, 1].min(), corners[:, 1].max()) == (20.0, 31.0)
    assert 50.0 not in corners[:, 0]


@pytest.mark.parametrize(
    ("count", "closed", "expected"),
    [(4, None, [0, 1, 2, 3]), (11, 7, [0, 2, 4, 7, 8, 10]), (101, 1, [0, 1, 40, 60, 80, 100])],
)
def test_frames_are_even_and_hold_the_first_and_the_closed(count, closed, expected):
    assert chosen_frames(count, closed) == expected
