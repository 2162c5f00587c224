"""Predicts an estimated valve under other conditions and compares it with the truth.

The simulated patients share one leaking anatomy. Their closed valves are simulated on another mesh
and observed with errors. The study estimates the parameters and predicts scenarios at the estimate
and at posterior samples, then computes the same scenarios with the true parameters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.common.building.closure import anatomy_of, build_mesh, mesh_store
from experiments.common.building.filters import require_one_each
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import Twin, build_twin
from experiments.common.progress import PartBar, solving
from experiments.common.records.record import Mesh
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.fields import valve_fields
from mvest.problem.record import record_of
from mvest.quantities import AxisCount, Count, Logarithm, Repeats
from mvest.reading.npz import read_npz
from mvest.reporting.skill import estimates_table
from mvest.reporting.tables import Column, Table, table
from mvest.scenarios.predict import (
    PredictedScenario,
    Sample,
    closed_valve,
    posterior_samples,
    predict_scenario,
)
from mvest.scenarios.scenario import Scenario, model_under
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import SolidMesh

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pandas import DataFrame

Row = Mapping[str, Any]

MEASURED_ON = (96, 22)
"""Vertices around and along the leaflets of the surface used for measurements."""

Compared = tuple[PredictedScenario, Sample, Sample]
"""A prediction, and the true valve on its own and on the estimator's mesh."""

LARGE = {"p95": "95th percentile", "p99": "99th percentile", "max": "largest"}
PREDICTED = {
    "gap_mm2": "regurgitant gap (mm²)",
    "coaptation_length_mm": "coaptation length (mm)",
    "coaptation_area_mm2": "coaptation area (mm²)",
    "coaptation_height_mm": "coaptation height (mm)",
    "tenting_height_mm": "tenting height (mm)",
    **{
        f"stress_{which}_{region}_mpa": f"stress, {region}, {label} (MPa)"
        for region in ("anterior", "posterior")
        for which, label in LARGE.items()
    },
}
"""Measures whose intervals are counted, and their labels."""

DRAWN = ("gap_mm2", "coaptation_length_mm", "coaptation_area_mm2", "tenting_height_mm",
         "stress_p99_anterior_mpa", "stress_p99_posterior_mpa")  # fmt: skip
KINDS = {
    "with_mesh_error": ("wide_low", "wide_high", "truth_own_mesh", "inside_wide"),
    "without_mesh_error": ("low", "high", "truth_own_mesh", "inside_own_mesh"),
    "same_mesh": ("low", "high", "truth_same_mesh", "inside_same_mesh"),
}
"""Kinds of intervals -> columns for the ends, the truth, and whether it is inside."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionSettings:
    """Scenarios, samples and simulated patients."""

    scenarios: dict[str, Scenario] = field(default_factory=dict)
    samples: Count = 32  # from the first patient's posterior; a power of two
    # Simulated, with the seeds seed, seed + 1, ...
    patients: Repeats = 1
    further_samples: Count = 8  # from every other patient's posterior
    spread: tuple[Logarithm, ...] = ()  # SD of the logarithms of true parameters
    # Cells of a finer mesh for the mesh error; empty: intervals exclude the mesh error.
    check_mesh: tuple[AxisCount, ...] = ()


def run_prediction(job: Job[PredictionSettings]) -> Result:
    """Estimate and predict every patient, then compare with the truth.

    ConfigurationError if scenarios, samples or the spread of true parameters are inadmissible.
    """
    config, settings = job.values, job.settings
    if not settings.scenarios:
        raise ConfigurationError("prediction.scenarios is empty, expected at least one")
    for name in ("samples", "further_samples"):
        count = getattr(settings, name)
        if count < 2 or count & (count - 1):
            raise ConfigurationError(f"prediction.{name} = {count}, expected a power of two > 1")
    spread, parameters = np.array(settings.spread), tuple(config["parameters"])
    require_one_each("prediction.spread", spread, parameters)
    twin = build_twin(config)
    # Measured on more points than are observed: correlated errors of many points are slow.
    valve = anatomy_of(config).valve(*MEASURED_ON)
    usual = replace(twin.model, valve=valve)
    finer = None
    if settings.check_mesh:
        columns, rows = settings.check_mesh
        cells = {**config["mesh"], "columns": columns, "rows": rows}
        element, store = config["mechanics"]["element"], mesh_store(config)
        finer = build_mesh(anatomy_of(config), cells, element, store)
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
    measured = [
        {"patient": seed, "scenario": title, "measure": measure, **row}
        for seed, (_, found) in patients.items()
        for title, (predicted, own, same) in found.items()
        for measure, row in predicted.against(own, same).items()
    ]
    first, compared = next(iter(patients.values()))
    every = [predicted for _, found in patients.values() for predicted, *_ in found.values()]
    attempted = sum(len(one.samples) for one in every)
    tables = {
        "": table(measured, **dict.fromkeys(measured[0], "")) if measured else table([]),
        "parameters": estimates_table("patient", records),
        "first_patient": first_patient_table(measured),
        "coverage": coverage_table(measured),
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


# -- estimate and predict -------------------------------------------------------------------------
def _patient(
    twin: Twin,
    usual: ClosureModel,
    finer: SolidMesh | None,
    seed: int,
    count: int,
    settings: PredictionSettings,
    step: Callable[[], None],
) -> tuple[StudyResult, dict[str, Compared]]:
    """One simulated patient: the estimate, and predictions by scenario title."""
    rng = np.random.default_rng(seed)
    spread = np.array(settings.spread, dtype=float)
    truth = np.asarray(twin.truth_values * np.exp(spread * rng.standard_normal(len(spread))))
    data = twin.observe(twin.source, values=truth, rng=rng)
    step()
    if data.observation is None:
        return StudyResult.failed(twin.problem, data.reason), {}
    # Start from the open valve, so that patients do not depend on each other.
    twin.model.restart(None)
    with solving(f"patient {seed}", twin.model, twin.problem.parameters) as bar:
        result = estimate(twin.problem, data.observation, on_iterate=bar.iterate)
    result = result.against(data.truth)
    if result.filtered is None or not result.converged:
        return result, {}
    samples = posterior_samples(result.filtered, count, seed)
    predicted = []
    for scenario in settings.scenarios.values():
        model = model_under(usual, scenario)
        # From the open valve, closures with a clip fail on these finer meshes: `model` guides them.
        check = None if finer is None else replace(model.fresh(), mesh=finer, guide=model)
        found = predict_scenario(model, result.filtered, samples, lambda _: step(), finer=check)
        predicted.append((scenario, model, found))
        step()
    compared = {}
    for scenario, model, found in predicted:
        own = model_under(replace(twin.truth_model, valve=usual.valve), scenario)
        own.guide = model
        compared[scenario.title] = found, closed_valve(own, truth)[0], closed_valve(model, truth)[0]
        step()
    return result, compared


def _fields(valve: Valve, compared: Mapping[str, Compared]) -> dict[str, NDArray[Any]]:
    """Closed shapes at the estimate, as case fields; NaN if a valve did not close."""
    blank = np.full(valve.surface.vertices.shape, np.nan)
    shapes = [blank if found.shape is None else found.shape for found, *_ in compared.values()]
    return valve_fields(valve, list(compared)) | {"fitted": np.stack(shapes).astype(np.float32)}


# -- tables ---------------------------------------------------------------------------------------
def first_patient_table(rows: Sequence[Row]) -> Table:
    """Measures of the first patient by condition, with 95 % intervals.

    The intervals include the mesh error if it is known.
    """
    cells: dict[str, dict[str, Any]] = {}
    columns: dict[str, Column] = {"measure": Column()}
    for row in rows:
        if row["measure"] not in PREDICTED or row["patient"] != rows[0]["patient"]:
            continue
        known = np.isfinite(row["wide_low"])
        ends = KINDS["with_mesh_error" if known else "without_mesh_error"][:3]
        title = row["scenario"]
        low, high, truth = names = [f"{title}, {end}" for end in ("low", "high", "truth")]
        columns |= {title: Column(low=low, high=high, truth=truth), truth: Column()}
        cell = cells.setdefault(row["measure"], {"measure": PREDICTED[row["measure"]]})
        cell |= {title: row["estimate"]}
        cell |= {name: row[end] for name, end in zip(names, ends, strict=True)}
    return table([cells[measure] for measure in PREDICTED if measure in cells], **columns)


def coverage_table(rows: Sequence[Row]) -> Table:
    """Number of intervals that contain the truth, by measure, over all patients and conditions.

    An interval without width at the truth (no gap at all) has no uncertainty and is not counted.
    """
    labels = [*PREDICTED.items(), ("all", "all")]
    out: dict[str, dict[str, Any]] = {name: {"measure": label} for name, label in labels}
    for kind, (low, high, truth, inside) in KINDS.items():
        for name, line in out.items():
            held = [
                row[inside]
                for row in rows
                if (row["measure"] == name or (name == "all" and row["measure"] in PREDICTED))
                and row[inside] is not None
                and not row[low] == row[high] == row[truth]
            ]
            line |= {kind: sum(held), f"{kind}_of": len(held)}
    return table(out.values())


def _failures(patients: Mapping[int, tuple[StudyResult, Mapping[str, Compared]]]) -> Iterator[Row]:
    """Valves that could not be estimated or did not close, with the reasons."""
    for seed, (result, compared) in patients.items():
        whole: dict[str, Any] = {"patient": seed, "scenario": "", "valve": "estimate", "count": 1}
        if not compared:
            yield whole | {"reason": result.reason}
        for title, (found, own, _) in compared.items():
            valves = {"at the estimate": found.at_estimate, "true": own, "finer mesh": found.finer}
            reasons = [(name, one.reason) for name, one in valves.items() if one is not None]
            reasons += [("sample", reason) for reason in found.failures]
            for (name, reason), count in Counter(reasons).items():
                if reason:
                    about = {"scenario": title, "valve": name, "count": count, "reason": reason}
                    yield whole | about


# -- figure ---------------------------------------------------------------------------------------
def figure(results: Results) -> Figures:
    """The first patient's closed valve by condition from the atrium, and its measures.

    Touching midsurfaces are one thickness apart, so the slit between them is drawn as tissue. Gaps
    have the colour of blood. Returns None without a prediction.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from mvest.problem.fields import case_fields
    from mvest.reporting.case import drawing
    from mvest.reporting.figures import ATRIUM, SMALL, TEXT

    record = results.first
    if results.first_arrays is None:
        return None
    reach = float(record.numbers["contact_reach_mm"])  # type: ignore[arg-type]
    valve = replace(case_fields(results.first_arrays, turned=False), reach_mm=reach)
    assert valve.fitted is not None
    rows, failed = record.table_of().frame, record.table_of("not_closed").frame
    drawn = Figure(figsize=(max(2.7 * len(valve.frames), 8.0), 8.6), layout="constrained")
    parts: Any = drawn.subfigures(2, 1, height_ratios=[1.0, 1.75])
    upper, lower = parts
    panels = upper.subplots(1, len(valve.frames), squeeze=False)[0]
    colours = drawing.leaflet_colours(valve.region)
    first = rows[(rows["patient"] == rows["patient"].iloc[0]) & (rows["measure"] == "gap_mm2")]
    gaps = first.set_index("scenario")["estimate"]
    known = [valve.rest]
    for axes, title, shape in zip(panels, valve.frames, valve.fitted, strict=True):
        if not np.isfinite(shape).all():
            why = failed[(failed["scenario"] == title) & (failed["valve"] == "at the estimate")]
            axes.set_axis_off()
            axes.set_title(f"{title}\nnot closed: {''.join(why['reason'])}", fontsize=SMALL)
            continue
        known.append(shape)
        drawing.draw_valve(axes, valve, shape, colours, ATRIUM, 0)
        drawing.paint_leak(axes, valve, shape, 0)
        axes.set_title(f"{title}\ngap {gaps[title]:.1f} mm²", fontsize=TEXT)
    drawing.name_leaflets(panels[0], valve, ("anterior", "posterior"))
    drawing.same_scale(panels, known, ATRIUM)
    names = {"gap": drawing.BLOOD, "leaflets touch (between midsurfaces)": drawing.TISSUE}
    handles = [Patch(color=colour, label=label) for label, colour in names.items()]
    upper.legend(handles=handles, loc="lower right", fontsize=SMALL, frameon=False, ncols=2)
    grid = lower.subplots(2, 3)
    for axes, measure in zip(grid.flat, DRAWN, strict=True):
        _draw_measure(axes, rows[rows["measure"] == measure], valve.frames)
        axes.set_title(PREDICTED[measure], fontsize=SMALL, loc="left")
    keys, where = grid[0, 0].get_legend_handles_labels(), "outside lower center"
    lower.legend(*keys, loc=where, fontsize=SMALL, frameon=False, ncols=4)
    title = "An estimated valve as observed and under changed conditions (simulated)"
    drawn.suptitle(f"{title}\n", fontsize=TEXT + 2)
    return drawn


def _draw_measure(axes: Any, rows: DataFrame, titles: Sequence[str]) -> None:
    """Draw one measure of all patients; matplotlib leaves out missing values."""
    from mvest.reporting.figures import COLOURS, SMALL, plain_axes

    plain_axes(axes)
    further = rows["patient"].map(list(rows["patient"].unique()).index)
    x = rows["scenario"].map(titles.index) - 0.12 + (0.14 + 0.13 * further) * (further > 0)
    numbers = rows.filter(regex="low|high|estimate|truth").astype(float)
    of_first = "estimate (drawn above), 95 %: thick samples, thin with the mesh"
    for own, colour, label in (
        (further == 0, COLOURS[0], of_first),
        (further > 0, "0.55", "further simulated patients"),
    ):
        at, of = x[own], numbers[own]
        axes.vlines(at, of["wide_low"], of["wide_high"], color=colour, lw=0.8)
        axes.vlines(at, of["low"], of["high"], color=colour, lw=2.5)
        axes.plot(at, of["estimate"], "o", color=colour, ms=5)
        axes.errorbar([], [], yerr=[], fmt="o", color=colour, label=label)
    for truth, label, marker, colour, size in (
        ("truth_own_mesh", "true valve (its own mesh)", "x", COLOURS[1], 6),
        ("truth_same_mesh", "true valve (same mesh)", "_", "black", 9),
    ):
        axes.plot(x, numbers[truth], marker, color=colour, ms=size, zorder=4, label=label)
    axes.set_xticks(range(len(titles)), titles, fontsize=SMALL, rotation=20, ha="right")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


STUDY = Study(
    settings=PredictionSettings,
    part="prediction",
    run=run_prediction,
    figure=figure,
    captions={
        "": "A leaking valve closed as observed and under changed conditions, seen from the "
        "atrium, and measures of it with their 95 % intervals. Simulated."
    },
    keep_arrays=lambda record, path: read_npz(path),
    golden=("patient",),
)
