"""Compares observations before they are made, using exact derivatives.

The experiment `identifiability` varies frames, vertices, errors and the knowledge of nuisances for
one configured valve. The experiment `design` varies the number of closed frames and their pressure
errors for virtual patients, and makes estimates for some designs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from experiments.common.building.closure import closure_model, mechanics_of, template_of
from experiments.common.building.filters import require_one_each
from experiments.common.cases.own_case import PersonalSettings, settings_of
from experiments.common.progress import say, solving
from experiments.common.records.record import NOT_GATED, Mesh
from experiments.common.schema import Values
from experiments.common.study import Job, Result, Results, Study
from mvest.closure.cycle import CycleModel, CycleProtocol
from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError
from mvest.estimation.information.design import Design, together
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.vertices import ALL_VERTICES, vertex_sets
from mvest.personalisation.chain import personalise
from mvest.personalisation.design import FrameDesigns, design_case
from mvest.personalisation.geometry import NuisanceGeometry
from mvest.personalisation.model import build_coarse
from mvest.personalisation.settings import PersonaliseSettings, PressureErrors
from mvest.problem.record import EstimateRecord, finite, record_of
from mvest.quantities import (
    BeatTime,
    Count,
    Factor,
    Length,
    Pressure,
    PressureError,
    Share,
    TimeStep,
)
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.virtual_patient import (
    PatientSettings,
    VirtualPatient,
    draw_patient_values,
    simulate_patient,
)
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignsSettings:
    """Observations of the configured valve to compare."""

    pressures_mmHg: tuple[Pressure, ...] = (60.0,)  # of one additional closed frame
    cycle_times: tuple[BeatTime, ...] = ()  # s, observed in a whole cycle
    cycle_dt: TimeStep = 0.003125  # s
    noise_mm: tuple[Length, ...] = (0.1, 0.25, 0.5, 1.0)
    typical_mm: Length = 0.5  # noise in tables that show one noise
    correlation_length_mm: Length = 5.0
    target: Share = 0.05  # required relative standard deviation of a modulus
    # Knowledge -> relative standard deviations of nuisances; 0: known, missing: unknown.
    knowledge: dict[str, dict[str, Factor]] = field(default_factory=dict)
    known: tuple[str, ...] = ()  # parameters taken as known in the table of confounded ones


@dataclass(frozen=True, slots=True, kw_only=True)
class Corner:
    """A design for which a patient is estimated; its stated errors are also drawn."""

    frames: Count = 1  # closed frames, the first with the pressure of the closed frame
    factor: Factor = 0.1  # relative, on all pressures
    offset_mmHg: PressureError = 0.0
    each_mmHg: PressureError = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesSettings:
    """Designs of the frames of a virtual patient."""

    geometry: NuisanceGeometry | None = None  # its errors where it is not exact
    corners: dict[str, Corner] | None = None  # name -> design


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds: for the configured valve, or for a patient."""

    designs: DesignsSettings = field(default_factory=DesignsSettings)
    frames: FramesSettings | None = None
    patient: PatientSettings | None = None
    personal: PersonalSettings = field(default_factory=PersonalSettings)


def run(job: Job[Settings]) -> Result:
    """Compare designs of the configured valve, or those of a virtual patient's frames."""
    try:
        if job.settings.frames is not None and job.settings.patient is not None:
            return _patient_designs(job, job.settings.frames, job.settings.patient)
        return _valve_designs(job.values, job.settings.designs)
    except GeometryError as error:
        return Result(status="failed", reason=str(error))


# -- one configured valve -------------------------------------------------------------------------
def _valve_designs(values: Values, settings: DesignsSettings) -> Result:
    """All designs, from the derivatives of one run per set of frames."""
    model = replace(closure_model(values), continuation=True)
    truth = np.array(values["truth"]["values"], dtype=float)
    require_one_each("truth.values", truth, model.names)
    frames = _jacobians(settings, model, truth)
    designs = list(_designs(values, settings, model, frames, truth))
    whole = [(about, design) for about, design in designs if about["vertices"] == ALL_VERTICES]
    rows = [{**about, **row} for about, design in designs for row in _expected(settings, design)]
    units = dict.fromkeys(next(iter(rows), ()), "")
    units |= {name: "%" for name in units if name.startswith("std")}
    units |= {name: "mm" for name in units if name.startswith("noise")}
    known = dict.fromkeys(settings.known, 0.0)
    confounded = [
        {key: about[key] for key in ("frames", "errors")}
        | {
            "changes that hardly show": ", ".join(
                f"{name} {100 * v:+.2g} %"
                for name, v in zip(group.parameters, group.relative, strict=True)
            ),
            "correlation": group.correlation,
        }
        for about, design in whole
        for group in design.at(settings.typical_mm, known).confounded()
    ]
    return Result(
        tables={"": table(rows, **units), "confounded": table(confounded)},
        numbers={"typical_mm": settings.typical_mm},
        mesh=Mesh.of(model.mesh),
        forward_solves=len(frames),
    )


def _jacobians(
    settings: DesignsSettings, model: ClosureModel, truth: FloatArray
) -> dict[str, list[FloatArray]]:
    """Label -> derivatives ``(3n, p)`` of frames; GeometryError if the valve does not close."""
    protocol = model.settings.protocol
    peak, closed = protocol.pressure_mmHg, dict[float, FloatArray]()
    for pressure in (*settings.pressures_mmHg, peak):
        at = replace(protocol, pressure_mmHg=pressure)
        own = replace(model, settings=replace(model.settings, protocol=at))
        with solving(f"closed at {pressure:g} mmHg", own):
            found = own(truth)
        if not found.converged:
            raise GeometryError(f"closed at {pressure:g} mmHg: {found.reason}")
        closed[pressure] = found.jacobian[len(found.y) // 2 :]
    # The open valve is at rest and does not depend on parameters.
    open_ = np.zeros_like(closed[peak])
    frames = {"closed": [closed[peak]], "open and closed": [open_, closed[peak]]}
    for pressure in sorted(closed.keys() - {peak}):
        frames[f"closed at {pressure:g} and {peak:g} mmHg"] = [closed[pressure], closed[peak]]
    if times := settings.cycle_times:
        found = CycleModel(model, CycleProtocol(peak, dt=settings.cycle_dt, times=times))(truth)
        if not found.converged:
            raise GeometryError(f"whole cycle: {found.reason}")
        frames[f"whole cycle, {len(times)} frames"] = np.split(found.jacobian, len(times))
    return frames


def _designs(
    values: Values,
    settings: DesignsSettings,
    model: ClosureModel,
    frames: Mapping[str, Sequence[FloatArray]],
    truth: FloatArray,
) -> Iterator[tuple[Row, Design]]:
    """Each observation, and its information."""
    observed, length = values["observation"], settings.correlation_length_mm
    correlation = SpatialCorrelation(model.valve.surface.vertices, length)
    sets = vertex_sets(observed["columns"], observed["rows"])
    for (name, members), correlated in product(sets.items(), (False, True)):
        R = correlation.of(members).noise(1.0, 3) if correlated else 1.0
        rows = np.repeat(members, 3)
        for label, jacobians in frames.items():
            parts = [Design.of(H[rows], R, truth, model.names) for H in jacobians]
            about = {
                "frames": label,
                "number of frames": len(parts),
                "vertices": name,
                "number of vertices": int(members.sum()),
                "errors": f"correlated over {length:g} mm" if correlated else "independent",
            }
            yield about, together(*parts)


def _expected(settings: DesignsSettings, design: Design) -> Iterator[Row]:
    """Each modulus for each level of knowledge of the nuisances."""
    moduli = [name for name in design.names if name.startswith("E_f.")]
    for (knowledge, stds), name in product(settings.knowledge.items(), moduli):
        row: Row = {"knowledge of the nuisances": knowledge, "parameter": name}
        for mm in settings.noise_mm:
            row[f"std at {mm:g} mm"] = finite(100 * design.std(name, mm, stds))
        needed = design.needed_noise(name, settings.target, stds)
        yield row | {f"noise for {100 * settings.target:g} %": finite(needed)}


# -- frames of a virtual patient ------------------------------------------------------------------
VALUES, ANATOMY, ERRORS = range(3)
"""Streams of random numbers, so that all designs are for the same valve."""


def _patient_designs(job: Job[Settings], frames: FramesSettings, about: PatientSettings) -> Result:
    """All designs for a patient's valve with generic moduli, and estimates for some."""
    patient = _patient(job.values, about, Corner(), ())
    wanted = settings_of(job.values, job.settings.personal)
    known = {"exact": None} | ({"considered": frames.geometry} if frames.geometry else {})
    designs: dict[str, FrameDesigns] = {}
    for name, geometry in known.items():
        say(f"designs, geometry {name}")
        found = design_case(patient.case, replace(wanted, nuisance_geometry=geometry))
        if isinstance(found, str):
            raise GeometryError(f"the generic valve does not close in every frame: {found}")
        designs[name] = found
    rows = [{"geometry": name, **row} for name, own in designs.items() for row in own.rows()]
    tables = {"": table(rows, geometry="", errors="", error="mmHg", left="%")}
    tried, estimates = list[Row](), list[EstimateRecord]()
    for name, corner in (frames.corners or {}).items():
        say(f"estimated: {name}")
        record, predicted = _tried(job.values, about, wanted, designs["exact"], name, corner)
        estimates.append(record)
        tried += _compared(record, predicted, designs["exact"].knowledge)
    if tried:
        tables["tried"] = table(tried, **TRIED)
    mesh = build_coarse(patient.case, wanted).mesh
    return Result(tables=tables, estimates=tuple(estimates), mesh=Mesh.of(mesh), gate=NOT_GATED)


def _patient(
    values: Values, about: PatientSettings, corner: Corner, pressures: tuple[float, ...]
) -> VirtualPatient:
    """The patient with further closed frames, and with the pressure errors of a design."""
    still = (0.0,) * len(pressures)
    simulation = replace(about.simulation, fitted_pressure_mmHg=pressures, fitted_relaxation=still)
    deviations = replace(
        about.deviations,
        pressure=corner.factor,
        pressure_offset_mmHg=corner.offset_mmHg,
        pressure_each_mmHg=corner.each_mmHg,
    )
    drawn = replace(about, simulation=simulation, deviations=deviations)
    streams = [np.random.default_rng([values["seed"], k]) for k in (VALUES, ANATOMY, ERRORS)]
    template = vary(template_of(values).parameters, streams[ANATOMY], about.variation)
    return simulate_patient(
        about.name,
        about.description,
        Template(template),
        draw_patient_values(drawn, streams[VALUES]),
        simulation,
        mechanics_of(values),
        streams[ERRORS],
    )


def _tried(
    values: Values,
    about: PatientSettings,
    wanted: PersonaliseSettings,
    designs: FrameDesigns,
    name: str,
    corner: Corner,
) -> tuple[EstimateRecord, dict[str, float]]:
    """An estimate of the patient under a design, and the predicted errors of the moduli."""
    further = tuple(designs.pressures_mmHg[k] for k in designs.chosen(corner.frames))[1:]
    unknowns = tuple(
        replace(u, std=corner.factor) if u.name == "pressure_scale" else u for u in wanted.unknowns
    )
    pressures = PressureErrors(corner.offset_mmHg, corner.each_mmHg)
    patient = _patient(values, about, corner, further)
    fit = personalise(patient.case, replace(wanted, unknowns=unknowns, pressures=pressures))
    record = record_of(fit.result, seed=values["seed"], case=name, simulated=True)
    stated = {"factor": corner.factor, "offset": corner.offset_mmHg, "each": corner.each_mmHg}
    known = record.without_details().with_truth(patient.values)
    return known, designs.left(corner.frames, stated)


TRIED: dict[str, Column | str] = {
    **dict.fromkeys(("design", "modulus"), ""),
    **dict.fromkeys(("predicted", "reported", "error"), "%:.0f"),
    "generic": "%:.0f:error of the generic guess",
}
"""Percentages of the standard deviation of the prior's logarithm."""


def _compared(
    record: EstimateRecord, predicted: Mapping[str, float], knowledge: Mapping[str, float]
) -> Iterator[Row]:
    """The predicted and the actual error of each modulus under a design."""
    for name, share in predicted.items():
        own, scale = record.unknown(name), knowledge[name] / 100
        estimate, truth, generic = own.estimate, own.truth or np.nan, own.prior_mean or np.nan
        yield {
            "design": record.case,
            "modulus": name,
            "predicted": 100 * share,
            "reported": None if not estimate else (own.std or 0.0) / estimate / scale,
            "error": None if not estimate else float(np.log(estimate / truth)) / scale,
            "generic": float(np.log(generic / truth)) / scale,
            "reason": record.reason,
        }


# -- tables ---------------------------------------------------------------------------------------
OBSERVATION = ["vertices", "errors", "frames"]
PATIENT_DESIGN = {"geometry": "", "errors": "", "error": "mmHg", "known": ""}


def summary(results: Results) -> dict[str, Table]:
    """A row for each observation, or the median over patients for each design."""
    rest = {name: results.table(name) for name in results.table_names if name}
    frame = results.table().frame
    if "left" not in frame:
        # The worse modulus at the typical noise; a missing value is an undetermined modulus.
        column = f"std at {results.first.numbers['typical_mm']:g} mm"
        keys = [*OBSERVATION, known := "knowledge of the nuisances"]
        worst = frame.fillna({column: np.inf}).groupby(keys, sort=False)[column].max().unstack()
        worse = worst.loc[:, frame[known].unique()]
        columns = dict.fromkeys(OBSERVATION, "") | dict.fromkeys(worse.columns, "%:.2g")
        return {"worse_modulus": table(worse.reset_index(), **columns), **rest}
    # The remaining fraction of the guess's error, by number of frames.
    groups = frame.groupby([*PATIENT_DESIGN, "frames"], sort=False)["left"]
    medians = groups.median().unstack().rename(columns=lambda n: f"{n} closed")
    counts = dict.fromkeys(medians.columns, "%:.0f")
    shown = {"median_left": table(medians.reset_index(), **PATIENT_DESIGN, **counts), **rest}
    if "tried" in rest:
        values = list(TRIED)[2:]
        squares = rest["tried"].frame.dropna().set_index("design")[values].astype(float) ** 2
        rms = (squares.groupby("design", sort=False).mean() ** 0.5).reset_index()
        about = {name: TRIED[name] for name in values}
        shown["root_mean_squares"] = table(rms, design="", **about)
    return shown


STUDY = Study(settings=Settings, run=run, summary=summary, golden=("twin", "patient"))
