"""Virtual patients whose geometry comes from files in other programs' formats.

The valve of a virtual patient is exported (as surfaces, a SlicerHeart folder or label maps),
imported, and estimated like a user's valve. The exports use no reader or writer of this project:
VTK (through PyVista) cuts and writes surfaces, pandas writes tables, and nibabel writes label maps.
"""

import shutil
from dataclasses import dataclass

import numpy as np

from experiments.common.building.patient_store import make_patient
from experiments.common.cases.own_case import PersonalSettings, case_words
from experiments.common.cases.revealed import (
    MODULUS_COLUMNS,
    Groups,
    estimate_hidden,
    modulus_row,
    short,
)
from experiments.common.records.record import Number, Record
from experiments.common.study import Job, Result, Results, Study
from mvest.cases.case import Frame
from mvest.cases.folder import read_case, write_case
from mvest.problem.record import EstimateRecord
from mvest.problem.registration import REGISTRATION
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.arrival import KINDS, ArrivalSettings, Arrived, arrive
from mvest.simulation.virtual_patient import PatientSettings
from mvest.typing import FloatArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import areas


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings
    arrival: ArrivalSettings


# -- run ------------------------------------------------------------------------------------------
def run_surfaces(job: Job[Settings]) -> Result:
    """Simulate, export, import, estimate in a separate process, then reveal the truth."""
    arrival, folder = job.settings.arrival, job.folder
    place = make_patient(job.values, job.settings.patient)
    hidden, positions = place.truth()
    patient = read_case(place.case)
    for name in ("arrival", "case"):  # from an earlier run
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / "arrival").mkdir()
    registration = np.array([hidden["values"][name] for name in REGISTRATION])
    arrived = arrive(patient, positions["closed"], registration, arrival, folder / "arrival")
    case = write_case(folder / "case", arrived.case)
    found = estimate_hidden(job.values, folder, case, place.hidden, job.settings.personal)
    numbers: dict[str, Number] = {"kind": arrival.kind, "geometry": arrival.label}
    for role, true in (("open", arrived.opened), ("closed", arrived.closed)):
        numbers[f"{role}_back_mm"] = surface_error(arrived.case.frame(true.role), true)
    numbers["thickness_mean_mm"] = thickness_error(arrived, patient.surface.thickness)
    seen = [arrived.case.frame(true.role) for true in (arrived.opened, arrived.closed)]
    off = area_strain(*seen) - area_strain(arrived.opened, arrived.closed)
    numbers |= zip(STRAINS, off.tolist(), strict=True)
    # The imported case lacks the displacements of the patient's case.
    truth = {name: hidden["values"][name] for name in hidden["values"] if name.startswith("E_f.")}
    about = {"case": patient.name, "seed": job.values["seed"]}
    (estimate,) = (one.model_copy(update=about).with_truth(truth) for one in found.estimates)
    return found.changed(tables={}, numbers=numbers, estimates=(estimate,), arrays={}, row="")


def surface_error(found: Frame, true: Frame) -> float:
    """Root mean square distance (mm) from the true midsurface's vertices to another surface."""
    distance = closest_points(true.vertices, found.vertices, found.triangles).distance
    return float(np.sqrt(np.mean(np.square(distance))))


def area_strain(opened: Frame, closed: Frame) -> FloatArray:
    """Change (%) of the area of each leaflet ``(2,)`` from the open to the closed frame."""
    size = [np.bincount(f.region, areas(f.vertices, f.triangles)) for f in (opened, closed)]
    return np.asarray(100.0 * (size[1] / size[0] - 1.0))


def thickness_error(arrived: Arrived, thickness_mm: FloatArray) -> float:
    """Mean thickness error (mm), given ``thickness_mm (n,)`` at the true frame's vertices."""
    surface, true = arrived.case.surface, arrived.opened
    nearest = closest_points(surface.vertices, true.vertices, true.triangles)
    return float(np.mean(surface.thickness - nearest.interpolate(thickness_mm, true.triangles)))


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """Each modulus by source of the geometry, and the skill of each source."""
    rows = []
    for record, estimate in _runs(results):
        failed_checks = () if estimate.verdict is None else estimate.verdict.failed_checks
        rows += [
            {
                "patient": estimate.case,
                "geometry": record.numbers["geometry"],
                **{name: record.numbers[f"{name}_mm"] for name in OFF},
                **{name: record.numbers[name] for name in STRAINS},
                **modulus_row(estimate, own),
                "failed_checks": "; ".join(f"{one.check}: {one.text}" for one in failed_checks),
                "ended": record.reason,
            }
            for own in estimate.moduli
        ]
    about = {"patient": Column(label="patient (simulated)"), "geometry": Column()}
    about |= dict.fromkeys(OFF, Column("mm", ".2f"))
    about |= dict.fromkeys(STRAINS, Column("% points", ".1f"))
    hidden = dict.fromkeys(("failed_checks", "ended"), Column(hidden=True))
    return {
        "": table(rows, **about, **MODULUS_COLUMNS, **hidden),
        "geometries": _by_geometry(results).skill("geometry"),
    }


OFF = ("open_back", "closed_back", "thickness_mean")
"""Geometric errors (mm), by their names in a record."""
STRAINS = "anterior_area_strain_off", "posterior_area_strain_off"
"""Errors of the change of area from open to closed, percentage points."""


def _runs(results: Results) -> list[tuple[Record, EstimateRecord]]:
    """Record and estimate of each run, sorted by patient and source."""

    def key(run: tuple[Record, EstimateRecord]) -> tuple[str, int, str]:
        numbers = run[0].numbers
        return run[1].case, KINDS.index(str(numbers["kind"])), str(numbers["geometry"])

    return sorted(results.estimates, key=key)


def _by_geometry(results: Results) -> Groups:
    return Groups.of((str(r.numbers["geometry"]), one, one) for r, one in _runs(results))


STUDY = Study(
    settings=Settings,
    run=run_surfaces,
    summary=summary,
    figure=lambda results: _by_geometry(results).figure(),
    captions={
        "": "Moduli over their true values, by how the geometry arrived, with 95 % intervals. "
        "Simulated."
    },
    words=case_words,
    keep=short,
    keeps_failures=True,
    golden=("case", "patient"),
)
