"""Virtual patients: what is drawn, what is seen, and what their case does not say."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.closure.frames import ERROR, OFFSET
from mvest.errors import GeometryError, InputError
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.mechanics.steps import NewtonSettings
from mvest.problem.registration import REGISTRATION, displace
from mvest.simulation import virtual_patient
from mvest.simulation.virtual_patient import (
    Deviations,
    PatientSettings,
    PatientSimulation,
    draw_patient_values,
    simulate_patient,
)
from mvest.valve.anatomy.template import Template

TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
CLOSING = ClosureProtocol(pressure_mmHg=100.0, ramp=0.2, dt=0.04, growth=2.0, end=0.4)
MECHANICS = MechanicsSettings(TISSUE, CLOSING)
MODULI = {"E_f.anterior": 6.0, "E_f.posterior": 4.0}
TEMPLATE = Template()
SMALL = PatientSimulation(
    columns=16, rows=2, dt_factor=1.0, contact_columns=60, contact_rows=16, seen_columns=32,
    seen_rows=9, std_mm=0.4, correlation_length_mm=8.0, held_pressure_mmHg=(95.0,),
    held_relaxation=(0.1,),
)  # fmt: skip


def make(values, simulation=SMALL, mechanics=MECHANICS, seed=3):
    return simulate_patient(
        "small", "d", TEMPLATE, values, simulation, mechanics, np.random.default_rng(seed)
    )


@pytest.fixture(scope="module")
def values():
    """True values with which 16 x 2 cells close in seconds."""
    factors = {"pressure_scale": 1.03, "chord_stiffness": 1.1, "chord_rest_length": 1.01}
    displacement = zip(REGISTRATION, (0.5, -0.2, 0.4, 1.0, -0.5, 0.5), strict=True)
    return {**MODULI, **factors, **dict(displacement)}


@pytest.fixture(scope="module")
def patient(values):
    return make(values)


def draw(rng, deviations=None, spread=0.0, **simulation):
    settings = PatientSettings(
        name="p", description="d", moduli=MODULI, moduli_spread=spread,
        simulation=PatientSimulation(**simulation), deviations=deviations or Deviations(),
    )  # fmt: skip
    return draw_patient_values(settings, rng)


def test_what_is_hidden_spreads_as_requested():
    rng = np.random.default_rng(0)
    drawn = [draw(rng, Deviations(0.1, 0.03, 0.25, 1.5, 4.0), 0.5) for _ in range(4000)]
    factors = {"E_f.anterior": 0.5, "pressure_scale": 0.1, "chord_rest_length": 0.03}
    displacements = {name: 1.5 if name.startswith("shift") else 4.0 for name in REGISTRATION}
    for name, std in (factors | displacements).items():
        found = np.array([values[name] for values in drawn])
        # Factors are log-normal with the median one, so none is negative.
        found = np.log(found / MODULI.get(name, 1.0)) if name in factors else found
        # Four standard errors: std / sqrt(n) of a mean, std / sqrt(2 n) of a spread.
        assert abs(found.mean()) < 4 * std / np.sqrt(4000)
        assert found.std() == pytest.approx(std, rel=4 / np.sqrt(8000))


def test_a_patient_is_seen_where_it_is_up_to_its_displacement_and_noise(patient, values):
    case, positions = patient.case, patient.positions
    assert patient.values == values
    assert [frame.name for frame in case.frames] == ["open", "closed", "held_95_mmHg"]
    open_, closed, held = case.frames
    assert [f.role for f in case.frames] == [Role.REFERENCE, Role.CLOSED, Role.HELD_OUT]
    # The reference is exact: the model is made from it.
    np.testing.assert_array_equal(open_.vertices, case.surface.vertices)
    np.testing.assert_array_equal(positions["open"], case.surface.vertices)
    # Without its displacement, the annulus of the seen valve is that of the boundary.
    centre = closed.annulus.mean(axis=0)
    registration = np.array([values[name] for name in REGISTRATION])
    assert np.linalg.norm(registration[:3]) > 0.5
    true = positions["closed"]
    ring = true[case.annulus]
    assert np.linalg.norm(ring - closed.annulus, axis=1).mean() > 0.3
    undone = (ring - centre - registration[:3]) @ np.linalg.inv(turn_of(registration)).T + centre
    # The hinge holds the annulus of a coarse mesh, whose edges are not those that are seen.
    np.testing.assert_allclose(undone[::2], closed.annulus[::2], atol=0.15)
    for frame in (closed, held):
        error = frame.vertices - positions[frame.name]
        assert 0.2 < error.std() < 0.6
        np.testing.assert_array_equal(frame.free_edge, frame.vertices[case.free_edge])
        assert frame.corresponds
    assert held.time > closed.time > 0
    # The case states the boundary without the displacement, and its own pressure and chordae.
    seen = TEMPLATE.valve(32, 9)
    motion = seen.motion
    np.testing.assert_array_equal(closed.annulus, motion.annulus[-1])
    np.testing.assert_array_equal(closed.papillary_tips, motion.papillary_tips[-1])
    np.testing.assert_allclose(held.annulus, 0.9 * motion.annulus[-1] + 0.1 * motion.annulus[0])
    np.testing.assert_allclose(held.papillary_tips, closed.papillary_tips + np.array([0, 0, 0.2]))
    assert [frame.pressure_mmHg for frame in case.frames] == [0.0, 100.0, 95.0]
    np.testing.assert_array_equal(case.chordae.rest_length, seen.chordae.rest_length)


def turn_of(registration):
    return displace(np.eye(3), np.array([0, 0, 0, *registration[3:]]), np.zeros(3)).T


def test_further_fitted_frames_are_closed_under_pressures_with_errors(patient, values):
    errors = {OFFSET: 2.0, f"{ERROR}.closed": -1.0, f"{ERROR}.fitted_95_mmHg": 0.0}
    further = {"fitted_pressure_mmHg": (95.0,), "fitted_relaxation": (0.1,)}
    both = make(values | errors, replace(SMALL, held_pressure_mmHg=(97.0,), **further))
    assert [(f.name, f.role) for f in both.case.frames[1:]] == [
        ("closed", Role.CLOSED), ("fitted_95_mmHg", Role.FITTED), ("held_97_mmHg", Role.HELD_OUT),
    ]  # fmt: skip
    assert both.case.fitted == (both.case.frames[2],)
    # The frame held out is under 97 + 2 mmHg; that of the other patient under 95 without an error,
    # and the one fitted here under 95 + 2.
    true, other = both.positions, patient.positions
    rise = [true[name] - other["held_95_mmHg"] for name in ("fitted_95_mmHg", "held_97_mmHg")]
    assert np.linalg.norm(rise[1]) == pytest.approx(2 * np.linalg.norm(rise[0]), rel=0.05)
    np.testing.assert_allclose(true["closed"] - other["closed"], 0.5 * rise[0], atol=0.02)
    drawn, alone = (draw(np.random.default_rng(1), **own) for own in (further, {}))
    assert alone.items() <= drawn.items()
    assert set(drawn) - set(alone) == {OFFSET, f"{ERROR}.closed", f"{ERROR}.fitted_95_mmHg"}


def seen_again(patient, rng, **simulation):
    """The case of the same valve: closing it once is enough."""
    true = {name: x for name, x in patient.positions.items() if name != "open"}
    rng = np.random.default_rng(rng) if isinstance(rng, int) else rng
    settings = replace(SMALL, **simulation)
    seen = TEMPLATE.valve(32, 9)
    return virtual_patient._case("small", "d", seen, true, settings, MECHANICS, rng)


def test_rough_errors_come_on_top_and_are_not_stated(patient):
    case = seen_again(patient, 3, rough_std_mm=0.3)
    assert case.uncertainty.std_mm == SMALL.std_mm
    pairs = list(zip(case.frames, patient.case.frames, strict=True))
    open_, *more = (a.vertices - b.vertices for a, b in pairs)
    assert not open_.any()
    # 1728 numbers: an SD of 1.7 %.
    assert np.std(more) == pytest.approx(0.3, rel=0.07)
    assert abs(np.mean(np.array(more)[:, 1:] * np.array(more)[:, :-1])) < 0.01


def test_a_valve_that_does_not_close_is_an_error(values):
    newton = NewtonSettings(max_iterations=1)
    fast = replace(CLOSING, ramp=1e-3, dt=1e-3, end=1e-3)
    with pytest.raises(GeometryError, match="virtual patient small does not close"):
        make(values, mechanics=MechanicsSettings(TISSUE, fast, newton=newton))


def test_frames_that_are_held_out_have_a_name_each():
    with pytest.raises(InputError, match="expected as many"):
        PatientSimulation(held_pressure_mmHg=(80.0, 60.0), held_relaxation=(0.1,))
    with pytest.raises(InputError, match="expected different pressures"):
        PatientSimulation(held_pressure_mmHg=(80.0, 80.0), held_relaxation=(0.1, 0.3))
