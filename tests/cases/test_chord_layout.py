"""The layout of chordae on a cylinder and the template; a case of one open frame alone."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.folder import read_case, write_case
from mvest.cases.tissue import (
    CLOSED_DEPTH,
    SEEN_ON_BAND,
    LeafletBand,
    assumed_closure,
    lay_out_chordae,
)
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.template import BRANCHING, MARGINAL_S, Template
from mvest.valve.anatomy.valve import band_grid
from tests.cases.folders import band_of, template_case
from tests.cases.test_folder import assert_equal

RADIUS, HEIGHT = 15.0, 12.0


def cylinder(columns=36, rows=5, begin=20.0, end=160.0):
    """A band round z from the annulus at z = 0 to the free edge at -12, normals outwards.

    The anterior leaflet, region 1, lies between the angles begin and end (degrees).
    """
    phi, s, triangles, _ = band_grid(columns, rows)
    x = np.stack(at_angle(phi, s), axis=1)
    middle = np.tile(phi[: columns * (rows - 1)] + 180.0 / columns, 2)
    region = ((middle > begin) & (middle < end)).astype(np.int64)
    annulus, free_edge = np.arange(columns), np.arange(columns) + columns * (rows - 1)
    return x, triangles, region, annulus, free_edge


def at_angle(degrees, s, radius=RADIUS):
    angle = np.deg2rad(degrees)
    return [radius * np.cos(angle), radius * np.sin(angle), -HEIGHT * s]


def narrowed(band):
    """Positions in a band of half the radius."""
    return replace(band, vertices=band.vertices * [0.5, 0.5, 1.0]).position


@pytest.mark.parametrize("roll", [0, 11])
@pytest.mark.parametrize("backwards", [False, True])
def test_phi_is_stretched_between_the_commissures(roll, backwards):
    x, t, r, annulus, free_edge = cylinder()
    annulus = np.roll(annulus[::-1] if backwards else annulus, roll)
    band = LeafletBand.of(x, t, r, annulus, free_edge, anterior=1)
    # Along the triangles the annulus runs backwards here, so the anterior leaflet begins at 160
    # and phi runs with decreasing angle: 90 is 160 - 70, and 270 is 20 - 110 = -90.
    found = band.position(np.array([0.0, 90.0, 180.0, 270.0, -90.0]), np.array([0, 0.5, 1, 0.5, 0]))
    expected = [at_angle(160, 0), at_angle(90, 0.5), at_angle(20, 1), at_angle(-90, 0.5)]
    np.testing.assert_allclose(found, [*expected, at_angle(-90, 0)], atol=1e-9)


def test_places_do_not_depend_on_where_the_annulus_begins():
    # On the template the border of the leaflets runs over 15 degrees of harmonic angle, so that for
    # some of these beginnings the angle jumps from 2 pi to 0 along it.
    valve = Template().valve(24, 8)
    phi, s = np.linspace(-180.0, 540.0, 50), np.linspace(0.0, 1.0, 50)
    expected = band_of(valve).position(phi, s)
    for roll in range(1, 24):
        band = band_of(replace(valve, annulus=np.roll(valve.annulus, roll)))
        np.testing.assert_allclose(band.position(phi, s), expected, atol=1e-8)


def test_rest_lengths_follow_the_closed_frame_but_never_fall_below_the_open_one():
    band = LeafletBand.of(*cylinder(), anterior=1)
    layout = ChordLayout(
        marginal=(180.0 / 14 * 3,), branches=1, basal=((-90.0, 0.5),), strut=(), open_slack=1.1,
        marginal_slack=0.9, basal_slack=2.0,
    )  # fmt: skip
    tips = np.array([[20.0, 0.0, -30.0], [-20.0, 0.0, -30.0]])
    closed, lower = narrowed(band), np.array([0.0, 0.0, 5.0])
    chordae = lay_out_chordae(band.position, tips, closed, tips - lower, layout)
    # phi = 180 - 3/14 180 from the side of 160 degrees: angles 130 and 50, and -90 twice.
    at = MARGINAL_S
    places = np.array([at_angle(130, at), at_angle(-90, 0.5), at_angle(50, at), at_angle(-90, 0.5)])
    np.testing.assert_allclose(chordae.insertion, places, atol=1e-9)
    np.testing.assert_array_equal(chordae.tip[[0, 2]], [1, 0])
    open_length = np.linalg.norm(places - tips[chordae.tip], axis=1)
    moved = places * [0.5, 0.5, 1.0]
    closed_length = np.linalg.norm(moved - (tips - lower)[chordae.tip], axis=1)
    expected = np.maximum([0.9, 2.0, 0.9, 2.0] * closed_length, 1.1 * open_length)
    # Both branches of the maximum occur.
    assert (expected > 1.1 * open_length).tolist() == [False, True, False, True]
    np.testing.assert_allclose(chordae.rest_length, expected, rtol=1e-12)
    assert [chordae.family_names[k] for k in chordae.family] == ["marginal", "basal"] * 2


def test_fans_branch_on_the_way_from_the_tip_to_their_middle():
    band = LeafletBand.of(*cylinder(), anterior=1)
    layout = ChordLayout(
        marginal=(180.0 / 14 * 3,), branches=2, fan_width=180.0 / 7, basal=((-90.0, 0.5),),
        strut=(), open_slack=1.1, marginal_slack=0.9, basal_slack=2.0, stiffness=(40.0, 16.0, 1.0),
    )  # fmt: skip
    tips = np.array([[20.0, 0.0, -30.0], [-20.0, 0.0, -30.0]])
    closed, lower = narrowed(band), np.array([0.0, 0.0, 5.0])
    chordae = lay_out_chordae(band.position, tips, closed, tips - lower, layout)
    # phi = 2/14 and 4/14 of 180 between 160 and 20 degrees: angles 140, 120 and -90; mirrored.
    angles, depth = (140, 120, -90, 40, 60, -90), (MARGINAL_S, MARGINAL_S, 0.5) * 2
    places = np.array([at_angle(*place) for place in zip(angles, depth, strict=True)])
    np.testing.assert_allclose(chordae.insertion, places, atol=1e-9)
    assert chordae.parent.tolist() == [0, 0, -1, 1, 1, -1, -1, -1]
    np.testing.assert_array_equal(chordae.tip[[0, 1, 3, 4, 6, 7]], [1, 1, 0, 0, 1, 0])
    lengths = []
    for leaflet, tip in ((places, tips), (places * [0.5, 0.5, 1.0], tips - lower)):
        forks = leaflet.reshape(2, 3, 3)[:, :2].mean(axis=1)
        forks = tip[[1, 0]] + BRANCHING * (forks - tip[[1, 0]])
        own = replace(chordae, insertion=leaflet, junction=forks)
        lengths.append(np.linalg.norm(np.diff(own.ends(tip), axis=1)[:, 0], axis=1))
        if tip is tips:
            np.testing.assert_allclose(chordae.junction, forks, atol=1e-9)
    # The open frame needs longer trees than 0.9 of the closed one: on one way of each exactly so.
    ratio = chordae.rest_length / lengths[1]
    np.testing.assert_allclose(ratio[[0, 1, 3, 4]], ratio[[6, 6, 7, 7]], rtol=1e-12)
    assert ratio[[6, 7]].min() > 0.9
    over_open = (chordae.along(chordae.rest_length) / chordae.along(lengths[0]))[[0, 1, 3, 4]]
    assert over_open.reshape(2, 2).min(axis=1) == pytest.approx([1.1, 1.1], rel=1e-12)
    assert chordae.axial_stiffness.tolist() == [20, 20, 16, 20, 20, 16, 40, 40]
    # Branches of a fan across the middle start at the tip that is nearer to its middle.
    across = replace(layout, marginal=(84.0,), fan_width=24.0)
    tip = lay_out_chordae(band.position, tips, closed, tips - lower, across).tip
    assert tip[[0, 1, 6]].tolist() == [1, 1, 1]
    assert tip[[3, 4, 7]].tolist() == [0, 0, 0]


def test_chordae_of_a_half_start_at_one_tip_also_where_the_other_is_nearer():
    valve = Template().valve(40, 12)
    for tips in (valve.papillary_tips, valve.papillary_tips[::-1]):
        shifted = tips + np.array([3.0, 0.0, 0.0])
        at = band_of(valve).position
        chordae = lay_out_chordae(at, shifted, at, shifted, SEEN_ON_BAND)
        own = chordae.end_tip
        np.testing.assert_array_equal(np.sign(chordae.insertion[:, 0]), np.sign(tips[own, 0]))
        reach = np.linalg.norm(chordae.insertion[:, None] - shifted, axis=2)
        assert (reach.argmin(axis=1) != own).any()


@pytest.fixture
def anatomy():
    case = template_case(40, 12)
    return replace(case, frames=case.frames[:1], derived=())


def test_an_open_frame_alone_comes_back_as_it_was_written(tmp_path, anatomy):
    back = read_case(write_case(tmp_path / "case", anatomy))
    assert_equal(back, anatomy, "sha256")
    assert back.closed is None
    # Its boundary stays where it is.
    motion = back.valve.motion
    for positions in (motion.annulus, motion.papillary_tips):
        np.testing.assert_array_equal(positions[0], positions[1])


def test_an_assumed_closure_brings_the_edges_together(anatomy):
    band = band_of(anatomy)
    frame = anatomy.frames[0]
    moved = assumed_closure(band, frame.annulus, frame.papillary_tips)
    np.testing.assert_allclose(moved.vertices[anatomy.annulus], frame.annulus, atol=1e-9)
    phi = np.linspace(10.0, 170.0, 9)
    gap = moved.position(phi, np.ones(9)) - moved.position(360.0 - phi, np.ones(9))
    before = band.position(phi, np.ones(9)) - band.position(360.0 - phi, np.ones(9))
    assert np.linalg.norm(gap, axis=1).max() < 0.5 < 5.0 < np.linalg.norm(before, axis=1).max()
    middle = frame.annulus[:, 2].mean()
    depth = moved.vertices[anatomy.free_edge, 2].mean() - middle
    assert depth == pytest.approx(CLOSED_DEPTH * (frame.free_edge[:, 2].mean() - middle), rel=0.02)
