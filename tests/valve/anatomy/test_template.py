"""The parametric valve: its parameters are its measurements, and its parts fit one another."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.template import ANTERIOR, Template

TEMPLATE = Template()
DEFAULT = TEMPLATE.parameters
OTHER = Template(
    DEFAULT.changed(
        {
            "annulus.commissural_half_axis": 20.0,
            "annulus.anteroposterior_half_axis": 15.5,
            "annulus.saddle_height": 4.0,
            "leaflets.anterior.length": 27.0,
        }
    )
)
ALL_AROUND = np.arange(0.0, 360.0, 0.05)


@pytest.mark.parametrize("template", [OTHER])
def test_the_annulus_has_the_diameters_and_the_height_of_the_parameters(template):
    # Half ellipses: y from -b to b (1 - flattening), 14 + 12.88 = 26.88 mm by default.
    p = template.parameters.annulus
    a, b = p.commissural_half_axis, p.anteroposterior_half_axis
    x, y, z = template.annulus(ALL_AROUND).T
    assert np.ptp(x) == pytest.approx(2 * a, rel=1e-5)
    assert np.ptp(y) == pytest.approx(b * (2 - p.anterior_flattening), rel=1e-5)
    assert np.ptp(z) == pytest.approx(p.saddle_height, rel=1e-5)
    # A saddle: its horns are the middles of the leaflets, towards the atrium.
    middles = template.annulus(np.array([90.0, 270.0]))
    np.testing.assert_allclose(middles[:, 2], 0.5 * p.saddle_height)
    np.testing.assert_allclose(middles[:, 0], 0, atol=1e-12)
    # The commissures are `commissure_angle` above the x axis, in the parameter of the ellipse.
    x, y, _ = template.annulus(np.array([0.0]))[0]
    angle = np.arctan2(y / (b * (1 - p.anterior_flattening)), x / a)
    assert np.degrees(angle) == pytest.approx(p.commissure_angle)


def arc(template, phi):
    """Length of a leaflet from annulus to free edge along the surface."""
    line = template.position(np.full(4001, phi), np.linspace(0, 1, 4001))
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


@pytest.mark.parametrize("template", [OTHER])
def test_leaflets_have_the_length_of_the_parameters(template):
    # A parabola of sagitta d over a chord L is L (1 + 8/3 (d/L)^2 - 32/5 (d/L)^4) long; d = 0.04 L
    # gives 1.00425 L.
    p = template.parameters.leaflets
    factor = 1 + 8 / 3 * p.belly_depth**2 - 32 / 5 * p.belly_depth**4
    assert factor == pytest.approx(1.00425, abs=1e-5)
    for phi, length in ((90.0, p.anterior.length), (270.0, p.posterior.length),
                        (0.0, p.commissural_length), (180.0, p.commissural_length)):  # fmt: skip
        assert arc(template, phi) == pytest.approx(factor * length, rel=1e-5)


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


@pytest.mark.parametrize("template", [OTHER])
def test_chordae_are_the_same_material_points_of_every_valve(template):
    chordae, layout = template.chordae(), template.parameters.chordae
    assert np.bincount(chordae.family).tolist() == [28, 6]
    assert np.bincount(chordae.tip).tolist() == [17, 17]
    phi = np.array([*layout.marginal_phi, *(phi for phi, _ in layout.basal)])
    s = np.array([layout.marginal_s] * 14 + [s for _, s in layout.basal])
    np.testing.assert_allclose(
        chordae.insertion,
        np.concatenate([template.position(phi, s), template.position(180 - phi, s)]),
        atol=1e-12,
    )
    # From the tip of their own side, and slack in the open valve by `open_slack` at least.
    tips = template.papillary_tips[chordae.tip]
    assert np.all(tips[:, 0] * chordae.insertion[:, 0] >= -1e-9)
    opened = np.linalg.norm(chordae.insertion - tips, axis=1)
    assert np.all(chordae.rest_length >= layout.open_slack * opened * (1 - 1e-12))
    assert layout.open_slack > 1
    np.testing.assert_array_equal(np.unique(chordae.axial_stiffness), [16.0, 20.0])


def test_rest_lengths_lead_to_the_intended_closed_line():
    # A marginal chord that is not kept slack has 0.985 of the distance from its tip to the point
    # of the coaptation line; put s = 1 and take the middle of the anterior edge (x = 0):
    # y = 1.83 - 7.19, z = -10.9, x = 0.
    layout = ChordLayout(marginal_phi=(90.0,), basal=(), marginal_s=1.0, open_slack=0.1)
    chordae = Template(replace(DEFAULT, chordae=layout)).chordae()
    target = np.array([0.0, 1.83 - 7.19, -10.9])
    expected = 0.985 * np.linalg.norm(target - np.array(DEFAULT.papillary.tip))
    assert chordae.rest_length[0] == pytest.approx(expected, rel=1e-9)


def test_chordae_of_a_range_are_elongated_and_those_of_no_other():
    # Insertions on the posterior leaflet are at negative degrees of the layout (-60 is 300 of the
    # whole valve) and, mirrored, at 180 + their angle (240): only the first is in 290 to 310.
    layout = ChordLayout(marginal_phi=(-60.0, 50.0), basal=((-60.0, 0.5),))
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


def test_absent_chordae_are_missing_and_the_others_are_as_before():
    layout = replace(DEFAULT.chordae, absent=((235.0, 262.0),))
    plain, chordae = TEMPLATE.chordae(), Template(replace(DEFAULT, chordae=layout)).chordae()
    # Spacing 175 / 13 = 13.46 degrees from -87: the mirrored ones are at 180 + 87, 73.5, 60.1 and
    # 46.6 degrees, of which 253.5 and 240.1 lie in the range, as does the basal chord at 240.
    assert len(plain) - len(chordae) == 3
    assert np.bincount(chordae.tip).tolist() == [17, 14]
    kept = [k for k, at in enumerate(plain.insertion) if at.tolist() in chordae.insertion.tolist()]
    for name in ("tip", "insertion", "family", "rest_length", "axial_stiffness"):
        np.testing.assert_array_equal(getattr(plain, name)[kept], getattr(chordae, name))


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
    opened = np.linalg.norm(chordae.insertion - template.papillary_tips[chordae.tip], axis=1)
    # Rest lengths are those for the tips before, unless these would be taut in the open valve ...
    expected = np.maximum(plain.rest_length, DEFAULT.chordae.open_slack * opened)
    np.testing.assert_allclose(chordae.rest_length, expected, rtol=1e-12)
    # ... and so they are shorter than those made for where the tips are now.
    moved = tuple(np.add(DEFAULT.papillary.tip, shift))
    adapted = Template(DEFAULT.changed({"papillary.tip": moved})).chordae()
    assert np.all(chordae.rest_length <= adapted.rest_length + 1e-12)
    assert (adapted.rest_length - chordae.rest_length).mean() > 1.0


def test_the_annulus_narrows_by_the_contractions_and_the_tips_stay():
    motion = TEMPLATE.valve().motion
    start, end = motion.annulus
    np.testing.assert_allclose(np.ptp(end, axis=0) / np.ptp(start, axis=0), [0.992, 0.936, 1.0])
    assert 1 - np.ptp(end[:, 1]) / np.ptp(start[:, 1]) == pytest.approx(0.064)
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
    assert changed.changed({"leaflets.anterior.length": 24.0, "annulus.saddle_height": 6.5}) == (
        DEFAULT
    )
    with pytest.raises(InputError, match=r"parameter 'middle\.length', expected one of anterior"):
        DEFAULT.changed({"leaflets.middle.length": 25.0})


@pytest.mark.parametrize("size", [(6, 5), (15, 5), (16, 2)])
def test_too_coarse_a_sampling_is_refused(size):
    with pytest.raises(InputError, match=f"valve of {size[0]} x {size[1]} vertices"):
        TEMPLATE.valve(*size)
