"""Designs of frames and pressures for a virtual patient, and estimations with some of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from experiments.common.building.anatomy import template_of
from experiments.common.building.closure import mechanics_of
from experiments.common.building.virtual_patients import draw_patient_values
from experiments.common.cases.own_case import settings_of
from experiments.common.progress import say
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import NOT_GATED, Outcome
from experiments.common.study import Job, Section, Study
from experiments.studies.design.findings import Findings, Left, Tried
from experiments.studies.design.report import design_answer, design_words, write_design
from experiments.studies.design.settings import Corner, Settings
from mvest.errors import ConfigurationError, GeometryError
from mvest.personalisation.chain import personalise
from mvest.personalisation.design import ERRORS_MMHG, GROUPS, KINDS, FrameDesigns, StatedErrors
from mvest.personalisation.expectation import design_case
from mvest.personalisation.model import build_coarse
from mvest.personalisation.settings import PersonaliseSettings, PressureErrors
from mvest.simulation.virtual_patient import VirtualPatient, simulate_patient
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

__all__ = ["STUDY", "run_design"]

VALUES, ANATOMY, ERRORS = range(3)
"""Streams of random numbers, so that all designs are tried on the same valve."""


def run_design(job: Job[Settings]) -> Outcome[Findings]:
    """All designs of a patient's valve at the generic moduli, and estimations with some.

    Raises
    ------
    GeometryError
        If the patient's valve does not close.
    """
    patient = _patient(job, Corner())
    wanted = settings_of(job.values, job.settings.personal)
    geometries = {False: None, True: job.settings.frames.geometry}
    designs: dict[bool, FrameDesigns] = {}
    for considered, geometry in geometries.items():
        if considered and geometry is None:
            continue
        say(f"designs, geometry {'considered' if considered else 'exact'}")
        found = design_case(patient.case, replace(wanted, considered_geometry=geometry))
        if isinstance(found, str):
            raise GeometryError(f"the generic valve does not close in every frame: {found}")
        designs[considered] = found
    exact = designs[False]
    findings = Findings(
        moduli=exact.moduli,
        prior_std=tuple(exact.knowledge[modulus] for modulus in exact.moduli),
        pressures_mmHg=exact.pressures_mmHg,
        left=tuple(row for considered, own in designs.items() for row in _left(own, considered)),
        tried=tuple(
            row
            for name, corner in (job.settings.frames.corners or {}).items()
            for row in _tried(job, wanted, exact, name, corner)
        ),
    )
    mesh = build_coarse(patient.case, wanted).mesh
    return outcome_of(findings, mesh, 0, gate=NOT_GATED)


def _patient(job: Job[Settings], corner: Corner) -> VirtualPatient:
    """The patient as a design sees it: seen in its frames, with pressures off as it says."""
    settings, seed = job.settings.patient, job.values["seed"]
    pressures = corner.fitted_pressure_mmHg
    simulation = replace(
        settings.simulation,
        fitted_pressure_mmHg=pressures,
        fitted_relaxation=(0.0,) * len(pressures),
    )
    deviations = replace(
        settings.deviations,
        pressure=corner.factor,
        pressure_offset_mmHg=corner.offset_mmHg,
        pressure_each_mmHg=corner.each_mmHg,
    )
    drawn = replace(settings, simulation=simulation, deviations=deviations)
    values, anatomy, errors = (np.random.default_rng([seed, k]) for k in (VALUES, ANATOMY, ERRORS))
    template = Template(vary(template_of(job.values).parameters, anatomy, settings.variation))
    return simulate_patient(
        settings.name,
        settings.description,
        template,
        draw_patient_values(drawn, values),
        simulation,
        mechanics_of(job.values),
        errors,
    )


def _left(designs: FrameDesigns, considered: bool) -> Iterator[Left]:
    counts = range(1, len(designs.frames) + 1)
    names = {name.partition(".")[0] for name in designs.frames[0].names}
    for kind, mmhg, count in product(KINDS, ERRORS_MMHG, counts):
        errors = StatedErrors.of_kind(kind, mmhg, designs.pressures_mmHg[0])
        yield _row(designs, considered, kind, mmhg, count, "", errors)
    for count in counts:
        yield _row(designs, considered, "stated", 0.0, count, "")
        for words, group in GROUPS.items():
            if names & set(group):
                yield _row(designs, considered, "stated", 0.0, count, words, known=group)


def _row(
    designs: FrameDesigns,
    considered: bool,
    kind: str,
    mmhg: float,
    count: int,
    words: str,
    errors: StatedErrors | None = None,
    known: tuple[str, ...] = (),
) -> Left:
    shares = designs.left(count, errors, known)
    return Left(considered, kind, mmhg, count, words, tuple(shares.values()))


def _tried(
    job: Job[Settings],
    wanted: PersonaliseSettings,
    designs: FrameDesigns,
    name: str,
    corner: Corner,
) -> Iterator[Tried]:
    """What becomes of the moduli if the patient is estimated with a design."""
    say(f"estimated: {name}")
    count = 1 + len(corner.fitted_pressure_mmHg)
    members = [designs.pressures_mmHg[k] for k in designs.chosen(count)][1:]
    if not np.allclose(members, corner.fitted_pressure_mmHg):
        raise ConfigurationError(
            f"frames.corners.{name}.fitted_pressure_mmHg = {list(corner.fitted_pressure_mmHg)}, "
            f"expected those of the design of {count} frames: {members}"
        )
    stated = StatedErrors(corner.factor, corner.offset_mmHg, corner.each_mmHg)
    predicted = designs.left(count, stated)
    unknowns = tuple(
        replace(u, std=corner.factor) if u.name == "pressure_scale" else u for u in wanted.unknowns
    )
    pressures = PressureErrors(corner.offset_mmHg, corner.each_mmHg)
    patient = _patient(job, corner)
    fit = personalise(patient.case, replace(wanted, unknowns=unknowns, pressures=pressures))
    result, truth = fit.result, patient.hidden.values
    prior = {u.name: u for u in wanted.unknowns}
    for modulus, share in predicted.items():
        scale = designs.knowledge[modulus]
        row: dict[str, Any] = {"reported": None, "error": None}
        if result.estimate is not None and result.std is not None:
            k = fit.names.index(modulus)
            estimate = float(result.estimate[k])
            row["reported"] = float(result.std[k]) / estimate / scale
            row["error"] = float(np.log(estimate / truth[modulus])) / scale
        generic = float(np.log(prior[modulus].mean / truth[modulus])) / scale
        reason = result.reason
        yield Tried(name, modulus, share, generic=generic, reason=reason, **row)


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_design,
    words=lambda record: design_words({record.row: record}),
    write=write_design,
    sections=(
        Section(
            "design",
            {
                "design": "What more closed frames leave of the generic guess's error, where their "
                "pressures are off in one of three ways. Simulated."
            },
            answer=design_answer,
        ),
    ),
)
