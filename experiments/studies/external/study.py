"""One's own program as the model: parameters from observed positions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import build_filter
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.study import Study
from experiments.studies.external.report import external_text, write_external_tables
from experiments.studies.external.settings import Settings
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.estimate import Estimate, Filter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Transform
from mvest.external.contract import read_points, write_points
from mvest.external.differences import Differences
from mvest.external.model import ProcessModel
from mvest.external.process import Command
from mvest.provenance import provenance
from mvest.typing import FloatArray

__all__ = ["STUDY", "check_external", "model_of", "run_external"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]

FITTED = "fitted.csv"
"""Where the program puts the observed points at the estimate."""


def observed(about: Values) -> FloatArray:
    """The observed positions ``(n, 3)`` mm that the configuration names.

    Raises
    ------
    ConfigurationError
        If it names none, or the file is not in order.
    """
    if about["observation"] is None:
        raise ConfigurationError(
            "external.observation is not given; expected a .csv file with the columns x,y,z (mm)"
        )
    return _points(about["observation"], "external.observation")


def model_of(config: Values, count: int, folder: Path) -> ProcessModel:
    """The configured program as an observation model.

    Raises
    ------
    MvestError
        If the program, a file or a setting is inadmissible.
    """
    about = config["external"]
    if not about["command"]:
        raise ConfigurationError(
            "external.command is not given; expected the program and its arguments, such as "
            '[python,"{here}/solve.py","{request}","{folder}"]'
        )
    names = config["parameters"]
    if about["units"] and len(about["units"]) != len(names):
        raise ConfigurationError(
            f"external.units = {about['units']}, expected one for each of {', '.join(names)}"
        )
    differences = None
    if about["differences"] != "none":
        differences = Differences(
            about["differences"], about["relative_step"], about["floor"], about["processes"]
        )
    kept = about["folder"]
    return ProcessModel(
        Command(tuple(about["command"]), about["environment"], about["time_limit_s"]),
        folder / "runs" if kept is None else Path(kept),
        names,
        count,
        units=about["units"] or None,
        points=None if about["points"] is None else _points(about["points"], "external.points"),
        settings=about["settings"],
        differences=differences,
        reuse=about["reuse"],
        inputs=tuple(map(Path, about["inputs"])),
    )


def estimator_of(config: Values) -> tuple[Filter, Transform, Gaussian, float]:
    """Filter, coordinates, prior and variance of each observed coordinate (mm²).

    Raises
    ------
    MvestError
        If a setting is missing or inadmissible.
    """
    about, names = config["external"], tuple(config["parameters"])
    for key, instead in (("P0", "external.prior_std"), ("R", "external.noise_mm")):
        if config["filter"][key] is not None:
            raise ConfigurationError(f"filter.{key} is given; expected {instead} in its place")
    std = np.array(about["prior_std"], dtype=float)
    if std.shape != (len(names),) or not np.all(np.isfinite(std) & (std > 0)):
        raise ConfigurationError(
            f"external.prior_std = {about['prior_std']}, expected one standard deviation > 0 for "
            f"each of {', '.join(names)}"
        )
    noise = about["noise_mm"]
    if noise is None or not (np.isfinite(noise) and noise > 0):
        raise ConfigurationError(f"external.noise_mm = {noise}, expected a number > 0 (mm)")
    settings = {**config["filter"], "P0": (std**2).tolist()}
    return *build_filter(settings, names, positive=True), float(noise) ** 2


def check_external(config: Values, folder: Path) -> str:
    """Run the program once at the initial values, and compare its derivatives with differences.

    Raises
    ------
    MvestError
        If a setting or a file is inadmissible, or the program gives no prediction.
    """
    y = observed(config["external"])
    _, _, prior, _ = estimator_of(config)
    model = model_of(config, len(y), folder)
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
    told = ", ".join(f"{n} {100 * a:.2g} %" for n, a in zip(model.names, apart, strict=True))
    return f"derivatives: the program's own; apart from differences by {told}"


def run_external(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Estimate the parameters of the configured program from the observed positions.

    Raises
    ------
    MvestError
        If a setting or a file is inadmissible.
    """
    (folder / FITTED).unlink(missing_ok=True)
    y = observed(config["external"])
    filter_, transform, prior, variance = estimator_of(config)
    model = model_of(config, len(y), folder)

    began = time.perf_counter()
    with SolveBar(config["name"], 0, TYPICAL_SOLVES, model.names) as bar:
        found = filter_(
            model,
            prior,
            y.ravel(),
            variance,
            names=model.names,
            transform=transform,
            on_iterate=bar.iterate,
        )
    record = _record(config, config_hash, found, model, started)
    record["seconds"] = time.perf_counter() - began
    if found.prediction is None:
        return record, []
    fitted = found.prediction.y.reshape(-1, 3)
    write_points(folder / FITTED, fitted)
    distance = np.linalg.norm(fitted - y, axis=1)
    record["distance_mm"] = {
        "mean": float(distance.mean()),
        "std": float(distance.std()),
        "max": float(distance.max()),
    }
    return record, [folder / FITTED]


def _points(file: str, what: str) -> FloatArray:
    try:
        return read_points(Path(file))
    except InputError as error:
        raise ConfigurationError(f"{what} = {file}: {error}") from error


def _record(
    config: Values, config_hash: str, found: Estimate, model: ProcessModel, started: float
) -> dict[str, Any]:
    summary = found.innovation
    return {
        "schema": 1,
        **{key: config[key] for key in ("title", "row", "table", "paper", "parameters")},
        "experiment": config["name"],
        "status": "converged" if found.converged else "failed",
        "reason": found.reason.value,
        "detail": found.detail,
        "truth": None,
        "units": list(model.units),
        "initial": found.prior.mean.tolist(),
        "prior_std": found.prior.std.tolist(),
        "estimate": found.mean.tolist() if found.converged else None,
        "std": found.std.tolist() if found.converged else None,
        "iterates": found.iterates.tolist(),
        "iterate_std": found.iterate_std.tolist(),
        **dict.fromkeys(
            ("relative_error", "moduli_error_percent", "distance_mm", "distance_to_truth_mm")
        ),
        "innovation": None
        if summary is None
        else {
            "size": summary.size,
            "rms": summary.rms,
            "nis": summary.nis,
            "nis_band": list(summary.nis_band),
        },
        "iterations": found.iterations,
        "forward_solves": found.forward_solves,
        "program": {
            "command": list(model.command.arguments),
            "points": model.count,
            "runs": model.runs,
            "reused": model.reused,
            "seconds": model.seconds,
            "own_jacobian": model.own_jacobian,
        },
        "seconds": 0.0,
        "seconds_total": time.time() - started,
        "mesh": {},
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": "none",
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_external),
    words=lambda record: external_text(flat(record)),
    write=each(write_external_tables),
    checks=lambda: (check_external,),
    sections=(),
)
