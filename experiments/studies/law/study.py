"""The study of the material law: a valve of the exponential law, to which both laws are fitted."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import Twin, build_twin
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.study import Section, Study
from experiments.studies.law.report import law_text, write_law_tables
from experiments.studies.law.settings import Settings
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
from mvest.problem.synthetic import Truth, TwinData, simulate_observation
from mvest.provenance import provenance
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_law_study"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]

DRAWS = 200
"""Samples of the estimate of which the band of the curves is made."""
CURVE = np.linspace(1.0, 1.25, 51)
"""Stretches of the curves."""
EXCISED_CURVE = np.linspace(1.0, 1.4, 201)
REACHED = 0.1
"""MPa, stress at which excised leaflets are compared."""


def run_law_study(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Close the valve, observe it, fit either law to what was observed."""
    twin, linear = build_twin(config), build_twin(_linear(config))
    record = _record(config, config_hash, twin, started)
    record["excised"] = _excised(config["law_study"]["excised"])
    closed = twin.truth_model(twin.truth_values)
    data = _observed(twin, closed, config["seed"])
    if data.observation is None or data.truth is None:
        return record | {"status": "failed", "reason": data.reason}, []
    record["stretches"] = _stretches(twin.truth_model, twin.truth_values)
    record["chi_square_band"] = [
        end / data.observation.y.size for end in chi_square_band(data.observation.y.size)
    ]
    fits = {}
    for name, problem in (("exponential", twin.problem), ("linear", linear.problem)):
        model = twin.model if name == "exponential" else linear.model
        steps = len(model.settings.protocol.steps())
        with SolveBar(f"{name} law", steps, TYPICAL_SOLVES, problem.parameters) as bar:
            model.on_step = bar.step
            fits[name] = estimate(problem, data.observation, on_iterate=bar.iterate)
        own = fits[name].against(data.truth) if name == "exponential" else fits[name]
        record["fits"].append(_fit(name, own, problem.prior.mean, data.observation, data.truth))
    if all(result.estimate is not None for result in fits.values()):
        models = (twin.model, linear.model)
        record["curves"] = _curves(models, fits, twin.truth_values, config["seed"])
    record["repeats"] = _repeats(
        twin, closed, range(config["seed"], config["seed"] + config["repeats"])
    )
    failed = [result for result in fits.values() if not result.converged]
    if failed:
        record |= {"status": "failed", "reason": failed[0].reason, "detail": failed[0].detail}
    solves = [fit["forward_solves"] for fit in record["fits"]]
    record["forward_solves"] = 1 + sum(solves) + sum(r["forward_solves"] for r in record["repeats"])
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


def _linear(config: Values) -> dict[str, Any]:
    """The same study with tissue of the linear law."""
    own = config["law_study"]
    names = list(own["linear_parameters"])
    if any(kind_of(name) is not kind_of("E_f.any") for name in names):
        raise ConfigurationError(f"law_study.linear_parameters = {names}, expected E_f.REGION")
    mechanics = dict(config["mechanics"])
    mechanics["tissue"] = {
        region: {**tissue, "law": "biot", "exponential": None}
        for region, tissue in mechanics["tissue"].items()
    }
    filter_ = {**config["filter"], "initial": own["linear_initial"], "P0": own["linear_P0"]}
    truth = {**config["truth"], "values": list(own["linear_initial"])}
    changes = {"mechanics": mechanics, "parameters": names, "filter": filter_, "truth": truth}
    return {**config, **changes}


def _observed(twin: Twin, closed: Prediction, seed: int) -> TwinData:
    """An observation of the true valve."""
    return simulate_observation(
        lambda m: closed,
        twin.problem.parameters,
        twin.truth_values,
        frames=twin.frames,
        variance=twin.variance,
        errors=twin.errors,
        rng=np.random.default_rng(seed),
    )


def _stretches(model: ClosureModel, values: FloatArray) -> dict[str, Any]:
    """Percentiles of the stretches along and across the fibres of each leaflet, closed."""
    assert model.closed is not None
    system, _ = model.tuned(values)
    solid = system.solid
    green = solid.evaluate(model.closed.positions, solid.initial_strain(), 0.0).green
    found = {}
    for k, region in enumerate(model.mesh.region_names):
        own = np.sqrt(1 + 2 * green[model.mesh.region == k][:, :, :2].reshape(-1, 2))
        quantiles = np.percentile(own, [5, 50, 95], axis=0)
        found[region] = {"along": quantiles[:, 0].tolist(), "across": quantiles[:, 1].tolist()}
    return found


def _fit(
    name: str, result: StudyResult, start: FloatArray, observation: Observation, truth: Truth
) -> dict[str, Any]:
    """What one law makes of the observation."""
    nothing = [None] * len(result.parameters)
    bound, filtered = result.identifiability, result.filtered
    columns: dict[str, Any] = {
        "truth": nothing if result.truth is None else result.truth.values,
        "start": start,
        "estimate": nothing if result.estimate is None else result.estimate,
        "std": nothing if result.std is None else result.std,
        "bound": nothing if bound is None else bound.std,
    }
    distance: dict[str, float | None] = {"mean": None, "max": None}
    residual: dict[str, float | None] = {"residual_rms_mm": None, "chi_square": None}
    if result.fitted is not None:
        d = np.linalg.norm(result.fitted[-1] - truth.positions[-1], axis=1)
        distance = {"mean": float(d.mean()), "max": float(d.max())}
        e = result.fitted - observation.positions
        share = e**2 / observation.variance[:, None, None]
        residual = {
            "residual_rms_mm": float(np.sqrt(np.nanmean(e**2))),
            "chi_square": float(np.nanmean(share)),
        }
    return {
        "law": name,
        "parameters": [
            {"name": parameter, "unit": kind_of(parameter).unit}
            | {key: None if c[k] is None else float(c[k]) for key, c in columns.items()}
            for k, parameter in enumerate(result.parameters)
        ],
        "distance_mm": distance,
        **residual,
        "iterations": 0 if filtered is None else filtered.iterations,
        "forward_solves": 0 if filtered is None else filtered.forward_solves,
        "seconds": result.seconds,
        "reason": result.reason,
        "converged": result.converged,
    }


def _repeats(twin: Twin, closed: Prediction, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Estimates with the exponential law from observations with other errors."""
    problem = replace(twin.problem, model=SharedStart(twin.model, twin.problem.start))
    entries = []
    steps = len(twin.model.settings.protocol.steps())
    solves = TYPICAL_SOLVES * len(seeds)
    with SolveBar("other errors", steps, solves, problem.parameters) as bar:
        twin.model.on_step = bar.step
        for seed in seeds:
            data = _observed(twin, closed, seed)
            assert data.observation is not None
            filtered = estimate(problem, data.observation, on_iterate=bar.iterate).filtered
            assert filtered is not None
            low, high = filtered.interval()
            entries.append(
                {
                    "seed": seed,
                    "estimate": filtered.mean.tolist(),
                    "low": low.tolist(),
                    "high": high.tolist(),
                    "converged": filtered.converged,
                    "forward_solves": filtered.forward_solves,
                }
            )
    return entries


def _curves(
    models: tuple[ClosureModel, ClosureModel],
    fits: Mapping[str, StudyResult],
    truth: FloatArray,
    seed: int,
) -> dict[str, Any]:
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
    found = {}
    for k, region in enumerate(model.mesh.region_names):
        many = np.array([biaxial_stress(law, stretches, k) for law in sampled])
        low, high = np.percentile(many, [2.5, 97.5], axis=0)
        estimated = biaxial_stress(_law(model, exponential.mean), stretches, k)
        found[region] = {
            "stretch": CURVE.tolist(),
            "truth": biaxial_stress(_law(model, truth), stretches, k).tolist(),
            "exponential": {
                "estimate": estimated.tolist(),
                "low": low.tolist(),
                "high": high.tolist(),
            },
            "linear": biaxial_stress(_law(linear, fits["linear"].estimate), stretches, k).tolist(),
        }
    return found


def _law(model: ClosureModel, values: FloatArray) -> Law:
    """The law of a model at its parameters."""
    named = {**model.fixed, **dict(zip(model.names, map(float, values), strict=True))}
    return material_law(model.mesh, model.settings, named)


def _excised(coefficients: Mapping[str, Any]) -> dict[str, Any]:
    """Curves of the law with coefficients ``[c0 (MPa), c1, c2]`` of each leaflet."""
    found = {}
    for region, (c0, c1, c2) in coefficients.items():
        law = ExponentialLaw.of([ExponentialTissue(c0, c1, c2)])
        stress = biaxial_stress(law, np.column_stack([EXCISED_CURVE, EXCISED_CURVE]))
        slopes = np.diff(stress[:, 0]) / np.diff(EXCISED_CURVE)
        reached = [_first_above(stress[:, k]) for k in (0, 1)]
        shown = stress.max(axis=1) < 2.0  # MPa; far beyond what is drawn
        found[region] = {
            "stretch": EXCISED_CURVE[shown].tolist(),
            "stress": stress[shown].tolist(),
            "slope_at_rest": float(slopes[0]),
            "slope": None if reached[0] is None else float(slopes[reached[0] - 1]),
            "reached": [None if i is None else float(EXCISED_CURVE[i]) for i in reached],
        }
    return found


def _first_above(stress: FloatArray) -> int | None:
    above = np.flatnonzero(stress >= REACHED)
    return int(above[0]) if len(above) else None


def _record(config: Values, config_hash: str, twin: Twin, started: float) -> dict[str, Any]:
    mesh = twin.model.mesh
    return {
        "schema": 1,
        "experiment": config["name"],
        "title": config["title"],
        "row": config["row"],
        "table": config["table"],
        "status": "converged",
        "reason": "completed",
        "detail": "",
        "parameters": list(config["parameters"]),
        "truth": twin.truth_values.tolist(),
        "fits": [],
        "repeats": [],
        "curves": {},
        "stretches": {},
        "chi_square_band": None,
        "noise_mm": config["observation"]["noise_mm"],
        "forward_solves": 0,
        "seconds": time.time() - started,
        "seconds_total": time.time() - started,
        "mesh": {"sha256": mesh.sha256, "nodes": len(mesh.nodes)},
        "model": {
            "element": config["mechanics"]["element"],
            "cells": [config["mesh"][key] for key in ("columns", "rows", "layers")],
        },
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": mesh.sha256,
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_law_study),
    words=lambda record: law_text(flat(record)),
    write=each(write_law_tables),
    sections=(
        Section(
            "law",
            {
                "law": "Stress of each leaflet under equibiaxial stretch: true, as estimated with "
                "the exponential law, and with the linear law from the same data. Simulated.",
                "law_biaxial": "The exponential law with the coefficients of excised leaflets.",
            },
        ),
    ),
)
