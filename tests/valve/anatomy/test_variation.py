"""Random anatomies are valves, of plausible sizes, and the same for the same seed."""

from operator import attrgetter

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import MAX_REFUSED, vary
from mvest.valve.mesh.structured import structured_mesh

DEFAULT = TemplateParameters()
DRAWN = [vary(DEFAULT, np.random.default_rng(seed)) for seed in range(200)]


def drawn(name):
    return np.array([attrgetter(name)(p) for p in DRAWN])


def test_every_seed_gives_a_valve_that_can_be_meshed():
    for p in DRAWN:
        assert np.all(Template(p).valve(24, 5).surface.thickness > 0)
    for p in DRAWN[:5]:
        structured_mesh(Template(p), "hex18", 24, 3)  # refuses elements that are inside out


def test_annuli_are_within_the_range_of_normal_valves():
    # Two standard deviations around the means: 24 - 2 x 3 to 30.8 + 2 x 4.4 mm between anterior
    # and posterior, 35.1 -+ 2 x 4.9 mm between the commissures.
    ap, commissural = (
        drawn("annulus.anteroposterior_diameter"),
        drawn("annulus.commissural_diameter"),
    )
    assert ap.min() > 18.0
    assert ap.max() < 39.6
    assert commissural.min() > 25.3
    assert commissural.max() < 44.9
    # About half of the reported 12 to 14 %: size 5 % and 3.5 or 3 % along a direction, their
    # normal tails cut at two standard deviations (which leaves 0.88 of the deviation).
    for values, own in ((ap, 0.035), (commissural, 0.03)):
        expected = 0.88 * np.hypot(0.05, own)
        assert np.log(values).std() == pytest.approx(expected, rel=0.2)


def test_the_seed_decides_and_the_given_valve_is_the_middle():
    assert vary(DEFAULT, np.random.default_rng(7)) == DRAWN[7]
    assert DRAWN[7] != DRAWN[8]
    assert vary(DEFAULT, np.random.default_rng(7), scale=0.0) == DEFAULT
    # A larger annulus has longer leaflets.
    both = drawn("annulus.anteroposterior_diameter"), drawn("leaflets.anterior.length")
    assert np.corrcoef(*both)[0, 1] > 0.8
    # Seven standard errors of 200 draws of a deviation of at most 15 %.
    for name in ("annulus.saddle_height", "leaflets.posterior.length", "free_edge.width"):
        middle = np.median(drawn(name))
        expected = attrgetter(name)(DEFAULT)
        assert middle == pytest.approx(expected, rel=7 * 1.25 * 0.15 / np.sqrt(200))
    (once, twice) = (
        np.log(vary(DEFAULT, np.random.default_rng(3), scale).annulus.saddle_height)
        for scale in (1.0, 2.0)
    )
    middle = np.log(DEFAULT.annulus.saddle_height)
    assert twice - middle == pytest.approx(2 * (once - middle))


def test_a_scale_that_leaves_no_valve_or_none_at_all_is_refused():
    for scale in (-1.0, np.nan, np.inf):
        with pytest.raises(InputError, match=f"scale of a variation = {scale}"):
            vary(DEFAULT, np.random.default_rng(0), scale)
    hopeless = DEFAULT.changed({"leaflets.anterior.length": 3.0})
    with pytest.raises(InputError, match=f"{MAX_REFUSED} shapes in a row"):
        vary(hopeless, np.random.default_rng(0))
