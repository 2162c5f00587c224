"""The gate of a case: its variations and parameters, and the lines of its report."""

import numpy as np
import pytest

from mvest.closure.robustness import GATE_CASES
from mvest.personalisation import model
from mvest.personalisation.model import gate_case
from mvest.personalisation.settings import PersonaliseSettings, Prior
from tests.closure.test_model import GENTLE, MODULI, SMALL, TINY, model_of, settings_of


@pytest.mark.parametrize("guided", [True, False])
def test_a_case_is_closed_under_the_variations_of_its_own_mesh(monkeypatch, guided):
    seen = {}
    guide = {"guide": model_of(GENTLE, **TINY)} if guided else {}
    built = model_of(GENTLE, **SMALL, **guide)
    monkeypatch.setattr(model, "build_model", lambda *_: built)
    monkeypatch.setattr(
        model, "run_gate", lambda build, m, cases: seen.update(build=build, m=m, cases=cases)
    )
    unknowns = (Prior(MODULI[1], 3.0, 1.0), Prior(MODULI[0], 5.0, 1.0))
    gate_case(None, PersonaliseSettings(unknowns, settings_of(GENTLE)))
    left_out = {case.name for case in GATE_CASES} - {case.name for case in seen["cases"]}
    remeshed = {"mesh x 1.5", "contact samples x 1.33"}
    assert left_out == (remeshed if guided else remeshed | {"followed on coarser meshes"})
    # In the model's order, whatever that of the unknowns.
    np.testing.assert_array_equal(seen["m"], [5.0, 3.0])
    for case in seen["cases"]:
        assert (seen["build"](case).perturbation is not None) == bool(case.perturbed)
        assert (seen["build"](case).guide is not None) == bool(case.guided)


def test_the_verdict_comes_first_and_then_the_failures():
    rows = (
        GateRow("reference", 0.0, 0.0, True, "converged"),
        GateRow("time step / 2", float("nan"), float("nan"), False, "it buckled"),
        GateRow("ramp / 3", 0.04, 0.7, False, "converged"),
    )
    paths = (Path("E_f", (), 3, "a jump of 0.3 mm"), Path("E_f.anterior", (), 3, ""))
    lines = gate_lines(GateReport(rows, paths))
    words = (
        ("gate NOT passed", "2 variations, 0.7 mm at most"),
        ("time step / 2", "it buckled"),
        ("0.7 mm off",),
        ("along E_f: a jump of 0.3 mm",),
    )
    for line, expected in zip(lines, words, strict=True):
        assert all(word in line for word in expected)
    (calm,) = gate_lines(GateReport(rows[:1], paths[1:]))
    assert "gate passed" in calm
