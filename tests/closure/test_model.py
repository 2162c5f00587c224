"""The closure model: closed states, their derivatives, continuation, guide and restart.

Everything runs on 16 x 2 cells of hex18 with a stiff posterior leaflet: enough for the leaflets to
meet in a few steps. The states are not realistic; the equations are those of any mesh.
"""

import re
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest

import mvest.closure.model
from mvest.closure.continuation import ClosedState
from mvest.closure.model import REST, ClosureModel
from mvest.errors import InputError
from mvest.mechanics.settings import (
    ClosureProtocol,
    MechanicsSettings,
    TissueSettings,
)
from mvest.mechanics.steps import NewtonSettings, StepReason
from mvest.mechanics.valve_system import HeldState, boundary_loading, build_system
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

MODULI = ("E_f.anterior", "E_f.posterior")
AT = np.array([6.0, 4.0])
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
CLOSING = ClosureProtocol(pressure_mmHg=100.0, ramp=0.2, dt=0.04, growth=2.0, end=0.4)
# Two steps that do not bring the leaflets together, for what needs no contact.
OPEN = ClosureProtocol(pressure_mmHg=20.0, ramp=0.1, dt=0.05, end=0.1, equilibrium=False)
# So little pressure that the open valve has an equilibrium nearby.
GENTLE = ClosureProtocol(pressure_mmHg=0.5, ramp=0.1, dt=0.05, end=0.1)
# Converged to round-off: a residual that Newton's method leaves is divided by a small step below.
EXACT = NewtonSettings(tolerance=1e-13, smallest_move=1e-11, max_iterations=60)

TEMPLATE = Template()
SMALL = {"cells": (12, 2), "samples": (32, 8)}
TINY = {"cells": (8, 1), "samples": (16, 5)}


def settings_of(protocol, **changes):
    return MechanicsSettings(TISSUE, protocol, newton=EXACT, **changes)


def model_of(protocol, names=MODULI, cells=(16, 2), samples=(60, 16), **changes):
    settings = settings_of(protocol, **changes.pop("settings", {}))
    return ClosureModel(
        TEMPLATE.valve(16, 5),
        TEMPLATE.valve(*samples),
        structured_mesh(TEMPLATE, "hex18", *cells),
        settings,
        names,
        **changes,
    )


@pytest.fixture(scope="module")
def closed():
    """A model that has closed once, and that closure."""
    model = model_of(CLOSING, continuation=True)
    result = model.close(AT)
    assert result.simulation.converged
    return model, result.simulation


def continued(model, start, m, sensitivities=False):
    """The equilibrium at ``m`` that is reached from the nodal positions ``start``."""
    model.restart(ClosedState(np.ones(len(m)), start))
    simulation = model.close(m, sensitivities=sensitivities).simulation
    assert simulation.converged
    # Two frames, the start and the equilibrium: the whole closure was not run again.
    assert len(simulation.times) == 2
    return simulation


def step_study(exact, run, m, k, coarse):
    """Errors of central differences at a relative step and at a quarter of it, and extrapolated.

    The error of a central difference falls by 16 from h to h/4, so that (16 D(h/4) - D(h)) / 15 is
    free of it. A wrong derivative leaves an error that does not fall.
    """
    differences = []
    for relative in (coarse, coarse / 4):
        h = relative * m[k] * np.eye(len(m))[k]
        differences.append((run(m + h) - run(m - h)) / (2 * h[k]))
    differences.append((16 * differences[1] - differences[0]) / 15)
    return [float(np.linalg.norm(d - exact) / np.linalg.norm(exact)) for d in differences]


def test_a_continued_closure_ends_in_the_state_of_one_from_the_open_valve(closed):
    model, simulation = closed
    other = AT * np.array([0.95, 1.05])
    warm = continued(model, simulation.frames[-1], other, sensitivities=True)
    cold_model = replace(model, continuation=False)
    cold = cold_model.close(other).simulation
    assert cold.converged
    assert len(cold.times) > 2
    assert np.abs(warm.frames[-1] - simulation.frames[-1]).max() > 0.01
    np.testing.assert_allclose(warm.frames[-1], cold.frames[-1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(warm.sensitivities[-1], cold.sensitivities[-1], rtol=0, atol=1e-6)


def test_the_closed_state_does_not_depend_on_how_the_path_to_it_is_solved(closed):
    model, simulation = closed
    rough, last = simulation.records[:-1], simulation.records[-1]
    assert max(r.residuals[-1] for r in rough) > 1e-4
    assert last.residuals[-1] < 1e-9
    # Solved in full at every step, and with continuation forbidden where every frame is wanted.
    full = model.close(AT, sensitivities=False, every_frame=True).simulation
    assert full.converged
    assert len(full.times) == len(simulation.times) > 2
    assert max(r.residuals[-1] for r in full.records) < 1e-9
    assert np.abs(full.frames[-2] - simulation.frames[-2]).max() > 1e-6
    np.testing.assert_allclose(full.frames[-1], simulation.frames[-1], rtol=0, atol=1e-8)


def test_a_guided_closure_ends_in_the_state_of_one_from_the_open_valve(closed):
    model, simulation = closed
    coarse = model_of(CLOSING, cells=(14, 2))
    guided = replace(model, continuation=False, guide=coarse)
    result = guided.close(AT).simulation
    assert result.converged
    # On the fine mesh, the state taken over only rests before its equilibrium is looked for.
    assert len(result.times) == 2 + len(REST)
    # It started where the coarse valve is closed, not where the fine one is.
    assert 0.01 < np.abs(result.frames[0] - simulation.frames[-1]).max() < 5.0
    np.testing.assert_allclose(result.frames[-1], simulation.frames[-1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        result.sensitivities[-1], simulation.sensitivities[-1], rtol=0, atol=1e-6
    )
    # Every frame can only come from the open valve.
    assert len(guided.close(AT, sensitivities=False, every_frame=True).simulation.times) > 2


@pytest.mark.parametrize(("pressure", "lift"), [(95.0, 0.0), (100.0, 0.3)])
def test_a_held_valve_is_one_that_was_closed_under_these_loads(closed, pressure, lift):
    # Reached from the closed state and from the open one.
    model, _ = closed
    motion = model.contact_valve.motion
    tips = motion.papillary_tips[-1] + [0.0, 0.0, lift]
    (held,) = model.held(AT, [HeldState(pressure, motion.annulus[-1], tips)])
    moved = replace(motion, papillary_tips=np.stack([motion.papillary_tips[0], tips]))
    other = replace(
        model,
        contact_valve=replace(model.contact_valve, motion=moved),
        settings=settings_of(replace(CLOSING, pressure_mmHg=pressure)),
        continuation=False,
    )
    closed_so = other.close(AT, sensitivities=False).simulation
    np.testing.assert_allclose(held, other.observed(closed_so.frames[-1]), rtol=0, atol=1e-7)


def test_held_loads_must_be_those_of_the_valve(closed):
    model, simulation = closed
    motion = model.contact_valve.motion
    model.restart(ClosedState(AT, simulation.frames[-1]))
    with pytest.raises(InputError, match="held annulus"):
        model.held(AT, [HeldState(80.0, motion.annulus[-1][:5], motion.papillary_tips[-1])])


def test_a_continuation_that_fails_is_repeated_from_the_open_valve(monkeypatch):
    model = model_of(GENTLE, **SMALL)
    model = replace(model, continuation=True)
    first = model.close(AT, sensitivities=False).simulation
    true_simulate, starts = mvest.closure.model.simulate, []

    def simulate(*arguments, **options):
        starts.append(options["initial_positions"])
        result = true_simulate(*arguments, **options)
        if options["initial_positions"] is not None:
            result = replace(result, reason=StepReason.NO_CONVERGENCE)
        return result

    monkeypatch.setattr(mvest.closure.model, "simulate", simulate)
    again = model.close(AT, sensitivities=False).simulation
    np.testing.assert_array_equal(starts[0], first.frames[-1])
    assert starts[1] is None
    assert again.converged
    # Frames on the way are solved to the path tolerance only.
    assert len(again.times) == len(first.times) > 2
    np.testing.assert_allclose(again.frames[-1], first.frames[-1], rtol=0, atol=1e-9)
    # Unless it is not to be repeated: then the failure is the result.
    starts.clear()
    alone = replace(model, repeat=False)
    alone.restart(ClosedState(AT, first.frames[-1]))
    failed = alone.close(AT, sensitivities=False).simulation
    assert len(starts) == 1
    assert failed.reason is StepReason.NO_CONVERGENCE


def test_a_restarted_model_forgets_to_the_last_bit(closed):
    # Earlier contact is in the sparsity pattern and in the order of elimination, which may round
    # differently.
    model, simulation = closed
    start, found = ClosedState(AT, simulation.frames[-1]), []
    for before in (None, np.array([4.0, 3.0])):
        model.restart(start)
        if before is not None:
            assert model(before).converged
            assert model._system._coupled.size
            model.restart(start)
            assert not model._system._coupled.size
        prediction = model(1.05 * AT)
        found.append(prediction.y.tobytes() + prediction.jacobian.tobytes())
        np.testing.assert_array_equal(model.closed.at, 1.05 * AT)
    assert found[0] == found[1]


def test_a_restarted_guide_forgets_too():
    model = model_of(GENTLE, cells=(12, 2), samples=(32, 8))
    model = replace(model, guide=model_of(GENTLE, **SMALL), continuation=True)
    model.close(AT, sensitivities=False)
    state = model.closed
    model.restart(None)
    assert model.closed is None
    assert model.guide.closed is None
    model.restart(state)
    np.testing.assert_array_equal(model.guide.closed.positions, state.guide.positions)


@pytest.mark.parametrize(
    ("reach", "m", "frames"),
    [
        (0.2, 1.2 * AT, 2),
        (0.2, 1.3 * AT, 4),
        (0.0, AT, 2),
    ],
)
def test_a_closure_is_continued_within_reach_only(reach, m, frames):
    # log 1.2 = 0.18 and log 1.3 = 0.26. Continued: start and equilibrium; else two steps more.
    model = replace(model_of(GENTLE, **SMALL), continuation=True, reach=reach)
    model.close(AT, sensitivities=False)
    assert len(model.close(m, sensitivities=False).simulation.times) == frames


def test_a_rounded_start_depends_on_the_parameters_alone():
    # Rounded in steps of 0.4 in the logarithm; log(9 / 5.5) = 0.49 is beyond the reach.
    ways = ((np.array([5.5, 3.6]),), (np.array([9.0, 3.6]), np.array([5.5, 3.6])))
    ends = []
    for way in ways:
        model = model_of(GENTLE, **TINY, continuation=True, rounded_start=True, reach=0.3)
        for m in way:
            simulation = model.close(m).simulation
            # From the rounded parameters straight to the equilibrium.
            assert len(simulation.times) == 2
        ends.append(simulation.frames)
    np.testing.assert_array_equal(*ends)
    # It starts at (e^1.6, e^1.2) = (4.95, 3.32) and ends in the state from the open valve.
    for end, m in zip(ends[0], (np.exp([1.6, 1.2]), ways[0][0]), strict=True):
        plain = model_of(GENTLE, **TINY).close(m).simulation
        np.testing.assert_allclose(end, plain.frames[-1], rtol=0, atol=1e-9)


def test_one_model_after_another_leaves_nothing_behind():
    # Retuned models keep their system; each value must come from its own arguments.
    names = (*MODULI, "pressure_scale", "chord_stiffness", "chord_rest_length")
    values = (np.array([*AT, 1.0, 1.0, 0.94]), np.array([3.0, 3.0, 0.8, 1.3, 0.97]))
    used = model_of(OPEN, names, **SMALL)
    one, two, one_again = (used(m) for m in (*values, values[0]))
    fresh = model_of(OPEN, names, **SMALL)(values[1])
    np.testing.assert_allclose(two.y, fresh.y, rtol=0, atol=1e-10)
    np.testing.assert_allclose(two.jacobian, fresh.jacobian, rtol=0, atol=1e-8)
    np.testing.assert_allclose(one_again.y, one.y, rtol=0, atol=1e-10)
    assert np.abs(two.y - one.y).max() > 0.1


def test_a_prediction_is_the_open_and_the_closed_frame_and_their_derivative(closed):
    model, simulation = closed
    model.restart(ClosedState(AT, simulation.frames[-1]))
    prediction = model(AT)
    assert prediction.converged
    n = len(model.valve.surface.vertices)
    assert prediction.y.shape == (6 * n,)
    assert prediction.jacobian.shape == (6 * n, 2)
    opened, shut = prediction.y.reshape(2, n, 3)
    # The coarse mesh cuts corners of the surface, and points outside are extrapolated exactly.
    np.testing.assert_allclose(opened, model.valve.surface.vertices, atol=1e-8)
    np.testing.assert_allclose(shut, model.observed(simulation.frames[-1]), atol=1e-9)
    assert np.linalg.norm(shut - opened, axis=1).max() > 5.0
    by_open, by_closed = prediction.jacobian.reshape(2, n, 3, 2)
    assert np.all(by_open == 0)
    for k in range(2):
        expected = model.observed(simulation.sensitivities[-1][k])
        np.testing.assert_allclose(by_closed[..., k], expected, atol=1e-8)


@pytest.mark.parametrize("values", [[-1.0, 2.0], [6.0, 0.0], [float("nan"), 2.0]])
def test_an_inadmissible_modulus_is_a_failed_prediction(values):
    prediction = model_of(OPEN, **TINY)(np.array(values))
    assert not prediction.converged
    assert re.search(r"E_f\S* = (-1|0|nan)", prediction.reason)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reach": -1.0}, r"reach of a continuation = -1\.0"),
        ({"largest_change": 0.0}, "largest_change = 0"),
        ({"guide": ("pressure_scale",)}, r"the guide's parameters are .*pressure_scale"),
    ],
)
def test_inadmissible_options_are_refused(changes, message):
    model = model_of(OPEN, **TINY)
    if "guide" in changes:
        changes = {"guide": replace(model, names=(*MODULI, *changes["guide"]))}
    with pytest.raises(InputError, match=message):
        replace(model, **changes)


def test_a_run_that_does_not_converge_is_a_failed_prediction_with_reason_and_time():
    model = model_of(OPEN, **SMALL)
    newton = NewtonSettings(max_iterations=1, max_halvings=0)
    model = replace(model, settings=replace(model.settings, newton=newton))
    simulation = model.close(AT).simulation
    assert simulation.reason is StepReason.NO_CONVERGENCE
    assert len(simulation.frames) == 1
    prediction = model(AT)
    assert not prediction.converged
    assert prediction.reason == (
        "Newton's method did not converge at the smallest step (t = 0.000 s)"
    )
    assert model._closed is None


@pytest.mark.parametrize("support", ["hinge", "clamp"])
def test_the_support_follows_the_annulus_within_micrometres(support):
    model = model_of(OPEN, **SMALL, settings={"support": support})
    result = model.close(AT, sensitivities=False)
    assert result.simulation.converged
    hinge, contact_valve = result.system.hinge, model.contact_valve
    loading = boundary_loading(result.system, model.valve, contact_valve, model.settings)
    target = loading(result.simulation.times[-1]).hinge
    points = hinge.points(result.simulation.frames[-1])
    n = len(contact_valve.annulus)
    assert len(points) == (n if support == "hinge" else 2 * n)
    assert np.linalg.norm(points - target, axis=1).max() < 0.02  # mm
    # The targets of the closed frame: the annulus of the closed frame, midway between the faces.
    middle = target if support == "hinge" else 0.5 * (target[:n] + target[n:])
    np.testing.assert_allclose(middle, contact_valve.motion.annulus[-1], atol=1e-3)
    # Stiffness per length: 50 N/mm per mm of annulus, however it is shared out.
    loop = contact_valve.surface.vertices[contact_valve.annulus]
    length = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum()
    assert hinge.stiffness.sum() == pytest.approx(50.0 * length)


def test_loads_do_not_depend_on_the_mesh():
    # Chord patches, hinge and contact samples are given in the rest frame.
    valves, moduli = (
        (TEMPLATE.valve(16, 5), TEMPLATE.valve(96, 32)),
        dict(zip(MODULI, AT, strict=True)),
    )
    first, other = (
        build_system(*valves, structured_mesh(TEMPLATE, *kind), settings_of(CLOSING), moduli)
        for kind in (("hex18", 36, 4), ("tet10", 24, 3))
    )
    for part in ("cables.patches", "hinge.points", "contact.points"):
        embedded = attrgetter(part)
        one, two = (embedded(system)(system.solid.mesh.nodes) for system in (first, other))
        np.testing.assert_allclose(two, one, atol=1e-6, err_msg=part)
    np.testing.assert_array_equal(other.hinge.stiffness, first.hinge.stiffness)


def test_the_protocol_ramps_in_equal_steps_then_grows_to_the_end_and_to_equilibrium():
    # 0.3 s in steps of 0.1 s; then 0.2 s, and what is left to 0.6 s; then the static step.
    protocol = ClosureProtocol(ramp=0.3, dt=0.1, growth=2.0, end=0.6)
    steps = protocol.steps()
    np.testing.assert_allclose([s.time for s in steps], [0.1, 0.2, 0.3, 0.5, 0.6, 1.6])
    assert [s.static for s in steps] == [False] * 5 + [True]
    assert not any(s.static for s in replace(protocol, equilibrium=False).steps())
    # A smooth step: 0, 1/2 and 1, and flat at both ends (slope 30 u^2 (1 - u)^2 / ramp).
    assert [protocol.phase(t) for t in (0, 0.15, 0.3, 9.0)] == pytest.approx([0, 0.5, 1, 1])
    assert protocol.phase(3e-4) == pytest.approx(0, abs=1e-7)
    assert protocol.phase(0.3 - 3e-4) == pytest.approx(1, abs=1e-7)


def test_the_loading_runs_from_the_open_to_the_closed_frame():
    model = model_of(replace(CLOSING, pressure_mmHg=120.0), **SMALL)
    moduli = {"E_f.anterior": 6.23, "E_f.posterior": 2.09}
    system = build_system(model.valve, model.contact_valve, model.mesh, model.settings, moduli)
    loading = boundary_loading(system, model.valve, model.contact_valve, model.settings)
    start, end = loading(0.0), loading(0.2)
    assert start.pressure == 0
    # 120 mmHg x 133.322 Pa = 15 999 Pa.
    assert end.pressure == pytest.approx(0.015999, abs=1e-6)
    np.testing.assert_array_equal(start.hinge, system.hinge.points(model.mesh.nodes))
    motion = model.contact_valve.motion
    np.testing.assert_allclose(
        end.hinge - start.hinge, motion.annulus[-1] - motion.annulus[0], atol=1e-12
    )
    np.testing.assert_array_equal(end.tips, motion.papillary_tips[-1])
    # Half way in time is half way in phase, and two frames are joined by a straight line.
    np.testing.assert_allclose(loading(0.1).hinge, 0.5 * (start.hinge + end.hinge), atol=1e-12)


def test_fixed_values_are_used_and_estimated_ones_go_before_them():
    names = (*MODULI, "pressure_scale")
    both = model_of(OPEN, names, **TINY).close(np.array([*AT, 0.5])).simulation
    fixed = model_of(OPEN, **TINY, fixed={"pressure_scale": 0.5}).close(AT).simulation
    np.testing.assert_allclose(fixed.frames[-1], both.frames[-1], atol=1e-10)
    over = model_of(OPEN, names, **TINY, fixed={"pressure_scale": 2.0})
    np.testing.assert_allclose(
        over.close(np.array([*AT, 0.5])).simulation.frames[-1], both.frames[-1], atol=1e-10
    )
    usual = model_of(OPEN, **TINY).close(AT).simulation
    assert np.abs(usual.frames[-1] - both.frames[-1]).max() > 0.1


def test_a_continued_closure_starts_where_it_is_expected_to_end(closed):
    model, simulation = closed
    m = AT * np.array([1.25, 0.85])
    plain = continued(model, simulation.frames[-1], m, sensitivities=True)
    model.restart(ClosedState(AT, simulation.frames[-1], slopes=simulation.sensitivities[-1]))
    expected = model.close(m).simulation
    assert len(expected.times) == 2
    assert expected.iterations < plain.iterations
    np.testing.assert_allclose(expected.frames[-1], plain.frames[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(expected.sensitivities[-1], plain.sensitivities[-1], atol=1e-7)
    # And so does the next one: the new state has its own slopes.
    np.testing.assert_array_equal(model.closed.slopes, expected.sensitivities[-1])


def test_a_far_continuation_goes_through_equilibria_between(closed):
    # In one step Newton's method would be asked for an equilibrium 0.11 away in the logarithm.
    model, simulation = closed
    far = AT * np.array([0.9, 1.1])
    walking = replace(model, largest_change=0.05)
    walking.restart(ClosedState(AT, simulation.frames[-1]))
    between = walking._way_to(far)
    assert len(between) == 2
    whole = np.log(far / AT)
    for k, m in enumerate(between, 1):
        np.testing.assert_allclose(np.log(m / AT), whole * k / 3, atol=1e-12)
    reached = walking.close(far).simulation
    direct = continued(replace(model), simulation.frames[-1], far, sensitivities=True)
    np.testing.assert_allclose(reached.frames[-1], direct.frames[-1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(reached.sensitivities[-1], direct.sensitivities[-1], atol=1e-6)
    assert not walking._way_to(far * 1.04)
