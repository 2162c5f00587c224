"""Estimates with any model: an external program called through files, or a Python function.

A single model is fitted to observed positions. If there are several models, each is fitted to
predictions that some of them make for known parameters.
"""

from __future__ import annotations

import runpy
import sys
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from experiments.common.building.filters import build_filter
from experiments.common.places import CHECKOUT
from experiments.common.progress import SolveBar
from experiments.common.schema import NOT_HASHED, InputFile, Reads, Values, contents
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.exchange.external.contract import Command, files_of_command, read_points, write_points
from mvest.exchange.external.model import ProcessModel
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, estimate
from mvest.problem.record import EstimateRecord, record_of
from mvest.quantities import Length, Processes, TimeLimit, Tolerance, Value, within
from mvest.reporting.tables import Column, table
from mvest.typing import FloatArray

POINTS = ("points",)
"""The only frame that models predict."""

FITTED = "fitted.csv"
"""The observed points, as predicted by a single model at its estimate."""


def _command(value: tuple[str, ...], other: Values) -> Any:
    files = contents(files_of_command(value, other.get("environment") or {}))
    return [*value, files] if value else value


def _python(value: str, _: Values) -> Any:
    file = _file(value)
    return value if file is None else [value.rpartition(":")[2], contents(file)]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSettings:
    """A program (mvest/exchange/external/README.md), or a function in a file of Python."""

    command: Annotated[tuple[str, ...], Reads(_command)] = ()  # program and arguments, no shell
    # FILE:FUNCTION, called with the settings; returns the model.
    python: Annotated[str | None, Reads(_python)] = None
    apart: bool = False  # run FILE as a program instead, with the request and its folder
    settings: dict[str, Any] = field(default_factory=dict)  # passed to the model unchanged
    environment: dict[str, str] = field(default_factory=dict)  # added to this process's
    # Files and folders that affect the result, besides those in the command.
    inputs: Annotated[tuple[str, ...], Reads(contents)] = ()
    time_limit_s: TimeLimit = 600.0  # of one run
    differences: Literal["central", "none"] = "central"  # none: program gives jacobian.csv
    relative_step: Tolerance = 1e-3  # of a parameter
    floor: Annotated[float, within(0, 1e12, "", "in the units of any model")] = 0.0  # if it is zero
    processes: Annotated[Processes, NOT_HASHED] = 1  # simultaneous runs


@dataclass(frozen=True, slots=True, kw_only=True)
class ExternalSettings(ModelSettings):
    """The model, or several, and the observation."""

    folder: Annotated[str | None, NOT_HASHED] = None  # of runs; null: in the folder of the job
    observation: InputFile = None  # .csv x,y,z (mm), one row per observed point
    points: InputFile = None  # .csv x,y,z (mm), reference positions for programs
    units: tuple[str, ...] = ()  # of the parameters; empty: not stated
    prior_std: tuple[Value, ...] = ()  # of the parameters
    noise_mm: Length | None = None  # SD of the error of each observed coordinate
    models: dict[str, ModelSettings] = field(default_factory=dict)  # several, with their settings
    data: tuple[str, ...] = ()  # models that predict observations from truth.values


def problem_of(about: ExternalSettings, values: Values) -> Problem:
    """The problem, with a placeholder model. MvestError if a setting is missing or inadmissible."""
    names = tuple(values["parameters"])
    for key, instead in (("P0", "external.prior_std"), ("R", "external.noise_mm")):
        if values["filter"][key] is not None:
            raise ConfigurationError(f"filter.{key} is given; expected {instead} instead")
    each = f"for each of {', '.join(names)}"
    if about.units and len(about.units) != len(names):
        raise ConfigurationError(f"external.units = {list(about.units)}, expected one {each}")
    if len(about.prior_std) != len(names) or min(about.prior_std) <= 0:
        found = f"external.prior_std = {list(about.prior_std)}"
        raise ConfigurationError(f"{found}, expected one standard deviation > 0 {each}")
    if not about.noise_mm:
        found = f"external.noise_mm = {about.noise_mm}"
        raise ConfigurationError(f"{found}, expected a number > 0 (mm)")
    settings = {**values["filter"], "P0": [std**2 for std in about.prior_std]}
    filter_, transform, prior = build_filter(settings, names, positive=True)
    return Problem(names, lambda _: Prediction.failed("no model"), prior, filter_, transform, {})


def model_of(
    about: ExternalSettings, parameters: tuple[str, ...], name: str, count: int, folder: Path
) -> ObservationModel:
    """A configured model for ``count`` observed points.

    MvestError if the program, a file or a setting is inadmissible.
    """
    source = about.models.get(name, about)
    settings, command = {**about.settings, **source.settings}, source.command
    if source.python is not None:
        where, function = f"python = {source.python}", source.python.rpartition(":")[2]
        if (file := _file(source.python)) is None:
            raise ConfigurationError(f"{where}: no such file, expected FILE:FUNCTION")
        command = (sys.executable, str(file), "{request}", "{folder}")
        if not source.apart:
            found = runpy.run_path(str(file))
            if function not in found:
                raise ConfigurationError(f"{where}: no function {function!r} in the file")
            return found[function](**settings)
    if not command:
        raise ConfigurationError(
            "external.command is not given; expected the program and its arguments, such as "
            '[python,"{here}/solve.py","{request}","{folder}"]'
        )
    if missing := [path for path in source.inputs if not Path(path).exists()]:
        raise ConfigurationError(f"external.inputs: cannot read {', '.join(missing)}")
    return ProcessModel(
        Command(command, source.environment, source.time_limit_s),
        folder / "runs" if about.folder is None else Path(about.folder),
        parameters,
        count,
        units=about.units or None,
        points=None if about.points is None else _points(about.points, "points"),
        settings=settings,
        inputs=source.inputs,
        differences=source.differences != "none",
        relative_step=source.relative_step,
        floor=source.floor,
        processes=source.processes,
    )


def _file(python: str) -> Path | None:
    """FILE in FILE:FUNCTION, in the checkout or in the working folder."""
    name = python.rpartition(":")[0]
    places = (CHECKOUT / name, Path(name).absolute())
    return next((place for place in places if place.is_file()), None)


def _points(file: str | None, what: str) -> FloatArray:
    if file is None:
        raise ConfigurationError(
            f"external.{what} is not given; expected a .csv file with the columns x,y,z (mm)"
        )
    try:
        return read_points(Path(file))
    except InputError as error:
        raise ConfigurationError(f"external.{what} = {file}: {error}") from error


def run(job: Job[ExternalSettings]) -> Result:
    """Fit each model to each observation."""
    about = job.settings
    problem = problem_of(about, job.values)
    names, noise_mm = problem.parameters, float(about.noise_mm or 0.0)
    true = list(map(float, job.values["truth"]["values"]))
    (job.folder / FITTED).unlink(missing_ok=True)
    data = {} if about.data else {"observation": _points(about.observation, "observation")}
    for name in about.data:
        exact = predict(model_of(about, names, name, 0, job.folder), np.array(true))
        if not exact.converged:
            return Result(status="failed", reason=f"{name}: {exact.reason}")
        # All get the same errors, so that only the models differ.
        errors = np.random.default_rng(job.values["seed"]).standard_normal(exact.y.size)
        data[name] = (exact.y + noise_mm * errors).reshape(-1, 3)
    estimates, rows = list[EstimateRecord](), list[dict[str, Any]]()
    for (source, y), name in product(data.items(), about.models or ("model",)):
        model, title = model_of(about, names, name, len(y), job.folder), f"{name}, from {source}"
        seen = Observation(POINTS, y[None], np.array(noise_mm**2), predicted=POINTS)
        with SolveBar(title, 0, names) as bar:
            found = estimate(replace(problem, model=model), seen, on_iterate=bar.iterate)
        if found.fitted is not None and not about.models:
            write_points(job.folder / FITTED, found.fitted[-1])
        record = record_of(found, case=title).with_truth(dict(zip(names, true, strict=False)))
        units = zip(record.unknowns, about.units or [""] * len(names), strict=True)
        unknowns = tuple(one.model_copy(update={"unit": unit}) for one, unit in units)
        record = record.model_copy(update={"unknowns": unknowns})
        whole: dict[str, Any] = {"data": source, "model": name}
        if isinstance(model, ProcessModel):
            whole["runs"] = model.runs
        rows += [{**whole, **{key: row.get(key) for key in COLUMNS}} for row in record.rows()]
        estimates.append(record)
    return Result(
        tables={"": table(rows, data="", model="", **COLUMNS)},
        estimates=tuple(estimates),
        status="converged" if any(one.converged for one in estimates) else "failed",
        reason=estimates[0].reason,
        detail=estimates[0].detail,
        forward_solves=sum(one.forward_solves or 0 for one in estimates),
    )


COLUMNS: dict[str, Column | str] = {
    **dict.fromkeys(("parameter", "unit", "truth"), ""),
    "prior_mean": Column(std="prior_std", label="prior"),
    "prior_std": "",
    "estimate": Column(digits=".3f", std="std"),
    "std": "",
    "relative_error": Column(digits="+.2%", label="error"),
    "reason": Column(hidden=True),
    "forward_solves": Column(label="predictions"),
    "distance_mean": Column("mm"),
}
"""Columns of a record shown in the table."""


def check_external(values: Values, folder: Path) -> str:
    """Run the program once at the initial values, and check its derivatives by differences.

    MvestError if a setting or a file is inadmissible, or the program gives no prediction.
    """
    about = STUDY.settings_of(values)
    problem = problem_of(about, values)
    y, m = _points(about.observation, "observation"), problem.prior.mean
    model = model_of(about, problem.parameters, "model", len(y), folder)
    found = predict(model, m)
    if not found.converged:
        raise InputError(f"at the initial values: {found.reason}")
    distance = np.linalg.norm(found.y.reshape(-1, 3) - y, axis=1)
    derivatives = "by differences, the program gives none"
    by: FloatArray | str = "it is a function"
    if isinstance(model, ProcessModel) and model.own_jacobian:
        by = model.by_differences(m)
    if not isinstance(model, ProcessModel) or model.own_jacobian:
        derivatives = f"the model's own; not compared with differences: {by}"
    if not isinstance(by, str):
        off = np.linalg.norm(found.jacobian - by, axis=0) / np.linalg.norm(by, axis=0)
        each = zip(problem.parameters, off, strict=True)
        shares = ", ".join(f"{name} {100 * share:.2g} %" for name, share in each)
        derivatives = f"the program's own; differences deviate by {shares}"
    return (
        f"{len(y)} points; at the initial values they are {distance.mean():.3g} mm (mean) and "
        f"{distance.max():.3g} mm (largest) from the observed ones\nderivatives: {derivatives}\n"
        "In order"
    )


def figure(results: Results) -> Figures:
    """Iterates of each parameter, for each model."""
    from mvest.reporting.figures import iterates_figure

    return iterates_figure(results.first.estimates)


STUDY = Study(
    settings=ExternalSettings,
    part="external",
    run=run,
    figure=figure,
    captions={"": "Parameters after each iteration, with each model."},
    check=check_external,
    golden=("case",),
)
