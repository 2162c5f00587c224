"""Misspecifications: each breaks the one assumption that it names, by its size."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.errors import InputError
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings, TissueSettings
from mvest.simulation import virtual_patient
from mvest.simulation.misspecification import Misspecification
from mvest.simulation.virtual_patient import PatientSimulation
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import surface_edges

LINEAR = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
TISSUE = {name: ExponentialTissue(0.06, 4.3, 1400.0) for name in LINEAR}
VALVE = Template().valve(32, 9)
POINTS = VALVE.surface.vertices


def rng():
    return np.random.default_rng(7)


def test_nothing_is_otherwise_by_default():
    misspecification, before = Misspecification(), rng()
    drawn = rng()
    assert misspecification.values({"pressure_scale": 1.1}, drawn) == {"pressure_scale": 1.1}
    assert misspecification.anatomy(Template().parameters, drawn) == Template().parameters
    settings = MechanicsSettings(LINEAR)
    assert misspecification.mechanics(settings) is settings
    np.testing.assert_array_equal(misspecification.seen(POINTS, VALVE.surface, drawn), POINTS)
    assert not misspecification.open_moves(VALVE, drawn).any()
    # Nothing was drawn, so the same seed is the same valve in every misspecification.
    assert drawn.bit_generator.state == before.bit_generator.state


def test_pressure_and_thickness_are_off_up_and_down():
    misspecification, drawn = Misspecification(pressure_off=0.2, thickness_off=0.2), rng()
    pressures = {
        misspecification.values({"pressure_scale": 1.0}, drawn)["pressure_scale"] for _ in range(20)
    }
    before, factors = Template().parameters.leaflets, set()
    for _ in range(20):
        after = misspecification.anatomy(Template().parameters, drawn).leaflets
        factor = after.anterior.thickness / before.anterior.thickness
        assert after.posterior.thickness / before.posterior.thickness == pytest.approx(factor)
        factors.add(round(factor, 9))
    assert sorted(pressures) == pytest.approx([1 / 1.2, 1.2])
    assert sorted(factors) == pytest.approx([1 / 1.2, 1.2])


@pytest.mark.parametrize(
    ("kernel", "length", "expected"),
    [
        # Correlations at the stated length of 10 mm: (1 + √3) exp(−√3), exp(−1), exp(−1/2).
        ("matern", 10.0, 0.4834),
        ("exponential", 10.0, 0.3679),
        ("gaussian", 10.0, 0.6065),
    ],
)
def test_errors_are_as_alike_as_their_kernel_says(kernel, length, expected):
    line = np.zeros((2, 3))
    line[1, 0] = 10.0
    misspecification = Misspecification(kernel=kernel, length_factor=length / 10.0)
    noise = misspecification.noise(0.5, line, 10.0)
    zero = np.zeros((4000, 2, 3))
    errors = noise(zero, zero, rng())
    # 12000 pairs: the correlation's standard deviation is below 0.01.
    assert errors.std() == pytest.approx(0.5, rel=0.03)
    alike = np.mean(errors[:, 0] * errors[:, 1]) / 0.25
    assert alike == pytest.approx(expected, abs=0.04)


def test_annulus_and_tips_are_off_by_their_size():
    misspecification, annulus = Misspecification(annulus_mm=1.0, tips_mm=2.0), POINTS[VALVE.annulus]
    drawn = rng()
    made = [misspecification.boundary(annulus, VALVE.papillary_tips, drawn) for _ in range(300)]
    case, motion = open_case(tips_mm=2.0), VALVE.motion.papillary_tips
    moved = case.frame(Role.CLOSED).papillary_tips - motion[-1]
    assert np.abs(moved).min() > 0.01
    open_tips = case.frame(Role.REFERENCE).papillary_tips
    np.testing.assert_allclose(open_tips - VALVE.papillary_tips, moved, atol=1e-12)
    off = np.array([one for one, _ in made])
    assert off.std() == pytest.approx(1.0, rel=0.1)
    assert np.array([tips for _, tips in made]).std() == pytest.approx(2.0, rel=0.1)
    # Smooth: neighbours are alike.
    assert np.mean(off[:, 1:] * off[:, :-1]) > 0.8


def test_what_is_missing_is_filled_in_without_its_detail():
    gradient = np.array([[0.1, 0.0, 0.2], [0.0, 0.1, 0.0], [0.1, 0.0, 0.0]])
    smooth = POINTS + POINTS @ gradient
    bumpy = smooth + rng().standard_normal(POINTS.shape)
    filled = Misspecification(missing=0.2).seen(bumpy, VALVE.surface, rng())
    hidden = np.any(filled != bumpy, axis=1)
    assert hidden.sum() == round(0.2 * len(POINTS))
    # A connected patch: nearer together than the valve is wide.
    patch = POINTS[hidden]
    assert np.ptp(patch, axis=0).max() < 0.7 * np.ptp(POINTS, axis=0).max()
    # Where a motion is constant there is no other harmonic value.
    shifted = Misspecification(missing=0.2).seen(POINTS + 1.0, VALVE.surface, rng())
    np.testing.assert_allclose(shifted, POINTS + 1.0, atol=1e-9)


def open_case(**scales):
    """A case whose closed leaflets are seen all but without an error."""
    simulation = PatientSimulation(
        std_mm=1e-7,
        held_pressure_mmHg=(),
        held_relaxation=(),
        misspecification=Misspecification(**scales),
    )
    true = {"closed": POINTS + 1.0}
    case = virtual_patient._case(
        "n", "d", VALVE, true, simulation, MechanicsSettings(LINEAR), rng()
    )
    np.testing.assert_allclose(case.frame(Role.CLOSED).vertices, POINTS + 1.0, atol=1e-5)
    np.testing.assert_array_equal(case.frame(Role.CLOSED).annulus, VALVE.motion.annulus[-1])
    assert case.chordae.rest_length == pytest.approx(VALVE.chordae.rest_length)
    # Chordae end on the leaflets as they are seen.
    surface = case.surface
    ends = closest_points(case.chordae.insertion, surface.vertices, surface.triangles)
    assert ends.distance.max() < 0.15
    return case


def lengths(vertices):
    """Length of each column of vertices from annulus to free edge, mm."""
    return np.linalg.norm(np.diff(vertices.reshape(9, 32, 3), axis=0), axis=2).sum(axis=0)


def test_one_open_leaflet_is_too_large():
    case = open_case(leaflet_scale=0.04)
    np.testing.assert_array_equal(case.surface.vertices[:32], POINTS[:32])
    ratio = lengths(case.surface.vertices) / lengths(POINTS)
    anterior, posterior = ratio[3:14], ratio[19:30]
    own, other = (anterior, posterior) if anterior[0] > 1.02 else (posterior, anterior)
    np.testing.assert_allclose(own, 1.04, atol=1e-12)
    np.testing.assert_allclose(other, 1.0, atol=1e-12)
    np.testing.assert_allclose(ratio[[0, 16]], 1.02)


def test_the_open_frame_is_too_large():
    case = open_case(frame_scale=0.03)
    edges = surface_edges(VALVE.surface.triangles)
    before, after = (np.diff(x[edges], axis=1) for x in (POINTS, case.surface.vertices))
    np.testing.assert_allclose(after, 1.03 * before, atol=1e-12)
    open_ring = case.frame(Role.REFERENCE).annulus
    centre = POINTS[VALVE.annulus].mean(axis=0)
    np.testing.assert_allclose(open_ring.mean(axis=0), centre, atol=1e-12)
    np.testing.assert_array_equal(open_ring, case.surface.vertices[VALVE.annulus])


def test_other_tissue_replaces_that_of_every_leaflet():
    settings = MechanicsSettings(LINEAR)
    other = {name: replace(own, prestretch=1.05) for name, own in LINEAR.items()}
    assert Misspecification(tissue=other).mechanics(settings).tissue == other
    with pytest.raises(InputError, match="other tissue of anterior, expected of anterior, post"):
        Misspecification(tissue={"anterior": other["anterior"]}).mechanics(settings)


def test_settings_out_of_range_are_refused():
    with pytest.raises(InputError, match="expected one of matern, exponential, gaussian"):
        Misspecification(kernel="cubic")
    with pytest.raises(InputError, match="expected a share below 1"):
        Misspecification(missing=1.0)


def test_one_vertex_in_fifty_is_somewhere_else():
    moved = Misspecification(outliers=0.02, outlier_mm=4.0).seen(POINTS, VALVE.surface, rng())
    off = np.linalg.norm(moved - POINTS, axis=1)
    assert np.count_nonzero(off) == round(0.02 * len(POINTS))
    assert 2.0 < off[off > 0].mean() < 12.0
