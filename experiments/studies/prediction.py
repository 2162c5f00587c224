"""What an estimated valve would do under other conditions, with its truth beside it.

Simulated patients with one leaking anatomy: each is observed closed, with errors, on another mesh;
parameters are estimated from that alone; scenarios are predicted at the estimate and at samples of
its posterior. Only then are the same scenarios computed with the true parameters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from experiments.common.building.closure import anatomy_of, build_mesh, mesh_store
from experiments.common.building.filters import require_one_each
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import Twin, build_twin
from experiments.common.progress import TYPICAL_SOLVES, PartBar, SolveBar
from experiments.common.records.record import Mesh
from experiments.common.schema import Values
from experiments.common.study import Job, Result, Results, Study
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.fields import valve_fields
from mvest.problem.record import EstimateRecord, record_of
from mvest.quantities import AxisCount, Count, Logarithm, within
from mvest.reading.npz import read_npz
from mvest.reporting.tables import Column, Table, table
from mvest.scenarios.predict import (
    PredictedScenario,
    Sample,
    closed_valve,
    posterior_samples,
    predict_scenario,
)
from mvest.scenarios.scenario import Scenario, model_under
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import SolidMesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

Row = Mapping[str, Any]

MEASURED_ON = (96, 22)
"""Vertices around and along the leaflets of the surface on which shapes are measured."""

Compared = tuple[PredictedScenario, Sample, Sample]
"""A prediction, and the valve with the true parameters on its own and on the estimator's mesh."""

STRESS = {
    f"stress_{which}_{region}_mpa": f"stress, {region}, {label} (MPa)"
    for region in ("anterior", "posterior")
    for which, label in (("p95", "95th percentile"), ("p99", "99th percentile"), ("max", "largest"))
}
PREDICTED = {
    "gap_mm2": "regurgitant gap (mm²)",
    "coaptation_length_mm": "coaptation length (mm)",
    "coaptation_area_mm2": "coaptation area (mm²)",
    "coaptation_height_mm": "coaptation height (mm)",
    "tenting_height_mm": "tenting height (mm)",
    **STRESS,
}
"""Measures whose intervals are counted, and what readers call them."""

PRESCRIBED = {
    "ap_diameter_mm": "AP diameter of the annulus (mm)",
    "annulus_circumference_mm": "circumference of the annulus (mm)",
}
"""Measures that follow from the prescribed annulus and not from the estimate."""

DRAWN = ("gap_mm2", "coaptation_length_mm", "coaptation_area_mm2", "tenting_height_mm",
         "stress_p99_anterior_mpa", "stress_p99_posterior_mpa")  # fmt: skip
OTHER = "0.55"

KINDS = {
    "with_mesh_error": ("wide_low", "wide_high", "truth_own_mesh", "inside_wide"),
    "without_mesh_error": ("low", "high", "truth_own_mesh", "inside_own_mesh"),
    "same_mesh": ("low", "high", "truth_same_mesh", "inside_same_mesh"),
}
"""Kinds of intervals -> columns with their ends, the truth, and whether they hold it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionSettings:
    """What is predicted of estimated valves, and how well their truth is hit."""

    scenarios: dict[str, Scenario] = field(default_factory=dict)
    samples: Count = 32  # of the first patient's posterior; a power of two
    # Simulated, with the seeds seed, seed + 1, ...
    patients: Annotated[int, within(1, 1000, "", "things that each take their time")] = 1
    further_samples: Count = 8  # of the posterior of every other patient
    spread: tuple[Logarithm, ...] = ()  # SD of the logarithms of true parameters
    # Cells [around, annulus to edge] of further meshes on which peak stress is computed.
    stress_meshes: tuple[Any, ...] = ()
    # Cells of the finer mesh on which each estimate is predicted once to measure the mesh's error;
    # empty: intervals do not include it.
    check_mesh: tuple[AxisCount, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    prediction: PredictionSettings = field(default_factory=PredictionSettings)


def run_prediction(job: Job[Settings]) -> Result:
    """Estimate and predict every patient, then compare with the truth.

    Raises
    ------
    ConfigurationError
        If scenarios, samples or the spread of true parameters make no sense.
    """
    config, settings = job.values, job.settings.prediction
    _require(settings, config["parameters"])
    twin = build_twin(config)
    # Measured on more points than are observed, which cost time where their errors are correlated.
    valve = anatomy_of(config).valve(*MEASURED_ON)
    usual = replace(twin.model, valve=valve)
    finer = _mesh_of(config, settings.check_mesh) if settings.check_mesh else None
    counts = [settings.samples, *[settings.further_samples] * (settings.patients - 1)]
    total = sum(len(settings.scenarios) * (2 + count) + 1 for count in counts)
    with PartBar("prediction", total, "closure") as bar:
        patients = {
            seed: _patient(twin, usual, finer, seed, count, settings, bar.step)
            for seed, count in enumerate(counts, config["seed"])
        }
    records = tuple(
        record_of(result, seed=seed, simulated=True) for seed, (result, _) in patients.items()
    )
    rows = [
        {"patient": seed, "scenario": title, "measure": measure, **row}
        for seed, (_, found) in patients.items()
        for title, (predicted, own, same) in found.items()
        for measure, row in predicted.against(own, same).items()
    ]
    first, compared = next(iter(patients.values()))
    truth = _draw_truth(twin, settings, np.random.default_rng(config["seed"]))
    meshes = ((cells, _mesh_of(config, cells)) for cells in settings.stress_meshes)
    stress = [
        _stress_row(closed_valve(_on_mesh(usual, mesh), truth)[0], cells) for cells, mesh in meshes
    ]
    every = [predicted for _, found in patients.values() for predicted, *_ in found.values()]
    attempted = sum(len(one.samples) for one in every)
    tables = {
        "": table(rows, **dict.fromkeys(rows[0], "")) if rows else table([]),
        "parameters": parameters_table(records),
        "first_patient": first_patient_table(rows),
        "coverage": coverage_table(rows),
        "stress_by_mesh": table(stress),
        "not_closed": table(_failures(patients)),
    }
    return Result(
        tables=tables,
        numbers={
            "samples": attempted,
            "samples_not_closed": sum(len(one.failures) for one in every),
            "contact_reach_mm": usual.contact_reach_mm,
        },
        estimates=records,
        arrays=_fields(valve, compared) if compared else {},
        status="converged" if compared else "failed",
        reason="completed" if compared else first.reason,
        mesh=Mesh.of(twin.model.mesh),
        forward_solves=sum(one.forward_solves or 0 for one in records)
        + attempted
        + sum(1 + (one.finer is not None) for one in every),
        gate=gate_of(config),
    )


def _require(settings: PredictionSettings, parameters: Sequence[str]) -> None:
    if not settings.scenarios:
        raise ConfigurationError("prediction.scenarios is empty, expected at least one")
    for name in ("samples", "further_samples"):
        count = getattr(settings, name)
        if count < 2 or count & (count - 1):
            raise ConfigurationError(f"prediction.{name} = {count}, expected a power of two > 1")
    require_one_each("prediction.spread", np.array(settings.spread), tuple(parameters))


# -- estimate and predict -------------------------------------------------------------------------
def _draw_truth(twin: Twin, settings: PredictionSettings, rng: np.random.Generator) -> FloatArray:
    spread = np.array(settings.spread, dtype=float)
    return np.asarray(twin.truth_values * np.exp(spread * rng.standard_normal(len(spread))))


def _patient(
    twin: Twin,
    usual: ClosureModel,
    finer: SolidMesh | None,
    seed: int,
    count: int,
    settings: PredictionSettings,
    step: Callable[[], None],
) -> tuple[StudyResult, dict[str, Compared]]:
    """One simulated patient: the estimate, and what is predicted by the titles of scenarios."""
    rng = np.random.default_rng(seed)
    truth = _draw_truth(twin, settings, rng)
    data = twin.observe(twin.source, truth, rng)
    step()
    if data.observation is None:
        return StudyResult.failed(twin.problem, data.reason, 0.0), {}
    # From the open valve, so that no patient depends on the one before.
    twin.model.restart(None)
    steps = len(twin.model.settings.protocol.steps())
    with SolveBar(f"patient {seed}", steps, TYPICAL_SOLVES, twin.problem.parameters) as bar:
        twin.model.on_step = bar.step
        result = estimate(twin.problem, data.observation, on_iterate=bar.iterate)
    twin.model.on_step = None
    result = result.against(data.truth)
    if result.filtered is None or not result.converged:
        return result, {}
    samples = posterior_samples(result.filtered, count, seed)
    predicted = []
    for scenario in settings.scenarios.values():
        model = model_under(usual, scenario)
        check = None if finer is None else _on_mesh(model, finer)
        found = predict_scenario(model, result.filtered, samples, lambda _: step(), finer=check)
        predicted.append((scenario, model, found))
        step()
    compared = {}
    for scenario, model, found in predicted:
        own = model_under(replace(twin.truth_model, valve=usual.valve), scenario)
        compared[scenario.title] = found, closed_valve(own, truth)[0], closed_valve(model, truth)[0]
        step()
    return result, compared


def _mesh_of(config: Values, cells: Sequence[int]) -> SolidMesh:
    """The configured mesh with ``cells`` around and along the leaflets."""
    columns, rows = cells
    return build_mesh(
        anatomy_of(config),
        {**config["mesh"], "columns": columns, "rows": rows},
        config["mechanics"]["element"],
        mesh_store(config),
    )


def _on_mesh(model: ClosureModel, mesh: SolidMesh) -> ClosureModel:
    """A fresh model of the same valve on another mesh, closed from the open valve."""
    return replace(model.fresh(), mesh=mesh, guide=None)


def _fields(valve: Valve, compared: Mapping[str, Compared]) -> dict[str, NDArray[Any]]:
    """Closed shapes at the estimate as fields of a case; NaN where there is none."""
    blank = np.full(valve.surface.vertices.shape, np.nan)
    shapes = [blank if found.shape is None else found.shape for found, *_ in compared.values()]
    return valve_fields(valve, list(compared)) | {"fitted": np.stack(shapes).astype(np.float32)}


# -- tables ---------------------------------------------------------------------------------------
def parameters_table(records: Sequence[EstimateRecord]) -> Table:
    """What was estimated of each patient, with its truth."""
    shown = ("parameter", "estimate", "std", "truth")
    rows = [
        {"patient": record.seed} | {name: row[name] for name in shown}
        for record in records
        for row in record.rows()
        if row.get("kind") in ("modulus", "nuisance")
    ]
    return table(rows, patient="", estimate=Column("", ".4g", std="std"), truth=":.4g")


def first_patient_table(rows: Sequence[Row]) -> Table:
    """Measures of the first patient by condition, with 95 % intervals; a cross marks a miss.

    Intervals are with the error of the mesh, where that is known.
    """
    columns: dict[str, Column] = {"measure": Column()}
    cells: dict[str, dict[str, Any]] = {}
    for measure, label in (PREDICTED | PRESCRIBED).items():
        for row in rows:
            if row["measure"] != measure or row["patient"] != rows[0]["patient"]:
                continue
            known = np.isfinite(row["wide_low"])
            low, high, truth, _ = KINDS["with_mesh_error" if known else "without_mesh_error"]
            ends = () if measure in PRESCRIBED else (low, high, truth)
            title = row["scenario"]
            names = [f"{title}, {end}" for end in ("low", "high", "truth")]
            columns[title] = Column(low=names[0], high=names[1], truth=names[2])
            columns[names[2]] = Column()
            cell = cells.setdefault(measure, {"measure": label})
            cell |= {title: row["estimate"], **dict.fromkeys(names)}
            cell |= dict(zip(names, (row[end] for end in ends), strict=False))
    return table(cells.values(), **columns)


def coverage_table(rows: Sequence[Row]) -> Table:
    """How many intervals of all patients and conditions hold the truth, by measure and in all.

    Where all samples and the truth are one number (no gap at all) there is no uncertainty that
    could be right or wrong: such an interval is not counted.
    """
    out: list[dict[str, Any]] = []
    for measure, label in PREDICTED.items():
        line: dict[str, Any] = {"measure": label}
        for kind, (low, high, truth, inside) in KINDS.items():
            held = [
                row[inside]
                for row in rows
                if row["measure"] == measure
                and row[inside] is not None
                and not row[low] == row[high] == row[truth]
            ]
            line |= {kind: sum(held), f"{kind}_of": len(held)}
        out.append(line)
    counts = {name: sum(line[name] for line in out) for name in out[0] if name != "measure"}
    return table([*out, {"measure": "all", **counts}])


def _stress_row(sample: Sample, cells: Sequence[int]) -> Row:
    """Peak stress of one closed valve, and the cells of its mesh."""
    measured = {PREDICTED[name]: sample.measures.get(name) for name in ("gap_mm2", *STRESS)}
    return {"cells": " × ".join(map(str, cells)), **measured, "not closed": sample.reason}


def _failures(patients: Mapping[int, tuple[StudyResult, Mapping[str, Compared]]]) -> list[Row]:
    """Valves that were not estimated or did not close, and why."""
    out: list[Row] = []
    for seed, (result, compared) in patients.items():
        if not compared:
            out.append({"patient": seed, "scenario": "", "valve": "estimate", "count": 1,
                        "reason": result.reason})  # fmt: skip
        for title, (found, own, _) in compared.items():
            reasons = [("at the estimate", found.at_estimate.reason), ("true", own.reason)]
            reasons += [("sample", reason) for reason in found.failures]
            reasons += [] if found.finer is None else [("finer mesh", found.finer.reason)]
            out += [
                {"patient": seed, "scenario": title, "valve": valve, "count": count,
                 "reason": reason}
                for (valve, reason), count in Counter(reasons).items()
                if reason
            ]  # fmt: skip
    return out


def figure(results: Results) -> Figure | None:
    """Closed valves by condition above their measures; None without a prediction."""
    from mvest.reporting.scenarios import scenarios_figure

    name, record = next(iter(results.records.items()))
    if name not in results.arrays:
        return None
    labels = {name: (PREDICTED | PRESCRIBED)[name] for name in DRAWN}
    reach = float(record.numbers["contact_reach_mm"])  # type: ignore[arg-type]
    failed = {
        row["scenario"]: row["reason"]
        for row in record.table_of("not_closed").rows
        if row["valve"] == "at the estimate"
    }
    return scenarios_figure(results.arrays[name], record.table_of().rows, labels, reach, failed)


STUDY = Study(
    settings=Settings,
    run=run_prediction,
    figure=figure,
    captions={
        "": "A leaking valve closed as observed and under changed conditions, seen from the "
        "atrium, and measures of it with their 95 % intervals. Simulated."
    },
    keep_arrays=lambda record, path: read_npz(path),
)
