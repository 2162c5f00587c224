"""Figures of the image step: what is drawn where, gaps and limits."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.reporting.images.figures import confidence_figure, errors_figure
from mvest.reporting.images.step import measures_figure


def measures(t, **changes):
    row = {
        "frame": t, "time_s": 0.05 * t, "confidence": 0.9,
        "annulus_area_mm2": 800.0 + t, "annulus_area_3d_mm2": 830.0 + t, "ap_diameter_mm": 28.0,
        "commissural_diameter_mm": 36.0, "annulus_height_mm": 6.0, "tenting_height_mm": 5.0,
        "billow_height_mm": 0.0, "orifice_mm2": 10.0 * t, "coaptation_length_mm": 4.0,
        "anterior_area_mm2": 600.0, "posterior_area_mm2": 650.0, "tip_separation_mm": 32.0,
        "tip_depth_mm": 24.0,
    }  # fmt: skip
    return row | changes


def panel(figure, title):
    return next(axes for axes in figure.axes if axes.get_title(loc="left") == title)


def test_measures_over_time_have_gaps_and_hollow_frames():
    rows = [
        measures(0),
        measures(1, tenting_height_mm=None, confidence=0.2),
        measures(2, coaptation_length_mm=None),
    ]
    rows = [row | {"coaptation_length_mm": None} for row in rows]
    figure = measures_figure(rows, title="made up", low_confidence=0.7)
    assert len(figure.axes) == 8
    area = panel(figure, "Annulus area")
    curves = {line.get_label(): line for line in area.lines}
    np.testing.assert_allclose(curves["projected"].get_xdata(), [0, 50, 100])
    np.testing.assert_allclose(curves["projected"].get_ydata(), [800, 801, 802])
    np.testing.assert_allclose(curves["in space"].get_ydata(), [830, 831, 832])
    hollow = [line for line in area.lines if line.get_markerfacecolor() == "white"]
    assert [list(line.get_xdata()) for line in hollow] == [[50.0], [50.0]]
    tenting = next(
        line for line in panel(figure, "Closed leaflets").lines
        if line.get_label() == "tenting height"
    )  # fmt: skip
    assert np.isnan(tenting.get_ydata()).tolist() == [False, True, False]
    nothing = panel(figure, "Coaptation")
    assert [text.get_text() for text in nothing.texts] == ["not measured in any frame"]
    assert any("1 of 3 frames" in text.get_text() for text in figure.texts)
    with pytest.raises(InputError, match="no frames"):
        measures_figure([], title="made up", low_confidence=0.7)


def test_bands_are_drawn_where_measures_have_bounds():
    bounds = {"ap_diameter_mm_low": 20.0, "ap_diameter_mm_high": 31.0}
    rows = [measures(0) | bounds, measures(1) | dict.fromkeys(bounds), measures(2) | bounds]
    rows.append(measures(3) | bounds)
    figure = measures_figure(rows, title="made up", low_confidence=0.7)
    diameters = panel(figure, "Annulus diameters")
    (band,) = diameters.collections
    corners = np.concatenate([path.vertices for path in band.get_paths()])
    assert (corners[:, 1].min(), corners[:, 1].max()) == (20.0, 31.0)
    assert 50.0 not in corners[:, 0]
    low, high = diameters.get_ylim()
    assert low < 20.0
    assert high > 36.0
    assert not panel(figure, "Annulus area").collections
    assert any("Bands: 95 %" in text.get_text() for text in figure.texts)
    plain = measures_figure([measures(0)], title="made up", low_confidence=0.7)
    assert not any("Bands" in text.get_text() for text in plain.texts)


DISTANCES = {"in distribution": [0.4, 0.5, 0.9], "shifted": [1.0, 12.0]}
STAGES = [
    {"stage": stage, "setting": setting, "unit": unit, "error": 1.0 + k, "error_90": 4.0}
    for stage, unit in (("position", "mm"), ("pose", "°"))
    for k, setting in enumerate(DISTANCES)
]


def errors(std=None):
    return errors_figure(
        DISTANCES,
        (0.5, 1.5),
        STAGES,
        std_mm=np.ones((5, 16)) if std is None else std,
        distance_mm=np.array([1.0, 8.0]),
        correlation=np.array([0.97, 0.48]),
        length_mm=8.0,
    )


def test_every_detected_valve_is_a_point_and_the_limits_are_marked():
    distance, stages = errors().axes[:2]
    dots = [line for line in distance.lines if line.get_alpha() == 0.75]
    assert [sorted(line.get_ydata()) for line in dots] == list(DISTANCES.values())
    dashed = [line.get_ydata()[0] for line in distance.lines if line.get_linestyle() == "--"]
    assert dashed == [0.5, 1.5]
    assert [text.get_text() for text in distance.get_xticklabels()] == list(DISTANCES)
    medians = {line.get_label(): list(line.get_ydata()) for line in stages.lines}
    assert medians == {"in distribution": [1.0, 1.0], "shifted": [2.0, 2.0]}
    names = [text.get_text() for text in stages.get_xticklabels()]
    assert names == ["position\n[mm]", "pose\n[°]"]


def test_the_fitted_correlation_is_drawn_beside_the_measured_one():
    axes = errors().axes[2]
    curve = next(line for line in axes.lines if "8.0 mm" in str(line.get_label()))
    x, y = curve.get_data()
    assert (y[0], x[-1]) == (1.0, 8.0)
    assert y[-1] == pytest.approx((1 + np.sqrt(3)) * np.exp(-np.sqrt(3)))


def test_the_map_of_std_has_each_vertex_at_its_phi_and_s():
    layout = ValveLayout(16, 5)
    std = (0.2 + layout.s + layout.phi / 360).reshape(5, 16)
    axes = errors(std).axes[3]
    mesh = axes.collections[0]
    values = mesh.get_array()
    assert values.shape == (5, 17)
    assert values[4, 4] == pytest.approx(0.2 + 1 + 0.25)
    # Column 4 is drawn about 90 degrees; the valve is closed by its first column.
    corners = mesh.get_coordinates()
    assert corners[0, 4, 0] < 90 < corners[0, 5, 0]
    np.testing.assert_allclose(values[1, 0], values[1, 16])
    assert axes.get_ylim() == (1.0, 0.0)


def test_the_figure_of_confidences_shows_wrong_valves_hollow():
    rows = [
        {"kind": "shifted", "confidence": 0.9, "points": 1.0},
        {"kind": "shifted", "confidence": 0.6, "points": 20.0},
        {"kind": "walls only", "confidence": 0.2, "points": None},
    ]
    axes = confidence_figure(rows, 0.5, 5.0).axes[0]
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels == ["shifted (2)", "no valve: walls only (1)"]
    faces = {
        float(x): line.get_markerfacecolor()
        for line in axes.lines
        if line.get_linestyle() == "None"
        for x in line.get_xdata()
    }
    assert faces[0.6] == "white"
    assert faces[0.9] != "white"
    assert faces[0.2] not in ("white", faces[0.9])
