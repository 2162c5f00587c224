"""Virtual patients in simulated volumes: imaged, estimated blindly, then revealed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import mechanics_of, template_of
from experiments.common.cases.blind import estimate_blindly
from experiments.common.cases.report import case_text, write_case_tables
from experiments.common.plain import Plain, flat, plain_run
from experiments.common.schema import build
from experiments.common.store import Store
from experiments.common.study import Section, Study
from experiments.studies.imaged_patient.report import kept_of_volume, volumes_answer, write_volumes
from experiments.studies.imaged_patient.settings import Settings
from mvest.cases.case import ValveCase
from mvest.cases.from_images.build import CaseTexts, case_of_sequence
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.cases.writer import write_case
from mvest.errors import ConfigurationError, GeometryError, InputError
from mvest.imaging.simulator.acquisition_ranges import draw_acquisition
from mvest.imaging.simulator.probe import Probe, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.imaging.writing.slicer import write_sequence_nrrd
from mvest.provenance import write_json
from mvest.simulation.motion.closing import MotionSettings
from mvest.simulation.motion.patient import IMAGED, ImagedPatient, simulate_imaged_patient
from mvest.simulation.motion.population import draw_tip_motion
from mvest.simulation.virtual_patient import Deviations, draw_hidden
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

__all__ = ["STUDY", "ImagedPlace", "make_imaged_patient", "run_imaged_patient", "volume_rows"]

Values = Mapping[str, Any]

VOLUME, KNOWN, TRUTH, HIDDEN = "volume.seq.nrrd", "known", "truth", "hidden.json"
MAX_DRAWS = 10
"""Anatomies that are drawn, one after another, until one closes as a valve does."""


@dataclass(frozen=True, slots=True)
class ImagedPlace:
    """Where an imaged patient lies.

    Attributes
    ----------
    volume : Path
        The file that an estimator is given.
    hidden : Path
        The folder that it cannot open: the truth, and a case of where the valve truly was.
    """

    volume: Path
    hidden: Path

    @classmethod
    def within(cls, root: Path) -> ImagedPlace:
        """The places in the folder of a patient."""
        return cls(root / VOLUME, root / "hidden")

    @property
    def known(self) -> Path:
        """Folder of a case with the true positions, for a second estimation."""
        return self.hidden / KNOWN

    @property
    def truth(self) -> Path:
        """Folder of what no estimation is given."""
        return self.hidden / TRUTH


def run_imaged_patient(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Simulate, estimate apart from the volume and from the true positions, reveal: the record."""
    place = make_imaged_patient(config)
    hidden = json.loads((place.truth / HIDDEN).read_text(encoding="utf-8"))
    imaged = {**config["imaged"], **hidden["stated"]}
    reason, found = "", None
    try:
        found = estimate_blindly(
            {**config, "imaged": imaged}, config_hash, folder, place.volume, place.hidden
        )
    except InputError as fault:
        reason = str(fault)
    # Of the known shape nothing is in error but what the estimator cannot know.
    beside = folder / KNOWN
    beside.mkdir(exist_ok=True)
    known: Values = NO_ESTIMATE
    try:
        known = estimate_blindly(config, config_hash, beside, place.known, place.truth)
    except InputError as fault:
        if found is None:
            raise
        known = NO_ESTIMATE | {"reason": str(fault)}
    record = {**known, **NO_ESTIMATE, "reason": reason} if found is None else found
    record = {
        **record,
        "rows": volume_rows(config["patient"]["name"], found, known, hidden["values"]),
        "known_geometry": {
            key: known.get(key) for key in ("status", "reason", "estimate", "std", "unknowns")
        },
        "made_from": hidden["made_from"],
        "anatomies_drawn": hidden["anatomies_drawn"],
        "row": config["row"],
    }
    record["provenance"] = {**record["provenance"], "seed": config["seed"]}
    return record, []


NO_ESTIMATE: dict[str, Any] = {
    "status": "failed", "detail": "", "estimate": None, "std": None, "relative_error": None,
}  # fmt: skip
"""Of a record of an estimation that found nothing, or left nothing behind."""


def volume_rows(
    patient: str, found: Values | None, known: Values, truth: Mapping[str, float]
) -> list[dict[str, Any]]:
    """What was found of each modulus, from the volume and from the known geometry, MPa.

    As `experiments.studies.imaged_patient.tables.volume_table` wants them.
    """
    rows = []
    for name in sorted(name for name in truth if name.startswith("E_f.")):
        one = _unknown(found, name)
        rows.append(
            {
                "patient": patient,
                "modulus": name.partition(".")[2],
                "truth": truth[name],
                "estimate": one.get("estimate"),
                "low": one.get("low"),
                "high": one.get("high"),
                "known_geometry": _unknown(known, name).get("estimate"),
            }
        )
    return rows


def _unknown(record: Values | None, name: str) -> Values:
    """What a record says of an unknown; nothing where it found no estimate."""
    if record is None or record["status"] != "converged":
        return {}
    return next((row for row in record["unknowns"] if row["name"] == name), {})


def make_imaged_patient(config: Values) -> ImagedPlace:
    """Simulate and image the configured patient, unless that was done: where it lies.

    Raises
    ------
    MvestError
        If the configuration is inadmissible or no anatomy that is drawn closes.
    """
    patient = config["patient"]
    if patient is None:
        raise ConfigurationError("patient is not given; expected one of conf/patient")
    described = {
        "patient": {
            key: patient[key]
            for key in ("name", "description", "moduli", "moduli_spread", "variation", "deviations")
        },
        "echo": config["echo"],
        "valve": config["valve"],
        "mechanics": config["mechanics"],
        "uncertainty": KNOWN_UNCERTAINTY,
        "seed": config["seed"],
    }
    store = Store(config["paths"]["outputs"])
    entry = store.entry("virtual", described, (_simulate, _write), _place, "{key}")

    def write(root: Path, made: _Made) -> None:
        _write(ImagedPlace.within(root), made, patient, described)

    return entry.get_or_make(lambda: _simulate(config), write)


def _place(root: Path) -> ImagedPlace:
    place = ImagedPlace.within(root)
    json.loads((place.truth / HIDDEN).read_text(encoding="utf-8"))
    return place


KNOWN_UNCERTAINTY = {"std_mm": 0.5, "correlation_length_mm": 10.0}
"""What the case of the true positions states: about what the image step does."""


_Made = tuple[ImagedPatient, Probe, VolumeSequence, int]
"""A patient, how it was imaged, and how many anatomies were drawn for it."""


def _simulate(config: Values) -> _Made:
    patient, echo = config["patient"], config["echo"]
    rng = np.random.default_rng(config["seed"])
    moduli = {
        name: float(value * np.exp(patient["moduli_spread"] * rng.standard_normal()))
        for name, value in sorted(patient["moduli"].items())
    }
    values = draw_hidden(moduli, build(Deviations, patient["deviations"]), rng)
    made, draws = _drawn(config, values, rng)
    acquisition = draw_acquisition(rng, spread=echo["spread"])
    probe = draw_probe(rng, acquisition)
    return made, probe, simulate_volume(made.valve, acquisition, probe, config["seed"]), draws


def _write(place: ImagedPlace, found: _Made, patient: Values, described: Values) -> None:
    made, probe, volume, draws = found
    place.truth.mkdir(parents=True)
    # The source of what is simulated names the patient; a file has its name alone.
    write_sequence_nrrd(place.volume, volume)
    frames = CaseFrames(0, made.closed, float(made.pressure_mmHg[made.closed]))
    write_case(place.known, _known_case(true_sequence(made.valve, probe), frames, patient))
    write_json(
        place.truth / HIDDEN,
        {
            "values": dict(made.hidden.values),
            "stated": {"closed_frame": frames.closed, "pressure_mmHg": frames.pressure_mmHg},
            "made_from": dict(described),
            "anatomies_drawn": draws,
        },
    )


def _drawn(
    config: Values, values: Mapping[str, float], rng: np.random.Generator
) -> tuple[ImagedPatient, int]:
    """The first anatomy that closes as a valve does, and how many were drawn."""
    template, scale = template_of(config), config["patient"]["variation"]
    reach = (float(config["echo"]["tip_motion_mm"][0]), float(config["echo"]["tip_motion_mm"][1]))
    for draws in range(1, MAX_DRAWS + 1):
        drawn = Template(vary(template.parameters, rng, scale)) if scale else template
        motion: FloatArray = draw_tip_motion(drawn, reach, rng)
        try:
            made = simulate_imaged_patient(
                config["patient"]["name"],
                drawn,
                values,
                IMAGED,
                MotionSettings(),
                mechanics_of(config),
                motion,
            )
        except GeometryError:
            if draws == MAX_DRAWS:
                raise
            continue
        return made, draws
    raise AssertionError("unreachable")


def _known_case(sequence: ValveSequence, frames: CaseFrames, patient: Values) -> ValveCase:
    n = sequence.layout.size
    stated = replace(
        sequence,
        std_mm=np.full(n, KNOWN_UNCERTAINTY["std_mm"]),
        correlation_length_mm=KNOWN_UNCERTAINTY["correlation_length_mm"],
    )
    texts = CaseTexts(
        patient["name"], f"{patient['description']}, its true positions", "simulated", "MIT", True
    )
    return case_of_sequence(stated, frames, texts)


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_imaged_patient),
    words=lambda record: case_text(flat(record)),
    write=write_volumes,
    write_run=lambda folder, record: write_case_tables(folder, flat(record)),
    keep=kept_of_volume,
    keeps_failures=True,
    sections=(
        Section(
            "volume", title="Moduli from simulated volumes", answer=volumes_answer, headline=True
        ),
    ),
)
