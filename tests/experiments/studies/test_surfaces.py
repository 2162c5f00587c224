"""Moduli from surfaces as they arrive: exports, imports, and what is said of the estimates."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from experiments.common.building import patient_store
from experiments.common.cases import blind
from experiments.common.records.record import Outcome
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.surfaces import study
from experiments.studies.surfaces.doors import arrive
from experiments.studies.surfaces.findings import SurfaceError, thickness_error
from experiments.studies.surfaces.report import (
    surfaces_answer,
    surfaces_frame,
    surfaces_words,
    write_surfaces,
)
from experiments.studies.surfaces.settings import DoorSettings, Settings
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.errors import ConfigurationError, InputError
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, Ground, Verdict
from mvest.reporting.case.findings import PosteriorCheck
from mvest.simulation.virtual_patient import Hidden, VirtualPatient
from tests.cases.folders import template_case
from tests.experiments.configured import composed, plain
from tests.experiments.studies.made_up import made_up
from tests.experiments.studies.made_up_patients import findings_of, patient
from tests.made_up_closure import TRUE, made_up_case

PATIENT = template_case(64, 16)
CLOSED = PATIENT.frame(Role.CLOSED)
OFF = np.array([0.3, 0.0, 0.0])
"""mm, errors of the closed frame of the patient's case."""
REGISTRATION = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
"""The leaflets of the closed frame are seen 1 mm towards +y of where tips are said to be."""
DOORS = {
    "vertices": DoorSettings(kind="vertices", label="vertices"),
    "surfaces": DoorSettings(kind="surfaces", label="surfaces"),
    "with errors": DoorSettings(kind="surfaces", label="with errors", seen_with_errors=True),
    "slicerheart": DoorSettings(kind="slicerheart", label="SlicerHeart"),
    "labels": DoorSettings(kind="labels", label="labels", voxel_mm=0.8),
    "closed": DoorSettings(kind="labels", label="closed", voxel_mm=0.8, closed=True),
}


def through(door, folder):
    """The template with errors in its closed frame, as it arrives."""
    seen = replace(CLOSED, vertices=CLOSED.vertices + OFF)
    case = replace(PATIENT, frames=(PATIENT.frame(Role.REFERENCE), seen))
    return arrive(case, CLOSED.vertices, REGISTRATION, DOORS[door], folder)


def laid_out_by(door):
    """Whether nothing but surfaces and tips goes through."""
    return door in ("slicerheart", "labels", "closed")


# Half a thickness is 0.6 mm, the shift to LPS 144 mm; 0.3 mm to one side are less off a surface.
@pytest.mark.parametrize(
    ("door", "corresponds", "opened_mm", "closed_mm"),
    [
        ("vertices", True, (0.0, 1e-9), (0.05, 0.3)),
        ("surfaces", False, (0.0, 1e-9), (0.0, 1e-9)),
        ("with errors", False, (0.0, 1e-9), (0.05, 0.3)),
        ("slicerheart", False, (0.0, 0.06), (0.0, 0.06)),
        pytest.param("labels", False, (0.02, 0.2), (0.0, 1e-5), marks=pytest.mark.slow),
        pytest.param("closed", False, (0.02, 0.2), (0.02, 0.2), marks=pytest.mark.slow),
    ],
)
def test_surfaces_arrive_where_they_are(door, corresponds, opened_mm, closed_mm, tmp_path):
    if door == "slicerheart":
        pytest.importorskip("pyvista", reason="needs VTK, which comes with the extra viz")
    arrived = through(door, tmp_path)
    case = arrived.case
    assert case.frame(Role.CLOSED).corresponds is corresponds
    assert case.frame(Role.CLOSED).pressure_mmHg == CLOSED.pressure_mmHg
    assert case.simulated
    for frame, true, (low, high) in (
        (case.frame(Role.REFERENCE), arrived.opened, opened_mm),
        (case.frame(Role.CLOSED), arrived.closed, closed_mm),
    ):
        error = SurfaceError.of(frame, true)
        assert low <= error.there_mm <= high
        assert low <= error.back_mm <= high
        # The left tip is the antero-lateral one, in whatever axes.
        tips = case.frame(Role.REFERENCE).papillary_tips
        assert np.sort(tips, axis=0) == pytest.approx(
            np.sort(arrived.opened.papillary_tips, axis=0), abs=1e-2
        )
    # Of what is imported the tips are where they are in the image that shows the leaflets.
    tips = case.frame(Role.CLOSED).papillary_tips
    moved = np.linalg.norm(tips - arrived.closed.papillary_tips, axis=1)
    assert moved == pytest.approx(1.0 if laid_out_by(door) else 0.0, abs=1e-2)
    off = thickness_error(case, arrived.opened, PATIENT.surface.thickness)
    assert abs(off.mean_mm) < 0.1
    laid_out = any("laid out" in sentence for sentence in case.derived)
    assert laid_out is laid_out_by(door)


def test_a_door_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(
        ConfigurationError, match=r"door\.kind = 'window', expected one of vertices"
    ):
        arrive(
            PATIENT, CLOSED.vertices, REGISTRATION, DoorSettings(kind="window", label=""), tmp_path
        )
    no_voxels = replace(DOORS["labels"], voxel_mm=None)
    with pytest.raises(ConfigurationError, match=r"door\.voxel_mm is not given"):
        arrive(PATIENT, CLOSED.vertices, REGISTRATION, no_voxels, tmp_path)


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A job whose patient is a formula."""

    def simulate(name, description, template, values, simulation, mechanics, rng):
        exact = made_up_case()
        positions = {frame.name: frame.vertices for frame in exact.frames}
        return VirtualPatient(made_up_case(0.3, 8.0, rng), Hidden(dict(TRUE), positions))

    monkeypatch.setattr(patient_store, "simulate_patient", simulate)
    values = plain(
        composed("experiment=surfaces", "door=surfaces", "seed=1", f"paths.outputs={tmp_path}")
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
        findings = findings_of(patient().findings.case)
        rows = tuple(replace(row, truth=None) for row in findings.case.unknowns)
        check = PosteriorCheck("curvature", 0.1, 0.25)
        case = replace(findings.case, unknowns=rows, verdict=Verdict(TRUSTWORTHY), posterior=check)
        return Outcome(findings=replace(findings, case=case), reason="converged")

    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    outcome = study.run_surfaces(job)
    found = outcome.findings
    assert not given["case"].frame(Role.CLOSED).corresponds
    assert json.loads((given["sealed"] / "hidden.json").read_text())["values"] == TRUE
    assert [row.truth for row in found.moduli] == [TRUE["E_f.anterior"], TRUE["E_f.posterior"]]
    assert [row.estimate for row in found.moduli] == [5.8, 2.1]
    assert all(row.truth is None for row in found.nuisances)
    assert found.closed.there_mm < 1e-6
    assert (found.verdict.trust, found.posterior.value) == (TRUSTWORTHY, 0.1)


def test_an_estimation_that_leaves_nothing_is_a_failure_with_its_prior(job, monkeypatch):
    def blindly(*_):
        raise InputError("does not close")

    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    outcome = study.run_surfaces(job)
    assert (outcome.status, outcome.reason) == ("failed", "does not close")
    found = outcome.findings
    assert found.verdict is None
    assert [(row.estimate, row.prior_mean) for row in found.moduli] == [(None, 6.23), (None, 2.09)]
    assert [row.truth for row in found.moduli] == [TRUE["E_f.anterior"], TRUE["E_f.posterior"]]


def record_of(name, kind, trust, estimates):
    """A run with intervals of 10 % about its estimates; truths are 6 and 2."""
    rows = tuple(
        replace(
            row,
            estimate=value,
            low=value and 0.9 * value,
            high=value and 1.1 * value,
        )
        for row, value in zip(patient().findings.case.unknowns[:2], estimates, strict=True)
    )
    grounds = () if trust == TRUSTWORTHY else (Ground("approximation", trust, "bent", "sample"),)
    exact = SurfaceError(0.03, 0.05, 0.2)
    found = study.Findings(
        patient=name,
        kind=kind,
        door=DOORS[kind].label,
        opened=exact,
        closed=exact,
        thickness=study.thickness_error(PATIENT, PATIENT.frame(Role.REFERENCE), np.ones(64 * 16)),
        derived=(),
        moduli=rows,
        posterior=PosteriorCheck("curvature", 0.4, 0.25),
        verdict=Verdict(trust, grounds),
        reason="converged",
        cpu_s=61.0,
    )
    return made_up(found, experiment="surfaces", table="surfaces", title="Surfaces")


RECORDS = {
    "c": record_of("drawn_1", "labels", NONE, (9.0, 2.0)),
    "a": record_of("drawn_1", "vertices", TRUSTWORTHY, (6.3, 2.1)),
    "b": record_of("drawn_1", "slicerheart", DOUBTFUL, (9.0, 2.0)),
    "d": record_of("drawn_2", "labels", NONE, (None, None)),
}


def test_what_is_not_stated_is_not_counted(tmp_path):
    answer = surfaces_answer(RECORDS)
    assert "Vertices: 1 trustworthy; 2 of 2 moduli inside, median error 5 %" in answer
    assert "SlicerHeart: 1 doubtful; 1 of 2 moduli inside, median error 25 %" in answer
    # Errors of estimates whose verdict is none would be 50 % and 0 %.
    assert "Labels: 2 none." in answer
    written = write_surfaces(tmp_path, RECORDS, {})
    assert {path.suffix for path in written} >= {".csv", ".md", ".png"}
    lines = (tmp_path / "surfaces.md").read_text().splitlines()
    table = [line for line in lines if line.startswith("| drawn")]
    # Patient by patient, doors in one order; no interval is without its verdict.
    assert [line.split(" | ")[1] for line in table] == [
        "vertices",
        "SlicerHeart",
        "labels",
        "labels",
    ]
    assert "9 (8.1 to 9.9) ✗" in table[1]
    assert "(9 (8.1 to 9.9) ✗)" in table[2]
    assert "0.4 (0.25)" in table[1]
    assert any("drawn 1, SlicerHeart: doubtful, since bent." in line for line in lines)
    assert any("generic guess" in line for line in lines)


def test_the_table_has_every_modulus_of_every_run(tmp_path):
    frame = surfaces_frame(list(RECORDS.values()))
    assert len(frame) == 2 * len(RECORDS)
    assert frame["inside"].isna().sum() == 2
    write_surfaces(tmp_path, RECORDS, {})
    kept = pd.read_csv(tmp_path / "surfaces.csv", comment="#")
    assert kept["truth [MPa]"].tolist() == [6.0, 2.0] * 4
    assert kept["grounds"].fillna("").str.contains("bent").sum() == 6
    assert "drawn_1, SlicerHeart: doubtful" in surfaces_words(RECORDS["b"])
