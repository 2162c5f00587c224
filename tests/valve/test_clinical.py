"""Clinical measurements of the template, whose axes are known."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve import clinical
from mvest.valve.anatomy import LeafletSurface
from mvest.valve.clinical import clinical_measurements
from mvest.valve.template import Template, TemplateParameters

CLOSURE = ("orifice_mm2", "passing_ball_mm", "coaptation_length_mm", "coaptation_area_mm2")


AS_IT_LIES = np.eye(3)


def measured(parameters=None, change=None, columns=80, rows=15, turn=AS_IT_LIES):
    valve = Template(parameters or TemplateParameters()).valve(columns, rows)
    surface = valve.surface if change is None else change(valve.surface)
    x = surface.vertices @ turn.T
    return clinical_measurements(x, surface, x[valve.annulus], valve.papillary_tips @ turn.T, 1.0)


@pytest.fixture
def quick(monkeypatch):
    """Without the closure, whose passing ball takes a second."""
    monkeypatch.setattr(clinical, "_closure", lambda distance: lambda *arguments: {})


@pytest.mark.parametrize(
    ("half_commissural", "half_ap"), [(18.0, 14.0), (22.0, 15.0), (16.0, 16.0)]
)
def test_diameters_are_the_axes_of_the_template(quick, half_commissural, half_ap):
    p = replace(
        TemplateParameters(), half_commissural=half_commissural, half_ap=half_ap, flattening=0.0
    )
    found = measured(p)
    assert found["ap_diameter_mm"] == pytest.approx(2 * half_ap, rel=0.02)
    assert found["commissural_diameter_mm"] == pytest.approx(2 * half_commissural, rel=0.02)
    # An ellipse seen from above; a saddle in space, so longer than it.
    assert found["annulus_area_mm2"] == pytest.approx(np.pi * half_ap * half_commissural, rel=0.02)
    assert found["annulus_height_mm"] == pytest.approx(p.saddle, rel=0.02)
    assert found["annulus_circumference_mm"] > 2 * np.pi * min(half_ap, half_commissural)


def test_the_flattened_side_is_the_anterior_one(quick):
    p = TemplateParameters()
    # The anterior half axis is shorter by its flattening: 14 (1 - 0.08) + 14 mm.
    expected = p.half_ap * (2 - p.flattening)
    assert measured(p)["ap_diameter_mm"] == pytest.approx(expected, rel=0.02)


def test_nothing_depends_on_how_the_valve_lies(quick):
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    one, other = measured(), measured(turn=turn)
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert other[name] == pytest.approx(value, rel=1e-6), name


def test_lengths_and_depths_are_those_of_the_template(quick):
    p = TemplateParameters()
    found = measured(p)
    # The longest way from annulus to edge, in the middle of each leaflet.
    assert found["anterior_length_mm"] == pytest.approx(p.length_anterior, rel=0.05)
    assert found["posterior_length_mm"] == pytest.approx(p.length_posterior, rel=0.05)
    surface = Template(p).valve(80, 15).surface
    corner = surface.vertices[surface.triangles]
    area = 0.5 * np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    for number, name in enumerate(("anterior", "posterior")):
        own = area[surface.region == number].sum()
        assert found[f"{name}_area_mm2"] == pytest.approx(own)
    assert found["tip_depth_mm"] == pytest.approx(-p.tips[2], abs=0.2 * p.saddle)


def test_the_open_valve_has_an_orifice():
    found = measured(columns=24, rows=7)
    assert set(CLOSURE) <= set(found)
    assert found["orifice_mm2"] > 100
    assert found["passing_ball_mm"] > 8


def three(surface):
    region = np.where(np.arange(len(surface.region)) % 80 < 20, 2, surface.region)
    return LeafletSurface(
        surface.vertices, surface.triangles, region, (*surface.region_names, "septal"),
        surface.fibre, surface.thickness,
    )  # fmt: skip


def test_of_three_leaflets_what_needs_two_is_not_told():
    found = measured(change=three)
    assert not set(CLOSURE) & set(found)
    assert {"anterior_area_mm2", "posterior_area_mm2", "septal_area_mm2"} <= set(found)
    assert "septal_length_mm" not in found
    assert "tenting_volume_mm3" in found


def test_a_shape_that_defies_a_measurement_has_the_others(monkeypatch, quick):
    def fails(*arguments):
        raise GeometryError("no tenting")

    whole = measured()
    monkeypatch.setattr(clinical, "measure_tenting", fails)
    found = measured()
    assert set(whole) - set(found) == {"tenting_height_mm", "tenting_volume_mm3"}
    valve = Template().valve(24, 7)
    flat = np.zeros((24, 3))
    x = valve.surface.vertices
    assert clinical_measurements(x, valve.surface, flat, valve.papillary_tips, 1.0) == {}
