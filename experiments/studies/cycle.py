"""Information in the frames of a whole cycle, time step errors, and estimates from the frames.

All results come from one simulated cycle of a valve with known parameters. The experiments `cycle`,
`joint` and `chord` differ in their unknowns and estimates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.building.filters import build_filter
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import noise_words
from experiments.common.progress import SolveBar
from experiments.common.records.record import Mesh, Number
from experiments.common.schema import Values
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.closure.cycle import CycleModel, CycleProtocol, compare_time_steps, with_mesh_error
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.prediction import Remembered, predict
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, estimate
from mvest.problem.record import EstimateRecord, finite, record_of
from mvest.problem.synthetic import Truth
from mvest.quantities import AxisCount, Count, Length, TimeStep, Tolerance
from mvest.reporting.expectation import expectation_text
from mvest.reporting.skill import estimates_table
from mvest.reporting.tables import table
from mvest.typing import FloatArray

EXACT, TWO, WHOLE, OTHER = "no noise", "open and closed", "whole cycle", "another mesh"
"""Observations for estimates; all but the second include all frames."""
WIDER = f"{OTHER}, with the mesh's error"


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleSettings:
    """The simulation and the estimates; a mesh is columns and rows of cells, then of contacts."""

    protocol: CycleProtocol = field(default_factory=CycleProtocol)
    noise_mm: Length = 0.5  # SD of each coordinate
    estimated: tuple[str, ...] = ()  # from no noise, open and closed, whole cycle, another mesh
    exact_assumed_mm: Length = 0.1  # SD that the filter assumes for coordinates without noise
    seeds: Count = 8  # for the noise of the whole cycle
    # A search that starts near its end stops when the objective decreases by less than this: 0.02
    # moves no parameter by more than a fifth of its standard deviation, 0.05 by a third.
    objective_tolerance: Tolerance = 0.02
    finer: tuple[AxisCount, ...] = (32, 4, 96, 21)  # mesh of the truth in "another mesh"
    check: tuple[AxisCount, ...] = (40, 5, 120, 26)  # mesh for the error of the estimator's mesh
    time_steps: tuple[TimeStep, ...] = ()  # s, to compare; each half of the last
    path_steps: Count = 16  # steps of the path that tests for jumps


FINER_STEP, PATH_CHANGE = 0.5, -0.3
"""Time step on other meshes relative to the estimator's, and relative change of the first parameter
along the path that tests frames for jumps."""


def run_cycle(job: Job[CycleSettings]) -> Result:
    """Simulate a cycle, compute the bounds of its frames, and make the configured estimates.

    InputError if the true cycle fails on one of the meshes, or a setting is inadmissible.
    """
    values, settings = job.values, job.settings
    truth = np.array(values["truth"]["values"], dtype=float)
    model = CycleModel(closure_model(values), settings.protocol)
    with _bar("true cycle", model):
        true = predict(model, truth, derivatives=True)
    if not true.converged:
        raise InputError(f"the truth has no cycle: {true.reason}")
    frames = true.y.reshape(len(settings.protocol.times), -1, 3)
    H, bounds = true.jacobian.reshape(*frames.shape, -1), []
    for label, chosen in settings.protocol.frame_sets().items():
        rows = H[chosen].reshape(-1, len(truth))
        # Cramér-Rao bounds.
        std = identifiability(rows, settings.noise_mm**2, truth, names=model.names).std
        for name, percent in zip(model.names, 100 * std / truth, strict=True):
            about = {"frames": label, "count": len(chosen), "parameter": name}
            bounds.append({**about, "bound": finite(percent)})
    tables = {"": table(bounds, frames="", count="", parameter="", bound="%")}
    numbers: dict[str, Number] = {"vertices": frames.shape[1], "noise_mm": settings.noise_mm}
    solves = 1
    if dts := settings.time_steps:
        path = np.tile(truth, (settings.path_steps + 1, 1))
        path[:, 0] *= np.linspace(1.0, 1.0 + PATH_CHANGE, len(path))
        with _bar("time steps", model):
            steps = compare_time_steps(model, dts, path)
        tables["time_steps"] = table(steps, dt="s", change="mm", unevenness=":.1f")
        solves += len(dts) * len(path)
    estimates = tuple(_estimates(values, settings, frames, truth, numbers))
    if estimates:
        tables["estimates"] = estimates_table("estimate from", estimates)
    solves += sum(one.forward_solves or 0 for one in estimates if one.case != WIDER)
    failed = [f"{one.case}: {one.reason}" for one in estimates if not one.converged]
    return Result(
        tables=tables,
        numbers=numbers,
        estimates=estimates,
        status="failed" if failed else "converged",
        reason="; ".join(failed) or "completed",
        mesh=Mesh.of(model.closure.mesh),
        forward_solves=solves,
        gate=gate_of(values),
    )


def _estimates(
    values: Values,
    settings: CycleSettings,
    frames: FloatArray,
    truth: FloatArray,
    numbers: dict[str, Number],
) -> Iterator[EstimateRecord]:
    """Estimate all parameters from observations of one true cycle."""
    if not set(settings.estimated) <= {EXACT, TWO, WHOLE, OTHER}:
        known = f"{EXACT}, {TWO}, {WHOLE}, {OTHER}"
        raise ConfigurationError(
            f"cycle.estimated = {settings.estimated}, expected some of {known}"
        )
    model, problem = _problem(values, settings)
    for what in settings.estimated:
        at = settings.protocol.frame_sets()[TWO if what == TWO else WHOLE]
        shown, noise = frames, 0.0 if what == EXACT else settings.noise_mm
        if what == OTHER:
            shown = _on_mesh(values, settings, settings.finer).frames(truth)
            apart = np.linalg.norm(shown - frames, axis=-1)
            numbers["meshes_apart_mm"] = float(apart.mean())
        for k in range(settings.seeds if what == WHOLE else 1):
            seed = values["seed"] + k
            positions = shown + noise * np.random.default_rng(seed).normal(size=shown.shape)
            seen = _observation(settings, positions, noise or settings.exact_assumed_mm, at)
            label = f"{what}, errors {seed}" if what == WHOLE else what
            with _bar(label, model, problem.parameters) as bar:
                result = estimate(problem, seen, on_iterate=bar.iterate)
            result = result.against(Truth(problem.parameters, truth, frames[at]))
            yield record_of(result, seed=seed, case=label, simulated=True)
            found, search = result.filtered, problem.filter
            if found is None:
                continue
            if what == WHOLE and not k and result.converged and isinstance(search, IteratedFilter):
                # The mode does not depend on the start, so later searches start near it.
                start, enough = tuple(found.mean.tolist()), settings.objective_tolerance
                nearer = replace(search, start=start, objective_tolerance=enough)
                problem = replace(problem, filter=nearer)
            if what == OTHER:
                # The error of the estimator's mesh follows from one run on a third mesh.
                finer = _on_mesh(values, settings, settings.check)
                try:
                    wider, numbers["check_mesh_apart_mm"] = with_mesh_error(found, seen.R, finer)
                except InputError as error:
                    numbers["check_mesh"] = str(error)
                    continue
                changed = replace(result, filtered=wider)
                yield record_of(changed, seed=seed, case=WIDER, simulated=True)


def _on_mesh(values: Values, settings: CycleSettings, mesh: tuple[int, ...]) -> CycleModel:
    """The cycle on another mesh, with a shorter time step."""
    columns, rows, around, along = mesh
    changed = {
        **values,
        "mesh": {**values["mesh"], "columns": columns, "rows": rows},
        "mechanics": {**values["mechanics"], "contact_points": {"columns": around, "rows": along}},
    }
    dt = settings.protocol.dt * FINER_STEP
    return CycleModel(closure_model(changed), replace(settings.protocol, dt=dt))


def _bar(title: str, model: CycleModel, names: Sequence[str] = ()) -> SolveBar:
    """A progress bar for a model's steps."""
    bar = SolveBar(title, len(model.protocol.steps()), names)
    model.closure.on_step = bar.step
    return bar


def _problem(values: Values, settings: CycleSettings) -> tuple[CycleModel, Problem]:
    """The estimator's model and problem."""
    names = tuple(values["parameters"])
    filter_, transform, prior = build_filter(values["filter"], names)
    model = CycleModel(closure_model(values), settings.protocol)
    tissue = model.closure.settings.tissue
    return model, Problem(names, Remembered(model), prior, filter_, transform, tissue)


def _observation(
    settings: CycleSettings, positions: FloatArray, std_mm: float, at: list[int]
) -> Observation:
    """An observation of the frames ``at`` of a cycle ``(f, n, 3)`` mm."""
    names = settings.protocol.frames
    frames = tuple(names[k] for k in at)
    return Observation(frames, positions[at], np.array(std_mm**2), predicted=names)


def expect_cycle(values: Values, _folder: Path | None = None) -> str:
    """Text for ``check=true``: expected intervals from all frames of a cycle."""
    settings = STUDY.settings_of(values)
    model, problem = _problem(values, settings)
    at = settings.protocol.frame_sets()[WHOLE]
    rest = model.closure.valve.surface.vertices
    seen = _observation(settings, np.tile(rest, (len(at), 1, 1)), settings.noise_mm, at)
    noise = noise_words([settings.noise_mm], 0.0)
    with _bar(values["name"], model):
        return expectation_text(f"{values['name']}, {values['row']}", problem, seen, noise)


def figure(results: Results) -> Figures:
    """Bounds for sets of frames, and the errors of estimates if there are any."""
    from mvest.reporting.figures import COLOURS, MARKERS, SMALL, log_axis, panels

    estimates = results.first.estimates
    drawn, (axes,) = panels(1, 1 + bool(estimates), 4.6)
    for k, (name, own) in enumerate(results.table().frame.groupby("parameter", sort=False)):
        style = {"color": COLOURS[k % 6], "marker": MARKERS[k % 6], "ms": 5}
        axes[0].plot(own["bound"], own["frames"], ls="", label=name, **style)
    axes[0].set(xscale="log", xlabel="smallest possible SD (%)")
    if estimates:
        _draw_errors(axes[1], estimates)
    for one in axes:
        one.invert_yaxis()
        log_axis(one.xaxis)
        one.legend(fontsize=SMALL - 1, frameon=False, loc="lower center",
                   bbox_to_anchor=(0.4, 1.0), ncols=2)  # fmt: skip
    return drawn


def _draw_errors(axes: Any, estimates: Sequence[EstimateRecord]) -> None:
    """Errors ± 2 standard deviations, grouped by parameter."""
    from mvest.reporting.figures import COLOURS

    kinds = [one.case.partition(", errors")[0] for one in estimates]
    colours = dict(zip(dict.fromkeys(kinds), COLOURS, strict=False))
    for j, (one, kind) in enumerate(zip(estimates, kinds, strict=True)):
        own = [unknown for unknown in one.parameters if unknown.estimate]
        y = np.arange(len(own)) + 0.7 * ((j + 0.5) / len(estimates) - 0.5)
        error = [100 * (unknown.relative_error or 0.0) for unknown in own]
        two = [200 * (unknown.std or 0.0) / (unknown.estimate or 1.0) for unknown in own]
        axes.errorbar(error, y, xerr=two, fmt="o", ms=3, lw=1, color=colours[kind])
    for kind, colour in colours.items():
        axes.plot([], [], "o", color=colour, label=kind)
    axes.axvline(0.0, color="black", lw=0.8)
    axes.set_xscale("symlog", linthresh=1.0)
    names = [unknown.name for unknown in estimates[0].parameters]
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("error ± 2 SD (%)")


STUDY = Study(
    settings=CycleSettings,
    part="cycle",
    run=run_cycle,
    figure=figure,
    captions={
        "": "The smallest possible standard deviation (Cramér-Rao) of each parameter from sets of "
        "frames, and estimates with 2 standard deviations. Simulated."
    },
    keeps_failures=True,
    check=expect_cycle,
    golden=("twin",),
)
