"""Images virtual patients in simulated volumes; compares blind estimates with the truth.

A separate process estimates the moduli from the volume file. Two more start from better geometries:
the true geometry (known geometry), and the true geometry with the error of a voxel (perfect
segmentation). Errors that remain in these two are not caused by the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import mechanics_of, template_of
from experiments.common.cases.calibrated import bias_table, calibration_figure, calibration_tables
from experiments.common.cases.own_case import (
    ImagedInput,
    PersonalSettings,
    case_words,
    write_report,
)
from experiments.common.cases.revealed import (
    MODULUS_COLUMNS,
    Groups,
    estimate_hidden,
    modulus_row,
    short,
)
from experiments.common.schema import Values
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import write_case
from mvest.cases.from_images.build import CaseFrames, case_of_sequence
from mvest.cases.tissue import SEEN_CLOSURE
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.imaging.simulator.acquisition import Probe, draw_acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import MovingValve, ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.observation.errors import SpatialCorrelation
from mvest.problem.record import UNCALIBRATED, EstimateRecord
from mvest.problem.registration import REGISTRATION
from mvest.problem.stored import entry_of
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping
from mvest.reporting.skill import skill_table, verdict_table
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.motion import DrawnValve, MotionSettings, chord_ratios, close_in_motion
from mvest.simulation.population import draw_tip_motion
from mvest.simulation.virtual_patient import PatientSettings, draw_patient_values, first_that_closes
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template

Made = tuple[DrawnValve, MovingValve, Probe, VolumeSequence, int]
"""A patient, its true motion and imaging, and the number of anatomies drawn for it."""

VOLUME, HIDDEN, TRUTH, REVEALED = "volume.seq.nrrd", "hidden", "hidden/truth", "hidden.json"
"""In a patient's folder: the estimator's input file; the folder with the better geometries, which
that process cannot open; the folder that no estimation can open; and the truth file."""

KNOWN, SEGMENTED = "known", "segmented"
"""Folders of the better geometries, and names of their estimates in a record."""
SOURCES = {
    "": "the volume",
    UNCALIBRATED: "the volume, uncalibrated",
    SEGMENTED: "a perfect segmentation",
    KNOWN: "the known geometry",
}

MAX_DRAWS = 10
"""Largest number of anatomies drawn to find one that closes as a valve."""

KNOWN_UNCERTAINTY = {"std_mm": 0.5, "correlation_length_mm": 10.0}
"""Stated errors of the true positions, similar to those of the image step."""

VOXELS_CORRELATED = 10.0
"""Correlation length (voxels) of segmentation errors: surfaces of label maps are smoothed."""

SAMPLES = 100
"""Number of error samples in the case of a segmentation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    patient: PatientSettings
    volume: str | None = None  # written by the study
    imaged: ImagedInput = field(default_factory=ImagedInput)
    personal: PersonalSettings
    better: tuple[str, ...] = (KNOWN, SEGMENTED)  # geometries to estimate from besides the volume


# -- run ------------------------------------------------------------------------------------------
def run_imaged_patient(job: Job[Settings]) -> Result:
    """Simulate, estimate from the volume and from better geometries, then reveal the truth."""
    values, folder, personal = job.values, job.folder, job.settings.personal
    place = make_imaged_patient(values, job.settings.patient)
    hidden = read_mapping(place / TRUTH / REVEALED)
    given = {**values, "imaged": {**values["imaged"], **hidden["stated"]}}
    found = estimate_hidden(given, folder, place / VOLUME, place / HIDDEN, personal)
    better = {}
    for name in job.settings.better:
        (folder / name).mkdir(exist_ok=True)
        case = place / HIDDEN / name
        result = estimate_hidden(values, folder / name, case, place / TRUTH, personal)
        better[name] = _numbers_if_converged(result.estimates[0])
    estimate = _numbers_if_converged(found.estimates[0])
    about = {"case": job.settings.patient.name, "seed": values["seed"]}
    others = {"alternatives": {**estimate.alternatives, **better}}
    chordae = hidden["chord_ratios"].items()
    ratios = [{"family": name, "ratio": one} for name, each in chordae for one in each]
    return found.changed(
        tables={"chordae": table(ratios)} if ratios else {},
        numbers={"anatomies_drawn": hidden["anatomies_drawn"]},
        estimates=(estimate.model_copy(update=about | others).with_truth(hidden["values"]),),
        row="",
        gate=None,
    )


def _numbers_if_converged(record: EstimateRecord) -> EstimateRecord:
    """An estimate, without numbers if it did not converge."""
    if record.converged:
        return record
    nothing = dict.fromkeys(("estimate", "std", "low", "high", "bound"))
    unknowns = tuple(own.model_copy(update=nothing) for own in record.unknowns)
    return record.model_copy(update={"unknowns": unknowns})


# -- the patient ----------------------------------------------------------------------------------
def make_imaged_patient(values: Values, patient: PatientSettings) -> Path:
    """The folder of the configured patient; simulates and images the patient once."""
    about = ("name", "description", "moduli", "moduli_spread", "variation", "deviations")
    described = {
        "patient": {key: values["patient"][key] for key in about},
        **{key: values[key] for key in ("valve", "mechanics")},
        "uncertainty": KNOWN_UNCERTAINTY,
        "seed": values["seed"],
    }
    folder = Path(values["paths"]["outputs"]) / "virtual"
    entry = entry_of(folder, described, (_simulate, _write), _place, "{key}")
    return entry.get_or_make(
        lambda: _simulate(values, patient),
        lambda root, made: _write(root, made, patient, described),
    )


def _place(root: Path) -> Path:
    read_mapping(root / TRUTH / REVEALED)
    return root


def _simulate(values: Values, patient: PatientSettings) -> Made:
    rng = np.random.default_rng(values["seed"])
    hidden, mechanics = draw_patient_values(patient, rng), mechanics_of(values)
    # Nothing is displaced: leaflets, annulus and tips are in the same images.
    hidden = {name: value for name, value in hidden.items() if name not in REGISTRATION}

    def simulate(template: Template) -> tuple[DrawnValve, MovingValve]:
        motion = draw_tip_motion(template, rng)
        drawn = DrawnValve(patient.name, template, hidden, mechanics, motion)
        return drawn, close_in_motion(drawn, MotionSettings())

    (drawn, valve), draws = first_that_closes(
        template_of(values), patient.variation, MAX_DRAWS, rng, simulate
    )
    acquisition = draw_acquisition(rng)
    probe = draw_probe(rng, acquisition)
    volume = simulate_volume(valve, acquisition, probe, values["seed"])
    return drawn, valve, probe, volume, draws


def _write(place: Path, imaged: Made, patient: PatientSettings, described: Values) -> None:
    drawn, valve, probe, volume, draws = imaged
    (place / TRUTH).mkdir(parents=True)
    # A simulated volume's source names the patient; the file must not.
    write_sequence_nrrd(place / VOLUME, volume)
    pressure = drawn.mechanics.protocol.pressure_mmHg
    frames = CaseFrames(0, MotionSettings().frames - 1, pressure)
    true, ratios = true_sequence(valve, probe), chord_ratios(drawn, valve, frames.closed)
    seen, samples = _segmented(true, frames, float(volume.spacing.max()), described["seed"])
    stated = replace(
        true,
        std_mm=np.full(true.layout.size, KNOWN_UNCERTAINTY["std_mm"]),
        correlation_length_mm=KNOWN_UNCERTAINTY["correlation_length_mm"],
    )
    better = {
        KNOWN: (stated, "its true positions", None),
        SEGMENTED: (seen, "a perfect segmentation", samples),
    }
    about: dict[str, Any] = {"source": "simulated", "licence": "MIT", "simulated": True}
    for name, (sequence, what, errors) in better.items():
        texts = {"name": patient.name, "description": f"{patient.description}, {what}", **about}
        case = case_of_sequence(sequence, frames, texts, error_samples=errors)
        write_case(place / HIDDEN / name, case)
    write_json(
        place / TRUTH / REVEALED,
        {
            "values": dict(drawn.values),
            "stated": {"closed_frame": frames.closed, "pressure_mmHg": frames.pressure_mmHg},
            "made_from": dict(described),
            "anatomies_drawn": draws,
            "chord_ratios": {name: each.tolist() for name, each in ratios.items()},
        },
    )


def _segmented(
    true: ValveSequence, frames: CaseFrames, voxel_mm: float, seed: int
) -> tuple[ValveSequence, ErrorSamples]:
    """The true positions with a voxel's rounding error, and samples of this error.

    Errors of open frame, closed frame and tips are independent.
    """
    rng = np.random.default_rng([seed, 3])
    std, count = voxel_mm / np.sqrt(12.0), len(true.times)
    length, n = VOXELS_CORRELATED * voxel_mm, true.layout.size
    factor = SpatialCorrelation(true.vertices[frames.open], length).factor

    def errors(samples: int, shown: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        white = rng.standard_normal((samples, count, n, 3))[:, shown]
        tips = rng.standard_normal((samples, count, 2, 3))[:, shown]
        return std * (factor @ white), std * tips

    (leaflets,), (tips,) = errors(1, range(count))
    seen = replace(
        true,
        vertices=true.vertices + leaflets,
        tips=true.tips + tips,
        std_mm=np.full(n, std),
        correlation_length_mm=length,
    )
    vertices, tip_errors = errors(SAMPLES, frames.in_order)
    return seen, ErrorSamples(vertices, tip_errors)


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """Moduli and truths, the skill and bias of each source, and the lengths of chordae.

    Without better geometries: the calibration of the moduli, and what it does.
    """
    if _is_calibration(results):
        return calibration_tables([one for _, one in results.estimates])
    groups = _by_source(results)
    skill = groups.unknowns() | groups.unknowns(by_name=True)
    estimates = [estimate for _, estimate in results.estimates]
    tables = {
        "": _moduli_table(estimates),
        "skill": skill_table("estimated from", skill),
        "bias": bias_table("estimated from", groups.unknowns(by_name=True, stated=False)),
        "verdicts": verdict_table(estimates),
        "chordae": _chordae(results),
    }
    return {name: one for name, one in tables.items() if len(one)}


def _by_source(results: Results, *, verdict_of_volume: bool = False) -> Groups:
    """Estimates by source, each with its own verdict or the verdict on the volume's estimate."""
    return Groups.of(
        (source, estimate, own if verdict_of_volume else estimate)
        for _, own in results.estimates
        for name, source in SOURCES.items()
        if not name or name in own.alternatives
        for estimate in (own.alternatives[name] if name else own,)
    )


def _is_calibration(results: Results) -> bool:
    return not any({KNOWN, SEGMENTED} & one.alternatives.keys() for _, one in results.estimates)


def _figures(results: Results) -> Figures:
    if _is_calibration(results):
        return calibration_figure([one for _, one in results.estimates])
    return {"moduli": _by_source(results, verdict_of_volume=True).figure()}


def _moduli_table(estimates: Sequence[EstimateRecord]) -> Table:
    """A row per patient and modulus, with signed errors."""
    rows = []
    for estimate in estimates:
        for own in estimate.moduli:
            row = {"patient": estimate.case, **modulus_row(estimate, own)}
            for name in (SEGMENTED, KNOWN):
                better = estimate.alternatives[name]
                row[f"error, {name}"] = modulus_row(better, better.unknown(own.name))["error"]
            rows.append(row)
    about = {"patient": Column(label="patient (simulated)"), **MODULUS_COLUMNS}
    for name in (SEGMENTED, KNOWN):
        label = f"error from {SOURCES[name]}"
        about[f"error, {name}"] = replace(MODULUS_COLUMNS["error"], label=label)
    return table(rows, **about)


def _chordae(results: Results) -> Table:
    """True chordal rest length over the distance between the ends when closed, by family.

    ``laid out`` is the ratio that the estimators assume.
    """
    laid_out = {"marginal": SEEN_CLOSURE.marginal_slack, "basal": SEEN_CLOSURE.basal_slack}
    if "chordae" not in results.table_names:
        return table([])
    families = results.table("chordae").frame.groupby("family", sort=False)["ratio"]
    rows = families.agg(ratio="mean", SD="std").reset_index()
    rows["laid out"] = rows["family"].map(laid_out)
    three = Column(digits=".3f")
    return table(rows, family="", ratio=replace(three, std="SD"), **{"laid out": three})


STUDY = Study(
    settings=Settings,
    run=run_imaged_patient,
    summary=summary,
    figure=_figures,
    captions={
        "": "True moduli and their ratio over estimates from volumes, before calibration and after "
        "it, when each patient is left out. Simulated.",
        "moduli": "Estimates with their 95 % intervals over the truth, in the colour of the "
        "verdict on the one from the volume. Simulated.",
    },
    words=case_words,
    files=write_report,
    keep=partial(short, details=("calibration",)),
    keeps_failures=True,
    golden=("patient", "volume"),
)
