"""Virtual patients in simulated volumes: imaged, estimated blindly, then revealed.

A process of its own goes from the file of a volume to the moduli. Two others start from better
geometries: from where the valve truly was (known geometry), and from that with the error of a voxel
(perfect segmentation). What is left of the error there is not the images'.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import linregress, sem

from experiments.common.building.closure import mechanics_of, template_of
from experiments.common.cases.blind import estimated_or_reason
from experiments.common.cases.own_case import case_words, write_report
from experiments.common.cases.settings import ImagedInput, PersonalSettings
from experiments.common.records.record import Record
from experiments.common.schema import Values
from experiments.common.study import Job, Result, Results, Study
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import write_case
from mvest.cases.from_images.build import CaseFrames, case_of_sequence
from mvest.cases.tissue import SEEN_CLOSURE
from mvest.errors import InputError
from mvest.exchange.segmentations import write_sequence_nrrd
from mvest.imaging.simulator.acquisition import Probe, draw_acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.observation.errors import SpatialCorrelation
from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.stored import entry_of
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping
from mvest.reporting.skill import (
    GENERIC,
    generic_guess,
    interval,
    interval_columns,
    moduli_figure,
    skill_table,
    stated,
    trust_of,
    verdict_table,
)
from mvest.reporting.tables import Column, Table, joined, table
from mvest.simulation.drawn_patient import (
    EchoSettings,
    PatientSettings,
    draw_patient_values,
    first_that_closes,
)
from mvest.simulation.imaged_patient import IMAGED, ImagedPatient, simulate_imaged_patient
from mvest.simulation.motion import MotionSettings
from mvest.simulation.population import draw_tip_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Made = tuple[ImagedPatient, Probe, VolumeSequence, int]
"""A patient, how it was imaged, and how many anatomies were drawn for it."""

VOLUME, HIDDEN, TRUTH = "volume.seq.nrrd", "hidden", "hidden/truth"
"""In the folder of a patient: the file that an estimator is given, the folder that it cannot open,
with the truth and the cases of better geometries, and what no estimation is given."""

REVEALED = "hidden.json"
KNOWN, SEGMENTED = "known", "segmented"
"""Folders of the better geometries, and what a record calls the estimates from them."""

SOURCES = {
    "": "the volume",
    SEGMENTED: "a perfect segmentation",
    KNOWN: "the known geometry",
}

MAX_DRAWS = 10
"""Anatomies that are drawn, one after another, until one closes as a valve does."""

KNOWN_UNCERTAINTY = {"std_mm": 0.5, "correlation_length_mm": 10.0}
"""What the case of the true positions states: about what the image step does."""

VOXELS_CORRELATED = 10.0
"""Voxels over which errors of a segmentation are correlated: surfaces of label maps are smoothed,
and rougher ones cannot be meshed."""

SAMPLES = 100
"""Of the errors of a segmentation, that go with its case."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    echo: EchoSettings = field(default_factory=EchoSettings)
    volume: str | None = None  # written by the study
    imaged: ImagedInput = field(default_factory=ImagedInput)
    personal: PersonalSettings


# -- run ------------------------------------------------------------------------------------------
def run_imaged_patient(job: Job[Settings]) -> Result:
    """Simulate, estimate from the volume and from better geometries, reveal.

    Raises
    ------
    InputError
        If neither the volume nor the known geometry left an estimation.
    """
    values, folder = job.values, job.folder
    place = make_imaged_patient(values, job.settings.patient, job.settings.echo)
    hidden = read_mapping(place / TRUTH / REVEALED)
    given = {**values, "imaged": {**values["imaged"], **hidden["stated"]}}
    found = {"": estimated_or_reason(given, folder, place / VOLUME, place / HIDDEN)}
    for name in (KNOWN, SEGMENTED):
        (folder / name).mkdir(exist_ok=True)
        found[name] = estimated_or_reason(
            values, folder / name, place / HIDDEN / name, place / TRUTH
        )
    main = found[""]
    run = found[KNOWN] if isinstance(main, str) else main
    if isinstance(run, str):
        raise InputError(run)
    estimates = {name: _estimate(each, run.estimates[0]) for name, each in found.items()}
    better = {name: estimates[name] for name in (KNOWN, SEGMENTED)}
    estimate = estimates[""].model_copy(
        update={
            "case": job.settings.patient.name,
            "seed": values["seed"],
            "alternatives": {**estimates[""].alternatives, **better},
        }
    )
    ratios = [
        {"family": name, "ratio": one}
        for name, each in hidden["chord_ratios"].items()
        for one in each
    ]
    lost = main if isinstance(main, str) else ""
    return run.changed(
        tables={"chordae": table(ratios)} if ratios else {},
        numbers={"anatomies_drawn": hidden["anatomies_drawn"]},
        arrays={} if lost else run.arrays,
        estimates=(estimate.with_truth(hidden["values"]),),
        status="failed" if lost else run.status,
        reason=lost or run.reason,
        detail="" if lost else run.detail,
        row="",
        gate=None,
    )


def _estimate(found: Result | str, other: EstimateRecord) -> EstimateRecord:
    """What an estimation left; unknowns have no numbers where it did not converge."""
    if isinstance(found, str):
        record = EstimateRecord(status="failed", reason=found, unknowns=other.parameters)
    else:
        record = found.estimates[0]
    if record.converged:
        return record
    nothing = dict.fromkeys(("estimate", "std", "low", "high", "bound"))
    unknowns = tuple(own.model_copy(update=nothing) for own in record.unknowns)
    return record.model_copy(update={"unknowns": unknowns})


# -- the patient ----------------------------------------------------------------------------------
def make_imaged_patient(values: Values, patient: PatientSettings, echo: EchoSettings) -> Path:
    """Simulate and image the configured patient, unless that was done: the folder where it lies."""
    described = {
        "patient": {
            key: values["patient"][key]
            for key in ("name", "description", "moduli", "moduli_spread", "variation", "deviations")
        },
        "echo": values["echo"],
        "valve": values["valve"],
        "mechanics": values["mechanics"],
        "uncertainty": KNOWN_UNCERTAINTY,
        "seed": values["seed"],
    }
    folder = Path(values["paths"]["outputs"]) / "virtual"
    entry = entry_of(folder, described, (_simulate, _write), _place, "{key}")
    return entry.get_or_make(
        lambda: _simulate(values, patient, echo),
        lambda root, made: _write(root, made, patient, described),
    )


def _place(root: Path) -> Path:
    read_mapping(root / TRUTH / REVEALED)
    return root


def _simulate(values: Values, patient: PatientSettings, echo: EchoSettings) -> Made:
    rng = np.random.default_rng(values["seed"])
    hidden, mechanics = draw_patient_values(patient, rng), mechanics_of(values)

    def simulate(drawn: Template) -> ImagedPatient:
        motion = draw_tip_motion(drawn, echo.tip_motion_mm, rng)
        return simulate_imaged_patient(
            patient.name, drawn, hidden, IMAGED, MotionSettings(), mechanics, motion
        )

    made, draws = first_that_closes(
        template_of(values), patient.variation, MAX_DRAWS, rng, simulate
    )
    acquisition = draw_acquisition(rng, spread=echo.spread)
    probe = draw_probe(rng, acquisition)
    return made, probe, simulate_volume(made.valve, acquisition, probe, values["seed"]), draws


def _write(place: Path, imaged: Made, patient: PatientSettings, described: Values) -> None:
    made, probe, volume, draws = imaged
    (place / TRUTH).mkdir(parents=True)
    # The source of what is simulated names the patient; a file has its name alone.
    write_sequence_nrrd(place / VOLUME, volume)
    frames = CaseFrames(0, made.closed, made.pressure_mmHg)
    true = true_sequence(made.valve, probe)
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
    for name, (sequence, what, errors) in better.items():
        about = f"{patient.description}, {what}"
        texts = {
            "name": patient.name, "description": about, "source": "simulated", "licence": "MIT",
            "simulated": True,
        }  # fmt: skip
        case = case_of_sequence(sequence, frames, texts, error_samples=errors)
        write_case(place / HIDDEN / name, case)
    write_json(
        place / TRUTH / REVEALED,
        {
            "values": dict(made.values),
            "stated": {"closed_frame": frames.closed, "pressure_mmHg": frames.pressure_mmHg},
            "made_from": dict(described),
            "anatomies_drawn": draws,
            "chord_ratios": {name: each.tolist() for name, each in made.chord_ratios().items()},
        },
    )


def _segmented(
    true: ValveSequence, frames: CaseFrames, voxel_mm: float, seed: int
) -> tuple[ValveSequence, ErrorSamples]:
    """The true positions as a label map without mistakes has them: to the error of a voxel.

    The error of a position that is rounded to a voxel, in open and closed frame and of the tips,
    independent of each other, and samples of it.
    """
    rng = np.random.default_rng([seed, 3])
    std, count = voxel_mm / np.sqrt(12.0), len(true.times)
    length, n = VOXELS_CORRELATED * voxel_mm, true.layout.size
    factor = SpatialCorrelation(true.vertices[frames.open], length).factor

    def errors(samples: int) -> tuple[FloatArray, FloatArray]:
        white = rng.standard_normal((samples, count, n, 3))
        tips = rng.standard_normal((samples, count, 2, 3))
        return std * np.einsum("nk,sfkd->sfnd", factor, white), std * tips

    (leaflets,), (tips,) = errors(1)
    seen = replace(
        true,
        vertices=true.vertices + leaflets,
        tips=true.tips + tips,
        std_mm=np.full(n, std),
        correlation_length_mm=length,
    )
    vertices, tip_errors = (each[:, frames.in_order] for each in errors(SAMPLES))
    return seen, ErrorSamples(vertices, tip_errors)


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """Moduli beside the truth, what they are worth, and what costs them how much."""
    estimates = _estimates(results)
    shares = _shares(estimates)
    tables = {
        "": _moduli_table(estimates),
        "skill": _skill(estimates),
        "bias": _bias(estimates),
        "verdicts": verdict_table(estimates),
        "chordae": _chordae(results),
        "shares": _medians(shares),
        "shares_of_patients": table(shares),
    }
    return {name: one for name, one in tables.items() if len(one)}


def _estimates(results: Results) -> list[EstimateRecord]:
    return [one.estimates[0] for one in results.records.values() if one.estimates]


def _by_source(
    estimates: Sequence[EstimateRecord],
) -> Iterator[tuple[str, EstimateRecord, EstimateRecord]]:
    """What was estimated from, the estimate from that, and the patient's own."""
    for estimate in estimates:
        for name, source in SOURCES.items():
            yield source, estimate.alternatives[name] if name else estimate, estimate


def _moduli_table(estimates: Sequence[EstimateRecord]) -> Table:
    """A row for each patient and modulus.

    Errors have a sign: that from the known geometry and the part from the images add up to the
    whole.
    """
    rows = []
    for estimate in estimates:
        for own in estimate.moduli:
            better = {
                name: estimate.alternatives[name].unknown(own.name) for name in (SEGMENTED, KNOWN)
            }
            error, of_known = _percent(own), _percent(better[KNOWN])
            rows.append(
                {
                    "patient": estimate.case,
                    "modulus": own.name,
                    "truth": own.truth,
                    "stated": own.estimate if estimate.is_stated else None,
                    **interval("estimate", own),
                    "verdict": trust_of(estimate),
                    "error": error,
                    **{f"error, {name}": _percent(one) for name, one in better.items()},
                    "part from images": None
                    if error is None or of_known is None
                    else error - of_known,
                    f"error, {GENERIC}": _percent(generic_guess(own)),
                }
            )
    about = {"patient": Column(label="patient (simulated)"), "modulus": Column()}
    about |= {"truth": Column("MPa")} | interval_columns("estimate", hidden=True)
    about["stated"] = replace(about["estimate"], label="estimate", hidden=False)
    percent = Column("%", "+.1f")
    about |= {"verdict": Column(), "error": percent}
    about[f"error, {SEGMENTED}"] = replace(percent, label="error from a perfect segmentation")
    about[f"error, {KNOWN}"] = replace(percent, label="error from the known geometry")
    about["part from images"] = percent
    about[f"error, {GENERIC}"] = replace(percent, hidden=True)
    return table(rows, **about)


def _percent(unknown: Unknown) -> float | None:
    error = unknown.relative_error
    return None if error is None else 100.0 * error


def _moduli_by_source(estimates: Sequence[EstimateRecord]) -> dict[str, list[Unknown]]:
    """What a modulus was estimated from, and which -> those of all patients."""
    groups: dict[str, list[Unknown]] = {}
    for source, one, _ in _by_source(estimates):
        for own in one.moduli:
            groups.setdefault(f"{source}, {own.name}", []).append(own)
    return groups


def _skill(estimates: Sequence[EstimateRecord]) -> Table:
    """What moduli are worth, together and each; those from volumes as far as they are stated."""
    each = _moduli_by_source(
        [one.model_copy(update={"unknowns": tuple(stated(one))}) for one in estimates]
    )
    both = {
        source: [own for name, moduli in each.items() if name.startswith(source) for own in moduli]
        for source in SOURCES.values()
    }
    return skill_table("estimated from", both | each)


def _bias(estimates: Sequence[EstimateRecord]) -> Table:
    """Mean error of each modulus' logarithm, and how far estimates follow the truth.

    Of all that converged, also of those that the verdict denies: it does not see the truth.
    """
    rows = []
    for source, moduli in _moduli_by_source(estimates).items():
        known = [(own.truth, own.estimate) for own in moduli if own.estimate is not None]
        truth, found = np.log(np.array(known, dtype=np.float64).reshape(-1, 2).T)
        row = {"estimated from": source, "n": len(known)}
        row |= dict.fromkeys(("bias", "bias SE", "slope", "slope SE"))
        if len(known) > 1:
            row |= {"bias": np.mean(found - truth), "bias SE": sem(found - truth)}
        if len(known) > 2 and np.ptp(truth) > 0:
            line = linregress(truth, found)
            row |= {"slope": line.slope, "slope SE": line.stderr}
        rows.append(row)
    about = {"estimated from": Column(), "n": Column()}
    about["bias"] = Column(digits=".2f", std="bias SE", label="mean error of the logarithm ± SE")
    about["slope"] = Column(digits=".2f", std="slope SE", label="slope over the truth's ± SE")
    return table(rows, **about)


def _chordae(results: Results) -> Table:
    """True rest length over the distance of a chord's ends in the closed valve, by family.

    Beside it the ratio by which estimators lay chordae out.
    """
    laid_out = {"marginal": SEEN_CLOSURE.marginal_slack, "basal": SEEN_CLOSURE.basal_slack}
    having = {k: one for k, one in results.records.items() if "chordae" in one.tables}
    if not having:
        return table([])
    chordae = joined({name: one.table_of("chordae") for name, one in having.items()}).frame
    by_family, by_patient = (
        chordae.groupby(keys, sort=False)["ratio"] for keys in ("family", ["family", "run"])
    )
    rows = by_family.agg(ratio="mean", SD="std")
    means = by_patient.mean().groupby("family", sort=False)
    rows.insert(0, "patients", means.size())
    rows["SD of patients"] = means.std().fillna(0.0)
    rows["laid out"] = rows.index.map(laid_out)
    about = {"family": Column(), "patients": Column(), "ratio": Column(digits=".3f", std="SD")}
    about |= dict.fromkeys(("SD of patients", "laid out"), Column(digits=".3f"))
    return table(rows.reset_index(), **about)


def _shares(estimates: Sequence[EstimateRecord]) -> list[dict[str, Any]]:
    """Where the variance of each modulus' logarithm comes from in each patient, to first order."""
    return [
        {"patient": estimate.case, **row}
        for estimate in estimates
        for row in estimate.detail_rows("shares")
    ]


def _medians(shares: Sequence[Mapping[str, Any]]) -> Table:
    """Medians over patients."""
    import pandas as pd

    if not shares:
        return table([])
    sources = pd.DataFrame(shares).groupby(["source", "parameter"], sort=False)
    medians = sources[["share"]].median().reset_index()
    return table(medians, source="", parameter="::modulus", share=":.3f")


# -- figure ---------------------------------------------------------------------------------------
def figure(results: Results) -> dict[str, Figure]:
    """Estimates from all sources over their truths."""
    groups: dict[str, list[tuple[Unknown, str]]] = {source: [] for source in SOURCES.values()}
    for source, one, own in _by_source(_estimates(results)):
        groups[source] += [(modulus, trust_of(own)) for modulus in one.moduli]
    return {"moduli": moduli_figure(groups)}


def keep(record: Record) -> Record:
    """What tables and figures need of a record."""
    kept = []
    for estimate in record.estimates:
        short = estimate.without_details("shares")
        better = {
            name: other.model_copy(update={"unknowns": other.moduli})
            for name, other in short.alternatives.items()
        }
        update = {"unknowns": short.moduli, "alternatives": better}
        kept.append(short.model_copy(update=update))
    return record.model_copy(update={"estimates": tuple(kept)})


STUDY = Study(
    settings=Settings,
    run=run_imaged_patient,
    summary=summary,
    figure=figure,
    captions={
        "moduli": "Estimates with their 95 % intervals over the truth, in the colour of the "
        "verdict on the one from the volume. Simulated.",
    },
    words=case_words,
    files=write_report,
    keep=keep,
    keeps_failures=True,
)
