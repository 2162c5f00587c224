"""The scikit-fem sheet as a program says what the library says."""

import numpy as np
import pytest

from experiments.studies.models.settings import ModelsSettings
from experiments.studies.models.sheet.second import SecondSheet
from experiments.studies.models.sheet.sheet import PARAMETERS, Sheet
from experiments.studies.models.sheet.solver import main
from experiments.studies.models.study import sheet_program
from mvest.external import RunRequest, read_answer, write_request

pytest.importorskip("skfem")

TINY = Sheet(cells=(2, 2), observed=(2, 3), load_steps=2)
M = np.array([4.0, 1.5])
ABOUT = ModelsSettings(sheet=TINY, time_limit_s=60.0, relative_step=1e-3, processes=2)


def test_the_program_predicts_what_the_library_predicts(tmp_path):
    expected = SecondSheet(TINY)(M)
    program = sheet_program(ABOUT, tmp_path, derivatives=True)
    answer = program(M)
    assert answer.converged, answer.reason
    # Another process may add up in another order; files that lose digits would show at 1e-7.
    np.testing.assert_allclose(answer.y, expected.y, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(answer.jacobian, expected.jacobian, rtol=1e-10, atol=1e-12)
    alone = sheet_program(ABOUT, tmp_path, derivatives=False)
    found = alone(M)
    assert (program.runs, alone.runs) == (1, 5)
    # Central differences of a relative step s err by about s^2.
    size = np.abs(expected.jacobian).max()
    np.testing.assert_allclose(found.jacobian, expected.jacobian, atol=1e-5 * size)


def test_what_the_program_is_asked_wrongly_it_says(tmp_path, capsys):
    assert main([]) == 2
    assert main([str(tmp_path / "absent.json"), str(tmp_path)]) == 2
    assert "absent.json is missing" in capsys.readouterr().err


def test_the_program_passes_on_a_failure(tmp_path):
    about = {"length": 24.0, "cells": [2, 2], "observed": [2, 3]}
    request = RunRequest(
        PARAMETERS, ("MPa", "MPa"), (-1.0, 1.0), 6,
        settings={"sheet": about, "law": "biot", "derivatives": True},
    )  # fmt: skip
    write_request(tmp_path, request)
    assert main([str(tmp_path / "request.json"), str(tmp_path)]) == 0
    assert "expected positive moduli" in read_answer(tmp_path, request).reason
