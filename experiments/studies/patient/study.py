"""Virtual patients: simulated, estimated by a process that cannot see the truth, then revealed."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import mechanics_of, template_of
from experiments.common.cases.blind import estimate_blindly
from experiments.common.cases.record import of_all_unknowns
from experiments.common.cases.report import case_text, write_case_tables
from experiments.common.expectation import expect_own
from experiments.common.plain import Plain, flat, plain_run
from experiments.common.schema import build
from experiments.common.store import Store
from experiments.common.study import Section, Study
from experiments.studies.patient.report import (
    arrays_of_patient,
    kept_of_patient,
    patients_answer,
    write_patients,
)
from experiments.studies.patient.settings import Settings
from experiments.studies.patient.tables import PATIENTS
from mvest.cases.writer import write_case
from mvest.errors import ConfigurationError, GeometryError, InputError
from mvest.provenance import write_json
from mvest.simulation.virtual_patient import (
    Deviations,
    PatientSimulation,
    VirtualPatient,
    draw_hidden,
    simulate_patient,
)
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

__all__ = ["STUDY", "PatientPlace", "make_patient", "reveal", "run_patient"]

Values = Mapping[str, Any]

HIDDEN, POSITIONS = "hidden.json", "positions.npz"
MAX_DRAWS = 5
"""Anatomies that are drawn, one after another, until one closes."""


@dataclass(frozen=True, slots=True)
class PatientPlace:
    """Where a virtual patient lies.

    Attributes
    ----------
    case : Path
        The folder that an estimator is given.
    hidden : Path
        The folder that it cannot open.
    """

    case: Path
    hidden: Path


def run_patient(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Simulate, estimate apart, reveal: the record, and the files written to ``folder``."""
    from mvest.reporting.case.report import write_case_report

    place = make_patient(config)
    record = estimate_blindly(config, config_hash, folder, place.case, place.hidden)
    fields = folder / "fields.npz"
    record = reveal(record, place, fields)
    record["provenance"]["seed"] = config["seed"]
    record["paper_patient"] = {
        "moduli": list(config["patient"]["paper_moduli"]),
        "distance_mm": list(config["patient"]["paper_distance_mm"]),
    }
    files: list[Path] = []
    if config["figures"] and fields.is_file():
        files = write_case_report(folder, of_all_unknowns(record), fields)
    return record, files


def make_patient(config: Values) -> PatientPlace:
    """Simulate the configured patient, unless that was done: where it lies.

    Raises
    ------
    MvestError
        If the configuration is inadmissible or the valve does not close.
    """
    patient = config["patient"]
    if patient is None:
        raise ConfigurationError("patient is not given; expected one of conf/patient")
    described = {
        "patient": {k: v for k, v in patient.items() if not k.startswith("paper")},
        "valve": config["valve"],
        "mechanics": config["mechanics"],
        "seed": config["seed"],
    }
    store = Store(config["paths"]["outputs"])
    entry = store.entry("virtual", described, (_simulate, _write), _place, "{key}")

    def write(root: Path, made: tuple[VirtualPatient, int]) -> None:
        _write(root, *made, described)

    return entry.get_or_make(lambda: _simulate(config), write)


def _place(root: Path) -> PatientPlace:
    place = PatientPlace(root / "case", root / "hidden")
    json.loads((place.hidden / HIDDEN).read_text(encoding="utf-8"))
    return place


def _simulate(config: Values) -> tuple[VirtualPatient, int]:
    """A patient, and how many anatomies were drawn for it."""
    patient = config["patient"]
    rng = np.random.default_rng(config["seed"])
    moduli = {
        name: float(value * np.exp(patient["moduli_spread"] * rng.standard_normal()))
        for name, value in sorted(patient["moduli"].items())
    }
    values = draw_hidden(moduli, build(Deviations, patient["deviations"]), rng)
    template = template_of(config)
    draws = 0
    while True:
        draws += 1
        drawn = template
        if patient["variation"]:
            drawn = Template(vary(template.parameters, rng, patient["variation"]))
        try:
            made = simulate_patient(
                patient["name"],
                patient["description"],
                drawn,
                values,
                build(PatientSimulation, patient["simulation"]),
                mechanics_of(config),
                rng,
            )
        except GeometryError:
            if not patient["variation"] or draws == MAX_DRAWS:
                raise
            continue
        return made, draws


def _write(root: Path, made: VirtualPatient, draws: int, described: Values) -> None:
    folder = root / "hidden"
    folder.mkdir(parents=True)
    write_case(root / "case", made.case)
    arrays: dict[str, Any] = dict(made.hidden.positions)
    np.savez_compressed(folder / POSITIONS, **arrays)
    values = dict(made.hidden.values)
    about = {"values": values, "made_from": dict(described), "anatomies_drawn": draws}
    write_json(folder / HIDDEN, about)


def reveal(record: dict[str, Any], place: PatientPlace, fields: Path) -> dict[str, Any]:
    """The finished record of an estimation, beside what its case had hidden.

    Parameters
    ----------
    record : dict
        Of the estimation, which is over.
    place : PatientPlace
    fields : Path
        The estimation's arrays; the true positions are added to them.
    """
    try:
        hidden = json.loads((place.hidden / HIDDEN).read_text(encoding="utf-8"))
        with np.load(place.hidden / POSITIONS, allow_pickle=False) as stored:
            positions = {name: stored[name] for name in stored.files}
    except (OSError, ValueError) as error:
        raise InputError(f"{place.hidden} does not hold what a patient hides: {error}") from error
    values = hidden["values"]
    revealed = copy.deepcopy(record)
    groups = [revealed["unknowns"]] + [
        revealed[key]["parameters"]
        for key in ("without_nuisances", "as_in_the_paper")
        if revealed[key] is not None
    ]
    for rows in groups:
        for row in rows:
            row["truth"] = values[row["name"]]
            row["inside"] = (
                None if row["low"] is None else bool(row["low"] <= row["truth"] <= row["high"])
            )
    for modulus in revealed["moduli"]:
        truth = values[f"E_f.{modulus['region']}"]
        ratio = modulus["estimate"] / _estimate(record, f"E_f.{modulus['region']}")
        modulus["truth"] = ratio * truth
        modulus["relative_error"] = (modulus["estimate"] - modulus["truth"]) / modulus["truth"]
    revealed["truth"] = [values[name] for name in record["parameters"]]
    if record["estimate"] is not None:
        revealed["relative_error"] = [
            (estimate - true) / true
            for estimate, true in zip(record["estimate"], revealed["truth"], strict=True)
        ]
    if fields.is_file():
        _reveal_positions(revealed, positions, fields)
    revealed["made_from"] = hidden["made_from"]
    revealed["anatomies_drawn"] = hidden["anatomies_drawn"]
    return revealed


def _estimate(record: Mapping[str, Any], name: str) -> float:
    return float(next(row["estimate"] for row in record["unknowns"] if row["name"] == name))


def _reveal_positions(
    record: dict[str, Any], positions: Mapping[str, FloatArray], fields: Path
) -> None:
    """Distances to where the valve truly was, and its shape among the arrays."""
    with np.load(fields, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    frames = [str(name) for name in arrays["frames"]]
    arrays["truth"] = np.stack([positions[name] for name in frames]).astype(np.float32)
    for k, row in enumerate(record["distances"]):
        row["to_truth"] = {
            which: _spread(np.linalg.norm(arrays[key][k] - arrays["truth"][k], axis=1))
            for which, key in (
                ("generic", "generic"),
                ("registered", "registered"),
                ("personalised", "fitted"),
            )
        }
    np.savez_compressed(fields, **arrays)


def _spread(values: FloatArray) -> dict[str, float]:
    return {"mean": float(values.mean()), "std": float(values.std()), "max": float(values.max())}


def expect_patient(config: Values, folder: Path | None = None) -> str:
    """The answer for the case of a virtual patient, which is simulated first unless it is there.

    Raises
    ------
    MvestError
        If the configuration is inadmissible or the patient's valve does not close.
    """
    return expect_own({**config, "case": str(make_patient(config).case)}, folder)


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_patient),
    words=lambda record: case_text(flat(record)),
    write=write_patients,
    write_run=lambda folder, record: write_case_tables(folder, flat(record)),
    keep=kept_of_patient,
    keep_arrays=arrays_of_patient,
    keeps_failures=True,
    checks=lambda: (expect_patient,),
    sections=(
        Section("table2", title="Table 2: moduli of five virtual patients (simulated)"),
        Section(
            "table3",
            {
                "figure3": "Figure 3: closed valves coloured by their distance from what was "
                "observed, "
                "with generic and with personalised stiffness, on one scale. Drawn are "
                "midsurfaces: leaflets that touch lie a thickness apart, so that a white slit"
                " is not yet a leak. Simulated."
            },
            "Table 3: distances of their closed valves (simulated)",
            table=PATIENTS,
            answer=patients_answer,
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
    ),
)
