"""Virtual patients whose geometry arrives as another program or a segmentation brings it.

The valve of a virtual patient is exported (as surfaces, as a folder of SlicerHeart, as label maps),
imported, and estimated as any own valve is. No reader or writer of this project takes part in the
exports: VTK (through PyVista) cuts and writes surfaces, pandas tables, nibabel label maps.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from experiments.common.building.patient_store import make_patient
from experiments.common.cases.blind import estimated_or_reason
from experiments.common.cases.own_case import PersonalSettings, case_words
from experiments.common.records.record import Number, Record
from experiments.common.study import Job, Result, Results, Study
from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import read_case, write_case
from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.registration import REGISTRATION
from mvest.reporting.skill import (
    VERDICTS,
    interval,
    interval_columns,
    moduli_figure,
    prior_alone,
    skill_table,
    stated,
    trust_of,
)
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.arrival import KINDS, DoorSettings, arrive
from mvest.simulation.drawn_patient import PatientSettings
from mvest.typing import FloatArray
from mvest.valve.geometry.proximity import closest_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRIOR = "prior alone"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings
    door: DoorSettings


# -- run ------------------------------------------------------------------------------------------
def run_surfaces(job: Job[Settings]) -> Result:
    """Simulate, export, import, estimate in a process of its own, reveal the truth."""
    door, folder = job.settings.door, job.folder
    place = make_patient(job.values, job.settings.patient)
    hidden, positions = place.truth()
    patient = read_case(place.case)
    for name in ("door", "case"):
        # Of an earlier run.
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / "door").mkdir()
    registration = np.array([hidden["values"][name] for name in REGISTRATION])
    arrived = arrive(patient, positions["closed"], registration, door, folder / "door")
    case = write_case(folder / "case", arrived.case)
    found = estimated_or_reason(job.values, folder, case, place.hidden)
    numbers: dict[str, Number] = {"kind": door.kind, "geometry": door.label}
    if isinstance(found, str):
        unknowns = _believed(job.settings.personal)
        estimate = EstimateRecord(status="failed", reason=found, unknowns=unknowns)
        found = Result(status="failed", reason=found)
    else:
        (estimate,) = found.estimates
    for check in estimate.detail_rows("check"):
        numbers |= {"check": check["value"], "check_limit": check["limit"]}
    for role, true in ((Role.REFERENCE, arrived.opened), (Role.CLOSED, arrived.closed)):
        numbers |= surface_error(arrived.case.frame(role), true)
    numbers |= thickness_error(arrived.case, arrived.opened, patient.surface.thickness)
    # What is displaced in the case of the patient is not in what was imported.
    truth = {name: hidden["values"][name] for name in hidden["values"] if name.startswith("E_f.")}
    about = {"case": patient.name, "seed": job.values["seed"]}
    revealed = estimate.model_copy(update=about).with_truth(truth)
    return found.changed(tables={}, numbers=numbers, estimates=(revealed,), arrays={}, row="")


def surface_error(found: Frame, true: Frame) -> dict[str, Number]:
    """Distances (mm) of a midsurface from the true one: root mean squares and the largest.

    ``there`` from its vertices, ``back`` from those of the true one to it.
    """
    there, back = (
        closest_points(a.vertices, b.vertices, b.triangles).distance
        for a, b in ((found, true), (true, found))
    )
    frame = "closed" if true.role is Role.CLOSED else "open"
    largest = float(max(there.max(), back.max()))
    return {
        f"{frame}_there_mm": _rms(there),
        f"{frame}_back_mm": _rms(back),
        f"{frame}_largest_mm": largest,
    }


def thickness_error(case: ValveCase, true: Frame, thickness_mm: FloatArray) -> dict[str, Number]:
    """Thickness of the open midsurface less the true one at the nearest point, mm.

    ``thickness_mm`` ``(n,)`` is that of the vertices of the true frame.
    """
    nearest = closest_points(case.surface.vertices, true.vertices, true.triangles)
    off = case.surface.thickness - nearest.interpolate(thickness_mm, true.triangles)
    return {"thickness_mean_mm": float(off.mean()), "thickness_rms_mm": _rms(off)}


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _believed(personal: PersonalSettings) -> tuple[Unknown, ...]:
    """The moduli before anything was seen."""
    return tuple(
        Unknown(name=name, unit="MPa", prior_mean=about.mean, prior_std=about.std)
        for name, about in personal.unknowns.items()
        if name.startswith("E_f.")
    )


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """Each modulus by how the geometry arrived, and what estimates of each way are worth."""
    runs = _runs(results)
    rows = []
    for record, estimate in runs:
        for own in estimate.moduli:
            grounds = () if estimate.verdict is None else estimate.verdict.grounds
            rows.append(
                {
                    "patient": estimate.case,
                    "geometry": record.numbers["geometry"],
                    **{name: record.numbers[f"{name}_mm"] for name in OFF},
                    "modulus": own.name,
                    "truth": own.truth,
                    "stated": own.estimate if estimate.is_stated else None,
                    **interval("estimate", own),
                    "error": None if own.relative_error is None else 100 * own.relative_error,
                    **interval(PRIOR, prior_alone(own)),
                    "check": record.numbers.get("check"),
                    "its limit": record.numbers.get("check_limit"),
                    "verdict": trust_of(estimate),
                    "grounds": "; ".join(f"{one.check}: {one.text}" for one in grounds),
                    "ended": record.reason,
                }
            )
    about = {"patient": Column(label="patient (simulated)"), "geometry": Column()}
    about |= {name: Column("mm", ".2f", hidden=name not in SHOWN) for name in OFF}
    about |= {"modulus": Column(), "truth": Column("MPa")}
    about |= interval_columns("estimate", hidden=True) | interval_columns(PRIOR, hidden=True)
    about["stated"] = replace(about["estimate"], label="estimate", hidden=False)
    about |= {"error": Column("%", "+.0f"), "verdict": Column()}
    about["check"] = Column(label="check of the posterior")
    about |= dict.fromkeys(("grounds", "ended"), Column(hidden=True))
    return {"": table(rows, **about), "geometries": _geometries(runs)}


OFF = tuple(
    f"{frame}_{way}" for frame in ("open", "closed") for way in ("there", "back", "largest")
)
OFF += ("thickness_mean", "thickness_rms")
"""How far geometries are off, in mm, by their names in a record."""
SHOWN = ("open_back", "closed_back", "thickness_mean")


def _runs(results: Results) -> list[tuple[Record, EstimateRecord]]:
    """Record and estimate of each run, by patient and way."""

    def place(record: Record) -> tuple[str, int, str]:
        kind = KINDS.index(str(record.numbers["kind"]))
        return record.estimates[0].case, kind, str(record.numbers["geometry"])

    runs = [one for one in results.records.values() if one.estimates]
    return [(record, record.estimates[0]) for record in sorted(runs, key=place)]


def _geometries(runs: Sequence[tuple[Record, EstimateRecord]]) -> Table:
    """What estimates are worth by how the geometry arrived, as far as they are stated."""
    moduli: dict[str, list[Unknown]] = {}
    verdicts: dict[str, list[str]] = {}
    for record, estimate in runs:
        name = str(record.numbers["geometry"])
        moduli.setdefault(name, []).extend(own for own in stated(estimate) if own.is_modulus)
        verdicts.setdefault(name, []).append(trust_of(estimate))
    skill = skill_table("geometry", moduli)
    counts = [{v: verdicts[row["geometry"]].count(v) for v in VERDICTS} for row in skill.rows]
    rows = [row | own for row, own in zip(skill.rows, counts, strict=True)]
    return table(rows, **skill.columns)


def figure(results: Results) -> Figure:
    """Estimates over their truths, by how the geometry arrived."""
    groups: dict[str, list[tuple[Unknown, str]]] = {}
    for record, estimate in _runs(results):
        own = groups.setdefault(str(record.numbers["geometry"]), [])
        own += [(modulus, trust_of(estimate)) for modulus in estimate.moduli]
    return moduli_figure(groups)


def keep(record: Record) -> Record:
    """What tables and the figure need of a record."""
    kept = (estimate.without_details() for estimate in record.estimates)
    few = tuple(one.model_copy(update={"unknowns": one.moduli}) for one in kept)
    return record.model_copy(update={"estimates": few})


STUDY = Study(
    settings=Settings,
    run=run_surfaces,
    summary=summary,
    figure=figure,
    captions={
        "": "Moduli over their true values, by how the geometry arrived, with 95 % intervals. "
        "Simulated."
    },
    words=case_words,
    keep=keep,
    keeps_failures=True,
)
