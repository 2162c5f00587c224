"""The study of the material law: a valve of the exponential law, to which both laws are fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from experiments.common.building.twin import Twin, build_twin
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.records.findings import rows, vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.law.findings import (
    Band,
    Curves,
    Distance,
    Excised,
    Findings,
    Fit,
    Parameter,
    Sample,
    Stretches,
)
from experiments.studies.law.report import (
    biaxial_figure,
    curves_figure,
    law_answer,
    law_table,
    law_text,
    law_words,
)
from experiments.studies.law.settings import LawSettings, Settings
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.information.consistency import chi_square_band
from mvest.estimation.prediction import Prediction
from mvest.estimation.wrappers import SharedStart
from mvest.mechanics.law.biaxial import biaxial_stress
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.parameters import kind_of
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.solid import Law
from mvest.mechanics.valve_system import material_law
from mvest.observation.vertices import Observation
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.synthetic import Truth, TwinData
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_law_study"]

Values = Mapping[str, Any]

DRAWS = 200
"""Samples of the estimate of which the band of the curves is made."""
CURVE = np.linspace(1.0, 1.25, 51)
"""Stretches of the curves."""
EXCISED_CURVE = np.linspace(1.0, 1.4, 201)
REACHED = 0.1
"""MPa, stress at which excised leaflets are compared."""


def run_law_study(job: Job[Settings]) -> Outcome[Findings]:
    """Close the valve, observe it, fit either law to what was observed.

    Raises
    ------
    ConfigurationError
        If the linear law is to estimate anything but moduli.
    """
    values, settings = job.values, job.settings.law_study
    twin, linear = build_twin(values), build_twin(_linear(values, settings))
    seed, mesh = values["seed"], twin.model.mesh
    findings = Findings(
        truth=vector(twin.truth_values),
        noise_mm=values["observation"]["noise_mm"],
        excised=_excised(settings.excised),
    )
    closed = twin.truth_model(twin.truth_values)
    data = _observed(twin, closed, seed)
    if data.observation is None or data.truth is None:
        return outcome_of(findings, mesh, 0, (data.reason,))
    stretches = _stretches(twin.truth_model, twin.truth_values)
    low, high = chi_square_band(data.observation.y.size)
    results, fits = {}, []
    for name, case in (("exponential", twin), ("linear", linear)):
        model, problem = case.model, case.problem
        steps = len(model.settings.protocol.steps())
        with SolveBar(f"{name} law", steps, TYPICAL_SOLVES, problem.parameters) as bar:
            model.on_step = bar.step
            results[name] = estimate(problem, data.observation, on_iterate=bar.iterate)
        own = results[name].against(data.truth) if name == "exponential" else results[name]
        fits.append(_fit(name, own, problem.prior.mean, data.observation, data.truth))
    curves = {}
    if all(result.estimate is not None for result in results.values()):
        curves = _curves((twin.model, linear.model), results, twin.truth_values, seed)
    samples = _samples(twin, closed, range(seed, seed + values["repeats"]))
    failed = [result for result in results.values() if not result.converged]
    outcome = outcome_of(
        replace(
            findings,
            fits=tuple(fits),
            samples=samples,
            curves=curves,
            stretches=stretches,
            chi_square_band=(low / data.observation.y.size, high / data.observation.y.size),
        ),
        mesh,
        1 + sum(fit.forward_solves for fit in fits) + sum(s.forward_solves for s in samples),
        [result.reason for result in failed],
    )
    return replace(outcome, detail=failed[0].detail) if failed else outcome


def _linear(values: Values, settings: LawSettings) -> dict[str, Any]:
    """The same study with tissue of the linear law."""
    names = list(settings.linear_parameters)
    if any(kind_of(name) is not kind_of("E_f.any") for name in names):
        raise ConfigurationError(f"law_study.linear_parameters = {names}, expected E_f.REGION")
    mechanics = dict(values["mechanics"])
    mechanics["tissue"] = {
        region: {**tissue, "law": "biot", "exponential": None}
        for region, tissue in mechanics["tissue"].items()
    }
    initial = list(settings.linear_initial)
    filter_ = {**values["filter"], "initial": initial, "P0": settings.linear_P0}
    truth = {**values["truth"], "values": initial}
    changes = {"mechanics": mechanics, "parameters": names, "filter": filter_, "truth": truth}
    return {**values, **changes}


def _observed(twin: Twin, closed: Prediction, seed: int) -> TwinData:
    """An observation of the true valve."""
    return twin.observe(lambda m: closed, twin.truth_values, np.random.default_rng(seed))


def _stretches(model: ClosureModel, values: FloatArray) -> dict[str, Stretches]:
    """Percentiles of the stretches along and across the fibres of each leaflet, closed."""
    assert model.closed is not None
    system, _ = model.tuned(values)
    solid = system.solid
    green = solid.evaluate(model.closed.positions, solid.initial_strain(), 0.0).green
    by_region = {}
    for k, region in enumerate(model.mesh.region_names):
        own = np.sqrt(1 + 2 * green[model.mesh.region == k][:, :, :2].reshape(-1, 2))
        quantiles = np.percentile(own, [5, 50, 95], axis=0)
        by_region[region] = Stretches(*rows(quantiles.T))
    return by_region


def _fit(
    name: str, result: StudyResult, start: FloatArray, observation: Observation, truth: Truth
) -> Fit:
    """What one law makes of the observation."""
    bound, filtered = result.identifiability, result.filtered

    def at(values: FloatArray | None, k: int) -> float | None:
        return None if values is None else float(values[k])

    distance = rms = chi_square = None
    if result.fitted is not None:
        d = np.linalg.norm(result.fitted[-1] - truth.positions[-1], axis=1)
        distance = Distance(float(d.mean()), float(d.max()))
        e = result.fitted - observation.positions
        rms = float(np.sqrt(np.nanmean(e**2)))
        chi_square = float(np.nanmean(e**2 / observation.variance[:, None, None]))
    return Fit(
        law=name,
        parameters=tuple(
            Parameter(
                parameter,
                kind_of(parameter).unit,
                None if result.truth is None else float(result.truth.values[k]),
                float(start[k]),
                at(result.estimate, k),
                at(result.std, k),
                None if bound is None else float(bound.std[k]),
            )
            for k, parameter in enumerate(result.parameters)
        ),
        distance_mm=distance,
        residual_rms_mm=rms,
        chi_square=chi_square,
        iterations=0 if filtered is None else filtered.iterations,
        forward_solves=0 if filtered is None else filtered.forward_solves,
        seconds=result.seconds,
        reason=result.reason,
        converged=result.converged,
    )


def _samples(twin: Twin, closed: Prediction, seeds: Sequence[int]) -> tuple[Sample, ...]:
    """Estimates with the exponential law from observations with other errors."""
    problem = replace(twin.problem, model=SharedStart(twin.model, twin.problem.start))
    samples = []
    steps = len(twin.model.settings.protocol.steps())
    solves = TYPICAL_SOLVES * len(seeds)
    with SolveBar("other errors", steps, solves, problem.parameters) as bar:
        twin.model.on_step = bar.step
        for seed in seeds:
            data = _observed(twin, closed, seed)
            assert data.observation is not None
            filtered = estimate(problem, data.observation, on_iterate=bar.iterate).filtered
            assert filtered is not None
            mean, low, high = rows(np.stack([filtered.mean, *filtered.interval()]))
            samples.append(
                Sample(seed, mean, low, high, filtered.converged, filtered.forward_solves)
            )
    return tuple(samples)


def _curves(
    models: tuple[ClosureModel, ClosureModel],
    fits: Mapping[str, StudyResult],
    truth: FloatArray,
    seed: int,
) -> dict[str, Curves]:
    """Stress of each leaflet under equibiaxial stretch: true, and as estimated with either law."""
    model, linear = models
    exponential = fits["exponential"].filtered
    assert exponential is not None
    assert fits["linear"].estimate is not None
    rng = np.random.default_rng(seed)
    z = exponential.transformed
    draws = rng.multivariate_normal(z.mean, z.covariance, DRAWS)
    sampled = [_law(model, exponential.transform.inverse(draw)) for draw in draws]
    stretches = np.column_stack([CURVE, CURVE])
    by_region = {}
    for k, region in enumerate(model.mesh.region_names):
        many = np.array([biaxial_stress(law, stretches, k) for law in sampled])
        low, high = np.percentile(many, [2.5, 97.5], axis=0)
        estimated = biaxial_stress(_law(model, exponential.mean), stretches, k)
        by_region[region] = Curves(
            vector(CURVE),
            rows(biaxial_stress(_law(model, truth), stretches, k)),
            Band(rows(estimated), rows(low), rows(high)),
            rows(biaxial_stress(_law(linear, fits["linear"].estimate), stretches, k)),
        )
    return by_region


def _law(model: ClosureModel, values: FloatArray) -> Law:
    """The law of a model at its parameters."""
    named = {**model.fixed, **dict(zip(model.names, map(float, values), strict=True))}
    return material_law(model.mesh, model.settings, named)


def _excised(coefficients: Mapping[str, tuple[float, ...]]) -> dict[str, Excised]:
    """Curves of the law with coefficients ``[c0 (MPa), c1, c2]`` of each leaflet."""
    by_region = {}
    for region, (c0, c1, c2) in coefficients.items():
        law = ExponentialLaw.of([ExponentialTissue(c0, c1, c2)])
        stress = biaxial_stress(law, np.column_stack([EXCISED_CURVE, EXCISED_CURVE]))
        slopes = np.diff(stress[:, 0]) / np.diff(EXCISED_CURVE)
        reached = [_first_above(stress[:, k]) for k in (0, 1)]
        shown = stress.max(axis=1) < 2.0  # MPa; far beyond what is drawn
        by_region[region] = Excised(
            vector(EXCISED_CURVE[shown]),
            rows(stress[shown]),
            float(slopes[0]),
            None if reached[0] is None else float(slopes[reached[0] - 1]),
            tuple(None if i is None else float(EXCISED_CURVE[i]) for i in reached),
        )
    return by_region


def _first_above(stress: FloatArray) -> int | None:
    above = np.flatnonzero(stress >= REACHED)
    return int(above[0]) if len(above) else None


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_law_study,
    words=law_text,
    write=write_each(law_table, law_words, curves_figure, biaxial=biaxial_figure),
    sections=(
        Section(
            "law",
            {
                "law": "Stress of each leaflet under equibiaxial stretch: true, as estimated with "
                "the exponential law, and with the linear law from the same data. Simulated.",
                "law_biaxial": "The exponential law with the coefficients of excised leaflets.",
            },
            answer=answer_of_main(law_answer),
        ),
    ),
)
