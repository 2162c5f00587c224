"""A configured case, or the valve in a configured volume: settings, check and result."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from experiments.common.building.closure import mechanics_of, mesh_store
from experiments.common.building.gate import gate_rows
from experiments.common.progress import PartBar, SolveBar, say, solving
from experiments.common.records.record import FIELDS, NOT_GATED, Mesh, Model, Record, has_passed
from experiments.common.schema import InputFile, Reads, Values, build, contents
from experiments.common.study import Result
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.cases.from_images.detected import (
    CASE,
    DetectedValve,
    ImagedSettings,
    detect_in_volume,
    read_for_case,
)
from mvest.cases.plausibility import implausible_values
from mvest.cases.schema import files_of_case
from mvest.closure.physiology import open_physiology
from mvest.errors import ConfigurationError
from mvest.exchange.volumes import files_of_volume
from mvest.imaging.detection.detect import NoValveError
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.calibration import CALIBRATIONS
from mvest.personalisation.chain import personalise
from mvest.personalisation.design import expect_case
from mvest.personalisation.model import build_coarse, gate_case, with_pressures
from mvest.personalisation.record import arrays_of_case, record_of_case
from mvest.personalisation.result import Expected
from mvest.personalisation.settings import (
    PACKAGE,
    CaseChoices,
    PersonaliseSettings,
    Prior,
    with_stiffening,
)
from mvest.problem.record import Row
from mvest.problem.registration import REGISTRATION
from mvest.quantities import Value
from mvest.reporting.case.tables import estimate_text, frame_table, unknown_table

CaseInput = Annotated[
    str | None, Reads(lambda value, _: contents(files_of_case(Path(value))) or value)
]
"""Type of a setting that names the folder of a case."""

VolumeInput = Annotated[
    str | None, Reads(lambda value, _: contents(files_of_volume(Path(value))) or value)
]
"""Type of a setting that names the file of a volume over time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownSettings:
    """An unknown quantity of a case: its prior, and whether it is estimated."""

    mean: Value
    std: Value
    treatment: Literal["estimated", "fixed"] = "estimated"


def _calibration_read(value: str, _: Values) -> Any:
    """The content of a calibration, or of all those of the package."""
    place = CALIBRATIONS if value == PACKAGE else Path(value)
    return contents(place) if place.exists() else value


@dataclass(frozen=True, slots=True, kw_only=True)
class PersonalSettings(CaseChoices):
    """How a case is personalised; with ``errors`` the noise is learned from these beliefs."""

    unknowns: dict[str, UnknownSettings] = field(default_factory=dict)
    errors: ErrorBeliefs | None = None
    calibration: Annotated[str | None, Reads(_calibration_read)] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedInput(ImagedSettings):
    """From a volume to a case; the hash depends on the content of the named files."""

    model: InputFile = None
    package_model: str | None = "${package_model:}"  # SHA-256 of the one for ultrasound
    pressure_curve: InputFile = None


def settings_of(values: Values, personal: PersonalSettings) -> PersonaliseSettings:
    """The configured settings of a personalisation."""
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
    """Personalise a case; ``gate`` is the verdict of the gate on its anatomy."""
    for sentence in () if images else case.derived:
        say(f"derived: {sentence}")
    for value in implausible_values(case):
        say(f"implausible: {value}")
    settings = with_pressures(case, settings_of(values, personal))
    steps = len(settings.mechanics.protocol.steps())
    free = [u.name for u in settings.unknowns if not u.fixed]
    names = sorted(free, key=lambda name: name in REGISTRATION)  # the order of estimation
    with SolveBar(case.name, steps, names) as bar:
        fit = personalise(
            case, settings, store=mesh_store(values), on_step=bar.step, on_iterate=bar.iterate
        )
    grid = settings.mesh
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
            noise_mm=case.uncertainty.typical_mm,
        ),
        gate=gate,
    )


def run_volume(
    values: Values, file: str | None, imaged: ImagedInput, personal: PersonalSettings, folder: Path
) -> Result:
    """Find the valve in the configured volume, write it, and personalise the case it makes."""
    from mvest.reporting.images import write_image_step

    detected = find_valve(file, imaged, folder)
    for sentence in detected.sentences:
        say(sentence)
    images = write_image_step(detected, folder, draw=bool(values["figures"]))
    return run_case(values, personal, read_case(folder / CASE), images)


def find_valve(
    file: str | None, imaged: ImagedInput, folder: Path, *, estimate: bool = True
) -> DetectedValve:
    """The valve in a volume; a rejected candidate is drawn, and a `NoValveError` raised."""
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
    """The text of a finished case for the terminal, with the verdict first."""
    return estimate_text(record.estimates[0])


def write_report(folder: Path, record: Record) -> list[Path]:
    """Write the report of a run's first estimate."""
    from mvest.reporting.case.report import report

    fields = folder / FIELDS
    return report(
        record.estimates[0],
        folder,
        arrays=fields if fields.is_file() else None,
        line=record.line,
        provenance=record.provenance.model_dump(),
    )


def check(values: Values, case: ValveCase, folder: Path, *, gate: bool = False) -> str:
    """Check and draw a case, and predict how well its moduli could be estimated.

    The folder of the run gets the same as ``check.html``. With ``gate`` it is tested for minutes
    whether the closed state is the only one.
    """
    from mvest.reporting.case.figures import frames_figure
    from mvest.reporting.case.report import check_page
    from mvest.reporting.case.tables import expected_tables
    from mvest.reporting.figures import save_figure_with

    settings = settings_of(values, build(PersonalSettings, values["personal"]))
    coarse = build_coarse(case, settings, mesh_store(values))
    figure = frames_figure(case, coarse.contact_reach_mm)
    drawn = save_figure_with(folder / "case", figure, f"case {case.sha256[:12]}")
    lines = [*str(case).splitlines(), *(f"derived: {sentence}" for sentence in case.derived)]
    if gate:
        with PartBar(f"{case.name}, gate", 1, "test") as bar:
            report = gate_case(case, settings, mesh_store(values))
            bar.step()
        verdict = "passed" if report.passed else "NOT passed: the closed state is not unique"
        lines += [f"gate {verdict}", *gate_rows(report).text().splitlines()]
    strange = implausible_values(case)
    lines += [f"{'MISTAKE?' if one.mistake else 'implausible'}: {one}" for one in strange]
    lines.append(
        f"Implausible values: {len(strange)}; look at them before anything is estimated "
        "(strict=true refuses them)"
        if strange
        else "In order"
    )
    expected = Expected(reason="an open frame alone, from which nothing can be estimated")
    if case.closed is not None:
        with solving(case.name, coarse):
            expected = expect_case(case, settings, coarse)
    of = "the generic valve, closed on a coarse mesh"
    if not expected.physiology:
        expected = replace(expected, physiology=open_physiology(coarse.valve))
        of = "the open frame, since no valve was closed"
    lines.append(f"Published ranges stand beside {of}")
    page = check_page(folder, case.name, lines, expected, drawn[-1])
    texts = [f"{name}\n{one.text()}" for name, one in expected_tables(expected).items()]
    if not expected.unknowns:
        texts.insert(0, f"how well moduli could be estimated is not known: {expected.reason}")
    return "\n".join([*lines, *texts, f"drawn and written: {page}"])
