"""One's own program as the model: parameters from observed positions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.filters import build_filter
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.records.estimate_record import innovation_of
from experiments.common.records.findings import rows, vector
from experiments.common.records.record import Outcome
from experiments.common.records.report import write_each
from experiments.common.schema import build
from experiments.common.study import Job, Study
from experiments.studies.external.findings import Findings, Program
from experiments.studies.external.report import (
    external_table,
    external_text,
    external_words,
    iterates,
)
from experiments.studies.external.settings import ExternalSettings, Settings
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.estimate import Filter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Transform
from mvest.external.contract import read_points, write_points
from mvest.external.differences import Differences
from mvest.external.model import ProcessModel
from mvest.external.process import Command
from mvest.reporting.findings import spread
from mvest.typing import FloatArray

__all__ = ["STUDY", "check_external", "model_of", "run_external"]

Values = Mapping[str, Any]

FITTED = "fitted.csv"
"""Where the program puts the observed points at the estimate."""


def observed(about: ExternalSettings) -> FloatArray:
    """The observed positions ``(n, 3)`` mm that the configuration names.

    Raises
    ------
    ConfigurationError
        If it names none, or the file is not in order.
    """
    if about.observation is None:
        raise ConfigurationError(
            "external.observation is not given; expected a .csv file with the columns x,y,z (mm)"
        )
    return _points(about.observation, "external.observation")


def model_of(
    about: ExternalSettings, names: tuple[str, ...], count: int, folder: Path
) -> ProcessModel:
    """The configured program as an observation model of ``count`` points.

    Raises
    ------
    MvestError
        If the program, a file or a setting is inadmissible.
    """
    if not about.command:
        raise ConfigurationError(
            "external.command is not given; expected the program and its arguments, such as "
            '[python,"{here}/solve.py","{request}","{folder}"]'
        )
    if about.units and len(about.units) != len(names):
        raise ConfigurationError(
            f"external.units = {list(about.units)}, expected one for each of {', '.join(names)}"
        )
    differences = None
    if about.differences != "none":
        differences = Differences(
            about.differences, about.relative_step, about.floor, about.processes
        )
    return ProcessModel(
        Command(about.command, about.environment, about.time_limit_s),
        folder / "runs" if about.folder is None else Path(about.folder),
        names,
        count,
        units=about.units or None,
        points=None if about.points is None else _points(about.points, "external.points"),
        settings=about.settings,
        differences=differences,
        reuse=about.reuse,
        inputs=tuple(map(Path, about.inputs)),
    )


def estimator_of(
    about: ExternalSettings, values: Values
) -> tuple[Filter, Transform, Gaussian, float]:
    """Filter, coordinates, prior and variance of each observed coordinate (mm²).

    Raises
    ------
    MvestError
        If a setting is missing or inadmissible.
    """
    names = tuple(values["parameters"])
    for key, instead in (("P0", "external.prior_std"), ("R", "external.noise_mm")):
        if values["filter"][key] is not None:
            raise ConfigurationError(f"filter.{key} is given; expected {instead} in its place")
    std = np.array(about.prior_std, dtype=float)
    if std.shape != (len(names),) or not np.all(np.isfinite(std) & (std > 0)):
        raise ConfigurationError(
            f"external.prior_std = {list(about.prior_std)}, expected one standard deviation > 0 "
            f"for each of {', '.join(names)}"
        )
    noise = about.noise_mm
    if noise is None or not (np.isfinite(noise) and noise > 0):
        raise ConfigurationError(f"external.noise_mm = {noise}, expected a number > 0 (mm)")
    settings = {**values["filter"], "P0": (std**2).tolist()}
    return *build_filter(settings, names, positive=True), float(noise) ** 2


def check_external(values: Values, folder: Path) -> str:
    """Run the program once at the initial values, and compare its derivatives with differences.

    Raises
    ------
    MvestError
        If a setting or a file is inadmissible, or the program gives no prediction.
    """
    about = build(ExternalSettings, values["external"])
    y = observed(about)
    _, _, prior, _ = estimator_of(about, values)
    model = model_of(about, tuple(values["parameters"]), len(y), folder)
    prediction = model(prior.mean)
    if not prediction.converged:
        raise InputError(f"at the initial values: {prediction.reason}")
    distance = np.linalg.norm(prediction.y.reshape(-1, 3) - y, axis=1)
    lines = [
        f"{len(y)} points; at the initial values they are {distance.mean():.3g} mm (mean) and "
        f"{distance.max():.3g} mm (largest) from the observed ones",
        f"{model.runs} runs of the program in {model.seconds:.3g} s, {model.reused} served again, "
        f"kept in {model.folder}",
    ]
    if model.own_jacobian:
        lines.append(_compared(model, prior.mean, prediction))
    else:
        lines.append("derivatives: by differences, the program gives none")
    return "\n".join([*lines, "In order"])


def _compared(model: ProcessModel, m: FloatArray, prediction: Prediction) -> str:
    """The program's own derivatives beside differences of its predictions."""
    by = model.by_differences(m, prediction.y)
    if isinstance(by, str):
        return f"derivatives: the program's own; not compared with differences: {by}"
    size = np.linalg.norm(by, axis=0)
    apart = np.linalg.norm(prediction.jacobian - by, axis=0) / np.where(size > 0, size, 1.0)
    shares = ", ".join(f"{n} {100 * a:.2g} %" for n, a in zip(model.names, apart, strict=True))
    return f"derivatives: the program's own; apart from differences by {shares}"


def run_external(job: Job[Settings]) -> Outcome[Findings]:
    """Estimate the parameters of the configured program from the observed positions.

    Raises
    ------
    MvestError
        If a setting or a file is inadmissible.
    """
    about, values = job.settings.external, job.values
    (job.folder / FITTED).unlink(missing_ok=True)
    y = observed(about)
    filter_, transform, prior, variance = estimator_of(about, values)
    model = model_of(about, tuple(values["parameters"]), len(y), job.folder)

    began = time.perf_counter()
    with SolveBar(values["name"], 0, TYPICAL_SOLVES, model.names) as bar:
        estimate = filter_(
            model,
            prior,
            y.ravel(),
            variance,
            names=model.names,
            transform=transform,
            on_iterate=bar.iterate,
        )
    distance = None
    if estimate.prediction is not None:
        fitted = estimate.prediction.y.reshape(-1, 3)
        write_points(job.folder / FITTED, fitted)
        distance = np.linalg.norm(fitted - y, axis=1)
    known = estimate.converged
    findings = Findings(
        units=model.units,
        initial=vector(estimate.prior.mean),
        prior_std=vector(estimate.prior.std),
        estimate=vector(estimate.mean) if known else None,
        std=vector(estimate.std) if known else None,
        iterates=rows(estimate.iterates),
        iterate_std=rows(estimate.iterate_std),
        distance_mm=spread(distance),
        innovation=innovation_of(estimate),
        iterations=estimate.iterations,
        seconds=time.perf_counter() - began,
        program=Program(
            model.command.arguments,
            model.count,
            model.runs,
            model.reused,
            model.seconds,
            model.own_jacobian,
        ),
    )
    return Outcome(
        findings=findings,
        status="converged" if known else "failed",
        reason=estimate.reason.value,
        detail=estimate.detail,
        forward_solves=estimate.forward_solves,
    )


def _points(file: str, what: str) -> FloatArray:
    try:
        return read_points(Path(file))
    except InputError as error:
        raise ConfigurationError(f"{what} = {file}: {error}") from error


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_external,
    words=external_text,
    write=write_each(external_table, external_words, iterates=iterates),
    checks=lambda: (check_external,),
)
