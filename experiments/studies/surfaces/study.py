"""Virtual patients whose geometry goes through a door before an estimator sees it."""

from __future__ import annotations

import resource
import shutil
from dataclasses import replace

import numpy as np

from experiments.common.building.patient_store import make_patient
from experiments.common.cases.blind import estimated_or_reason
from experiments.common.cases.settings import PersonalSettings
from experiments.common.records.record import Outcome
from experiments.common.study import Job, Section, Study
from experiments.studies.surfaces.doors import arrive
from experiments.studies.surfaces.findings import Findings, SurfaceError, thickness_error
from experiments.studies.surfaces.report import surfaces_answer, surfaces_words, write_surfaces
from experiments.studies.surfaces.settings import Settings
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.cases.writer import write_case
from mvest.problem.registration import REGISTRATION
from mvest.reporting.case.findings import MODULUS, UnknownRow

__all__ = ["STUDY", "run_surfaces"]

CLOSED = "closed"
"""The closed frame of a virtual patient."""


def run_surfaces(job: Job[Settings]) -> Outcome[Findings]:
    """Simulate, export, import, estimate apart, reveal.

    Raises
    ------
    MvestError
        If the patient's valve does not close, or an importer refuses it.
    """
    place = make_patient(job.values, job.settings.patient)
    hidden, positions = place.truth()
    patient = read_case(place.case)
    for name in ("door", "case"):
        # Of an earlier run.
        shutil.rmtree(job.folder / name, ignore_errors=True)
    (job.folder / "door").mkdir()
    registration = np.array([hidden["values"][name] for name in REGISTRATION])
    arrived = arrive(
        patient, positions[CLOSED], registration, job.settings.door, job.folder / "door"
    )
    case = write_case(job.folder / "case", arrived.case)
    before = _cpu_of_children()
    estimated = estimated_or_reason(job.values, job.folder, case, place.hidden)
    cpu = _cpu_of_children() - before
    left = None if isinstance(estimated, str) else estimated.findings.case
    unknowns = _believed(job.settings.personal) if left is None else left.unknowns
    findings = Findings(
        patient=patient.name,
        kind=job.settings.door.kind,
        door=job.settings.door.label,
        opened=SurfaceError.of(arrived.case.frame(Role.REFERENCE), arrived.opened),
        closed=SurfaceError.of(arrived.case.frame(Role.CLOSED), arrived.closed),
        thickness=thickness_error(arrived.case, arrived.opened, patient.surface.thickness),
        derived=arrived.case.derived,
        moduli=tuple(
            replace(row, truth=hidden["values"][row.name]) for row in unknowns if row.is_modulus
        ),
        nuisances=tuple(row for row in unknowns if not row.is_modulus),
        posterior=None if left is None else left.posterior,
        verdict=None if left is None else left.verdict,
        reason=estimated if isinstance(estimated, str) else estimated.reason,
        cpu_s=cpu,
    )
    if isinstance(estimated, str):
        return Outcome(findings=findings, status="failed", reason=estimated)
    return Outcome(
        findings=findings,
        status=estimated.status,
        reason=estimated.reason,
        detail=estimated.detail,
        mesh=estimated.mesh,
        forward_solves=estimated.forward_solves,
        parameters=estimated.parameters,
        model=estimated.model,
        gate=estimated.gate,
    )


def _believed(personal: PersonalSettings) -> tuple[UnknownRow, ...]:
    """The moduli before anything was seen."""
    return tuple(
        UnknownRow(
            name=name,
            label=name.replace(".", " "),
            unit="MPa",
            kind=MODULUS,
            treatment=about.treatment,
            prior_mean=about.mean,
            prior_std=about.std,
        )
        for name, about in personal.unknowns.items()
        if name.startswith("E_f.")
    )


def _cpu_of_children() -> float:
    """S of all processes that were started from here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_surfaces,
    words=surfaces_words,
    write=write_surfaces,
    keeps_failures=True,
    sections=(
        Section(
            "surfaces",
            {
                "surfaces": "Moduli over their true values, by how the geometry arrived, with "
                "95 % intervals. Simulated."
            },
            "Moduli from surfaces as they arrive (simulated)",
            answer=surfaces_answer,
            headline=True,
            opens="surfaces",
        ),
    ),
)
