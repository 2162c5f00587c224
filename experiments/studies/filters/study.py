"""All filters on the same problems: what they find, how sure they are, and what they cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from pydantic import TypeAdapter

from experiments.common.building.filters import filter_of
from experiments.common.building.store import Store
from experiments.common.building.truth import MADE_BY
from experiments.common.progress import SolveBar, say
from experiments.common.records.findings import vector
from experiments.common.records.record import Mesh, Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.filters.findings import (
    Estimated,
    Findings,
    OwnCheck,
    Problem,
    Repeats,
    SurrogateFit,
)
from experiments.studies.filters.problem import (
    TRANSFORM,
    ComparedProblem,
    FittedSurrogate,
    build_problem,
    fit_to_prior,
)
from experiments.studies.filters.report import (
    REFERENCE,
    filters_answer,
    filters_words,
    write_filters,
)
from experiments.studies.filters.settings import FilterStudySettings, Settings
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate, Filter
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.monte_carlo import log_posterior
from mvest.estimation.filters.sampler import SamplerSettings, draw
from mvest.estimation.noise import observation_noise
from mvest.files import write_atomically
from mvest.kept import Entry
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_filter_study"]

Values = Mapping[str, Any]

INSIDE = 0.9
"""Part of the surrogate's region from which the truths of repeats are drawn, so that their
posteriors lie within it."""


def run_filter_study(job: Job[Settings]) -> Outcome[Findings]:
    """Every filter on every problem; a problem that was computed before is read from its store.

    Raises
    ------
    ConfigurationError
        If the reference is not among the filters.
    """
    settings = job.settings.filters
    if REFERENCE not in settings.methods:
        raise ConfigurationError(f"filters.methods needs {REFERENCE}, to compare the others with")
    problems, meshes = zip(
        *(_solve(job.values, settings, name) for name in settings.problems), strict=True
    )
    estimates = [one for problem in problems for one in problem.filters.values()]
    return Outcome(
        findings=Findings(problems, sum(one.seconds for one in estimates)),
        mesh=meshes[0],
        forward_solves=sum(one.forward_solves for one in estimates),
    )


T = TypeVar("T")


def _entry(
    config: Values, name: str, part: str, decisive: Any, made_by: tuple[Any, ...], kind: type[T]
) -> Entry[T]:
    """Where a part of what is computed of a problem is kept: under a key of all that decides it."""
    described = {k: config[k] for k in ("valve", "mesh", "mechanics", "fixed", "seed")}
    problem = config["filters"]["problems"][name]
    words = ("title", "about")
    without = (*words, "truth", "noise_mm") if part == "runs" else words
    described["problem"] = {k: v for k, v in problem.items() if k not in without}
    described["decisive"] = decisive
    store = Store(config["paths"]["outputs"])
    adapter = TypeAdapter(kind)

    def read(path: Path) -> T:
        return adapter.validate_json(path.read_bytes())

    return store.entry("filter_store", described, made_by, read, f"{name}_{part}_{{key}}.json")


def _write(path: Path, made: Any) -> None:
    write_atomically(path, TypeAdapter(Any).dump_json(made))


def _solve(config: Values, settings: FilterStudySettings, name: str) -> tuple[Problem, Mesh]:
    """All that the study says of one problem, and its mesh; what was computed before is read."""
    described = settings.problems[name]
    problem = build_problem(config, name, described)
    raw = config["filters"]
    filters = {
        method: filter_of(_with_noise(values, problem), problem.prior.mean)
        for method, values in raw["methods"].items()
    }
    estimates = {}
    made_by: tuple[Any, ...] = (_estimate, build_problem, filter_of)
    for method, filter_ in filters.items():
        entry = _entry(config, name, method, raw["methods"][method], made_by, Estimated)
        make = partial(_estimate, problem, filter_, config["seed"])
        done = estimates[method] = entry.get_or_make(make, _write)
        say(f"{name}, {method}: {done.forward_solves} runs, {done.seconds:.0f} s")
    design = {k: v for k, v in raw["design"].items() if k != "degree"}
    runs = _entry(config, name, "runs", design, (fit_to_prior, *MADE_BY), object)
    fitted = fit_to_prior(problem, settings.design, runs.path.with_suffix(""))
    decisive = {k: raw[k] for k in ("methods", "design", "repeats", "sampler")}
    made_by = (_repeats, build_problem, fit_to_prior)
    repeats = _entry(config, name, "repeats", decisive, made_by, dict[str, Repeats])
    return Problem(
        name=name,
        title=described.title,
        about=described.about,
        parameters=described.parameters,
        truth=described.truth,
        initial=described.initial,
        log_std=vector(problem.log_prior.std),
        noise_mm=described.noise_mm,
        observations=problem.observations,
        surrogate=SurrogateFit(
            fitted.runs,
            fitted.held_out,
            int(fitted.model.surrogate.powers.sum(axis=1).max()),
            fitted.rms_mm,
            fitted.largest_mm,
        ),
        filters=estimates,
        repeats=repeats.get_or_make(
            lambda: _repeats(problem, fitted, filters, settings, config["seed"]), _write
        ),
    ), problem.mesh


def _with_noise(values: Values, problem: ComparedProblem) -> dict[str, Any]:
    """Settings of a filter, with the process noise of the paper: as large as the prior."""
    return {**values, "Q": np.diag(problem.prior.covariance)}


def _estimate(problem: ComparedProblem, filter_: Filter, seed: int) -> Estimated:
    """One estimate with the model itself, from the open valve on."""
    problem.model.restart()
    y = problem.exact
    y = y + problem.noise * np.random.default_rng(seed).standard_normal(y.shape)
    problem.model.restart()
    began, before = time.process_time(), problem.model.seconds
    estimate = filter_(
        problem.model,
        problem.prior,
        y,
        problem.noise**2,
        names=problem.parameters,
        transform=TRANSFORM,
        on_iterate=SolveBar(problem.name, 0, 0, problem.parameters).iterate,
    )
    seconds = time.process_time() - began
    low, high = estimate.interval()
    draws = estimate.transformed_samples
    return Estimated(
        converged=estimate.converged,
        reason=estimate.why,
        detail=estimate.detail,
        forward_solves=estimate.forward_solves,
        iterations=estimate.iterations,
        seconds=seconds,
        model_seconds=problem.model.seconds - before,
        estimate=vector(estimate.mean),
        log_mean=vector(estimate.transformed.mean),
        log_std=vector(estimate.transformed.std),
        low=vector(low),
        high=vector(high),
        skewness=None if draws is None else vector(scipy.stats.skew(draws, axis=0)),
        check=_own_check(estimate),
    )


def _own_check(estimate: Estimate) -> OwnCheck | None:
    made = estimate.check
    if made is None:
        return None
    return OwnCheck(made.compared, made.value, made.limit, made.extra_runs)


def _repeats(
    problem: ComparedProblem,
    fitted: FittedSurrogate,
    filters: Mapping[str, Filter],
    settings: FilterStudySettings,
    seed: int,
) -> dict[str, Repeats]:
    """Estimates from many observations, each of a truth of its own, with the surrogate."""
    p = len(problem.parameters)
    every: dict[str, list[_Interval | None]] = {method: [] for method in filters}
    truths = _truths(p, INSIDE * settings.design.reach, np.random.default_rng([seed, 1]))
    log_prior = problem.log_prior
    for k in range(settings.repeats):
        rng = np.random.default_rng([seed, 2, k])
        truth = next(truths)
        y = fitted.model.surrogate(truth[None])[0]
        y = y + problem.noise * rng.standard_normal(y.shape)
        for method, filter_ in filters.items():
            interval: tuple[FloatArray, FloatArray, FloatArray] | None
            if method == REFERENCE:
                interval = _drawn(problem, fitted, y, settings.sampler, rng)
            else:
                if isinstance(filter_, EnsembleFilter):
                    filter_ = replace(filter_, seed=k)
                estimate = filter_(
                    fitted.model, problem.prior, y, problem.noise**2, transform=TRANSFORM
                )
                interval = _interval(estimate, log_prior.mean, log_prior.std)
            every[method].append(None if interval is None else (*interval, truth))
    return {method: _summary(own, every[REFERENCE], log_prior.std) for method, own in every.items()}


_Interval = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Mean, lower and upper end of an estimate and the truth, (p,) each, where the prior is N(0, I)."""


def _truths(size: int, reach: float, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Draws from N(0, I) that lie in the region of the surrogate."""
    while True:
        x = rng.standard_normal(size)
        if np.all(np.abs(x) <= reach):
            yield x


def _interval(
    estimate: Estimate, mean: FloatArray, std: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    if estimate.prediction is None:
        return None
    low, high = estimate.interval()
    centre, low, high = (
        (z - mean) / std for z in (estimate.transformed.mean, *np.log([low, high]))
    )
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
    intervals: list[_Interval | None], reference: list[_Interval | None], std: FloatArray
) -> Repeats:
    """Coverage, error and width over the repeats; one that failed covers nothing."""
    kept = [(f, r) for f, r in zip(intervals, reference, strict=True) if f is not None]
    held = np.array([(f[1] <= f[3]) & (f[3] <= f[2]) for f, _ in kept])
    error = np.array([f[0] - f[3] for f, _ in kept]) * std
    width = np.array([(f[2] - f[1]) / (r[2] - r[1]) for f, r in kept if r is not None])
    return Repeats(
        runs=len(intervals),
        failed=len(intervals) - len(kept),
        coverage=vector(held.sum(axis=0) / len(intervals)) if kept else None,
        log_rms_error=vector(np.sqrt((error**2).mean(axis=0))) if kept else None,
        width_ratio=vector(np.median(width, axis=0)) if kept else None,
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_filter_study,
    words=filters_words,
    write=write_filters,
    sections=(
        Section(
            "filters",
            {
                "filters": "95 % interval that each filter gives each unknown, on that of Monte "
                "Carlo: blue where it is as wide to 10 %. Simulated."
            },
            answer=answer_of_main(lambda record: f"{filters_answer(record.findings)} (simulated)."),
        ),
    ),
)
