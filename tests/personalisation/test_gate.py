"""The gate of a case: which variations it can be asked, at which parameters, and what is said."""

import numpy as np
import pytest

from mvest.closure.robustness import GATE_CASES, GateReport, GateRow
from mvest.closure.smoothness import Path
from mvest.personalisation import model
from mvest.personalisation.model import gate_case, gate_lines
from mvest.personalisation.settings import PersonaliseSettings, Prior
from tests.closure.test_model import GENTLE, MODULI, SMALL, TINY, model_of, settings_of


@pytest.fixture
def asked(monkeypatch):
    """What the gate is run with on a case whose model is ``model_of``'s."""

    def ask(**changes):
        seen = {}

        def run(build, m, cases):
            seen.update(build=build, m=m, cases=cases)
            return "report"

        monkeypatch.setattr(model, "run_gate", run)
        monkeypatch.setattr(model, "build_model", lambda *_: model_of(GENTLE, **SMALL, **changes))
        unknowns = (Prior(MODULI[1], 3.0, 1.0), Prior(MODULI[0], 5.0, 1.0))
        assert gate_case(None, PersonaliseSettings(unknowns, settings_of(GENTLE))) == "report"
        return seen

    return ask


def test_a_case_is_asked_what_its_own_mesh_can_answer(asked):
    seen = asked()
    left_out = {case.name for case in GATE_CASES} - {case.name for case in seen["cases"]}
    assert left_out == {"mesh x 1.5", "contact samples x 1.33", "followed on coarser meshes"}
    # In the model's order, whatever that of the unknowns.
    np.testing.assert_array_equal(seen["m"], [5.0, 3.0])
    (perturbed, *_) = (case for case in seen["cases"] if case.perturbed)
    assert seen["build"](perturbed).perturbation is not None


def test_a_guided_case_is_also_closed_with_its_guide(asked):
    seen = asked(guide=model_of(GENTLE, **TINY))
    (guided,) = (case for case in seen["cases"] if case.guided)
    assert seen["build"](guided).guide is not None
    assert seen["build"](seen["cases"][0]).guide is None


def test_the_verdict_comes_first_and_then_what_it_fails_by():
    rows = (
        GateRow("reference", 0.0, 0.0, True, "converged"),
        GateRow("time step / 2", float("nan"), float("nan"), False, "it buckled"),
        GateRow("ramp / 3", 0.04, 0.7, False, "converged"),
    )
    jumping = Path("E_f", (), 3, "a jump of 0.3 mm")
    paths = (jumping, Path("E_f.anterior", (), 3, ""))
    first, *others = gate_lines(GateReport(rows, paths))
    assert "gate NOT passed" in first
    assert "2 variations, 0.7 mm at most" in first
    assert len(others) == 3
    assert "time step / 2" in others[0]
    assert "it buckled" in others[0]
    assert "0.7 mm off" in others[1]
    assert "along E_f: a jump of 0.3 mm" in others[2]
    calm = gate_lines(GateReport(rows[:1], paths[1:]))
    assert len(calm) == 1
    assert "gate passed" in calm[0]
