"""Simulates virtual patients, estimates them blind in another process, compares with the truth.

The study has three published tables. ``patients`` has the paper's Tables 2 and 3 and Figure 3 for
five virtual patients. ``population`` counts how often intervals contain the truth for thirty random
patients. ``calibration`` does the same for misspecification scenarios; each violates one assumption
of the estimator, so the counts show what a verdict is worth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from experiments.common.building.gate import gate_of
from experiments.common.building.patient_store import PatientPlace, make_patient
from experiments.common.cases.blind import estimate_blindly
from experiments.common.cases.own_case import PersonalSettings, case_words, check, write_report
from experiments.common.cases.revealed import (
    Groups,
    short,
)
from experiments.common.records.record import NOT_GATED, Number, Record
from experiments.common.schema import Values, build
from experiments.common.study import Figures, Job, Result, Results, Study
from experiments.studies.patient.figures import figure_3, ranks_figure
from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.estimation.information.consistency import nees
from mvest.problem.record import EstimateRecord, Spread, Unknown
from mvest.problem.verdict import TRUSTWORTHY
from mvest.reading.npz import read_npz
from mvest.reporting.skill import (
    interval,
    interval_columns,
    score,
    skill_table,
    stated,
    trust_of,
    verdict_table,
    warning_table,
)
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.virtual_patient import PatientSettings
from mvest.typing import FloatArray
from mvest.valve.measure.strain import mean_strains

POPULATION, CALIBRATION = "population", "calibration"
"""Published tables other than the five patients' table."""
ORDER = ("normal_small", "normal_large", "functional_mr", "prolapse", "fibroelastic")
"""Order of the five patients; others follow by name."""
REFERENCE = "reference"
"""The scenario without misspecification."""
WITH = "with nuisances"
"""The estimate of all unknowns, to which the verdict applies."""
ALTERNATIVES = {"moduli_only": "without nuisances", "paper": "paper's filter"}
"""Name in a record -> label in tables."""
WHICH = ("generic", "registered", "personalised")
"""Closed valves with listed distances; the registered valve is the generic one moved rigidly."""

MM = Column("mm", ".2f")
TAILS = (0.025, 0.975)

KEPT_ARRAYS = (
    "triangles", "region", "rest", "annulus", "free_edge", "frames", "seen", "tips", "chord_tip",
    "chord_insertion", "chord_parent", "chord_junction", "chord_weights", "generic", "fitted",
    "distance_generic", "distance_fitted", "reach_mm",
)  # fmt: skip
"""Arrays needed for Figure 3."""

Patients = Sequence[tuple[Record, EstimateRecord]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings


# -- run ------------------------------------------------------------------------------------------
def run_patient(job: Job[Settings]) -> Result:
    """Simulate a patient, estimate in a separate process, then reveal the truth."""
    patient = job.settings.patient
    place = make_patient(job.values, patient)
    # A random patient's anatomy differs from the configured one.
    gate = NOT_GATED if patient.variation else gate_of(job.values)
    estimated = estimate_blindly(job.values, job.folder, place.case, place.hidden, gate)
    return reveal(estimated, place, patient, job.values["seed"])


def reveal(estimated: Result, place: PatientPlace, patient: PatientSettings, seed: int) -> Result:
    """Add the truth to an estimation's result; InputError if the truth is missing."""
    hidden, positions = place.truth()
    (blind,) = estimated.estimates
    arrays, frames = dict(estimated.arrays), blind.frames
    if arrays:
        truth = np.stack([positions[str(name)] for name in arrays["frames"]]).astype(np.float32)
        arrays["truth"] = truth
        shapes = zip(WHICH, ("generic", "registered", "fitted"), strict=True)
        off = {
            f"{which}_to_truth": np.linalg.norm(arrays[shape] - truth, axis=2)
            for which, shape in shapes
        }
        frames = tuple(
            frame.model_copy(update={name: Spread.of(each[k]) for name, each in off.items()})
            for k, frame in enumerate(frames)
        )
    seen = [frame.personalised_to_truth for frame in frames if frame.seen]
    about = {"seed": seed, "frames": frames, "distance_to_truth_mm": seen[-1] if seen else None}
    estimate = blind.with_truth(hidden["values"]).model_copy(update=about)
    numbers: dict[str, Number] = {
        "anatomies_drawn": hidden["anatomies_drawn"],
        "scenario": patient.misspecification or REFERENCE,
        "unknowns": len(estimate.parameters),
        "nees": _nees(estimate),
    }
    distances = zip(("generic", "personalised"), patient.paper_distance_mm, strict=False)
    numbers |= {f"paper_{which}_mm": value for which, value in distances}
    numbers |= _true_quantities(estimate, read_case(place.case), positions)
    return estimated.changed(tables={}, numbers=numbers, estimates=(estimate,), arrays=arrays)


def _true_quantities(
    estimate: EstimateRecord, case: ValveCase, positions: Mapping[str, FloatArray]
) -> dict[str, Number]:
    """True ratio and strains (``true NAME``), and defaults without an estimate (``else NAME``).

    The defaults are the generic ratio and the strains between the observed frames.
    """
    known = {str(own["name"]): own for own in estimate.details.get("known", ())}
    truths = [own.truth for own in estimate.moduli if own.truth]
    numbers: dict[str, Number] = {}
    for name, own in known.items():
        if name.startswith("ratio") and len(truths) == 2:
            ratio = truths[0] / truths[1]
            numbers |= {f"true {name}": ratio, f"else {name}": own["generic"]}
    strains, seen = [name for name in known if name.startswith("strain")], case.frame(Role.CLOSED)
    if strains and seen.corresponds:
        for label, frame in ("true", positions[seen.name]), ("else", seen.vertices):
            values = 100.0 * mean_strains(case.surface.vertices, frame, case.surface).ravel()
            names = [f"{label} {name}" for name in strains]
            numbers |= zip(names, map(float, values), strict=True)
    return numbers


def _nees(estimate: EstimateRecord) -> float | None:
    """Normalised estimation error squared over the number of unknowns."""
    scores = [score(unknown) for unknown in estimate.parameters]
    if not estimate.correlation or None in scores:
        return None
    return nees(np.array(scores), np.array(estimate.correlation)) / len(scores)


def check_patient(values: Values, folder: Path) -> str:
    """Check a virtual patient's case; simulate it first if necessary."""
    patient = build(PatientSettings, values["patient"])
    return check(values, read_case(make_patient(values, patient).case), folder)


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """The tables of the five patients, of the population or of the scenarios."""
    patients, which = _patients(results), results.first.table
    estimates = [estimate for _, estimate in patients]
    if which == CALIBRATION:
        scenarios = _by_scenario(patients)
        trusted = _by_scenario(
            [(record, one) for record, one in patients if trust_of(one) == TRUSTWORTHY]
        )
        moduli = scenarios.unknowns(by_name=True, stated=False)
        return {
            "": _with_nees(scenarios.skill("scenario", stated=False), patients),
            "trusted": skill_table("scenario", trusted.unknowns()),
            "verdicts": verdict_table(estimates),
            "warning": warning_table(estimates),
            "moduli": skill_table("scenario, modulus", moduli),
            "estimates": _estimates(patients),
        }
    ways, frames = _by_way(estimates), _table3(patients)
    both = {"moduli": skill_table("estimation", ways.unknowns()), "distances": _distances(frames)}
    if which == POPULATION:
        each = ways.unknowns(by_name=True, nuisances=True)
        return {
            "": skill_table("estimation, unknown", each),
            **both,
            "quantities": skill_table("quantity", _quantities(patients)),
            "verdicts": verdict_table(estimates),
            "estimates": _estimates(patients),
        }
    return {"table_2": _table2(estimates), "table_3": frames, **both}


def _patients(results: Results) -> Patients:
    """Record and estimate of each patient, in the order of the tables."""

    def key(item: tuple[Record, EstimateRecord]) -> tuple[int, bool, str, str]:
        record, estimate = item
        five = ORDER.index(estimate.case) if estimate.case in ORDER else len(ORDER)
        scenario = _scenario(record)
        return five, scenario != REFERENCE, scenario, estimate.case

    return sorted(results.estimates, key=key)


def _scenario(record: Record) -> str:
    return str(record.numbers.get("scenario", REFERENCE))


def _by_scenario(patients: Patients) -> Groups:
    return Groups.of((_scenario(record), estimate, estimate) for record, estimate in patients)


def _by_way(estimates: Sequence[EstimateRecord]) -> Groups:
    """Estimates by unknowns and filter, with the patient's verdict."""
    return Groups.of((name, way, one) for one in estimates for name, way in _ways(one).items())


def _ways(estimate: EstimateRecord) -> dict[str, EstimateRecord]:
    """An estimate and its alternatives, by their labels in tables."""
    others = estimate.alternatives
    return {WITH: estimate} | {
        label: others[name] for name, label in ALTERNATIVES.items() if name in others
    }


def _table2(estimates: Sequence[EstimateRecord]) -> Table:
    """A row per patient and modulus, with all estimates; the truth is the paper's estimate."""
    rows = []
    for estimate in estimates:
        ways = _ways(estimate)
        for own in stated(estimate):
            if not own.is_modulus:
                continue
            row: dict[str, Any] = {"patient": estimate.case, "verdict": trust_of(estimate)}
            row |= {"modulus": own.name, "truth": own.truth, **interval("estimate", own)}
            for label in ALTERNATIVES.values():
                way = ways.get(label)
                row |= interval(label, None if way is None else way.unknown(own.name))
                row[f"{label} converged"] = None if way is None else way.converged
            rows.append(row)
    about = {"patient": Column(label="patient (simulated)"), "verdict": Column()}
    about |= {"modulus": Column(), "truth": Column("MPa")} | interval_columns("estimate")
    for label in ALTERNATIVES.values():
        about |= interval_columns(label) | {f"{label} converged": Column()}
    return table(rows, **about)


def _table3(patients: Patients) -> Table:
    """A row per patient and frame: distances (mm) of the closed valves."""
    rows = []
    for record, estimate in patients:
        for fit in estimate.frames:
            row: dict[str, Any] = {"patient": estimate.case, "verdict": trust_of(estimate)}
            row |= {"frame": fit.frame, "seen": fit.seen}
            for which in WHICH:
                spread, off = getattr(fit, which), getattr(fit, f"{which}_to_truth")
                row |= {which: spread.mean, f"{which} SD": spread.std}
                row[f"{which} to truth"] = off and off.mean
            row["closer"] = 100.0 * (1.0 - fit.personalised.mean / fit.generic.mean)
            for which in ("generic", "personalised"):
                paper = record.numbers.get(f"paper_{which}_mm") if fit.seen else None
                row[f"paper {which}"] = paper
            rows.append(row)
    about = {"patient": Column(label="patient (simulated)"), "verdict": Column()}
    about |= {"frame": Column(), "seen": Column(label="shown to the filter")}
    about |= {which: replace(MM, std=f"{which} SD") for which in WHICH}
    about["closer"] = Column("%", ".0f", label="personalised closer than generic by")
    about |= dict.fromkeys(
        (f"{which} {part}" for part in ("SD", "to truth") for which in WHICH), MM
    )
    return table(rows, **about, **dict.fromkeys(("paper generic", "paper personalised"), MM))


def _distances(frames: Table) -> Table:
    """How often and by how much personalised valves are closer to the observation."""
    if not len(frames):
        return table([])
    every = frames.frame
    seen = every["seen"].astype(bool)
    means = [f"{which}{end}" for end in ("", " to truth") for which in WHICH]
    groups = {"all": every, "shown to the filter": every[seen], "held out": every[~seen]}
    found = [
        {
            "frames": name,
            "n": len(own),
            "closer than generic": (own["personalised"] < own["generic"]).sum(),
            "closer than registered": (own["personalised"] < own["registered"]).sum(),
            "closer by": own["closer"].mean(),
            **own[means].astype(float).mean(),
        }
        for name, own in groups.items()
        if len(own)
    ]
    about = dict.fromkeys(found[0], Column()) | dict.fromkeys(means, MM)
    return table(found, **about | {"closer by": Column("%", ".0f")})


def _quantities(patients: Patients) -> dict[str, list[Unknown]]:
    """Ratio and strains of all reported estimates, with `_true_quantities` as truth and guess."""
    groups: dict[str, list[Unknown]] = {}
    for record, estimate in patients:
        for own in estimate.details.get("known", ()) if estimate.is_stated else ():
            name, numbers = str(own["name"]), record.numbers
            if f"true {name}" in numbers:
                row = {key: own[key] for key in ("name", "unit", "estimate", "low", "high")}
                row |= {"truth": numbers[f"true {name}"], "prior_mean": numbers[f"else {name}"]}
                groups.setdefault(name, []).append(Unknown(kind="quantity", **row))
    return groups


def _estimates(patients: Patients) -> Table:
    """A machine-readable row per patient, estimation and unknown."""
    rows = []
    for record, estimate in patients:
        failed_checks = () if estimate.verdict is None else estimate.verdict.failed_checks
        whole = {
            "case": estimate.case,
            "seed": record.provenance.seed,
            "scenario": _scenario(record),
            "verdict": trust_of(estimate),
            "NEES": record.numbers.get("nees"),
            "failed_checks": "; ".join(f"{one.check}: {one.text}" for one in failed_checks),
        }
        for name, way in _ways(estimate).items():
            rows += [
                {**row, **whole, "estimation": name, "off by SD": score(own)}
                for own, row in zip(way.unknowns, way.rows(), strict=False)
                if own.kind != "derived"
            ]
    first = ("case", "scenario", "seed", "estimation") if rows else ()
    return table(rows, **dict.fromkeys(first, ""))


def _with_nees(skill: Table, patients: Patients) -> Table:
    """Skill per scenario, and mean `_nees` with its 95 % bounds for correct posteriors."""
    import pandas as pd

    numbers = pd.DataFrame([{"scenario": _scenario(one), **one.numbers} for one, _ in patients])
    known = numbers[["scenario", "nees", "unknowns"]].dropna().astype({"nees": float})
    found = known.groupby("scenario").agg(NEES=("nees", "mean"), freedom=("unknowns", "sum"))
    freedom = found.pop("freedom").astype(float)
    found["NEES low"], found["NEES high"] = (chi2.ppf(q, freedom) / freedom for q in TAILS)
    about = {"NEES": Column(digits=".2f", low="NEES low", high="NEES high")}
    return table(skill.frame.join(found, on="scenario"), **skill.columns, **about)


# -- figures --------------------------------------------------------------------------------------
def figure(results: Results) -> Figures:
    """Figure 3, or the figure of the population or of the scenarios."""
    patients = _patients(results)
    if results.first.table == POPULATION:
        return {"moduli": _by_way([estimate for _, estimate in patients]).figure()}
    if results.first.table == CALIBRATION:
        return {"ranks": ranks_figure(_by_scenario(patients))}
    from mvest.problem.fields import case_fields

    fields = {
        estimate.case: case_fields(results.arrays[name])
        for record, estimate in patients
        for name, own in results.records.items()
        if own is record and name in results.arrays
    }
    denied = [estimate.case for _, estimate in patients if not estimate.is_stated]
    return {"figure_3": figure_3(fields, denied)} if fields else {}


# -- published records ----------------------------------------------------------------------------
def keep(record: Record) -> Record:
    """The parts of a record that tables and figures need; the run's folder has the full record."""
    details = ("known",) if record.table == POPULATION else ()
    return short(record, nuisances=record.table != CALIBRATION, details=details)


def keep_arrays(record: Record, path: Path) -> dict[str, Any]:
    """Arrays needed for Figure 3, in single precision."""
    if record.table in (POPULATION, CALIBRATION):
        return {}
    stored = read_npz(path)
    return {
        key: stored[key].astype(np.float32) if stored[key].dtype == np.float64 else stored[key]
        for key in KEPT_ARRAYS
        if key in stored
    }


STUDY = Study(
    settings=Settings,
    run=run_patient,
    summary=summary,
    figure=figure,
    captions={
        "figure_3": "Figure 3: distance of closed valves from the observed ones, with generic and "
        "with personalised stiffness. Drawn are midsurfaces, which are a thickness apart where "
        "leaflets touch. White: space between them; grey: known to be no leak; red: a gap. "
        "Simulated.",
        "moduli": "Estimates with their 95 % intervals over the hidden truth. Simulated.",
        "ranks": "Ranks of the truth in the posterior: difference of their distribution from the "
        "uniform one. Grey: 95 of 100 samples of right intervals stay there. Simulated.",
    },
    latex=("patients_table_2", "patients_table_3", "patients_figure_3"),
    words=case_words,
    files=write_report,
    keep=keep,
    keep_arrays=keep_arrays,
    keeps_failures=True,
    check=check_patient,
    golden=("case", "patient"),
)
