"""Virtual patients on disk: simulated once, with the case and its truth in separate folders."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import mechanics_of, template_of
from experiments.common.schema import Values
from mvest.cache import Entry
from mvest.cases.folder import write_case
from mvest.errors import InputError
from mvest.problem.stored import key_of
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping
from mvest.reading.npz import read_npz
from mvest.simulation.virtual_patient import (
    PatientSettings,
    VirtualPatient,
    draw_patient_values,
    first_that_closes,
    simulate_patient,
)
from mvest.typing import FloatArray

HIDDEN, POSITIONS = "hidden.json", "positions.npz"
MAX_DRAWS = 5  # anatomies that are drawn, one after another, until one closes


@dataclass(frozen=True, slots=True)
class PatientPlace:
    """Folders of a virtual patient."""

    case: Path  # for the estimator
    hidden: Path  # the sealed truth

    def truth(self) -> tuple[dict[str, Any], dict[str, FloatArray]]:
        """The truth, and frame -> true positions ``(n, 3)`` mm; an `InputError` if missing."""
        try:
            return read_mapping(self.hidden / HIDDEN), read_npz(self.hidden / POSITIONS)
        except InputError as error:
            raise InputError(f"{self.hidden} does not hold a patient's truth: {error}") from error


def make_patient(values: Values, patient: PatientSettings) -> PatientPlace:
    """Simulate the configured patient, unless it is cached; returns its folders."""
    described = {
        "patient": {k: v for k, v in values["patient"].items() if not k.startswith("paper")},
        **{key: values[key] for key in ("valve", "mechanics", "seed")},
    }
    folder = Path(values["paths"]["outputs"]) / "virtual"

    def read(root: Path) -> PatientPlace:
        place = PatientPlace(root / "case", root / "hidden")
        read_mapping(place.hidden / HIDDEN)
        return place

    def write(root: Path, made: tuple[VirtualPatient, int]) -> None:
        _write(root, *made, described)

    entry = Entry(folder / key_of(described, "experiments"), read)
    return entry.get_or_make(lambda: _simulate(values, patient), write)


def _simulate(values: Values, patient: PatientSettings) -> tuple[VirtualPatient, int]:
    """A patient, and how many anatomies were drawn for it."""
    rng = np.random.default_rng(values["seed"])
    hidden = draw_patient_values(patient, rng)
    mechanics = mechanics_of(values)
    return first_that_closes(
        template_of(values),
        patient.variation,
        MAX_DRAWS if patient.variation else 1,
        rng,
        lambda drawn: simulate_patient(
            patient.name, patient.description, drawn, hidden, patient.simulation, mechanics, rng
        ),
    )


def _write(root: Path, made: VirtualPatient, draws: int, described: Values) -> None:
    folder = root / "hidden"
    folder.mkdir(parents=True)
    write_case(root / "case", made.case)
    arrays: dict[str, Any] = dict(made.positions)
    np.savez_compressed(folder / POSITIONS, **arrays)
    values = dict(made.values)
    about = {"values": values, "made_from": dict(described), "anatomies_drawn": draws}
    write_json(folder / HIDDEN, about)
