"""Closures with exponential, stiffening and prestretched tissue, and one leaflet of each law.

On the same small valve as in test_model.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.law.regional import LeafletLaw
from mvest.mechanics.settings import EXPONENTIAL_KINDS, ExponentialTissue, Relaxation
from mvest.mechanics.valve_system import HeldState, material_law
from tests.closure.test_model import (
    AT,
    CLOSING,
    EXACT,
    GENTLE,
    MODULI,
    OPEN,
    SMALL,
    TINY,
    TISSUE,
    continued,
    model_of,
    step_study,
)


def anterior(law, *coefficients):
    """Tissue with another law in the anterior leaflet, so that both laws meet in one valve."""
    own = replace(TISSUE["anterior"], law=law, exponential=ExponentialTissue(*coefficients))
    return {**TISSUE, "anterior": own}


EXPONENTIAL = anterior("exponential", 0.2, 4.3, 1400.0)
STIFFENING = anterior("stiffening", 0.06, 4.3, 900.0)
COEFFICIENTS = dict(zip(EXPONENTIAL_KINDS, (0.2, 4.3, 1400.0, 0.05, 5.0), strict=True))
STIFF_NAMES, STIFF_AT = (*MODULI, "stiffening.anterior"), np.array([6.23, 2.09, 0.5])
FIBRES = {name: replace(own, compression=0.05) for name, own in TISSUE.items()}
STRETCH_NAMES, STRETCH_AT = (*MODULI, "prestretch.anterior"), np.array([6.23, 2.09, 1.03])


def with_tissue(tissue, protocol, names=STIFF_NAMES, **changes):
    model = model_of(protocol, names, **changes)
    model.settings = replace(model.settings, tissue=tissue)
    return model


def check_closed_derivatives(model, at, step=3.2e-3, least=0.1):
    """Derivatives of the valve closed in contact against equilibria beside it."""
    simulation = model.close(at).simulation
    assert simulation.converged
    assert simulation.records[-1].active_contacts > 100
    start = simulation.frames[-1]
    for k, name in enumerate(model.names):
        exact = simulation.sensitivities[-1][k]
        assert np.linalg.norm(exact) * at[k] > least, name
        coarse, fine, best = step_study(
            exact, lambda m: continued(model, start, m).frames[-1], at, k, step
        )
        assert coarse / fine == pytest.approx(16, rel=0.1) or coarse < 1e-6, name
        assert best < 1e-6, name


def check_moving_derivatives(model, at, steps):
    """Derivatives of a moving valve, in which the history of strain is, against differences."""
    simulation = model.close(at).simulation
    assert simulation.converged
    exact = simulation.sensitivities[-1]

    def run(values):
        result = model.close(values, sensitivities=False).simulation
        assert result.converged
        return result.frames[-1]

    for k, name in enumerate(model.names):
        assert np.linalg.norm(exact[k]) * at[k] > 1e-3, name
        coarse, fine, best = step_study(exact[k], run, at, k, steps[k])
        # Second order, unless the error is round-off already.
        assert coarse / fine == pytest.approx(16, rel=0.2) or coarse < 1e-5, name
        assert best < 1e-6, name


def test_derivatives_of_a_moving_valve_agree_with_differences_for_each_coefficient():
    values = {f"{kind}.anterior": value for kind, value in COEFFICIENTS.items()}
    values |= {"E_f.posterior": 4.0, "damping": 0.12}
    # Nearly linear in a coefficient: large steps keep the error above the round-off.
    steps = [1.6e-3 if name == "damping" else 1.6e-2 for name in values]
    model = with_tissue(EXPONENTIAL, OPEN, tuple(values), **TINY)
    check_moving_derivatives(model, np.array(list(values.values())), steps)


def test_derivatives_of_a_moving_valve_agree_with_differences_for_stiffening():
    model = with_tissue(STIFFENING, OPEN, (*STIFF_NAMES, "damping"), **TINY)
    check_moving_derivatives(model, np.array([*STIFF_AT, 0.12]), [1.6e-3] * 4)


@pytest.mark.parametrize(
    ("tissue", "names", "at", "options"),
    [
        (EXPONENTIAL, ("c0.anterior", "c2.anterior", "E_f.posterior"), (0.2, 1400.0, 4.0), {}),
        (STIFFENING, STIFF_NAMES, STIFF_AT, {"least": 0.05}),
        (TISSUE, STRETCH_NAMES, STRETCH_AT, {"step": 1.6e-3}),
        (FIBRES, MODULI, (6.23, 2.09), {"step": 1.6e-3}),
    ],
    ids=["exponential", "stiffening", "prestretch", "tension only"],
)
def test_derivatives_of_the_closed_valve_agree_with_differences(tissue, names, at, options):
    model = with_tissue(tissue, CLOSING, names, continuation=True)
    check_closed_derivatives(model, np.array(at), **options)


def test_a_valve_from_its_shape_about_to_open():
    # Its leaflets are free of stress in the equilibrium of linear tissue under a lower pressure.
    fixed, at = {"E_f.posterior": AT[1]}, AT[:1]
    model = model_of(GENTLE, ("E_f.anterior",), fixed=fixed, continuation=True, **SMALL)
    plain = model.fresh()
    relaxation = Relaxation({"anterior": AT[0], "posterior": AT[1]}, 0.3)
    model.settings = replace(model.settings, relaxation=relaxation)
    end = plain.contact_valve.motion
    state = HeldState(0.3, end.annulus[-1], end.papillary_tips[-1])
    x = plain.rests(at, [state])[-1].frames[-1]
    at_rest, before = (
        one.tuned(at)[0].solid.evaluate(x, one.tuned(at)[0].solid.initial_strain(), 0.0)
        for one in (model, plain)
    )
    assert np.abs(before.stress).max() > 0.01
    assert np.abs(at_rest.stress).max() < 1e-9
    hasty = replace(model.settings, newton=replace(EXACT, max_iterations=1, max_halvings=0))
    failed = replace(model.fresh(), settings=hasty)(at)
    assert failed.reason.startswith("relaxation: the valve does not close: Newton's method")
    with pytest.raises(InputError, match="pressure_mmHg = -1, expected > 0"):
        Relaxation({}, -1)
    rotated = {name: replace(own, law="corotational") for name, own in TISSUE.items()}
    with pytest.raises(InputError, match="relaxation of mechanics: the corotational law has none"):
        replace(model.settings, tissue=rotated)


def test_a_moving_valve_has_no_derivative_by_its_prestretch():
    with pytest.raises(InputError, match="at an equilibrium only"):
        model_of(OPEN, STRETCH_NAMES, **SMALL).close(STRETCH_AT)


MESH = model_of(OPEN, **TINY).mesh


def law_of(tissue, **values):
    named = {name.replace("__", "."): value for name, value in values.items()}
    return material_law(MESH, replace(model_of(OPEN, **TINY).settings, tissue=tissue), named)


def test_each_region_follows_its_own_law():
    law = law_of(EXPONENTIAL, E_f__posterior=4.0)
    own = (
        ExponentialLaw.of([EXPONENTIAL["anterior"].coefficients({})] * 2),
        BiotLaw.of([TISSUE["posterior"].material(4.0)] * 2),
    )
    green, before = np.random.default_rng(0).uniform(-0.05, 0.1, (2, len(MESH.elements), 4, 6))
    at = Points(green, MESH.region, before, 0.3)
    for region, other in enumerate(own):
        for ours, theirs in zip(law.response(at), other.response(at), strict=True):
            members = MESH.region == region
            np.testing.assert_array_equal(ours[members], theirs[members])


def test_parameters_go_before_settings_and_one_law_for_all_is_not_divided():
    moduli = {"E_f__anterior": 6.0, "E_f__posterior": 4.0}
    assert isinstance(law_of(TISSUE, **moduli), BiotLaw)
    both = law_of({**EXPONENTIAL, "posterior": EXPONENTIAL["anterior"]}, c0__posterior=0.3)
    np.testing.assert_array_equal(both.coefficients[:, 0], [0.2, 0.3])
    longer = {**TISSUE, "anterior": replace(TISSUE["anterior"], prestretch=1.1)}
    stretched = law_of(longer, prestretch__posterior=0.98, **moduli)
    along = [stretched.stress_free[MESH.region == k, 0, 0, 0] for k in (0, 1)]
    for found, expected in zip(along, (1.1, 0.98), strict=True):
        np.testing.assert_allclose(found, expected**2)
    with pytest.raises(InputError, match="expected > 0"):
        law_of(longer, prestretch__posterior=-1.0, **moduli)
    twice = {**STIFFENING, "posterior": replace(STIFFENING["anterior"], stiffening=2.0)}
    stiff = law_of(twice, stiffening__anterior=0.5, **moduli)
    assert isinstance(stiff, LeafletLaw)
    assert [one.stiffening for one in stiff.laws] == [0.5, 2.0]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("stiffening.anterior",), r"'anterior' follows the exponential law, which has E_f, c0"),
        (("E_f.anterior", "c0.anterior", "E_f.posterior"), r"either the modulus .* or its coeff"),
        (("E_f.posterior", "c0.posterior"), r"'posterior' follows the biot law, which has E_f"),
    ],
)
def test_parameters_of_the_other_law_are_refused_before_anything_is_closed(names, message):
    with pytest.raises(InputError, match=message):
        with_tissue(EXPONENTIAL, OPEN, names, **TINY).close(np.ones(len(names)))


def test_a_closure_begins_with_linear_tissue_and_ends_where_any_other_does():
    # Without contact there is one equilibrium.
    ends = with_tissue(STIFFENING, GENTLE, **SMALL).close(STIFF_AT).simulation
    model = with_tissue(STIFFENING, GENTLE, continuation=True, **SMALL)
    begun, closing = [], model._close

    def followed(m, *given, **more):
        begun.append(m[2])
        return closing(m, *given, **more)

    model._close = followed
    found = model.close(STIFF_AT).simulation
    assert (begun[0], begun[-1]) == (0.0, STIFF_AT[2])
    np.testing.assert_allclose(found.frames[-1], ends.frames[-1], atol=1e-7)
    # Further closures continue from there.
    model.close(STIFF_AT * [1.0, 1.0, 1.1])
    assert 0.0 not in begun[1:]
