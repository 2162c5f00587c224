"""Newton's method: quadratic where it converges, a value with a reason where it does not."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics import (
    BiotLaw,
    Loads,
    NewtonSettings,
    Parameter,
    Step,
    StepReason,
    System,
    box,
    integrate,
    outer_faces,
    simulate,
    simulate_body,
)
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.solid import Solid
from tests.mechanics.bodies import MATERIALS, block, sandwich


def sheet(element_type="hex18", **changes):
    nodes, elements = box(element_type, (4, 4, 1), (20.0, 20.0, 1.3))
    faces = outer_faces(elements, element_type)
    settings = {
        "material": MATERIALS["A"],
        "fibre": (0.8, 0.6, 0.0),
        "fixed_nodes": np.flatnonzero(np.any((nodes[:, :2] == 0) | (nodes[:, :2] == 20), axis=1)),
        "pressure_faces": faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)],
        "pressure": [(0.0, 0.0), (0.05, 0.016)],
        "times": [0.02, 0.04, 0.06],
    }
    return simulate_body(nodes, elements, element_type, **(settings | changes))


def assert_quadratic(residuals):
    """Two iterations together at least cube the residual, down to round-off.

    Quadratic convergence squares it twice; membrane and bending take turns, so that single
    iterations may gain less. A tangent wrong by more than about half a per cent fails: linear
    convergence with rate q needs q^2 r < 5 r^3. Below 2e-10 the elimination of the enhanced
    strains is felt.
    """
    r = residuals
    small = [k for k in range(1, len(r) - 2) if r[k] < 5e-2]
    for k in small:
        assert r[k + 2] < 5 * r[k] ** 3 + 2e-10
    return len(small)


@pytest.mark.parametrize(
    ("element_type", "static"), [("hex18", False), ("hex18", True), ("tet10", False)]
)
def test_newton_converges_quadratically(element_type, static):
    # Without the load stiffness, the rotation derivative or the Schur complement of the enhanced
    # strain convergence is linear.
    result = sheet(element_type, static=static, newton=NewtonSettings(tolerance=1e-9))
    assert result.converged
    assert all(len(record.residuals) <= 7 for record in result.records)
    assert sum(assert_quadratic(record.residuals) for record in result.records) >= 2


def test_newton_converges_quadratically_with_contact():
    system, loading = sandwich(cells=2, samples=11)
    steps = [Step(t) for t in (0.02, 0.04, 0.06, 0.1)]
    result = simulate(system, loading, steps)
    assert result.converged
    assert result.records[-1].active_contacts > 20
    assert sum(assert_quadratic(record.residuals) for record in result.records) >= 4


@pytest.mark.parametrize("parameters", [(), (Parameter("E_f.0", 6.23),)])
def test_the_last_correction_is_part_of_the_solution(parameters):
    # What the tolerance leaves would be some 1e-5 mm; two runs that stop at different residuals
    # would differ by as much.
    exact = sheet(static=True, newton=NewtonSettings(tolerance=1e-12)).frames[-1]
    rough = sheet(static=True, newton=NewtonSettings(tolerance=1e-4), parameters=parameters)
    assert 1e-9 < rough.records[-1].residuals[-1] < 1e-4
    np.testing.assert_allclose(rough.frames[-1], exact, rtol=0, atol=1e-8)


@pytest.mark.parametrize("always", [False, True])
def test_a_step_that_ends_intersecting_is_repeated_with_detection(monkeypatch, always):
    true_step, true_intersects, detected = Contact.largest_step, Contact.intersects, []

    def largest_step(self, pairs, y, dy, *, detect):
        detected.append(detect)
        return true_step(self, pairs, y, dy, detect=detect)

    def intersects(self, y):
        assert not true_intersects(self, y)
        return always or not detected[-1]

    monkeypatch.setattr(Contact, "largest_step", largest_step)
    monkeypatch.setattr(Contact, "intersects", intersects)
    system, loading = sandwich(cells=2, samples=11)
    settings = NewtonSettings(max_halvings=0)
    result = simulate(system, loading, [Step(0.1)], newton=settings)
    assert detected[0] is False
    assert detected[-1] is True
    # Once, from the beginning of the step; what intersects in spite of it is not accepted.
    assert np.count_nonzero(np.diff(detected)) == 1
    reason = StepReason.INTERSECTION if always else StepReason.COMPLETED
    assert result.reason is reason


def test_a_run_that_cannot_converge_is_a_value():
    result = sheet(
        newton=NewtonSettings(max_iterations=1, max_halvings=0),
        parameters=[Parameter("E_f.0", 6.23)],
    )
    assert not result.converged
    assert result.reason is StepReason.NO_CONVERGENCE
    assert "did not converge" in result.reason.value
    # Only the given state: no geometry that was not reached.
    assert result.frames.shape[0] == len(result.times) == len(result.sensitivities) == 1
    assert np.all(result.sensitivities == 0)


def test_a_failure_on_the_way_keeps_the_steps_before_it():
    result = sheet(
        pressure=[(0.0, 0.0), (0.03, 0.001), (0.04, 50.0)],
        times=[0.01, 0.02, 0.03, 0.04],
        newton=NewtonSettings(max_iterations=6, max_halvings=1),
    )
    assert result.reason is StepReason.NO_CONVERGENCE
    assert result.times.tolist() == [0.0, 0.01, 0.02, 0.03]
    assert len(result.frames) == 4


def test_a_failed_step_leaves_nothing_behind(monkeypatch):
    # A wild iterate may send the enhanced strains far off; the halved step must not start there.
    true_evaluate, calls = Solid.evaluate, []

    def evaluate(self, x, previous, rate):
        state = true_evaluate(self, x, previous, rate)
        calls.append(1)
        if 3 <= len(calls) < 11:  # every trial of one line search
            self.enhanced_parameters = self.enhanced_parameters + 1e20
            state.stress[:] = np.nan
        return state

    undisturbed = sheet()
    monkeypatch.setattr(Solid, "evaluate", evaluate)
    disturbed = sheet()
    assert undisturbed.converged
    assert disturbed.converged
    assert disturbed.records[0].halvings == 1
    # One halved step of three is another path to nearly the same place, not to another one.
    largest = np.abs(undisturbed.frames[-1] - undisturbed.frames[0]).max()
    np.testing.assert_allclose(disturbed.frames[-1], undisturbed.frames[-1], atol=0.05 * largest)


@pytest.mark.parametrize("times", [[], [0.0], [0.2, 0.1], [0.1, float("nan")]])
def test_times_must_increase_from_zero(times):
    with pytest.raises(InputError, match="time steps must increase"):
        sheet(times=times)


def cantilever(**options):
    """A strip under constant pressure: two time steps, then its equilibrium."""
    mesh = block("hex18", (4, 2, 1), (20.0, 10.0, 1.3))
    nodes, law = mesh.nodes, BiotLaw.of((MATERIALS["A"],))
    fixed = np.flatnonzero(nodes[:, 0] == 0)
    faces = outer_faces(mesh.elements, "hex18")
    under = faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)]
    system = System(Solid(mesh, law), pressure=PressureLoad(under, "quad9"), fixed_nodes=fixed)
    loads = Loads(pressure=2e-4, fixed=nodes[fixed])
    parameters = [Parameter("pressure_scale", 1.0)]
    steps = [Step(0.01), Step(0.02), Step(1.0, static=True)]
    return simulate(system, lambda t: loads, steps, parameters=parameters, **options)


def test_an_equilibrium_that_is_not_found_is_tried_again_after_a_rest(monkeypatch):
    undisturbed = cantilever(final_only=True)
    true_step, refused = integrate._Stepper._step, []

    def step(self, state, end, dt, static):
        if static and not refused:
            refused.append(dt)
            raise integrate._StepError(StepReason.NO_CONVERGENCE)
        return true_step(self, state, end, dt, static)

    monkeypatch.setattr(integrate._Stepper, "_step", step)
    for final_only in (True, False):
        refused.clear()
        rested = cantilever(final_only=final_only)
        assert rested.converged
        assert len(rested.times) == 4
        # Three steps of twice the length each, then the equilibrium.
        assert [r.dt for r in rested.records[2:]] == pytest.approx([0.02, 0.04, 0.08, 0.98])
        assert [r.halvings for r in rested.records] == [0, 0, 1, 1, 1, 1]
        np.testing.assert_allclose(rested.frames[-1], undisturbed.frames[-1], atol=1e-8)
        np.testing.assert_allclose(
            rested.sensitivities[-1], undisturbed.sensitivities[-1], rtol=0, atol=1e-6
        )


def test_iterates_that_run_away_and_detection_without_memory_fail_the_step(monkeypatch):
    class NoMemory:
        def largest_step(self, pairs, y, dy, *, detect):
            raise MemoryError("std::bad_alloc")

    with pytest.raises(integrate._StepError):
        integrate._largest_step(NoMemory(), None, np.zeros((1, 3)), np.ones((1, 3)), detect=False)
    # The limit is on the iterations of one step: a body that may not move at all bends nowhere.
    monkeypatch.setattr(integrate, "RUNAWAY", 1e-4)
    halving = NewtonSettings(max_halvings=0)
    assert sheet(newton=halving).reason is StepReason.NO_CONVERGENCE


def test_a_step_that_is_stuck_fails_soon(monkeypatch):
    # Wherever the body moves, the residual stays as it was: no trial is better than the start.
    true_evaluate, first = System.evaluate, []

    def evaluate(self, *args, **options):
        found = true_evaluate(self, *args, **options)
        first.append(found.residual.copy())
        found.residual[:] = first[0]
        return found

    monkeypatch.setattr(System, "evaluate", evaluate)
    result = sheet(newton=NewtonSettings(max_halvings=0), times=[0.02])
    assert result.reason is StepReason.NO_CONVERGENCE
    # Five searches of eight trials, not sixty.
    assert len(first) == 1 + 5 * 8


def bent_and_thickened(mesh, curvature=0.6, thickness=2.0):
    """Positions of a block of side 2 and thickness 1, bent to a curvature (1/mm) and thickened."""
    turn, z = curvature * (mesh.nodes[:, 0] - 1.0), thickness * (mesh.nodes[:, 2] - 0.5)
    radius = 1.0 / curvature - z
    across = 1.0 / curvature - radius * np.cos(turn)
    return np.stack([radius * np.sin(turn), mesh.nodes[:, 1], across], axis=1)


@pytest.mark.parametrize("start", [0.0, -0.45, 1.0])
def test_enhanced_strains_are_found_in_elements_that_are_much_thicker(start):
    # At twice the thickness a full step of Newton's method leads to a negative C33, where it stays;
    # and what an earlier state has left need not be admissible here.
    mesh = block("hex18", (1, 1, 1), (2.0, 2.0, 1.0), fibre=(0.8, 0.6, 0))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["C"],)))
    solid.enhanced_parameters += start
    state = solid.evaluate(bent_and_thickened(mesh), solid.initial_strain(), 0.0)
    stress = np.einsum("eqi,eqi->eq", solid.direction, state.stress)
    balance = np.einsum("eq,eq,qm->em", solid.volumes, stress, solid.polynomials)
    assert np.abs(balance).max() < 1e-9 * np.abs(solid.volumes * stress).sum()
    assert np.abs(state.alpha).max() > 1.0


def test_positions_without_equilibrium_in_an_element_are_inadmissible(monkeypatch):
    mesh = block("hex18", (1, 1, 1), (2.0, 2.0, 1.0), fibre=(0.8, 0.6, 0))
    solid = Solid(mesh, BiotLaw.of((MATERIALS["C"],)))
    x, strain = bent_and_thickened(mesh), solid.initial_strain()
    assert np.isfinite(solid.evaluate(x, strain, 0.0).stress).all()
    monkeypatch.setattr("mvest.mechanics.solid.ENHANCED_ITERATIONS", 2)
    solid.reset()
    assert np.isnan(solid.evaluate(x, strain, 0.0).stress).all()
