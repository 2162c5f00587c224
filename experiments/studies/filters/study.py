"""All filters on the same problems: what they find, how sure they are, and what they cost."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from experiments.common.build import MADE_BY, filter_of
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import SolveBar
from experiments.common.schema import build
from experiments.common.store import Store
from experiments.common.study import Section, Study
from experiments.studies.filters.problem import (
    TRANSFORM,
    ComparedProblem,
    FittedSurrogate,
    build_problem,
    fit_to_prior,
)
from experiments.studies.filters.report import (
    REFERENCE,
    filters_text,
    write_filter_study,
)
from experiments.studies.filters.settings import Settings
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate, Filter
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.monte_carlo import log_posterior
from mvest.estimation.filters.sampler import SamplerSettings, draw
from mvest.estimation.noise import observation_noise
from mvest.kept import Entry
from mvest.provenance import provenance, write_json
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_filter_study"]

Values = Mapping[str, Any]

BINS = 40
"""Of the histograms of the Monte Carlo posterior."""

INSIDE = 0.9
"""Part of the surrogate's region from which the truths of repeats are drawn, so that their
posteriors lie within it."""


def run_filter_study(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Every filter on every problem; a problem that was computed before is read from its store."""
    settings = config["filters"]
    if settings is None or REFERENCE not in settings["methods"]:
        raise ConfigurationError(f"filters.methods needs {REFERENCE}, to compare the others with")
    problems = [_solve(config, name) for name in settings["problems"]]
    record = _record(config, config_hash, problems, started)
    return record, []


def _entry(config: Values, name: str, part: str, decisive: Any, made_by: tuple[Any, ...]) -> _Kept:
    """Where a part of what is computed of a problem is kept: under a key of all that decides it."""
    described = {k: config[k] for k in ("valve", "mesh", "mechanics", "fixed", "seed")}
    problem = config["filters"]["problems"][name]
    words = ("title", "about")
    without = (*words, "truth", "noise_mm") if part == "runs" else words
    described["problem"] = {k: v for k, v in problem.items() if k not in without}
    described["decisive"] = decisive
    store = Store(config["paths"]["outputs"])
    return store.entry("filter_store", described, made_by, _read, f"{name}_{part}_{{key}}.json")


_Kept = Entry[dict[str, Any]]


def _read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _solve(config: Values, name: str) -> dict[str, Any]:
    """All that the study tells of one problem; what was computed before is read."""
    settings = config["filters"]
    problem = build_problem(config, name)
    methods = settings["methods"]
    filters = {
        method: filter_of(_told(values, problem), problem.prior.mean)
        for method, values in methods.items()
    }
    found = {}
    for method, filter_ in filters.items():
        entry = _entry(config, name, method, methods[method], (_estimate, build_problem, filter_of))
        make = partial(_estimate, problem, filter_, config["seed"])
        found[method] = entry.get_or_make(make, write_json)
        row = found[method]
        _say(f"{name}, {method}: {row['forward_solves']} runs, {row['seconds']:.0f} s")
    design = {k: v for k, v in settings["design"].items() if k != "degree"}
    runs = _entry(config, name, "runs", design, (fit_to_prior, *MADE_BY)).path.with_suffix("")
    fitted = fit_to_prior(problem, settings["design"], runs)
    decisive = {k: settings[k] for k in ("methods", "design", "repeats", "sampler")}
    entry = _entry(config, name, "repeats", decisive, (_repeats, build_problem, fit_to_prior))
    repeats = entry.get_or_make(
        lambda: _repeats(problem, fitted, filters, settings, config["seed"]), write_json
    )
    described = settings["problems"][name]
    log_prior = problem.log_prior
    return {
        "name": name,
        **{
            k: described[k]
            for k in ("title", "about", "parameters", "truth", "initial", "noise_mm")
        },
        "log_prior": {"mean": log_prior.mean.tolist(), "std": log_prior.std.tolist()},
        "observations": problem.observations,
        "mesh_hash": problem.mesh_hash,
        "surrogate": {
            "runs": fitted.runs,
            "held_out": fitted.held_out,
            "degree": int(fitted.model.surrogate.powers.sum(axis=1).max()),
            "rms_mm": fitted.rms_mm,
            "largest_mm": fitted.largest_mm,
        },
        "filters": found,
        "repeats": repeats,
    }


def _told(values: Values, problem: ComparedProblem) -> dict[str, Any]:
    """Settings of a filter, with the process noise of the paper: as large as the prior."""
    return {**values, "Q": np.diag(problem.prior.covariance)}


def _estimate(problem: ComparedProblem, filter_: Filter, seed: int) -> dict[str, Any]:
    """One estimate with the model itself, from the open valve on."""
    problem.model.restart()
    y = problem.exact
    y = y + problem.noise * np.random.default_rng(seed).standard_normal(y.shape)
    problem.model.restart()
    began, before = time.process_time(), problem.model.seconds
    found = filter_(
        problem.model,
        problem.prior,
        y,
        problem.noise**2,
        names=problem.parameters,
        transform=TRANSFORM,
        on_iterate=SolveBar(problem.name, 0, 0, problem.parameters).iterate,
    )
    seconds = time.process_time() - began
    low, high = found.interval()
    row = {
        "converged": found.converged,
        "reason": found.reason.value,
        "detail": found.detail,
        "forward_solves": found.forward_solves,
        "iterations": found.iterations,
        "seconds": seconds,
        "model_seconds": problem.model.seconds - before,
        "estimate": found.mean.tolist(),
        "log_mean": found.transformed.mean.tolist(),
        "log_std": found.transformed.std.tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
    }
    if found.transformed_samples is not None:
        row["histogram"] = [_histogram(draws) for draws in found.transformed_samples.T]
        row["skewness"] = scipy.stats.skew(found.transformed_samples, axis=0).tolist()
    return row


def _histogram(draws: FloatArray) -> dict[str, Any]:
    density, edges = np.histogram(draws, bins=BINS, density=True)
    return {"edges": edges.tolist(), "density": density.tolist()}


def _repeats(
    problem: ComparedProblem,
    fitted: FittedSurrogate,
    filters: Mapping[str, Filter],
    settings: Values,
    seed: int,
) -> dict[str, Any]:
    """Estimates from many observations, each of a truth of its own, with the surrogate."""
    p, count = len(problem.parameters), settings["repeats"]
    sampler = build(SamplerSettings, settings["sampler"])
    every: dict[str, list[_Interval | None]] = {method: [] for method in filters}
    truths = _truths(p, INSIDE * settings["design"]["reach"], np.random.default_rng([seed, 1]))
    log_prior = problem.log_prior
    for k in range(count):
        rng = np.random.default_rng([seed, 2, k])
        truth = next(truths)
        y = fitted.model.surrogate(truth[None])[0]
        y = y + problem.noise * rng.standard_normal(y.shape)
        for method, filter_ in filters.items():
            interval: tuple[FloatArray, FloatArray, FloatArray] | None
            if method == REFERENCE:
                interval = _drawn(problem, fitted, y, sampler, rng)
            else:
                if isinstance(filter_, EnsembleFilter):
                    filter_ = replace(filter_, seed=k)
                found = filter_(
                    fitted.model, problem.prior, y, problem.noise**2, transform=TRANSFORM
                )
                interval = _interval(found, log_prior.mean, log_prior.std)
            every[method].append(None if interval is None else (*interval, truth))
    return {
        method: _summary(found, every[REFERENCE], log_prior.std) for method, found in every.items()
    }


_Interval = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Mean, lower and upper end of an estimate and the truth, (p,) each, where the prior is N(0, I)."""


def _truths(size: int, reach: float, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Draws from N(0, I) that lie in the region of the surrogate."""
    while True:
        x = rng.standard_normal(size)
        if np.all(np.abs(x) <= reach):
            yield x


def _interval(
    found: Estimate, mean: FloatArray, std: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    if found.prediction is None:
        return None
    low, high = found.interval()
    centre, low, high = ((z - mean) / std for z in (found.transformed.mean, *np.log([low, high])))
    return centre, low, high


def _drawn(
    problem: ComparedProblem,
    fitted: FittedSurrogate,
    y: FloatArray,
    sampler: SamplerSettings,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The reference: draws from the posterior of the surrogate itself."""
    noise = observation_noise(problem.noise**2, y.size)
    surrogate = fitted.model.surrogate
    unit = replace(problem.log_prior, mean=np.zeros(len(problem.parameters)))
    start = replace(unit, covariance=np.eye(unit.size))
    density = log_posterior(surrogate.misfit(y, noise))
    points = draw(density, start, sampler, rng).points
    low, high = np.quantile(points, (0.025, 0.975), axis=0)
    return points.mean(axis=0), low, high


def _summary(
    found: list[_Interval | None], reference: list[_Interval | None], std: FloatArray
) -> dict[str, Any]:
    """Coverage, error and width over the repeats; one that failed covers nothing."""
    kept = [(f, r) for f, r in zip(found, reference, strict=True) if f is not None]
    held = np.array([(f[1] <= f[3]) & (f[3] <= f[2]) for f, _ in kept])
    error = np.array([f[0] - f[3] for f, _ in kept]) * std
    width = np.array([(f[2] - f[1]) / (r[2] - r[1]) for f, r in kept if r is not None])
    return {
        "runs": len(found),
        "failed": len(found) - len(kept),
        "coverage": (held.sum(axis=0) / len(found)).tolist() if kept else None,
        "log_rms_error": np.sqrt((error**2).mean(axis=0)).tolist() if kept else None,
        "width_ratio": np.median(width, axis=0).tolist() if kept else None,
    }


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _record(
    config: Values, config_hash: str, problems: list[dict[str, Any]], started: float
) -> dict[str, Any]:
    seconds = sum(row["seconds"] for p in problems for row in p["filters"].values())
    return {
        **{key: config[key] for key in ("title", "row", "table", "parameters")},
        "schema": 1,
        "experiment": config["name"],
        "status": "converged",
        "reason": "completed",
        "detail": "",
        "truth": None,
        "estimate": None,
        "std": None,
        "relative_error": None,
        "iterates": None,
        "iterate_std": None,
        "distance_mm": None,
        "distance_to_truth_mm": None,
        "moduli_error_percent": None,
        "iterations": 0,
        "forward_solves": sum(
            row["forward_solves"] for p in problems for row in p["filters"].values()
        ),
        "seconds": seconds,
        "seconds_total": time.time() - started,
        "mesh": {},
        "model": {
            "element": config["mechanics"]["element"],
            "cells": [config["mesh"][key] for key in ("columns", "rows", "layers")],
        },
        "problems": problems,
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": problems[0]["mesh_hash"],
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_filter_study),
    words=lambda record: filters_text(flat(record)),
    write=each(write_filter_study),
    sections=(
        Section(
            "filters",
            {
                "filters": "95 % interval that each filter gives each unknown, on that of Monte "
                "Carlo: blue where it is as wide to 10 %. Simulated."
            },
        ),
    ),
)
