"""Moduli from imported surfaces: geometry of each import, and estimates blind to the truth."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.common.building import patient_store
from experiments.common.cases import blind
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.surfaces import (
    Settings,
    run_surfaces,
    surface_error,
    thickness_error,
)
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.errors import InputError
from mvest.problem.verdict import TRUSTWORTHY, Verdict
from mvest.simulation.arrival import ArrivalSettings, arrive
from mvest.simulation.virtual_patient import VirtualPatient
from tests.cases.folders import template_case
from tests.experiments.configured import composed, plain
from tests.experiments.studies.made_up_patients import a_result
from tests.made_up_closure import TRUE, made_up_case

PATIENT = template_case(64, 16)
CLOSED = PATIENT.frame(Role.CLOSED)
OFF = np.array([0.3, 0.0, 0.0])
"""mm, errors of the closed frame of the patient's case."""
REGISTRATION = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
"""The leaflets of the closed frame are seen 1 mm towards +y of where tips are said to be."""
ARRIVALS = {
    "vertices": ArrivalSettings(kind="vertices", label="vertices"),
    "surfaces": ArrivalSettings(kind="surfaces", label="surfaces"),
    "with errors": ArrivalSettings(kind="surfaces", label="with errors", seen_with_errors=True),
    "slicerheart": ArrivalSettings(kind="slicerheart", label="SlicerHeart"),
    "labels": ArrivalSettings(kind="labels", label="labels", voxel_mm=0.8),
    "closed": ArrivalSettings(kind="labels", label="closed", voxel_mm=0.8, closed=True),
}


def through(kind, folder):
    """The template with errors in its closed frame, as it arrives."""
    seen = replace(CLOSED, vertices=CLOSED.vertices + OFF)
    case = replace(PATIENT, frames=(PATIENT.frame(Role.REFERENCE), seen))
    return arrive(case, CLOSED.vertices, REGISTRATION, ARRIVALS[kind], folder)


def laid_out_by(kind):
    """Whether nothing but surfaces and tips goes through."""
    return kind in ("slicerheart", "labels", "closed")


# Half a thickness is 0.6 mm, the shift to LPS 144 mm; 0.3 mm to one side are less off a surface.
# Triangles 2 mm wide lie 0.1 mm within scallops that bend with a radius of 5 mm.
@pytest.mark.parametrize(
    ("kind", "corresponds", "opened_mm", "closed_mm"),
    [
        ("surfaces", False, (0.0, 1e-9), (0.0, 1e-9)),
        ("with errors", False, (0.0, 1e-9), (0.05, 0.3)),
        ("slicerheart", False, (0.0, 0.1), (0.0, 0.1)),
        pytest.param("labels", False, (0.02, 0.2), (0.0, 1e-5), marks=pytest.mark.slow),
        pytest.param("closed", False, (0.02, 0.2), (0.02, 0.2), marks=pytest.mark.slow),
    ],
)
def test_surfaces_arrive_where_they_are(kind, corresponds, opened_mm, closed_mm, tmp_path):
    if kind == "slicerheart":
        pytest.importorskip("pyvista", reason="needs VTK, which comes with the extra viz")
    arrived = through(kind, tmp_path)
    case = arrived.case
    assert case.frame(Role.CLOSED).corresponds is corresponds
    assert case.frame(Role.CLOSED).pressure_mmHg == CLOSED.pressure_mmHg
    assert case.simulated
    for frame, true, (low, high) in (
        (case.frame(Role.REFERENCE), arrived.opened, opened_mm),
        (case.frame(Role.CLOSED), arrived.closed, closed_mm),
    ):
        assert low <= surface_error(frame, true) <= high
        assert low <= surface_error(true, frame) <= high
        # The left tip is the antero-lateral one, in whatever axes.
        tips = case.frame(Role.REFERENCE).papillary_tips
        assert np.sort(tips, axis=0) == pytest.approx(
            np.sort(arrived.opened.papillary_tips, axis=0), abs=1e-2
        )
    # Of what is imported the tips are where they are in the image that shows the leaflets.
    tips = case.frame(Role.CLOSED).papillary_tips
    moved = np.linalg.norm(tips - arrived.closed.papillary_tips, axis=1)
    assert moved == pytest.approx(1.0 if laid_out_by(kind) else 0.0, abs=1e-2)
    assert abs(thickness_error(arrived, PATIENT.surface.thickness)) < 0.1
    laid_out = any("laid out" in sentence for sentence in case.derived)
    assert laid_out is laid_out_by(kind)


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A job whose patient is a formula."""

    def simulate(name, description, template, values, simulation, mechanics, rng):
        exact = made_up_case()
        positions = {frame.name: frame.vertices for frame in exact.frames}
        return VirtualPatient(made_up_case(0.3, 8.0, rng), dict(TRUE), positions)

    monkeypatch.setattr(patient_store, "simulate_patient", simulate)
    values = plain(
        composed("experiment=surfaces", "arrival=surfaces", "seed=1", f"paths.outputs={tmp_path}")
    )
    folder = tmp_path / "job"
    folder.mkdir()
    return Job(values, build(Settings, values), folder)


def test_the_estimator_gets_the_case_and_not_the_truth(job, monkeypatch):
    given = {}

    def blindly(values, folder, case, sealed):
        given.update(case=read_case(case), sealed=sealed)
        text = b"".join(p.read_bytes() for p in folder.rglob("*") if p.is_file()).decode("latin-1")
        # Nothing of what is hidden lies outside the sealed folder.
        assert not [name for name in TRUE if name in text]
        found = a_result(5.8, 2.1)
        update = {"verdict": Verdict(TRUSTWORTHY)}
        estimates = (found.estimates[0].model_copy(update=update),)
        return found.model_copy(update={"estimates": estimates})

    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    result = run_surfaces(job)
    assert not given["case"].frame(Role.CLOSED).corresponds
    assert json.loads((given["sealed"] / "hidden.json").read_text())["values"] == TRUE
    (estimate,) = result.estimates
    assert [own.truth for own in estimate.moduli] == [TRUE["E_f.anterior"], TRUE["E_f.posterior"]]
    assert [own.estimate for own in estimate.moduli] == [5.8, 2.1]
    # Those of the patient's own case are not those of what was imported.
    assert all(own.truth is None for own in estimate.unknowns if not own.is_modulus)
    assert result.numbers["closed_back_mm"] < 1e-6
    assert (estimate.case, estimate.seed, result.row) == (given["case"].name, 1, "")


def test_an_estimation_that_leaves_nothing_is_a_failure_with_its_prior(job, monkeypatch):
    def blindly(*_):
        raise InputError("does not close")

    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    result = run_surfaces(job)
    assert (result.status, result.reason) == ("failed", "does not close")
    (estimate,) = result.estimates
    rows = estimate.moduli
    assert [(own.estimate, own.prior_mean) for own in rows] == [(None, 6.23), (None, 2.09)]
    assert [own.truth for own in rows] == [TRUE["E_f.anterior"], TRUE["E_f.posterior"]]
