"""Images virtual patients in simulated volumes; compares blind estimates with the truth.

A separate process estimates the moduli from the volume file. Two more start from better geometries:
the true geometry (known geometry), and the true geometry with the error of a voxel (perfect
segmentation). Errors that remain in these two are not caused by the images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import linregress, sem

from experiments.common.building.closure import mechanics_of, template_of
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
from mvest.cache import Entry
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import write_case
from mvest.cases.from_images.build import CaseFrames, case_of_sequence
from mvest.cases.tissue import SEEN_CLOSURE
from mvest.errors import InputError
from mvest.estimation.recalibration import left_out
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.imaging.simulator.acquisition import Probe, draw_acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import MovingValve, ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.observation.errors import SpatialCorrelation
from mvest.personalisation.calibration import calibrate, pairs_of
from mvest.problem.record import UNCALIBRATED, EstimateRecord, Unknown
from mvest.problem.registration import REGISTRATION
from mvest.problem.stored import key_of
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping
from mvest.reporting.skill import HALF, skill_table, verdict_table
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.motion import DrawnValve, MotionSettings, chord_ratios, close_in_motion
from mvest.simulation.population import draw_tip_motion
from mvest.simulation.virtual_patient import PatientSettings, draw_patient_values, first_that_closes
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    entry = Entry(folder / key_of(described, "experiments"), _place)
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


# -- calibration ----------------------------------------------------------------------------------
# Each patient's calibrated estimate is predicted from all other patients (left out).
TICKS = (0.3, 0.5, 1.0, 2.0, 3.0)
BEFORE, AFTER = UNCALIBRATED, "calibrated"


def before_and_after(estimates: Sequence[EstimateRecord]) -> dict[str, list[Unknown]]:
    """``uncalibrated, NAME`` and ``calibrated, NAME`` -> moduli and their ratios, by patient.

    All are relative to their prior means. InputError as `pairs_of`.
    """
    pairs = pairs_of(estimates)
    names = [str(name).removeprefix("E_f.") for name in pairs.row["parameters"]]
    directions = dict(zip(names, np.eye(len(names)), strict=True))
    for a, b in combinations(names, 2):
        directions[f"{a} / {b}"] = directions[a] - directions[b]
    own = pairs.estimates[0].moduli
    prior = np.array([float(m.prior_std or 0) / float(m.prior_mean or 1) for m in own])

    def along(name: str, means: FloatArray, covariances: FloatArray) -> list[Unknown]:
        d = directions[name]
        stds = np.sqrt(np.einsum("i,nij,j->n", d, covariances, d))
        return [
            Unknown(
                name=f"E_f.{name}",
                kind="modulus" if name in names else "quantity",
                prior_mean=1.0,
                prior_std=float(np.linalg.norm(d * prior)),
                estimate=float(np.exp(mean)),
                std=float(np.exp(mean) * std),
                low=float(np.exp(mean - HALF * std)),
                high=float(np.exp(mean + HALF * std)),
                truth=float(np.exp(truth)),
            )
            for mean, std, truth in zip(means @ d, stds, pairs.truth @ d, strict=True)
        ]

    found = {BEFORE: (pairs.x, pairs.V), AFTER: left_out(pairs.x, pairs.V, pairs.truth)}
    return {f"{when}, {name}": along(name, *found[when]) for name in directions for when in found}


def calibration_tables(estimates: Sequence[EstimateRecord]) -> dict[str, Table]:
    """The calibration, and skill and bias of the estimates before and after it, left out.

    Only the reason if there is none: too few patients, or some of other detectors.
    """
    try:
        known, groups = calibrate(estimates), before_and_after(estimates)
    except InputError as fault:
        return {"": table([{"no calibration": str(fault)}])}
    measured = known.measured
    stds = np.sqrt(np.diag(measured.covariance)).reshape(2, -1)
    columns = {
        "modulus": known.parameters,
        "offset": measured.offset,
        "offset SD": stds[0],
        "slope": measured.slope,
        "slope SD": stds[1],
        "spread": np.exp(measured.log_spread),
        "spread SD": np.exp(measured.log_spread) * np.sqrt(np.diag(measured.log_spread_covariance)),
    }
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    about = {name: Column(digits=".2f", std=f"{name} SD") for name in ("offset", "slope", "spread")}
    return {
        "": table(
            [row | {"patients": known.patients, "simulated": known.simulated} for row in rows],
            modulus=Column(),
            **about,
        ),
        "skill": skill_table("estimate", groups),
        "bias": bias_table("estimate", groups, of_truth=True),
    }


def bias_table(
    by: str, groups: Mapping[str, Sequence[Unknown]], *, of_truth: bool = False
) -> Table:
    """Mean error of the logarithms, and their slope over the truths', if they have estimates.

    With ``of_truth`` the truths' slope over the estimates, which is 1 after a calibration.
    """
    rows = []
    for name, own in groups.items():
        known = [(one.truth, one.estimate) for one in own if one.estimate is not None]
        truth, found = np.log(np.array(known, dtype=np.float64).reshape(-1, 2).T)
        row = {by: name, "n": len(known), **dict.fromkeys(("bias", "bias SE", "slope", "slope SE"))}
        if len(known) > 1:
            row |= {"bias": np.mean(found - truth), "bias SE": sem(found - truth)}
        if len(known) > 2 and np.ptp(truth) > 0:
            line = linregress(found, truth) if of_truth else linregress(truth, found)
            row |= {"slope": line.slope, "slope SE": line.stderr}
        rows.append(row)
    digits, text = (
        (".3f", "the truth's slope over it") if of_truth else (".2f", "slope over the truth's")
    )
    bias = Column(digits=digits, std="bias SE", label="mean error of the logarithm ± SE")
    slope = Column(digits=".2f", std="slope SE", label=f"{text} ± SE")
    return table(rows, **{by: Column(), "n": Column()}, bias=bias, slope=slope)


def calibration_figure(estimates: Sequence[EstimateRecord]) -> dict[str, Figure]:
    """True moduli and ratios over their estimates before and after calibration, left out.

    Nothing if there is no calibration.
    """
    from mvest.reporting.figures import COLOURS, GREY, panels

    try:
        groups: Mapping[str, Sequence[Unknown]] = before_and_after(estimates)
    except InputError:
        return {}
    names = list(dict.fromkeys(group.partition(", ")[2] for group in groups))
    drawn, (grid,) = panels(1, len(names), 3.4)
    for axes, name in zip(grid, names, strict=True):
        for when, colour, marker in ((BEFORE, GREY, "x"), (AFTER, COLOURS[0], "o")):
            own = groups[f"{when}, {name}"]
            x, truth = ([getattr(one, key) for one in own] for key in ("estimate", "truth"))
            axes.plot(x, truth, marker, color=colour, ms=4, ls="", label=when)
        axes.axline((1.0, 1.0), (2.0, 2.0), color="0.3", lw=0.8)
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_ticks(TICKS, labels=[f"{tick:g}" for tick in TICKS])
        axes.minorticks_off()
        axes.set_title(f"E_f {name}", fontsize=9)
        axes.set_xlabel("estimate / prior mean")
    grid[0].set_ylabel("truth / prior mean")
    grid[0].legend(fontsize=8, frameon=False)
    return {"": drawn}


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
