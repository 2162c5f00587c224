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
