"""The gate with cheap stand-ins for the valve, whose closed states are known by hand."""

import numpy as np
import pytest

from mvest.closure.robustness import GATE_CASES, PERTURBATION, GateCase, run_gate, vary
from mvest.errors import InputError
from mvest.estimation import Prediction
from tests.closure.test_model import GENTLE, SMALL, model_of

OPEN = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]] * 2)
DIRECTION = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, -1], [0.5, 0, 0]] * 2)
AT = np.array([6.0, 2.0, 1.5])
BY_NAME = {case.name: case for case in GATE_CASES}


class Valve:
    """Closed points that move along ``DIRECTION`` by ``size`` times a power of the mean modulus.

    With all moduli times f the closed state is OPEN + size f^power DIRECTION at AT; the third
    parameter is no modulus and shifts everything by its value. Above ``jump_at`` (of the mean
    modulus over that at AT) the first point is 0.3 mm higher.
    """

    names = ("E_f.anterior", "E_f.posterior", "pressure_scale")

    def __init__(self, size=1.0, power=1, shift=None, reason=None, jump_at=None):
        self.size, self.power, self.reason = size, power, reason
        self.shift = np.zeros((8, 3)) if shift is None else shift
        self.jump_at = jump_at
        self.asked = []

    def __call__(self, m):
        self.asked.append(m)
        if self.reason:
            return Prediction.failed(self.reason)
        factor = (m[0] + m[1]) / 8.0
        closed = OPEN + self.size * factor**self.power * DIRECTION + self.shift + m[2]
        if self.jump_at is not None and factor > self.jump_at:
            closed[0, 2] += 0.3
        slope = self.size * self.power * factor ** (self.power - 1) / 8.0 * DIRECTION.ravel()
        jacobian = np.zeros((48, 3))
        jacobian[24:, 0] = jacobian[24:, 1] = slope
        jacobian[24:, 2] = 1.0
        return Prediction(np.concatenate([OPEN.ravel(), closed.ravel()]), jacobian)


def built(changed=(), **options):
    """A builder of the same valve for all cases but those named in ``changed``."""
    changed = dict(changed)
    return lambda case: changed.get(case.name) or Valve(**options)


def test_one_closed_state_passes():
    report = run_gate(built(), AT)
    assert report.passed
    assert [row.case for row in report.rows] == ["reference", *BY_NAME]
    assert all(row.passed for row in report.rows)
    assert max(row.max_mm for row in report.rows) < 1e-12


def test_moduli_are_followed_together_and_one_by_one():
    valve = Valve()
    report = run_gate(lambda case: valve, AT, [])
    assert [path.name for path in report.paths] == ["E_f", "E_f.anterior", "E_f.posterior"]
    at = np.array(valve.asked)
    # Unchanged, then 4 states of all moduli, and 2 of each; never the pressure.
    np.testing.assert_allclose(at[0], AT)
    together, one, other = at[1:5], at[5:7], at[7:9]
    np.testing.assert_allclose(together[:, 0] / 6, [0.8, 0.95, 1.05, 1.2])
    np.testing.assert_allclose(together[:, 0] / 6, together[:, 1] / 2)
    np.testing.assert_allclose(one[:, 0] / 6, [0.8, 1.2])
    np.testing.assert_allclose(one[:, 1], 2)
    np.testing.assert_allclose(other[:, 1] / 2, [0.8, 1.2])
    np.testing.assert_allclose(other[:, 0], 6)
    np.testing.assert_allclose(at[:, 2], 1.5)
    assert [path.closures for path in report.paths] == [4, 2, 2]


def test_a_jump_along_the_moduli_fails():
    report = run_gate(built(jump_at=1.1), AT)
    assert not report.passed
    assert all(row.passed for row in report.rows)
    together, anterior, posterior = report.paths
    assert "a jump of 0.3 mm at 1 vertices between +8.56 % and +10.4 %" in together.reason
    # Alone the anterior modulus makes three quarters of the mean: it jumps at 1.133.
    assert "a jump of 0.3 mm at 1 vertices between +12" in anterior.reason
    assert posterior.passed


def move(vertices, distance):
    shift = np.zeros((8, 3))
    shift[:vertices, 2] = distance
    return Valve(shift=shift)


@pytest.mark.parametrize("name", ["time step / 2", "continued from E_f - 20 %"])
@pytest.mark.parametrize(
    ("vertices", "distance", "mean", "largest"),
    # Everything by more than 0.1 mm fails by its mean; one of eight by 0.6 mm by its maximum.
    [(8, 0.11, 0.11, 0.11), (1, 0.6, 0.075, 0.6)],
)
def test_a_jump_in_one_case_fails(name, vertices, distance, mean, largest):
    report = run_gate(built({name: move(vertices, distance)}), AT)
    assert not report.passed
    (row,) = [row for row in report.rows if not row.passed]
    assert row.case == name
    assert row.mean_mm == pytest.approx(mean)
    assert row.max_mm == pytest.approx(largest)


def test_a_continued_closure_ends_where_the_valve_is_closed_at_once():
    class Sticky(Valve):
        """Stays where it was closed first."""

        def __call__(self, m):
            self.first = getattr(self, "first", m)
            return super().__call__(self.first)

    case = BY_NAME["continued from E_f + 20 %"]
    valve = Valve()
    assert run_gate(lambda c: valve if c == case else Valve(), AT, [case]).passed
    np.testing.assert_allclose(valve.asked, [[7.2, 2.4, 1.5], AT])
    report = run_gate(lambda c: Sticky() if c == case else Valve(), AT, [case])
    assert report.rows[1].max_mm == pytest.approx(0.2 * 2)
    assert not report.passed


def test_a_failed_closure_is_a_row_with_its_reason():
    report = run_gate(built({"mesh x 1.5": Valve(reason="it buckled")}), AT)
    (row,) = [row for row in report.rows if not row.passed]
    assert (row.case, row.reason) == ("mesh x 1.5", "it buckled")
    assert np.isnan([row.mean_mm, row.max_mm]).all()
    assert not report.passed
    # Without a reference nothing else is run.
    report = run_gate(lambda case: Valve(reason="no convergence"), AT)
    assert not report.passed
    assert [(row.case, row.reason) for row in report.rows] == [("reference", "no convergence")]


def test_a_model_is_varied_as_its_case_says_and_begins_anew():
    model = model_of(GENTLE, **SMALL)
    model.continuation = True
    again = vary(model, GateCase("x", dt=0.5, ramp=0.5, activation=0.9, converged_path=True))
    old, new = model.settings, again.settings
    assert new.protocol.dt == 0.5 * old.protocol.dt
    assert new.protocol.ramp == 0.5 * old.protocol.ramp
    assert new.contact.activation_distance == 0.9 * old.contact.activation_distance
    assert new.newton.path_tolerance == old.newton.tolerance
    assert again.perturbation is None
    assert not again.continuation
    assert vary(model, GateCase("x", start=1.2)).continuation
    guided = vary(model_of(GENTLE, **SMALL, guide=model), GateCase("x", guided=True))
    assert guided.guide is not None
    assert vary(guided, GateCase("x")).guide is None
    for case in (GateCase("x", mesh=1.5), GateCase("x", sampling=2.0)):
        with pytest.raises(InputError, match="another mesh or other contact samples"):
            vary(model, case)


def test_a_perturbed_valve_closes_in_the_same_state():
    model = model_of(GENTLE, **SMALL)
    at = np.array([6.0, 2.0])[: len(model.names)]
    moved, other = (vary(model, GateCase("x", perturbed=seed)) for seed in (1, 2))
    assert np.linalg.norm(moved.perturbation, axis=1).max() == pytest.approx(PERTURBATION)
    assert np.abs(moved.perturbation - other.perturbation).max() > 0.5 * PERTURBATION
    here, there = (m.close(at, sensitivities=False).simulation for m in (model, moved))
    assert here.converged
    assert there.converged
    # It began elsewhere, and ends in the same equilibrium.
    assert np.abs(there.frames[0] - here.frames[0]).max() > 0.3
    np.testing.assert_allclose(there.frames[-1], here.frames[-1], atol=1e-6)
