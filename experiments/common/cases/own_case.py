"""A configured case, or the valve in a configured volume, from its files to the result of a run."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from experiments.common.building.closure import mechanics_of, mesh_store
from experiments.common.cases.settings import ImagedInput, PersonalSettings
from experiments.common.progress import PartBar, SolveBar
from experiments.common.records.record import (
    FIELDS,
    NOT_GATED,
    Mesh,
    Model,
    Record,
    has_passed,
)
from experiments.common.schema import Values
from experiments.common.study import Result
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.cases.from_images.detected import (
    CASE,
    DetectedValve,
    detect_in_volume,
    read_for_case,
)
from mvest.cases.plausibility import doubts
from mvest.errors import ConfigurationError
from mvest.imaging.detection.detect import NoValveError
from mvest.personalisation.chain import personalise
from mvest.personalisation.model import with_pressures
from mvest.personalisation.record import arrays_of_case, record_of_case
from mvest.personalisation.settings import (
    CaseChoices,
    PersonaliseSettings,
    Prior,
    with_stiffening,
)
from mvest.problem.record import Row
from mvest.problem.registration import REGISTRATION
from mvest.reporting.case.tables import estimate_text, frame_table, unknown_table

TYPICAL_SOLVES = 8
"""Forward solves of one case; only the progress bar's first guess."""


def settings_of(values: Values, personal: PersonalSettings) -> PersonaliseSettings:
    """How the configuration wants a case to be personalised.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    unknowns = tuple(
        Prior(name, about.mean, about.std, about.treatment == "fixed")
        for name, about in personal.unknowns.items()
    )
    choices = {f.name: getattr(personal, f.name) for f in fields(CaseChoices)}
    return with_stiffening(PersonaliseSettings(unknowns, mechanics_of(values), **choices))


def read_configured(place: str | None) -> ValveCase:
    """The case that a configuration names."""
    if place is None:
        raise ConfigurationError(
            "case is not given; expected case=FOLDER, a folder with case.yaml; "
            "mvest/cases/README.md says what it holds"
        )
    return read_case(Path(place))


def run_case(
    values: Values,
    personal: PersonalSettings,
    case: ValveCase,
    images: Mapping[str, tuple[Row, ...]] | None = None,
    gate: str = NOT_GATED,
) -> Result:
    """Personalise a case; ``gate`` is what the gate said of its anatomy."""
    for sentence in () if images else case.derived:
        print(f"derived: {sentence}", file=sys.stderr)
    for doubt in doubts(case):
        print(f"doubtful: {doubt}", file=sys.stderr)
    settings = with_pressures(case, settings_of(values, personal))
    steps = len(settings.mechanics.protocol.steps())
    free = [u.name for u in settings.unknowns if not u.fixed]
    # As they are estimated: those of the closure first.
    names = sorted(free, key=lambda name: name in REGISTRATION)
    with SolveBar(case.name, steps, TYPICAL_SOLVES, names) as bar:
        fit = personalise(
            case, settings, store=mesh_store(values), on_step=bar.step, on_iterate=bar.iterate
        )
    grid, noise = settings.mesh, case.uncertainty.typical_mm
    estimate = record_of_case(fit, gate=has_passed(gate), images=images)
    return Result(
        tables={"": unknown_table(estimate.unknowns), "frames": frame_table(estimate.frames)},
        estimates=(estimate,),
        arrays=arrays_of_case(fit),
        status=estimate.status,
        reason=estimate.reason,
        detail=estimate.detail,
        mesh=Mesh.of(fit.mesh),
        forward_solves=estimate.forward_solves or 0,
        row=estimate.case,
        parameters=tuple(modulus.name for modulus in estimate.moduli),
        model=Model(
            element=fit.mesh.element_type,
            cells=(grid.columns, grid.rows, 1),
            source=grid.source,
            filter="iterated",
            noise_mm=noise,
        ),
        gate=gate,
    )


def run_volume(
    values: Values,
    file: str | None,
    imaged: ImagedInput,
    personal: PersonalSettings,
    folder: Path,
) -> Result:
    """Find the valve in the configured volume, write it, and personalise the case it makes."""
    from mvest.reporting.images import write_image_step

    detected = find_valve(file, imaged, folder)
    for sentence in detected.sentences:
        print(sentence, file=sys.stderr)
    images = write_image_step(detected, folder)
    return run_case(values, personal, read_case(folder / CASE), images)


def find_valve(
    file: str | None, imaged: ImagedInput, folder: Path, *, estimate: bool = True
) -> DetectedValve:
    """The valve in the configured volume; a candidate that is not accepted is drawn.

    Raises
    ------
    MvestError
        As `detect_in_volume`, and if no file is configured.
    """
    if file is None:
        raise ConfigurationError("volume is not given; expected volume=FILE, a volume over time")
    with PartBar("valve in the frames", 0, "frame") as bar:
        try:
            return detect_in_volume(
                file, imaged, estimate=estimate, progress=lambda _, count: bar.step(count)
            )
        except NoValveError as nothing:
            if nothing.candidate is None:
                raise
            from mvest.reporting.images import draw_candidate

            volume, low = read_for_case(Path(file), imaged), imaged.min_confidence
            drawn = draw_candidate(volume, nothing.candidate, low, folder)
            raise NoValveError(
                f"{nothing}; the best candidate, not accepted, is drawn in {drawn}",
                nothing.candidate,
            ) from nothing


def case_words(record: Record) -> str:
    """What a finished case says on the terminal: the verdict first."""
    return estimate_text(record.estimates[0])


def write_report(folder: Path, record: Record) -> list[Path]:
    """The report of a run's first estimate, and its arrays drawn in it."""
    from mvest.reporting.case.report import report

    fields = folder / FIELDS
    return report(
        record.estimates[0],
        folder,
        arrays=fields if fields.is_file() else None,
        line=record.line,
        provenance=record.provenance.model_dump(),
    )
