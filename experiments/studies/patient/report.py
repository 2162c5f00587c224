"""What the results keep of virtual patients, and the tables that follow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.cases.findings import Findings
from experiments.common.cases.skill import skill_words
from experiments.common.records.record import Record
from mvest.reading.npz import read_npz
from mvest.reporting.case.findings import CaseFindings, UnknownRow

__all__ = [
    "arrays_of_patient",
    "distances_answer",
    "kept_of_patient",
    "moduli_of_patients",
    "patients_answer",
    "write_patients",
]

KEPT_ARRAYS = (
    "triangles", "region", "rest", "annulus", "free_edge", "frames", "seen", "tips", "chord_tip",
    "chord_insertion", "generic", "fitted", "distance_generic", "distance_fitted",
    "reach_mm",
)  # fmt: skip
"""Arrays that Figure 3 needs."""


def write_patients(
    folder: Path, records: Mapping[str, Record[Findings]], arrays: Mapping[str, Path]
) -> list[Path]:
    """Tables 2 and 3 and Figure 3, or the table of the population or of the worlds."""
    from experiments.studies.patient.calibration import CALIBRATION, write_calibration_tables
    from experiments.studies.patient.population import write_population_tables
    from experiments.studies.patient.tables import POPULATION, in_order, write_patient_tables

    kept = in_order(records)
    table = next(iter(records.values())).table
    if table == CALIBRATION:
        return write_calibration_tables(folder, list(kept.values()))
    if table == POPULATION:
        return write_population_tables(folder, list(kept.values()))
    return write_patient_tables(folder, kept, arrays)


def moduli_of_patients(records: Iterable[Record[Findings]]) -> list[UnknownRow]:
    """The modulus of each leaflet of each patient."""
    unknowns = [row for record in records for row in record.findings.case.unknowns]
    return [row for row in unknowns if row.is_modulus]


def patients_answer(records: Mapping[str, Record[Findings]]) -> str:
    """How good the moduli of the patients are, in one line."""
    words = skill_words(moduli_of_patients(records.values()))
    return f"{len(records)} simulated patients, known geometry: {words}"


def distances_answer(records: Mapping[str, Record[Findings]]) -> str:
    """How near fitted valves come to observed ones, seen and held out, beside the generic."""
    words = []
    for seen, label in ((True, "shown to the filter"), (False, "held out")):
        frames = [
            frame
            for record in records.values()
            for frame in record.findings.case.distances
            if frame.seen is seen
        ]
        if frames:
            own, generic = (
                float(np.mean([spread.mean for spread in spreads]))
                for spreads in (
                    [frame.personalised for frame in frames],
                    [frame.generic for frame in frames],
                )
            )
            words.append(f"{own:.2f} mm in frames {label} (generic {generic:.2f} mm)")
    return (
        f"{len(records)} simulated patients: personalised valves close {', '.join(words)} from "
        "the observed ones, on average."
    )


def kept_of_patient(record: Record[Findings]) -> Record[Findings]:
    """What tables need of a record; the settings are in ``conf``."""
    from experiments.studies.patient.calibration import CALIBRATION
    from experiments.studies.patient.tables import POPULATION

    case = record.findings.case
    if record.table == POPULATION:
        case = replace(case, settings={}, measurements={})
    elif record.table == CALIBRATION:
        case = CaseFindings(
            about=case.about,
            converged=case.converged,
            reason=case.reason,
            unknowns=case.unknowns,
            correlation=case.correlation,
            innovation=case.innovation,
            errors=case.errors,
            verdict=case.verdict,
        )
    return replace(record, findings=replace(record.findings, case=case))


def arrays_of_patient(record: Record[Findings], path: Path) -> dict[str, Any]:
    """Arrays that Figure 3 needs, in single precision."""
    from experiments.studies.patient.tables import PATIENTS

    if record.table != PATIENTS:
        return {}
    stored = read_npz(path)
    return {key: _small(stored[key]) for key in KEPT_ARRAYS if key in stored}


def _small(array: Any) -> Any:
    return array.astype(np.float32) if array.dtype == np.float64 else array
