"""Scenarios: what they change of a model, and that they change it by what was asked for."""

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.scenarios.scenario import (
    Annuloplasty,
    Clip,
    Scenario,
    clip_points,
    model_under,
    plane_of,
)
from mvest.valve.measure.annulus import measure_annulus
from tests.scenarios.valves import model


@pytest.fixture(scope="module")
def plain():
    return model()


def closed_annulus(valve):
    annulus = valve.motion.annulus[-1]
    return annulus, measure_annulus(annulus, plane_of(valve, annulus))


def test_a_ring_narrows_exactly_and_leaves_the_commissural_line(plain):
    before_points, before = closed_annulus(plain.contact_valve)
    changed = model_under(plain, Scenario("ring", annuloplasty=Annuloplasty(20.0)))
    points, after = closed_annulus(changed.contact_valve)
    wanted = 0.8 * before.anteroposterior_diameter
    assert after.anteroposterior_diameter == pytest.approx(wanted, abs=1e-9)
    # Along the commissures and in height over the plane every point stays; the curve is shorter.
    plane = plane_of(plain.contact_valve, before_points)
    stays = np.stack([plane.lateral, plane.normal], axis=1)
    np.testing.assert_allclose(points @ stays, before_points @ stays, atol=1e-9)
    assert after.circumference < before.circumference
    share = ((points - plane.origin) @ plane.anterior) / (
        (before_points - plane.origin) @ plane.anterior
    )
    assert np.ptp(share) < 1e-9
    # The open valve, on which everything is defined, and the model that was given stay.
    np.testing.assert_array_equal(
        changed.contact_valve.motion.annulus[0], plain.contact_valve.motion.annulus[0]
    )
    assert closed_annulus(plain.contact_valve)[1] == before
    # The observed valve gets the same ring, on fewer points.
    own = closed_annulus(changed.valve)[1].anteroposterior_diameter
    assert own == pytest.approx(wanted, rel=0.01)


def test_scenarios_combine_and_reach_the_guide(plain):
    guided = model(cells=(16, 2))
    guided.guide = plain
    scenario = Scenario("all", 160.0, Annuloplasty(10.0), Clip(stiffness=50.0))
    changed = model_under(guided, scenario)
    for one in (changed, changed.guide):
        assert one.settings.protocol.pressure_mmHg == 160.0
        assert one.ties.stiffness == 50.0
        assert one.contact_valve.motion.annulus[-1, :, 1].max() < 0.95 * (
            plain.contact_valve.motion.annulus[-1, :, 1].max()
        )
    assert guided.settings.protocol.pressure_mmHg == 120.0
    assert guided.ties is None
    unchanged = model_under(plain, Scenario("as observed"))
    assert unchanged.settings == plain.settings
    assert unchanged.contact_valve is plain.contact_valve


def test_a_clip_holds_both_leaflets_where_it_is_put(plain):
    clip = Clip(position_mm=3.0, width_mm=4.0, grasp_mm=4.0)
    anterior, posterior = clip_points(plain.contact_valve, clip)
    # Three planes across the commissures, at 1, 3 and 5 mm from the middle, two rows in each.
    assert anterior.shape == posterior.shape == (6, 3)
    for points in (anterior, posterior):
        np.testing.assert_allclose(points[:, 0], np.repeat([1.0, 3.0, 5.0], 2), atol=1e-9)
    assert np.all(anterior[:, 1] > posterior[:, 1])
    surface = plain.contact_valve.surface
    edge = surface.vertices[plain.contact_valve.free_edge]
    for points in (anterior, posterior):
        own = np.sign(points[0, 1] - 1.8)
        side = edge[np.sign(edge[:, 1] - 1.8) == own]
        nearest = np.linalg.norm(points[:, None] - side[None], axis=2).min(axis=1)
        # Rows at half and at the whole grasp; the edge is curved and has vertices only.
        assert np.all(np.abs(nearest - np.tile([2.0, 4.0], 3)) < 0.6)
    tied = model_under(plain, Scenario("clip", clip=clip)).ties
    # By default as far apart as the contact's reference: 1.2 thicknesses of about 1 mm.
    edge_thickness = surface.thickness[plain.contact_valve.free_edge].mean()
    assert tied.length == pytest.approx(1.2 * edge_thickness)


def test_a_clip_that_misses_the_leaflets_is_refused(plain):
    with pytest.raises(GeometryError, match="free edge lies there 0 times"):
        clip_points(plain.contact_valve, Clip(position_mm=25.0))
    with pytest.raises(GeometryError, match="ends less than 40 mm"):
        clip_points(plain.contact_valve, Clip(grasp_mm=40.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Annuloplasty(80.0), "less than 70 %"),
        (lambda: Clip(width_mm=0.0), "clip width_mm = 0.0"),
        (lambda: Scenario(" "), "needs a title"),
    ],
)
def test_inadmissible_scenarios_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
