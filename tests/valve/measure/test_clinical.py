"""Clinical measurements of the template, whose axes are known."""

import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.measure import clinical
from mvest.valve.measure.clinical import clinical_measurements, clinical_names

CLOSURE = ("orifice_mm2", "coaptation_length_mm", "coaptation_area_mm2")


AS_IT_LIES = np.eye(3)


def measured(parameters=None, change=None, columns=80, rows=15, turn=AS_IT_LIES):
    valve = Template(parameters or TemplateParameters()).valve(columns, rows)
    surface = valve.surface if change is None else change(valve.surface)
    x = surface.vertices @ turn.T
    return clinical_measurements(x, surface, x[valve.annulus], valve.papillary_tips @ turn.T, 1.0)


@pytest.fixture
def quick(monkeypatch):
    """Without the closure."""
    monkeypatch.setattr(clinical, "closure", lambda *arguments: {})


def test_the_open_valve_has_an_orifice():
    found = measured(columns=24, rows=7)
    assert set(CLOSURE) <= set(found)
    assert found["orifice_mm2"] > 100
    assert set(found) == set(clinical_names(("anterior", "posterior")))


def test_a_shape_that_defies_a_measurement_has_the_others(monkeypatch, quick):
    def fails(*arguments):
        raise GeometryError("no tenting")

    whole = measured()
    monkeypatch.setattr(clinical, "tenting", fails)
    found = measured()
    assert set(whole) - set(found) == {"tenting_height_mm", "tenting_volume_mm3"}
    valve = Template().valve(24, 7)
    flat = np.zeros((24, 3))
    x = valve.surface.vertices
    assert clinical_measurements(x, valve.surface, flat, valve.papillary_tips, 1.0) == {}


def dome(height, rim=15.0, n=96, rings=24):
    """Two halves of a spherical cap of a height over a circle (negative: below it)."""
    radius = (rim**2 + height**2) / (2 * abs(height))
    angle = np.arange(n) * 2 * np.pi / n
    loops = []
    for r in rim * np.linspace(1.0, 0.004, rings):
        z = np.sign(height) * (np.sqrt(radius**2 - r**2) - (radius - abs(height)))
        loops.append(np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(n, z)]))
    here = np.arange(n)
    triangles = np.concatenate(
        [
            part + k * n
            for k in range(rings - 1)
            for part in (
                np.stack([here, here + n, (here + 1) % n + n], 1),
                np.stack([here, (here + 1) % n + n, (here + 1) % n], 1),
            )
        ]
    )
    vertices = np.concatenate(loops)
    middle = vertices[triangles].mean(axis=1)
    surface = LeafletSurface(
        vertices, triangles, (middle[:, 1] < 0).astype(int), ("anterior", "posterior"),
        np.tile([1.0, 0.0, 0.0], (len(vertices), 1)), np.ones(len(vertices)),
    )  # fmt: skip
    return vertices, surface, vertices[:n]


TIPS = np.array([[10.0, -3.0, -25.0], [-10.0, -3.0, -23.0]])


@pytest.mark.parametrize("height", [15.0])
def test_a_dome_into_the_atrium_prolapses_by_its_height_and_volume(quick, height):
    vertices, surface, annulus = dome(height)
    found = clinical_measurements(vertices, surface, annulus, TIPS, 1.0)
    cap = np.pi * height * (3 * 15.0**2 + height**2) / 6
    for name in ("prolapse", "billow"):
        assert found[f"{name}_height_mm"] == pytest.approx(height, rel=0.01)
        assert found[f"{name}_volume_mm3"] == pytest.approx(cap, rel=0.02)
    assert found["tenting_volume_mm3"] == pytest.approx(-cap, rel=0.02)
    # Both leaflets together are the cap: 2 pi R h.
    both = found["anterior_area_mm2"] + found["posterior_area_mm2"]
    assert both == pytest.approx(np.pi * (15.0**2 + height**2), rel=0.01)


def test_a_saddle_prolapses_over_its_plane_but_does_not_billow(quick):
    _, surface, flat = dome(-6.0)
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    lift = -3.0 * np.cos(2 * angle)
    # The leaflets hang 2 mm below a saddle with high points on the anterior and posterior side.
    x = surface.vertices.copy()
    share = np.hypot(x[:, 0], x[:, 1]) / 15.0
    x[:, 2] = np.tile(lift, len(x) // len(flat)) * share**2 - 2.0 * (1 - share**2)
    annulus = x[: len(flat)]
    found = clinical_measurements(x, surface, annulus, TIPS, 1.0)
    assert found["annulus_height_mm"] == pytest.approx(6.0, rel=0.01)
    assert found["annulus_height_to_width_ratio"] == pytest.approx(6.0 / 30.0, rel=0.01)
    assert found["prolapse_height_mm"] > 2.0
    assert found["billow_height_mm"] == pytest.approx(0.0, abs=0.05)


def test_ratios_lengths_and_tips(quick):
    p = TemplateParameters()
    found = measured(p)
    assert found["annulus_sphericity_ratio"] == pytest.approx(
        p.annulus.anteroposterior_diameter / p.annulus.commissural_diameter, 0.02
    )
    assert found["tip_separation_mm"] == pytest.approx(2 * p.papillary.tip[0])
    # The longest way from annulus to edge, in the middle of each leaflet.
    assert found["anterior_length_mm"] == pytest.approx(p.leaflets.anterior.length, rel=0.05)
    assert found["posterior_length_mm"] == pytest.approx(p.leaflets.posterior.length, rel=0.05)
    vertices, surface, annulus = dome(-6.0)
    found = clinical_measurements(
        vertices, surface, annulus, TIPS, 1.0, tip_names=("tip_0", "tip_180")
    )
    assert found["tip_0_depth_mm"] == pytest.approx(25.0)
    assert found["tip_180_depth_mm"] == pytest.approx(23.0)
    assert found["tip_depth_mm"] == pytest.approx(24.0)
    near = 15.0 - np.hypot(10.0, 3.0)
    assert found["tip_0_annulus_distance_mm"] == pytest.approx(np.hypot(near, 25.0), rel=1e-3)
    assert found["tip_separation_mm"] == pytest.approx(np.hypot(20.0, 2.0))
