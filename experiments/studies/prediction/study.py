"""What an estimated valve would do under other conditions, with its truth beside it.

Simulated patients with one leaking anatomy: each is observed closed, with errors, on another mesh;
parameters are estimated from that alone; scenarios are predicted at the estimate and at samples of
its posterior. Only then are the same scenarios computed with the true parameters.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import Twin, build_mesh, build_twin, template_of
from experiments.common.forward import forward_record
from experiments.common.plain import Plain, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, PartBar, SolveBar
from experiments.common.schema import build
from experiments.common.study import Section, Study
from experiments.studies.prediction.report import prediction_text, write_prediction
from experiments.studies.prediction.settings import Settings
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.synthetic import simulate_observation
from mvest.scenarios.measures import contact_reach, meaning_of
from mvest.scenarios.posterior import posterior_samples
from mvest.scenarios.predict import PredictedScenario, Sample, closed_valve
from mvest.scenarios.predict import predict_scenario as predict
from mvest.scenarios.scenario import Scenario, model_under
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = ["STUDY", "run_prediction"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]

MEASURED_ON = (96, 22)
"""Vertices around and along the leaflets of the surface on which shapes are measured."""


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What is asked of every patient."""

    scenarios: dict[str, Scenario]
    spread: FloatArray  # of the logarithms of true parameters
    valve: Valve  # the surface that is measured
    finer: SolidMesh | None  # on which the mesh's error is told


@dataclass(frozen=True, slots=True, eq=False)
class _Patient:
    """A simulated patient: what was estimated and predicted; the truth is computed afterwards."""

    seed: int
    truth: FloatArray
    result: StudyResult
    scenarios: dict[str, PredictedScenario]
    models: dict[str, ClosureModel]


def run_prediction(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Estimate and predict every patient, then compare with the truth."""
    from experiments.studies.prediction.figure import prediction_figure
    from mvest.reporting.figures import save_figure

    settings = config["prediction"]
    scenarios = _scenarios(settings)
    twin = build_twin(config)
    # Measured on more points than are observed, which cost time where their errors are correlated.
    valve = template_of(config).valve(*MEASURED_ON)
    asked = _Asked(
        scenarios,
        np.array(settings["spread"], dtype=float),
        valve,
        _mesh_of(config, settings["check_mesh"]) if settings["check_mesh"] else None,
    )
    seeds = [config["seed"] + k for k in range(settings["patients"])]
    patients = []
    total = sum(len(scenarios) * (2 + _count(settings, k == 0)) + 1 for k in range(len(seeds)))
    with PartBar("prediction", total, "closure") as bar:
        for number, seed in enumerate(seeds):
            count = _count(settings, number == 0)
            patients.append(_predicted(twin, seed, asked, count, bar.step))
        truths = {p.seed: _true_scenarios(twin, p, scenarios, bar.step) for p in patients}
    usual = replace(twin.model, valve=valve)
    record = forward_record(config, config_hash, twin.model, patients[0].truth, started, 0)
    record |= {
        "patients": [_told(p, truths[p.seed]) for p in patients],
        "scenarios": {name: scenario.title for name, scenario in scenarios.items()},
        "stress_meshes": _stress_on_meshes(config, usual, patients[0].truth),
        "reach_mm": contact_reach(usual),
        "check_mesh": list(settings["check_mesh"]),
        "observed": {
            "vertices": len(twin.valve.surface.vertices),
            "truth_cells": [config["truth"][k] for k in ("columns", "rows")],
            "truth_element": config["truth"]["element"] or config["mechanics"]["element"],
            "noise_mm": config["observation"]["noise_mm"],
            "correlated_mm": config["observation"]["correlated_mm"],
            "correlation_length_mm": config["observation"]["correlation_length_mm"],
        },
    }
    first = patients[0]
    record |= _summary(first)
    record["forward_solves"] = sum(
        (p.result.filtered.forward_solves if p.result.filtered else 0)
        + sum(1 + len(s.samples) + (s.finer is not None) for s in p.scenarios.values())
        for p in patients
    )
    names = sorted({name for p in patients for s in p.scenarios.values() for name in _names(s)})
    record["measures"] = {name: meaning_of(name) for name in names}
    record["seconds"] = record["seconds_total"] = time.time() - started
    if not first.scenarios:
        return record | {"status": "failed", "reason": first.result.reason}, []
    fields = folder / "fields.npz"
    _write_fields(fields, valve, first, scenarios)
    if not config["figures"]:
        return record, []
    return record, save_figure(folder / "prediction", prediction_figure(record, fields), record)


def _scenarios(settings: Values) -> dict[str, Scenario]:
    if not settings["scenarios"]:
        raise ConfigurationError("prediction.scenarios is empty, expected at least one")
    for name in ("samples", "further_samples"):
        if settings[name] < 2 or settings[name] & (settings[name] - 1):
            raise ConfigurationError(
                f"prediction.{name} = {settings[name]}, expected a power of two > 1"
            )
    if settings["patients"] < 1:
        raise ConfigurationError(f"prediction.patients = {settings['patients']}, expected >= 1")
    return {name: build(Scenario, value) for name, value in settings["scenarios"].items()}


def _count(settings: Values, first: bool) -> int:
    return int(settings["samples"] if first else settings["further_samples"])


# -- estimate and predict -------------------------------------------------------------------------
def _predicted(
    twin: Twin, seed: int, asked: _Asked, count: int, step: Callable[[], None]
) -> _Patient:
    rng = np.random.default_rng(seed)
    spread = asked.spread
    if spread.shape != twin.truth_values.shape:
        raise ConfigurationError(
            f"prediction.spread has {spread.size} values; expected one for each of "
            f"{', '.join(twin.problem.parameters)}"
        )
    truth = twin.truth_values * np.exp(spread * rng.standard_normal(len(spread)))
    data = simulate_observation(
        twin.source,
        twin.problem.parameters,
        truth,
        frames=twin.frames,
        variance=twin.variance,
        correlation=twin.correlation,
        errors=twin.errors,
        rng=rng,
    )
    step()
    if data.observation is None:
        return _Patient(seed, truth, StudyResult.failed(twin.problem, data.reason, 0.0), {}, {})
    # From the open valve, so that no patient depends on the one before.
    twin.model.restart(None)
    steps = len(twin.model.settings.protocol.steps())
    with SolveBar(f"patient {seed}", steps, TYPICAL_SOLVES, twin.problem.parameters) as bar:
        twin.model.on_step = bar.step
        result = estimate(twin.problem, data.observation, on_iterate=bar.iterate)
    twin.model.on_step = None
    if result.filtered is None or not result.converged:
        return _Patient(seed, truth, result, {}, {})
    samples = posterior_samples(result.filtered, count, seed)
    measured = replace(twin.model, valve=asked.valve)
    models = {name: model_under(measured, scenario) for name, scenario in asked.scenarios.items()}
    found = {}
    for name, model in models.items():
        finer = None if asked.finer is None else _on_mesh(model, asked.finer)
        found[name] = predict(model, result.filtered, samples, lambda _: step(), finer=finer)
        step()
    return _Patient(seed, truth, result, found, models)


def _true_scenarios(
    twin: Twin, patient: _Patient, scenarios: Mapping[str, Scenario], step: Callable[[], None]
) -> dict[str, dict[str, Sample]]:
    """Every scenario with the true parameters: on the truth's mesh, and on the estimator's."""
    found = {}
    for name, model in patient.models.items():
        own = model_under(replace(twin.truth_model, valve=model.valve), scenarios[name])
        found[name] = {
            "own": closed_valve(own, patient.truth)[0],
            "same": closed_valve(model, patient.truth)[0],
        }
        step()
    return found


def _stress_on_meshes(
    config: Values, usual: ClosureModel, truth: FloatArray
) -> list[dict[str, Any]]:
    """Peak stress of the first patient as observed, on finer and finer meshes."""
    rows = []
    for columns, count in config["prediction"]["stress_meshes"]:
        model = _on_mesh(usual, _mesh_of(config, [columns, count]))
        sample = closed_valve(model, truth)[0]
        stress = {k: v for k, v in sample.measures.items() if k.startswith("stress")}
        gap = sample.measures.get("gap_mm2")
        rows.append({"cells": [columns, count], "gap_mm2": gap, **stress, "reason": sample.reason})
    return rows


def _mesh_of(config: Values, cells: Sequence[int]) -> SolidMesh:
    """The configured mesh with ``cells`` around and along the leaflets."""
    columns, rows = cells
    return build_mesh(
        template_of(config),
        {**config["mesh"], "columns": columns, "rows": rows},
        config["mechanics"]["element"],
        Path(config["paths"]["outputs"]) / "meshes",
    )


def _on_mesh(model: ClosureModel, mesh: SolidMesh) -> ClosureModel:
    """A fresh model of the same valve on another mesh, closed from the open valve."""
    return replace(model.fresh(), mesh=mesh, guide=None)


# -- record ---------------------------------------------------------------------------------------
def _summary(patient: _Patient) -> dict[str, Any]:
    result = patient.result
    estimated = result.estimate
    return {
        "estimate": None if estimated is None else estimated.tolist(),
        "std": None if result.std is None else result.std.tolist(),
        "relative_error": None
        if estimated is None
        else ((estimated - patient.truth) / patient.truth).tolist(),
    }


def _told(patient: _Patient, truth: Mapping[str, Mapping[str, Sample]]) -> dict[str, Any]:
    filtered = patient.result.filtered
    return {
        "seed": patient.seed,
        "truth": patient.truth.tolist(),
        **_summary(patient),
        "reason": patient.result.reason,
        "correlation": None if filtered is None else _correlation(filtered.covariance),
        "scenarios": {
            name: {
                "failure": found.at_estimate.reason,
                "samples": len(found.samples),
                "failures": list(found.failures),
                "sampled": [s.measures for s in found.samples],
                "truth_failure": truth[name]["own"].reason,
                "finer_failure": "" if found.finer is None else found.finer.reason,
                "measures": {
                    measure: _row(found, truth[name], measure) for measure in _names(found)
                },
            }
            for name, found in patient.scenarios.items()
        },
    }


def _correlation(covariance: FloatArray) -> list[list[float]]:
    std = np.sqrt(np.diag(covariance))
    return [[float(v) for v in row] for row in covariance / np.outer(std, std)]


def _names(found: PredictedScenario) -> list[str]:
    return list(found.at_estimate.measures)


def _row(
    found: PredictedScenario, truth: Mapping[str, Sample], measure: str
) -> dict[str, float | bool | None]:
    spread = found.spread(measure)
    low, high = found.interval(measure)
    row: dict[str, float | bool | None] = {
        "estimate": found.at_estimate.measures[measure],
        "first_order_std": found.first_order.get(measure),
        "mean": _known(spread.mean),
        "std": _known(spread.std),
        "low": _known(spread.low),
        "high": _known(spread.high),
        "samples": spread.count,
        "mesh_error": _known(found.mesh_error(measure)),
        "wide_low": _known(low),
        "wide_high": _known(high),
    }
    for key, sample in truth.items():
        true = sample.measures.get(measure)
        row[f"truth_{key}_mesh"] = true
        row[f"inside_{key}_mesh"] = _inside(spread.low, true, spread.high)
    row["inside_wide"] = _inside(low, row["truth_own_mesh"], high)
    return row


def _inside(low: float, true: float | None, high: float) -> bool | None:
    """Whether an interval holds the truth; None where one of them is not known."""
    if true is None or not np.isfinite(high - low):
        return None
    return bool(low <= true <= high)


def _known(value: float) -> float | None:
    """NaN, which JSON lacks, as None."""
    return float(value) if np.isfinite(value) else None


def _write_fields(
    path: Path, valve: Valve, patient: _Patient, scenarios: Mapping[str, Scenario]
) -> None:
    """Closed shapes of the first patient at the estimate, NaN where there is none."""
    surface = valve.surface
    blank = np.full(surface.vertices.shape, np.nan)
    shapes = [patient.scenarios[name].shape for name in scenarios]
    np.savez_compressed(
        path,
        shapes=np.stack([blank if s is None else s for s in shapes]).astype(np.float32),
        names=np.array(list(scenarios)),
        rest=surface.vertices.astype(np.float32),
        triangles=surface.triangles.astype(np.int32),
        region=surface.region.astype(np.int8),
        annulus=valve.annulus.astype(np.int32),
        free_edge=valve.free_edge.astype(np.int32),
        tips=valve.papillary_tips.astype(np.float32),
    )


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_prediction),
    words=lambda record: prediction_text(flat(record)),
    write=write_prediction,
    sections=(
        Section(
            "prediction",
            {
                "prediction": "A leaking valve closed as observed and under changed "
                "conditions, seen from "
                "the atrium, and measures of it with their 95 % intervals. Simulated."
            },
        ),
    ),
)
