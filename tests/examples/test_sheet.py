"""Two finite-element codes that share nothing but the problem, and the filters that use them."""

import importlib.util
import sys

import numpy as np
import pytest

from mvest.errors import ConfigurationError, InputError
from mvest.estimation import Gaussian, IteratedFilter, Log
from mvest.exchange.external.contract import Command, RunRequest, read_answer, write_request
from mvest.exchange.external.model import ProcessModel
from tests.places import ROOT

pytest.importorskip("skfem")

FILE = ROOT / "examples" / "sheet.py"


def _imported():
    spec = importlib.util.spec_from_file_location("example_sheet", FILE)
    module = sys.modules["example_sheet"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


EXAMPLE = _imported()
LAWS, PARAMETERS = EXAMPLE.LAWS, EXAMPLE.PARAMETERS
OwnSheet, SecondSheet, Sheet = EXAMPLE.OwnSheet, EXAMPLE.SecondSheet, EXAMPLE.Sheet

TINY = Sheet(cells=(2, 2), observed=(4, 3), load_steps=2)
M = np.array([4.0, 1.5])


def green_to_stretch(seed):
    """A right Cauchy-Green tensor with distinct stretches, in no special direction."""
    rng = np.random.default_rng(seed)
    F = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
    return F.T @ F


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("C", [green_to_stretch(1), green_to_stretch(2), np.eye(3) * 1.1**2])
def test_stress_and_tangent_are_derivatives_of_the_energy(law, C):
    # S = dW/dE and D = dS/dE with E = (C - I)/2, by central differences; the third C has three
    # equal stretches, where an eigenvector formula with differences of eigenvalues divides by zero.
    lame, mu = np.array(3.0), np.array(0.7)

    def energy(C):
        if law == "biot":
            stretch = np.sqrt(np.linalg.eigvalsh(C))
            return 1.5 * (stretch.sum() - 3) ** 2 + 0.7 * np.sum((stretch - 1) ** 2)
        E = 0.5 * (C - np.eye(3))
        return 1.5 * np.trace(E) ** 2 + 0.7 * np.sum(E * E)

    S, D = LAWS[law](C, lame, mu)
    step = 1e-5
    for i in range(3):
        for j in range(3):
            d = np.zeros((3, 3))
            d[i, j] += 0.5
            d[j, i] += 0.5
            # A step in E is twice as large in C.
            slope = (energy(C + 2 * step * d) - energy(C - 2 * step * d)) / (2 * step)
            assert np.sum(S * d) == pytest.approx(slope, rel=1e-7, abs=1e-9)
            up, down = (LAWS[law](C + s * 2 * step * d, lame, mu)[0] for s in (1, -1))
            change = (D @ d.ravel()).reshape(3, 3)
            np.testing.assert_allclose(change, (up - down) / (2 * step), rtol=1e-6, atol=1e-8)


def test_the_codes_agree_to_rounding_with_the_same_elements_and_quadrature():
    # Same law, same triquadratic bricks, same Gauss points: one discrete problem, solved twice.
    own, second = OwnSheet(TINY, "hex27")(M), SecondSheet(TINY, thickness_points=2)(M)
    assert own.converged
    assert second.converged
    moved = np.abs(own.y.reshape(-1, 3) - TINY.points).max()
    assert moved > 2.0  # mm: large displacements, more than the thickness twice
    np.testing.assert_allclose(second.y, own.y, atol=1e-8)
    np.testing.assert_allclose(second.jacobian, own.jacobian, atol=1e-7)


def test_each_model_estimates_from_the_other_s_data():
    own, second = OwnSheet(TINY, "hex27"), SecondSheet(TINY, thickness_points=2)
    prior = Gaussian(np.array([2.0, 3.0]), np.diag([9.0, 9.0]))
    for y, model in ((own(M).y, second), (second(M).y, own)):
        found = IteratedFilter(tolerance=1e-6)(
            model, prior, y, 1e-8, names=PARAMETERS, transform=Log()
        )
        assert found.converged
        # Noise of 1e-4 mm against a prior of 3 MPa: nothing but the data counts.
        np.testing.assert_allclose(found.mean, M, rtol=1e-5)


@pytest.mark.parametrize(
    "change", [{"thickness": float("nan")}, {"poisson": 0.5}, {"cells": (3, 2)}, {"load_steps": 0}]
)
def test_an_inadmissible_sheet_is_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        Sheet(**change)
    with pytest.raises(ConfigurationError, match="st_venant_kirchhoff"):
        SecondSheet(TINY, "hooke")


def test_the_program_predicts_what_the_library_predicts(tmp_path):
    expected = SecondSheet(TINY)(M)
    program = ProcessModel(
        Command((sys.executable, str(FILE), "{request}", "{folder}"), {}, 60.0),
        tmp_path,
        PARAMETERS,
        len(TINY.points),
        units=("MPa", "MPa"),
        settings={"cells": [2, 2], "observed": [4, 3], "load_steps": 2},
    )
    answer = program(M)
    assert answer.converged, answer.reason
    # Another process may add up in another order; files that lose digits would show at 1e-7.
    np.testing.assert_allclose(answer.y, expected.y, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(answer.jacobian, expected.jacobian, rtol=1e-10, atol=1e-12)
    assert program.runs == 1


def test_the_program_passes_on_a_failure(tmp_path):
    settings = {"length": 24.0, "cells": [2, 2], "observed": [2, 3], "law": "biot"}
    parameters = [{"name": n, "value": v} for n, v in zip(PARAMETERS, (-1.0, 1.0), strict=True)]
    request = RunRequest(parameters=parameters, points=6, settings=settings)
    write_request(tmp_path, request)
    assert EXAMPLE.main([str(tmp_path / "request.json"), str(tmp_path)]) == 0
    assert "expected positive moduli" in read_answer(tmp_path, request).reason
