"""Worlds: that each breaks the one assumption that it names, by as much as it says."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import CLOSED_STRETCHES, ExponentialLaw, biaxial_stress
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings, TissueSettings
from mvest.simulation.world import World
from mvest.valve.anatomy.template import Template

LINEAR = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
TISSUE = {name: ExponentialTissue(0.06, 4.3, 1400.0) for name in LINEAR}
VALVE = Template().valve(32, 9)
POINTS = VALVE.surface.vertices


def rng():
    return np.random.default_rng(7)


def test_nothing_is_otherwise_by_default():
    world, before = World(), rng()
    drawn = rng()
    assert world.values({"pressure_scale": 1.1}, drawn) == {"pressure_scale": 1.1}
    assert world.anatomy(Template().parameters, drawn) == Template().parameters
    settings = MechanicsSettings(LINEAR)
    assert world.mechanics(settings, {}) is settings
    np.testing.assert_array_equal(world.seen(POINTS, VALVE.surface, drawn), POINTS)
    # Nothing was drawn, so the same seed is the same valve in every world.
    assert drawn.bit_generator.state == before.bit_generator.state
    annulus, tips = world.boundary(POINTS[VALVE.annulus], VALVE.papillary_tips, drawn)
    assert not annulus.any()
    assert not tips.any()


def test_pressure_and_thickness_are_off_up_and_down():
    world = World(pressure_off=0.2, thickness_off=0.2)
    drawn = rng()
    pressures = {world.values({"pressure_scale": 1.0}, drawn)["pressure_scale"] for _ in range(20)}
    assert sorted(pressures) == pytest.approx([1 / 1.2, 1.2])
    before = Template().parameters.leaflets
    factors = set()
    for _ in range(20):
        after = world.anatomy(Template().parameters, drawn).leaflets
        factor = after.anterior.thickness / before.anterior.thickness
        assert after.posterior.thickness / before.posterior.thickness == pytest.approx(factor)
        factors.add(round(factor, 9))
    assert sorted(factors) == pytest.approx([1 / 1.2, 1.2])


@pytest.mark.parametrize(
    ("kernel", "length", "expected"),
    [
        # Correlations at the stated length of 10 mm: (1 + √3) exp(−√3), exp(−1), exp(−1/2).
        ("matern", 10.0, 0.4834),
        ("exponential", 10.0, 0.3679),
        ("gaussian", 10.0, 0.6065),
        ("exponential", 20.0, 0.6065),
    ],
)
def test_errors_are_as_alike_as_their_kernel_says(kernel, length, expected):
    line = np.zeros((2, 3))
    line[1, 0] = 10.0
    world = World(kernel=kernel, length_factor=length / 10.0)
    noise = world.noise(0.5, line, 10.0)
    zero = np.zeros((4000, 2, 3))
    errors = noise(zero, zero, rng())
    # 12000 pairs: the correlation's standard deviation is below 0.01.
    assert errors.std() == pytest.approx(0.5, rel=0.03)
    alike = np.mean(errors[:, 0] * errors[:, 1]) / 0.25
    assert alike == pytest.approx(expected, abs=0.04)


def test_annulus_and_tips_are_off_by_their_size():
    world, annulus = World(annulus_mm=1.0, tips_mm=2.0), POINTS[VALVE.annulus]
    drawn = rng()
    made = [world.boundary(annulus, VALVE.papillary_tips, drawn) for _ in range(300)]
    off = np.array([one for one, _ in made])
    assert off.std() == pytest.approx(1.0, rel=0.1)
    assert np.array([tips for _, tips in made]).std() == pytest.approx(2.0, rel=0.1)
    # Smooth: neighbours are alike.
    assert np.mean(off[:, 1:] * off[:, :-1]) > 0.8


def test_one_vertex_in_fifty_is_somewhere_else():
    moved = World(outliers=0.02, outlier_mm=4.0).seen(POINTS, VALVE.surface, rng())
    off = np.linalg.norm(moved - POINTS, axis=1)
    assert np.count_nonzero(off) == round(0.02 * len(POINTS))
    assert 2.0 < off[off > 0].mean() < 12.0


def test_what_is_missing_is_filled_in_without_its_detail():
    gradient = np.array([[0.1, 0.0, 0.2], [0.0, 0.1, 0.0], [0.1, 0.0, 0.0]])
    smooth = POINTS + POINTS @ gradient
    bumpy = smooth + rng().standard_normal(POINTS.shape)
    filled = World(missing=0.2).seen(bumpy, VALVE.surface, rng())
    hidden = np.any(filled != bumpy, axis=1)
    assert hidden.sum() == round(0.2 * len(POINTS))
    # A connected patch: nearer together than the valve is wide.
    patch = POINTS[hidden]
    assert np.ptp(patch, axis=0).max() < 0.7 * np.ptp(POINTS, axis=0).max()
    # Where a motion is constant there is no other harmonic value.
    shifted = World(missing=0.2).seen(POINTS + 1.0, VALVE.surface, rng())
    np.testing.assert_allclose(shifted, POINTS + 1.0, atol=1e-9)


def test_exponential_tissue_is_as_stiff_as_its_modulus_where_leaflets_are_closed():
    settings = MechanicsSettings(LINEAR)
    world = World(exponential=TISSUE)
    values = {"E_f.anterior": 8.0, "E_f.posterior": 2.0}
    own = world.mechanics(settings, values)
    at = np.array([CLOSED_STRETCHES])
    for region, linear in LINEAR.items():
        tissue = own.tissue[region].exponential
        assert (tissue.c1, tissue.c2) == (4.3, 1400.0)
        law = BiotLaw.of([linear.material(values[f"E_f.{region}"])])
        expected = biaxial_stress(law, at).mean()
        assert biaxial_stress(ExponentialLaw.of([tissue]), at).mean() == pytest.approx(expected)
        # It is another law: not as stiff where it is stretched less.
        less = 1 + 0.3 * (at - 1)
        softer = biaxial_stress(ExponentialLaw.of([tissue]), less).mean()
        assert softer < 0.97 * biaxial_stress(law, less).mean()
    with pytest.raises(InputError, match="exponential tissue of anterior, expected of"):
        replace(world, exponential={"anterior": TISSUE["anterior"]}).mechanics(settings, values)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kernel": "cubic"}, "expected one of matern, exponential, gaussian"),
        ({"length_factor": 0.0}, "length_factor = 0.0, expected > 0"),
        ({"tips_mm": -1.0}, "world tips_mm = -1.0, expected >= 0"),
        ({"missing": 1.0}, "expected a share below 1"),
    ],
)
def test_what_is_no_world_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        World(**settings)
