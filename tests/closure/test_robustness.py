"""The gate with cheap stand-ins for the valve, whose states and derivatives are known by hand."""

import numpy as np
import pytest

from mvest.closure.robustness import GATE_CASES, SLOPE_LIMIT, GateCase, run_gate
from mvest.estimation import Prediction

OPEN = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
DIRECTION = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, -1], [0.5, 0, 0]])
AT = np.array([6.0, 2.0, 1.5])
BY_NAME = {case.name: case for case in GATE_CASES}


class Valve:
    """Closed points that move along ``DIRECTION`` by ``size`` times a power of the mean modulus.

    With all moduli times f the closed state is OPEN + size f^power DIRECTION at AT; the third
    parameter is no modulus and shifts everything by its value.
    """

    names = ("E_f.anterior", "E_f.posterior", "pressure_scale")

    def __init__(self, size=1.0, power=1, shift=None, reason=None):
        self.size, self.power, self.reason = size, power, reason
        self.shift = np.zeros((4, 3)) if shift is None else shift
        self.asked = []

    def __call__(self, m):
        self.asked.append(m)
        if self.reason:
            return Prediction.failed(self.reason)
        factor = (m[0] + m[1]) / 8.0
        closed = OPEN + self.size * factor**self.power * DIRECTION + self.shift + m[2]
        slope = self.size * self.power * factor ** (self.power - 1) / 8.0 * DIRECTION.ravel()
        jacobian = np.zeros((24, 3))
        jacobian[12:, 0] = jacobian[12:, 1] = slope
        jacobian[12:, 2] = 1.0
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
    # Linear in the modulus: what the derivative predicts is what happens.
    assert max(row.max_mm for row in report.rows) < 1e-12
    assert set(report.slopes) == {0.01, 0.05, 0.2}
    assert max(report.slopes.values()) < 1e-12


def test_the_cases_are_the_variations_that_must_not_matter():
    assert [(c.dt, c.mesh, c.activation, c.sampling) for c in GATE_CASES[:6]] == [
        (0.5, 1, 1, 1),
        (0.25, 1, 1, 1),
        (0.0625, 1, 1, 1),
        (1, 1, 0.9, 1),
        (1, 1, 1, 4 / 3),
        (1, 1.5, 1, 1),
    ]
    assert [c.modulus for c in GATE_CASES[6:]] == [1.2, 0.8, 1.05, 0.95, 1.01, 0.99]
    assert all(c.modulus == 1 for c in GATE_CASES[:6])


def test_only_the_moduli_are_multiplied():
    models = {case.name: Valve() for case in GATE_CASES}
    run_gate(built(models), AT)
    for case in GATE_CASES:
        asked = models[case.name].asked
        np.testing.assert_allclose(asked, [[6 * case.modulus, 2 * case.modulus, 1.5]])


def test_slopes_are_those_of_the_central_differences():
    # Cubic: ((1 + h)^3 - (1 - h)^3) / 2h = 3 + h^2, so the relative difference is h^2 / 3, and the
    # deviation from the tangent (1 + h)^3 - 1 - 3h = 3 h^2 + h^3.
    report = run_gate(built(size=0.2, power=3), AT)
    assert report.slopes == pytest.approx({h: h * h / 3 for h in (0.01, 0.05, 0.2)}, rel=1e-6)
    rows = {row.case: row for row in report.rows}
    length = 0.2 * np.linalg.norm(DIRECTION, axis=1)
    for name, h in (("E_f + 20 %", 0.2), ("E_f - 20 %", -0.2), ("E_f + 1 %", 0.01)):
        off = abs(3 * h**2 + h**3) * length
        assert rows[name].mean_mm == pytest.approx(off.mean(), rel=1e-9)
        assert rows[name].max_mm == pytest.approx(off.max(), rel=1e-9)
    assert report.passed


def move(vertices, distance):
    shift = np.zeros((4, 3))
    shift[:vertices, 2] = distance
    return Valve(shift=shift)


@pytest.mark.parametrize("name", list(BY_NAME))
@pytest.mark.parametrize(
    ("vertices", "distance", "mean", "largest"),
    # Everything by more than 0.1 mm fails by its mean; one of four by 0.6 mm also by its maximum.
    [(4, 0.11, 0.11, 0.11), (1, 0.6, 0.15, 0.6)],
)
def test_a_jump_in_one_case_fails(name, vertices, distance, mean, largest):
    report = run_gate(built({name: move(vertices, distance)}), AT)
    assert not report.passed
    (row,) = [row for row in report.rows if not row.passed]
    assert row.case == name
    assert row.mean_mm == pytest.approx(mean)
    assert row.max_mm == pytest.approx(largest)


def test_the_limits_are_a_tenth_in_the_mean_and_half_a_millimetre_anywhere():
    # With 2 x 12 points one far point changes the mean little: only the maximum can see it.
    class Many(Valve):
        def __call__(self, m):
            one = super().__call__(m)
            open_, closed = one.y.reshape(2, -1)
            calm = OPEN + (m[0] + m[1]) / 8.0 * DIRECTION + m[2]
            y = np.concatenate([open_, open_, open_, closed, calm.ravel(), calm.ravel()])
            by_open, by_closed = np.split(one.jacobian, 2)
            return Prediction(y, np.concatenate([by_open] * 3 + [by_closed] * 3))

    def report(distance):
        shift = np.zeros((4, 3))
        shift[0, 0] = distance
        return run_gate(
            lambda case: Many(shift=shift) if case.mesh != 1 else Many(),
            AT,
            [BY_NAME["mesh x 1.5"]],
        )

    assert report(0.49).passed
    failed = report(0.51)
    assert failed.rows[1].mean_mm < 0.1
    assert not failed.rows[1].passed
    assert not failed.passed


def test_a_small_jump_beside_the_state_shows_in_the_slope_alone():
    # 0.02 mm at every vertex are within the limits, but over +-1 % they change the slope by
    # 0.02 mm / 0.02 = 1 mm per unit and vertex: |(0, 0, 1) x 4| / |DIRECTION| = 2 / sqrt(6.25).
    report = run_gate(built({"E_f + 1 %": move(4, 0.02)}), AT)
    assert all(row.passed for row in report.rows)
    assert report.slopes[0.01] == pytest.approx(0.8, rel=1e-6)
    assert report.slopes[0.05] < 1e-9 < SLOPE_LIMIT
    assert not report.passed


def test_a_failed_closure_is_a_row_with_its_reason():
    report = run_gate(built({"E_f - 5 %": Valve(reason="it buckled")}), AT)
    (row,) = [row for row in report.rows if not row.passed]
    assert (row.case, row.reason) == ("E_f - 5 %", "it buckled")
    assert np.isnan(row.mean_mm)
    assert np.isnan(row.max_mm)
    # The central difference at 5 % has lost one side and is not made up.
    assert set(report.slopes) == {0.01, 0.2}
    assert not report.passed


def test_without_a_reference_nothing_else_is_run():
    asked = []

    def build(case):
        asked.append(case.name)
        return Valve(reason="no convergence")

    seen = []
    report = run_gate(build, AT, on_case=seen.append)
    assert asked == ["reference"]
    assert not report.passed
    (row,) = report.rows
    assert row is seen[0]
    assert (row.case, row.passed, row.reason) == ("reference", False, "no convergence")


def test_each_row_is_told_as_it_is_finished():
    seen = []
    cases = [GateCase("time step / 2", dt=0.5), GateCase("E_f + 5 %", modulus=1.05)]
    report = run_gate(built(), AT, cases, on_case=seen.append)
    assert tuple(seen) == report.rows
    assert [row.case for row in seen] == ["reference", "time step / 2", "E_f + 5 %"]
    assert all(row.seconds >= 0 for row in seen)
    # One side alone is no central difference.
    assert report.slopes == {}
