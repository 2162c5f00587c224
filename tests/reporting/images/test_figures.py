"""Figures of the image step: what is drawn where, gaps, limits and what is refused."""

import numpy as np
import pandas as pd
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.reporting.images.figures import (
    LIMITS_MM,
    SETTINGS,
    distance_figure,
    measures_figure,
    std_figure,
    training_figure,
)


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
    figure = measures_figure(rows, title="made up")
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
        measures_figure([], title="made up")


def test_bands_are_drawn_where_measures_have_bounds():
    bounds = {"ap_diameter_mm_low": 20.0, "ap_diameter_mm_high": 31.0}
    rows = [measures(0) | bounds, measures(1) | dict.fromkeys(bounds), measures(2) | bounds]
    rows.append(measures(3) | bounds)
    figure = measures_figure(rows, title="made up")
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
    plain = measures_figure([measures(0)], title="made up")
    assert not any("Bands" in text.get_text() for text in plain.texts)


def volumes(setting, values):
    return [{"setting": setting, "surface_mm": value} for value in values]


def test_every_volume_is_a_point_and_the_limits_are_marked():
    rows = volumes("in distribution", [0.4, 0.5, 0.9]) + volumes("shifted", [1.0, None, 12.0])
    axes = distance_figure(rows).axes[0]
    points = {
        line.get_label(): sorted(line.get_xdata())
        for line in axes.lines
        if line.get_label() in SETTINGS
    }
    assert points == {"in distribution": [0.4, 0.5, 0.9], "shifted": [1.0]}
    limits = [line.get_xdata()[0] for line in axes.lines if line.get_label() == "limit"]
    assert limits == list(LIMITS_MM)
    words = [text.get_text() for text in axes.texts]
    assert words == ["1 beyond, up to 12.0 mm →", "0.5", "0.8", "1.5"]
    ticks = [text.get_text() for text in axes.get_yticklabels()]
    assert ticks[0] == "in distribution\n(3 volumes)"
    assert ticks[1] == "shifted\n(3 volumes, 1 without a valve found)"
    assert axes.get_xlim() == (0, 4.5)


def test_a_setting_without_any_valve_is_drawn_empty():
    axes = distance_figure(volumes("in distribution", [0.4]) + volumes("shifted", [None])).axes[0]
    assert {line.get_label() for line in axes.lines} & set(SETTINGS) == {"in distribution"}
    assert axes.get_xlim()[1] == pytest.approx(1.06 * 1.5)


@pytest.mark.parametrize("rows", [[], volumes("moved", [0.5])])
def test_other_settings_are_refused(rows):
    with pytest.raises(InputError, match="expected in distribution or shifted"):
        distance_figure(rows)


def errors(stages=("pose", "surface", "position", "gate"), counts=(50, 200)):
    return pd.DataFrame(
        [
            {
                "stage": stage, "training_volumes": count, "setting": setting,
                "median": 100 / count, "p90": 200 / count,
                "unit": "degrees" if stage == "pose" else "mm",
            }
            for stage in stages
            for count in reversed(counts)
            for setting in SETTINGS
        ]
    )  # fmt: skip


def test_each_stage_has_a_panel_in_its_own_unit():
    figure = training_figure(errors())
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["position", "pose", "surface", "gate", "", ""]
    assert panel(figure, "pose").get_ylabel() == "error [degrees]"
    curves = {line.get_label(): line for line in panel(figure, "surface").lines}
    assert set(curves) == {f"{s}, {w}" for s in SETTINGS for w in ("median", "90 %")}
    # From few to many volumes, in whatever order the rows are.
    assert list(curves["shifted, median"].get_xdata()) == [50, 200]
    assert list(curves["shifted, 90 %"].get_ydata()) == [4.0, 1.0]
    ticks = [text.get_text() for text in panel(figure, "gate").get_xticklabels()]
    assert ticks == ["50", "200"]
    assert figure.axes[-1].get_legend() is not None


def test_a_full_grid_has_its_legend_outside():
    figure = training_figure(errors(("position", "pose", "surface")))
    assert len(figure.legends) == 1
    assert len(figure.axes) == 3


def test_a_table_that_is_none_is_refused():
    with pytest.raises(InputError, match="no columns p90, unit"):
        training_figure(errors().drop(columns=["p90", "unit"]))
    with pytest.raises(InputError, match="no rows"):
        training_figure(errors().iloc[:0])


def test_the_map_of_std_has_each_vertex_at_its_phi_and_s():
    layout = ValveLayout(16, 5)
    std = 0.2 + layout.s + layout.phi / 360
    std[layout.vertex(90, 0)] = np.nan
    figure = std_figure(layout, std)
    mesh = figure.axes[0].collections[0]
    values = mesh.get_array()
    assert values.shape == (5, 17)
    assert values[4, 4] == pytest.approx(0.2 + 1 + 0.25)
    assert values.mask[0, 4]
    assert values.mask.sum() == 1
    # Column 4 is drawn about 90 degrees; the valve is closed by its first column.
    corners = mesh.get_coordinates()
    assert corners[0, 4, 0] < 90 < corners[0, 5, 0]
    np.testing.assert_allclose(values[1, 0], values[1, 16])
    assert figure.axes[0].get_ylim() == (1.0, 0.0)
    assert any("never measured (1 points)" in text.get_text() for text in figure.texts)
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(80,\)"):
        std_figure(layout, np.ones(3))
