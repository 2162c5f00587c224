"""The parametric valve: its parameters are its measurements, and its parts fit one another."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.template import (
    ANTERIOR,
    BRANCHING,
    FLATTENING,
    INDENTATION_ANGLE,
    MARGINAL_S,
    Template,
)

TEMPLATE = Template()
DEFAULT = TEMPLATE.parameters
OTHER = Template(
    DEFAULT.changed(
        {
            "annulus.commissural_diameter": 40.0,
            "annulus.anteroposterior_diameter": 30.0,
            "annulus.saddle_height": 4.0,
            "leaflets.anterior.length": 27.0,
        }
    )
)
ALL_AROUND = np.arange(0.0, 360.0, 0.05)


@pytest.mark.parametrize("template", [OTHER])
def test_the_annulus_has_the_diameters_and_the_height_of_the_parameters(template):
    p = template.parameters.annulus
    x, y, z = template.annulus(ALL_AROUND).T
    assert np.ptp(x) == pytest.approx(p.commissural_diameter, rel=1e-5)
    assert np.ptp(y) == pytest.approx(p.anteroposterior_diameter, rel=1e-5)
    assert np.ptp(z) == pytest.approx(p.saddle_height, rel=1e-5)
    # A saddle: its horns are the middles of the leaflets, towards the atrium.
    middles = template.annulus(np.array([90.0, 270.0]))
    np.testing.assert_allclose(middles[:, 2], 0.5 * p.saddle_height)
    np.testing.assert_allclose(middles[:, 0], 0, atol=1e-12)
    # The commissures are `commissure_angle` above the x axis, in the parameter of the ellipse.
    x, y, _ = template.annulus(np.array([0.0]))[0]
    posterior = p.anteroposterior_diameter / (2 - FLATTENING)
    angle = np.arctan2(y / (posterior * (1 - FLATTENING)), x / (0.5 * p.commissural_diameter))
    assert np.degrees(angle) == pytest.approx(p.commissure_angle)


def arc(template, phi):
    """Length of a leaflet from annulus to free edge along the surface."""
    line = template.position(np.full(4001, phi), np.linspace(0, 1, 4001))
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def test_leaflets_have_the_length_of_the_parameters():
    # Without bulges the lines from annulus to free edge are straight.
    flat = dict.fromkeys(
        ("leaflets.anterior.belly", "leaflets.posterior.belly", "leaflets.scallop_bulge"), 0.0
    )
    template, p = Template(OTHER.parameters.changed(flat)), OTHER.parameters.leaflets
    for phi, length in ((90.0, p.anterior.length), (270.0, p.posterior.length),
                        (0.0, p.commissural_length), (180.0, p.commissural_length)):  # fmt: skip
        assert arc(template, phi) == pytest.approx(length, rel=1e-9)
    # A parabola of sagitta d over a chord L is L (1 + 8/3 (d/L)^2 - 32/5 (d/L)^4) long.
    bulging = Template(OTHER.parameters.changed({**flat, "leaflets.anterior.belly": 0.04}))
    assert arc(bulging, 90.0) == pytest.approx(1.00425 * p.anterior.length, rel=1e-5)


def test_the_posterior_leaflet_has_three_scallops():
    share = DEFAULT.leaflets.indentation
    whole = Template(DEFAULT.changed({"leaflets.indentation": 0.0}))
    phi = np.arange(180.0, 360.0, 0.5)
    left = TEMPLATE.length(phi) / whole.length(phi)
    valleys = phi[1:-1][(left[1:-1] < left[:-2]) & (left[1:-1] < left[2:])]
    assert valleys.tolist() == [270.0 - INDENTATION_ANGLE, 270.0 + INDENTATION_ANGLE]
    assert left.min() == pytest.approx(1 - share)
    np.testing.assert_allclose(left[[0, 180, -1]], 1.0)
    # The edge lies on the same surface, nearer to the annulus.
    at = np.array([valleys[0]])
    np.testing.assert_allclose(
        TEMPLATE.position(at, np.ones(1)), whole.position(at, np.full(1, 1 - share)), atol=1e-12
    )


def test_thickness_is_the_papers_and_tapers_to_three_quarters():
    phi, s = np.array([90.0, 270.0, 90.0, 270.0, 90.0, 0.0]), np.array([0, 0, 1, 1, 0.75, 0.0])
    # Half way of the taper, which begins at s = 1/2: 1 - 0.25 / 2. At a commissure: the mean.
    expected = [1.32, 1.26, 0.75 * 1.32, 0.75 * 1.26, 0.875 * 1.32, 1.29]
    np.testing.assert_allclose(TEMPLATE.thickness(phi, s), expected, rtol=1e-12)


def test_anterior_fibres_turn_until_they_are_perpendicular_at_the_commissures():
    # They turn over 0.23 x 180 = 41.4 degrees by a smooth step: 90, 45 and 0 degrees from the
    # annulus at 0, 20.7 and 41.4 degrees from the commissure, on both sides.
    for phi, angle in ((0.0, 90), (20.7, 45), (41.4, 0), (90.0, 0), (159.3, 45), (180.0, 90)):
        at, s, region = np.array([phi]), np.array([0.4]), np.array([ANTERIOR])
        t, _ = TEMPLATE.tangents(at, s)
        cosine = abs(float((TEMPLATE.fibre(at, s, region) @ t.T)[0, 0]))
        assert np.degrees(np.arccos(min(cosine, 1.0))) == pytest.approx(angle, abs=1e-4)


def test_chordae_are_the_same_material_points_of_every_valve():
    chordae, layout = OTHER.chordae(), OTHER.parameters.chordae
    fans, others = len(layout.marginal), [*layout.basal, *layout.strut]
    ends = fans * layout.branches + len(others)
    assert np.bincount(chordae.end_tip).tolist() == [ends, ends]
    assert np.bincount(chordae.tip[chordae.parent < 0]).tolist() == [fans + len(others)] * 2
    # Three branches of each fan, half its width apart.
    half = 0.5 * layout.fan_width
    phi = np.array([m + turn for m in layout.marginal for turn in (-half, 0.0, half)])
    phi = np.concatenate([phi, [phi for phi, _ in others]])
    s = np.concatenate([np.full(3 * fans, MARGINAL_S), [s for _, s in others]])
    expected = [OTHER.position(phi, s), OTHER.position(180 - phi, s)]
    np.testing.assert_allclose(chordae.insertion, np.concatenate(expected), atol=1e-12)
    # From the tip of their own side, and slack in the open valve by `open_slack` at least.
    tips = OTHER.papillary_tips
    starts, stops = np.moveaxis(chordae.ends(tips), 1, 0)
    way = chordae.along(np.linalg.norm(stops - starts, axis=1))
    assert np.all(chordae.along(chordae.rest_length) >= layout.open_slack * way * (1 - 1e-12))
    assert layout.open_slack > 1
    # The branches of a fan have the stiffness of its trunk together.
    trunks = chordae.axial_stiffness[len(chordae.insertion) :]
    np.testing.assert_allclose(trunks, layout.stiffness[0])
    branches = chordae.axial_stiffness[: 3 * fans].reshape(-1, 3).sum(axis=1)
    np.testing.assert_allclose(branches, layout.stiffness[0])


def test_rest_lengths_lead_to_the_intended_closed_line():
    # A chord that is not kept slack has `basal_slack` of the distance from its tip to the middle of
    # the coaptation line (x = 0, y = commissural_y - sag, z = -depth).
    layout = ChordLayout(marginal=(), basal=((90.0, 1.0),), strut=(), open_slack=0.1)
    chordae = Template(replace(DEFAULT, chordae=layout)).chordae()
    edge = DEFAULT.free_edge
    target = np.array([0.0, edge.commissural_y - edge.sag, -edge.depth])
    expected = layout.basal_slack * np.linalg.norm(target - np.array(DEFAULT.papillary.tip))
    assert chordae.rest_length[0] == pytest.approx(expected, rel=1e-9)


def test_a_fan_branches_on_the_line_to_its_middle():
    layout = ChordLayout(marginal=(50.0,), basal=(), strut=(), open_slack=0.1, marginal_slack=0.9)
    template = Template(replace(DEFAULT, chordae=layout))
    chordae, tip = template.chordae(), template.papillary_tips[0]
    goal = template._closed_position(
        template.chord_places().phi, np.full(6, MARGINAL_S), chordae.insertion
    )[:3]
    fork = tip + BRANCHING * (goal.mean(axis=0) - tip)
    np.testing.assert_allclose(chordae.rest_length[6], 0.9 * np.linalg.norm(fork - tip))
    expected = 0.9 * np.linalg.norm(goal - fork, axis=1)
    np.testing.assert_allclose(chordae.rest_length[:3], expected)


def test_chordae_of_a_range_are_elongated_and_those_of_no_other():
    # Insertions on the posterior leaflet are at negative degrees of the layout (-60 is 300 of the
    # whole valve) and, mirrored, at 180 + their angle (240): only the first is in 290 to 310.
    layout = ChordLayout(marginal=(-60.0, 50.0), branches=1, basal=((-60.0, 0.5),), strut=())
    plain = Template(replace(DEFAULT, chordae=layout)).chordae()
    longer = replace(layout, elongated=((290.0, 310.0, 1.2), (295.0, 305.0, 1.1)))
    chordae = Template(replace(DEFAULT, chordae=longer)).chordae()
    # Ranges that overlap multiply: 1.2 x 1.1 = 1.32.
    np.testing.assert_allclose(
        chordae.rest_length / plain.rest_length, [1.32, 1, 1.32, 1, 1, 1], rtol=1e-12
    )
    np.testing.assert_array_equal(chordae.insertion, plain.insertion)
    # The same range, named by other multiples of 360 degrees.
    again = replace(layout, elongated=((-70.0, -50.0, 1.32),))
    np.testing.assert_allclose(
        Template(replace(DEFAULT, chordae=again)).chordae().rest_length, chordae.rest_length
    )
    # A trunk is elongated with its fan.
    fan = replace(layout, marginal=(-60.0,), branches=3, basal=())
    ratio = (
        Template(replace(DEFAULT, chordae=replace(fan, elongated=((280.0, 320.0, 1.1),))))
        .chordae()
        .rest_length
        / Template(replace(DEFAULT, chordae=fan)).chordae().rest_length
    )
    np.testing.assert_allclose(ratio, [1.1, 1.1, 1.1, 1, 1, 1, 1.1, 1])


def test_absent_chordae_are_missing_and_the_others_are_as_before():
    # Of the mirrored fan at 180 + 52 = 232 degrees only the branch at 223.5 is left, which then is
    # straight; the basal chord at 238 is missing, too.
    layout = replace(DEFAULT.chordae, absent=((230.0, 245.0),))
    plain, chordae = TEMPLATE.chordae(), Template(replace(DEFAULT, chordae=layout)).chordae()
    assert len(plain.insertion) - len(chordae.insertion) == 3
    assert len(plain.junction) - len(chordae.junction) == 1
    places = Template(replace(DEFAULT, chordae=layout)).chord_places()
    alone = np.flatnonzero(
        (places.parent[: len(places.phi)] < 0) & (places.family[: len(places.phi)] == 0)
    )
    np.testing.assert_allclose(places.phi[alone], [180 + 52 - 0.5 * layout.fan_width])
    kept = [k for k, at in enumerate(plain.insertion) if at.tolist() in chordae.insertion.tolist()]
    whole = np.setdiff1d(np.arange(len(kept)), alone)
    for name in ("tip", "insertion", "family", "rest_length", "axial_stiffness"):
        before, after = getattr(plain, name)[kept], getattr(chordae, name)[: len(kept)]
        np.testing.assert_array_equal(before[whole], after[whole])


@pytest.mark.parametrize(
    "wrong",
    [
        {"elongated": ((225.0, 315.0),)},
        {"elongated": ((225.0, 315.0, 0.0),)},
        {"absent": ((315.0, 225.0),)},
    ],
)
def test_ranges_of_chordae_that_mean_nothing_are_refused(wrong):
    (name, ranges), *_ = wrong.items()
    with pytest.raises(InputError, match=rf"{name} chordae \({ranges[0][0]}"):
        ChordLayout(**wrong)


def test_displaced_tips_tether_because_the_chordae_do_not_follow():
    shift = (3.0, -1.0, -5.0)
    plain = TEMPLATE.chordae()
    template = Template(DEFAULT.changed({"papillary.displacement": shift}))
    chordae = template.chordae()
    # Outward on both sides, and down.
    moved_by = template.papillary_tips - TEMPLATE.papillary_tips
    np.testing.assert_allclose(moved_by, [[3, -1, -5], [-3, -1, -5]], atol=1e-12)
    for tips in template.valve(24, 5).motion.papillary_tips:
        np.testing.assert_array_equal(tips, template.papillary_tips)
    # Rest lengths are those for the tips before, unless these would be taut in the open valve ...
    straight = chordae.family > 0
    starts, stops = np.moveaxis(chordae.ends(template.papillary_tips), 1, 0)
    opened = np.linalg.norm(stops - starts, axis=1)[straight]
    expected = np.maximum(plain.rest_length[straight], DEFAULT.chordae.open_slack * opened)
    np.testing.assert_allclose(chordae.rest_length[straight], expected, rtol=1e-12)
    # ... and so they are shorter than those made for where the tips are now. Of the ways of a tree
    # that the open valve needs longer, this holds for the tightest one.
    moved = tuple(np.add(DEFAULT.papillary.tip, shift))
    adapted = Template(DEFAULT.changed({"papillary.tip": moved})).chordae()
    ways = [own.along(own.rest_length) for own in (chordae, adapted)]
    slack = ways[0] / chordae.along(np.linalg.norm(stops - starts, axis=1))
    trees = chordae.paths[:, chordae.parent < 0][: len(slack)].T
    tightest = np.argmin(np.where(trees, slack, np.inf), axis=1)
    assert np.all(ways[0][tightest] <= ways[1][tightest] + 1e-9)
    assert (ways[1] - ways[0]).mean() > 1.0


def test_the_annulus_narrows_by_the_contractions_and_the_tips_stay():
    motion = TEMPLATE.valve().motion
    start, end = motion.annulus
    p = DEFAULT.annulus
    expected = [
        1 - p.commissural_contraction, 1 - p.anteroposterior_contraction, 1 + p.saddle_deepening,
    ]  # fmt: skip
    np.testing.assert_allclose(np.ptp(end, axis=0) / np.ptp(start, axis=0), expected)
    np.testing.assert_array_equal(motion.papillary_tips[0], motion.papillary_tips[1])
    np.testing.assert_array_equal(motion.papillary_tips[0], TEMPLATE.papillary_tips)
    assert motion.phase.tolist() == [0, 1]


def test_a_leaflet_that_cannot_reach_its_free_edge_is_refused():
    template = Template(DEFAULT.changed({"leaflets.posterior.length": 1.5}))
    with pytest.raises(GeometryError, match=r"at phi = 270 degrees is 1\.5 mm long and cannot rea"):
        template.valve(24, 5)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("leaflets.anterior.length", float("nan"), "> 0"),
        ("leaflets.fibre_turn", 0.6, r"in \(0, 0.5\]"),
        ("papillary.tip", (1.0, 2.0), r"\(x, y, z\)"),
        ("chordae", ChordLayout(absent=((0.0, 360.0),)), "none is left"),
    ],
)
def test_inadmissible_parameters_are_refused(name, value, expected):
    with pytest.raises(InputError, match=expected):
        Template(DEFAULT.changed({name: value})).chordae()


def test_values_are_changed_by_their_dotted_names():
    changed = DEFAULT.changed({"leaflets.anterior.length": 25.0, "annulus.saddle_height": 5.0})
    assert changed.leaflets.anterior == replace(DEFAULT.leaflets.anterior, length=25.0)
    assert changed.leaflets.posterior == DEFAULT.leaflets.posterior
    assert changed.annulus == replace(DEFAULT.annulus, saddle_height=5.0)
    back = {
        "leaflets.anterior.length": DEFAULT.leaflets.anterior.length,
        "annulus.saddle_height": DEFAULT.annulus.saddle_height,
    }
    assert changed.changed(back) == DEFAULT
    with pytest.raises(InputError, match=r"parameter 'middle\.length', expected one of anterior"):
        DEFAULT.changed({"leaflets.middle.length": 25.0})


@pytest.mark.parametrize("size", [(6, 5), (15, 5), (16, 2)])
def test_too_coarse_a_sampling_is_refused(size):
    with pytest.raises(InputError, match=f"valve of {size[0]} x {size[1]} vertices"):
        TEMPLATE.valve(*size)
