"""Virtual patients in simulated volumes: imaged, estimated blindly, then revealed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.anatomy import template_of
from experiments.common.building.closure import mechanics_of
from experiments.common.building.store import Store
from experiments.common.building.virtual_patients import (
    EchoSettings,
    PatientSettings,
    draw_patient_values,
    first_that_closes,
    require_patient,
)
from experiments.common.cases import findings as of_cases
from experiments.common.cases.blind import estimated_or_reason
from experiments.common.records.record import Outcome, Status
from experiments.common.study import Job, Section, Study
from experiments.studies.imaged_patient.findings import (
    KNOWN,
    SEGMENTED,
    Findings,
    KnownGeometry,
    Row,
)
from experiments.studies.imaged_patient.report import (
    volume_text,
    volumes_answer,
    write_run,
    write_volumes,
)
from experiments.studies.imaged_patient.settings import Settings
from mvest.cases.case import ErrorSamples, ValveCase
from mvest.cases.from_images.build import CaseTexts, case_of_sequence
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.cases.writer import write_case
from mvest.errors import InputError
from mvest.imaging.simulator.acquisition_ranges import draw_acquisition
from mvest.imaging.simulator.probe import Probe, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.imaging.writing.slicer import write_sequence_nrrd
from mvest.observation.errors import SpatialCorrelation
from mvest.provenance import write_json
from mvest.reading.json_file import read_mapping
from mvest.reporting.case.findings import UnknownRow
from mvest.simulation.motion.closing import MotionSettings
from mvest.simulation.motion.patient import IMAGED, ImagedPatient, simulate_imaged_patient
from mvest.simulation.motion.population import draw_tip_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template

__all__ = ["STUDY", "ImagedPlace", "make_imaged_patient", "run_imaged_patient", "volume_rows"]

Values = Mapping[str, Any]

VOLUME, TRUTH, HIDDEN = "volume.seq.nrrd", "truth", "hidden.json"
MAX_DRAWS = 10
"""Anatomies that are drawn, one after another, until one closes as a valve does."""


@dataclass(frozen=True, slots=True)
class ImagedPlace:
    """Where an imaged patient lies: the file that an estimator is given, and what it cannot open.

    Hidden are the truth, and a case of where the valve truly was.
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
    def segmented(self) -> Path:
        """Folder of a case with these as a perfect segmentation has them."""
        return self.hidden / SEGMENTED

    @property
    def truth(self) -> Path:
        """Folder of what no estimation is given."""
        return self.hidden / TRUTH


def run_imaged_patient(job: Job[Settings]) -> Outcome[Findings]:
    """Simulate, estimate apart from the volume and from better geometries, reveal.

    Raises
    ------
    InputError
        If neither estimation left anything.
    """
    values, folder = job.values, job.folder
    place = make_imaged_patient(values, job.settings.patient, job.settings.echo)
    hidden = read_mapping(place.truth / HIDDEN)
    stated = {**values, "imaged": {**values["imaged"], **hidden["stated"]}}
    volume = estimated_or_reason(stated, folder, place.volume, place.hidden)
    # Of the known shape nothing is in error but what the estimator cannot know.
    known, segmented = (
        _beside(values, folder / case.name, case, place.truth)
        for case in (place.known, place.segmented)
    )
    lost = volume if isinstance(volume, str) else ""
    run = known if isinstance(volume, str) else volume
    if isinstance(run, str):
        raise InputError(run)
    left = None if lost else run.findings
    findings = Findings(
        rows=volume_rows(job.settings.patient.name, volume, known, segmented, hidden["values"]),
        unknowns=left.case.unknowns if left else (),
        known_geometry=_kept(known),
        segmented=_kept(segmented),
        image_errors=left.case.image_errors if left else None,
        budget=left.case.budget if left else (),
        distances=left.case.distances if left else (),
        repeats=(replace(left.repeats[0], seed=values["seed"]),) if left else (),
        data=left.data if left else None,
        anatomies_drawn=hidden["anatomies_drawn"],
        chord_ratios=hidden["chord_ratios"],
    )
    return Outcome(
        findings=findings,
        status=FAILED if lost else run.status,
        reason=lost or run.reason,
        detail="" if lost else run.detail,
        mesh=run.mesh,
        forward_solves=run.forward_solves,
        parameters=run.parameters,
        model=run.model,
    )


FAILED: Status = "failed"

Estimation = Outcome[of_cases.Findings] | str
"""What an estimation apart left, or why it left nothing."""


def _beside(values: Values, folder: Path, case: Path, sealed: Path) -> Estimation:
    folder.mkdir(exist_ok=True)
    return estimated_or_reason(values, folder, case, sealed)


def _kept(found: Estimation) -> KnownGeometry:
    if isinstance(found, str):
        return KnownGeometry(False, found)
    return KnownGeometry(found.status != FAILED, found.reason, found.findings.case.unknowns)


def volume_rows(
    patient: str,
    volume: Estimation,
    known: Estimation,
    segmented: Estimation,
    truth: Mapping[str, float],
) -> tuple[Row, ...]:
    """Each modulus as estimated from the volume and from better geometries."""
    return tuple(
        Row(
            patient,
            replace(_unknown(volume, known, name), truth=truth[name]),
            _unknown(known, volume, name).estimate,
            None if isinstance(segmented, str) else _unknown(segmented, volume, name).estimate,
            _verdict(volume),
        )
        for name in sorted(name for name in truth if name.startswith("E_f."))
    )


def _verdict(estimation: Estimation) -> str:
    """How far an estimate may be believed, as it says itself; empty where it was not judged."""
    verdict = None if isinstance(estimation, str) else estimation.findings.case.verdict
    return "" if verdict is None else verdict.trust


def _unknown(estimation: Estimation, other: Estimation, name: str) -> UnknownRow:
    """What an estimation says of an unknown; what it was believed to be if it did not converge."""
    left = other if isinstance(estimation, str) else estimation
    assert not isinstance(left, str)
    (row,) = [row for row in left.findings.case.unknowns if row.name == name]
    if left is estimation and left.status != FAILED:
        return row
    return replace(row, estimate=None, std=None, low=None, high=None)


def make_imaged_patient(
    values: Values, patient: PatientSettings | None, echo: EchoSettings
) -> ImagedPlace:
    """Simulate and image the configured patient, unless that was done: where it lies.

    Raises
    ------
    MvestError
        If the configuration is inadmissible or no anatomy that is drawn closes.
    """
    patient = require_patient(patient)
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
    store = Store(values["paths"]["outputs"])
    entry = store.entry("virtual", described, (_simulate, _write), _place, "{key}")

    def write(root: Path, made: _Made) -> None:
        _write(ImagedPlace.within(root), made, patient, described)

    return entry.get_or_make(lambda: _simulate(values, patient, echo), write)


def _place(root: Path) -> ImagedPlace:
    place = ImagedPlace.within(root)
    read_mapping(place.truth / HIDDEN)
    return place


KNOWN_UNCERTAINTY = {"std_mm": 0.5, "correlation_length_mm": 10.0}
"""What the case of the true positions states: about what the image step does."""


VOXELS_ALIKE = 10.0
"""Over how many voxels errors of a segmentation are alike: surfaces of label maps are smoothed, and
rougher ones cannot be meshed."""

SAMPLES = 100
"""Of the errors of a segmentation, that go with its case."""


_Made = tuple[ImagedPatient, Probe, VolumeSequence, int]
"""A patient, how it was imaged, and how many anatomies were drawn for it."""


def _simulate(values: Values, patient: PatientSettings, echo: EchoSettings) -> _Made:
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


def _write(place: ImagedPlace, imaged: _Made, patient: PatientSettings, described: Values) -> None:
    made, probe, volume, draws = imaged
    place.truth.mkdir(parents=True)
    # The source of what is simulated names the patient; a file has its name alone.
    write_sequence_nrrd(place.volume, volume)
    frames = CaseFrames(0, made.closed, float(made.pressure_mmHg[made.closed]))
    true = true_sequence(made.valve, probe)
    write_case(place.known, _known_case(true, frames, patient))
    segmented = _segmented_case(
        true, frames, patient, float(volume.spacing.max()), described["seed"]
    )
    write_case(place.segmented, segmented)
    write_json(
        place.truth / HIDDEN,
        {
            "values": dict(made.hidden.values),
            "stated": {"closed_frame": frames.closed, "pressure_mmHg": frames.pressure_mmHg},
            "made_from": dict(described),
            "anatomies_drawn": draws,
            "chord_ratios": {name: each.tolist() for name, each in made.chord_ratios().items()},
        },
    )


def _known_case(sequence: ValveSequence, frames: CaseFrames, patient: PatientSettings) -> ValveCase:
    n = sequence.layout.size
    stated = replace(
        sequence,
        std_mm=np.full(n, KNOWN_UNCERTAINTY["std_mm"]),
        correlation_length_mm=KNOWN_UNCERTAINTY["correlation_length_mm"],
    )
    texts = CaseTexts(
        patient.name, f"{patient.description}, its true positions", "simulated", "MIT", True
    )
    return case_of_sequence(stated, frames, texts)


def _segmented_case(
    true: ValveSequence, frames: CaseFrames, patient: PatientSettings, voxel_mm: float, seed: int
) -> ValveCase:
    """The true positions as a label map without mistakes has them: to the error of a voxel.

    The error of a position that is rounded to a voxel, in open and closed frame and of the tips,
    independent of each other, and samples of it.
    """
    rng = np.random.default_rng([seed, 3])
    std, count = voxel_mm / np.sqrt(12.0), len(true.times)
    length, n = VOXELS_ALIKE * voxel_mm, true.layout.size
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
    texts = CaseTexts(
        patient.name, f"{patient.description}, a perfect segmentation", "simulated", "MIT", True
    )
    return case_of_sequence(seen, frames, texts, error_samples=ErrorSamples(vertices, tip_errors))


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_imaged_patient,
    words=volume_text,
    write=write_volumes,
    write_run=write_run,
    keeps_failures=True,
    sections=(
        Section(
            "volume", title="Moduli from simulated volumes", answer=volumes_answer, headline=True
        ),
        Section(
            "volume_budget",
            {
                "volume_budget": "Where the information dies between a volume and a modulus. "
                "Simulated."
            },
            title="What is not known costs the moduli.",
            table="volume",
        ),
    ),
)
