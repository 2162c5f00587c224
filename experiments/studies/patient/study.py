"""Virtual patients: simulated, estimated by a process that cannot see the truth, then revealed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.gate import gate_of
from experiments.common.building.patient_store import PatientPlace, make_patient
from experiments.common.building.virtual_patients import PatientSettings
from experiments.common.cases.blind import estimate_blindly
from experiments.common.cases.findings import Findings, Revealed
from experiments.common.cases.own_case import FIELDS, expect_own
from experiments.common.cases.report import case_text, write_case_run
from experiments.common.records.record import NOT_GATED, Outcome
from experiments.common.schema import build
from experiments.common.study import Job, Section, Study
from experiments.studies.patient.calibration import calibration_answer
from experiments.studies.patient.report import (
    arrays_of_patient,
    distances_answer,
    kept_of_patient,
    patients_answer,
    write_patients,
)
from experiments.studies.patient.settings import Settings
from experiments.studies.patient.tables import PATIENTS
from mvest.reading.npz import read_npz
from mvest.reporting.case.findings import FrameDistances, ModuliAlone, ToTruth, UnknownRow
from mvest.reporting.findings import Spread
from mvest.typing import FloatArray

__all__ = ["STUDY", "reveal", "run_patient"]

Values = Mapping[str, Any]


def run_patient(job: Job[Settings]) -> Outcome[Findings]:
    """Simulate, estimate apart, reveal."""
    patient = job.settings.patient
    place = make_patient(job.values, patient)
    # One that is drawn has another anatomy than the one configured.
    gate = NOT_GATED if patient.variation else gate_of(job.values)
    estimated = estimate_blindly(job.values, job.folder, place.case, place.hidden, gate)
    return reveal(estimated, place, job.folder / FIELDS, patient, job.values["seed"])


def reveal(
    estimated: Outcome[Findings],
    place: PatientPlace,
    fields: Path,
    patient: PatientSettings,
    seed: int,
) -> Outcome[Findings]:
    """The outcome of an estimation, beside what its case had hidden.

    The true positions are added to its arrays in the file ``fields``.

    Raises
    ------
    InputError
        If the patient hides nothing.
    """
    hidden, positions = place.truth()
    truth, case = hidden["values"], estimated.findings.case
    moduli = []
    for modulus in case.moduli:
        name = f"E_f.{modulus.region}"
        (own,) = [row.estimate for row in case.unknowns if row.name == name]
        assert own is not None
        moduli.append(replace(modulus, truth=modulus.estimate / own * truth[name]))
    revealed = replace(
        case,
        unknowns=_known(case.unknowns, truth),
        moduli=tuple(moduli),
        without_nuisances=_alone(case.without_nuisances, truth),
        as_in_the_paper=_alone(case.as_in_the_paper, truth),
        distances=_to_truth(case.distances, positions, fields),
    )
    drawn = Revealed(
        hidden["anatomies_drawn"], patient.paper_moduli, patient.paper_distance_mm, patient.world
    )
    (run,) = estimated.findings.repeats
    true = (truth[name] for name in estimated.parameters)
    errors = run.estimate and tuple((a - b) / b for a, b in zip(run.estimate, true, strict=True))
    run = replace(run, relative_error=errors, seed=seed)
    findings = replace(estimated.findings, case=revealed, repeats=(run,), revealed=drawn)
    return replace(estimated, findings=findings)


def _known(rows: tuple[UnknownRow, ...], truth: Mapping[str, float]) -> tuple[UnknownRow, ...]:
    return tuple(replace(row, truth=truth[row.name]) for row in rows)


def _alone(alone: ModuliAlone | None, truth: Mapping[str, float]) -> ModuliAlone | None:
    return None if alone is None else replace(alone, parameters=_known(alone.parameters, truth))


def _to_truth(
    distances: tuple[FrameDistances, ...], positions: Mapping[str, FloatArray], fields: Path
) -> tuple[FrameDistances, ...]:
    """Distances to where the valve truly was, whose shape is put among the arrays."""
    if not fields.is_file():
        return distances
    arrays: dict[str, Any] = read_npz(fields)
    frames = [str(name) for name in arrays["frames"]]
    arrays["truth"] = np.stack([positions[name] for name in frames]).astype(np.float32)
    np.savez_compressed(fields, **arrays)

    def off(name: str, k: int) -> Spread:
        return Spread.of(np.linalg.norm(arrays[name][k] - arrays["truth"][k], axis=1))

    return tuple(
        replace(row, to_truth=ToTruth(off("generic", k), off("registered", k), off("fitted", k)))
        for k, row in enumerate(distances)
    )


def expect_patient(values: Values, folder: Path | None = None) -> str:
    """The answer for the case of a virtual patient, which is simulated first unless it is there.

    Raises
    ------
    MvestError
        If the configuration is inadmissible or the patient's valve does not close.
    """
    patient = values["patient"] and build(PatientSettings, values["patient"])
    return expect_own({**values, "case": str(make_patient(values, patient).case)}, folder)


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_patient,
    words=case_text,
    write=write_patients,
    write_run=write_case_run,
    keep=kept_of_patient,
    keep_arrays=arrays_of_patient,
    keeps_failures=True,
    checks=lambda: (expect_patient,),
    sections=(
        Section(
            "table2",
            title="Table 2: moduli of five virtual patients (simulated)",
            table=PATIENTS,
            answer=patients_answer,
            headline=True,
        ),
        Section(
            "table3",
            {
                "figure3": "Figure 3: closed valves coloured by their distance from what was "
                "observed, "
                "with generic and with personalised stiffness, on one scale. Drawn are "
                "midsurfaces: leaflets that touch lie a thickness apart, and what"
                " opens between them is white or, where it is known to be no leak, grey; a "
                "gap is red. Simulated."
            },
            "Table 3: distances of their closed valves (simulated)",
            table=PATIENTS,
            answer=distances_answer,
            headline=True,
            opens="figure3",
        ),
        Section(
            "population",
            {
                "population": "Estimates with their 95 % intervals against the hidden truth. "
                "Simulated."
            },
            "Virtual patients drawn at random (simulated)",
            answer=patients_answer,
            headline=True,
            opens="population",
        ),
        Section(
            "calibration",
            {
                "calibration": "Where the truth lies in the posterior: difference of its "
                "distribution from the uniform one, and where that of right intervals stays in 95 "
                "of 100 samples (grey). Simulated."
            },
            "Estimates in worlds that are not as they assume (simulated)",
            answer=calibration_answer,
            headline=True,
            opens="calibration",
        ),
    ),
)
