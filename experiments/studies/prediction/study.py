"""What an estimated valve would do under other conditions, with its truth beside it.

Simulated patients with one leaking anatomy: each is observed closed, with errors, on another mesh;
parameters are estimated from that alone; scenarios are predicted at the estimate and at samples of
its posterior. Only then are the same scenarios computed with the true parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.anatomy import anatomy_of, build_mesh
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import Twin, build_twin
from experiments.common.progress import TYPICAL_SOLVES, PartBar, SolveBar
from experiments.common.records.findings import Rows, rows, vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.prediction.findings import (
    Findings,
    MeshStress,
    Observed,
    Patient,
    Predicted,
    Scenario,
)
from experiments.studies.prediction.report import (
    prediction_answer,
    prediction_words,
    write_prediction,
)
from experiments.studies.prediction.settings import PredictionSettings, Settings
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.problem.estimate import StudyResult, estimate
from mvest.reading.npz import read_npz
from mvest.scenarios import scenario as conditions
from mvest.scenarios.measures import contact_reach, meaning_of
from mvest.scenarios.posterior import posterior_samples
from mvest.scenarios.predict import PredictedScenario, Sample, closed_valve
from mvest.scenarios.predict import predict_scenario as predict
from mvest.scenarios.scenario import model_under
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = ["STUDY", "run_prediction"]

Values = Mapping[str, Any]
Asked = Mapping[str, conditions.Scenario]

MEASURED_ON = (96, 22)
"""Vertices around and along the leaflets of the surface on which shapes are measured."""

FIELDS = "fields.npz"


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What is asked of every patient."""

    scenarios: Asked
    spread: FloatArray  # of the logarithms of true parameters
    valve: Valve  # the surface that is measured
    finer: SolidMesh | None  # on which the mesh's error is seen


@dataclass(frozen=True, slots=True, eq=False)
class _Patient:
    """A simulated patient: what was estimated and predicted; the truth is computed afterwards."""

    seed: int
    truth: FloatArray
    result: StudyResult
    scenarios: dict[str, PredictedScenario]
    models: dict[str, ClosureModel]


def run_prediction(job: Job[Settings]) -> Outcome[Findings]:
    """Estimate and predict every patient, then compare with the truth.

    Raises
    ------
    ConfigurationError
        If scenarios, samples, patients or the spread of their parameters make no sense.
    """
    config, settings = job.values, job.settings.prediction
    _require(settings)
    scenarios = settings.scenarios
    twin = build_twin(config)
    # Measured on more points than are observed, which cost time where their errors are correlated.
    valve = anatomy_of(config).valve(*MEASURED_ON)
    asked = _Asked(
        scenarios,
        np.array(settings.spread, dtype=float),
        valve,
        _mesh_of(config, settings.check_mesh) if settings.check_mesh else None,
    )
    counts = [settings.samples, *[settings.further_samples] * (settings.patients - 1)]
    total = sum(len(scenarios) * (2 + count) + 1 for count in counts)
    with PartBar("prediction", total, "closure") as bar:
        patients = [
            _predicted(twin, config["seed"] + k, asked, count, bar.step)
            for k, count in enumerate(counts)
        ]
        truths = [_true_scenarios(twin, p, scenarios, bar.step) for p in patients]
    usual = replace(twin.model, valve=valve)
    first = patients[0]
    names = {
        name for p in patients for s in p.scenarios.values() for name in s.at_estimate.measures
    }
    described = tuple(_patient(p, truth) for p, truth in zip(patients, truths, strict=True))
    findings = Findings(
        patients=described,
        estimate=described[0].estimate,
        std=described[0].std,
        relative_error=described[0].relative_error,
        scenarios={name: scenario.title for name, scenario in scenarios.items()},
        stress_meshes=tuple(
            _stress_on_mesh(_on_mesh(usual, _mesh_of(config, cells)), cells, first.truth)
            for cells in settings.stress_meshes
        ),
        reach_mm=contact_reach(usual),
        check_mesh=settings.check_mesh,
        observed=_observed(config, len(twin.valve.surface.vertices)),
        measures={name: meaning_of(name) for name in names},
    )
    if first.scenarios:
        _write_fields(job.folder / FIELDS, valve, first, scenarios)
    return outcome_of(
        findings,
        twin.model.mesh,
        sum(
            (p.result.filtered.forward_solves if p.result.filtered else 0)
            + sum(1 + len(s.samples) + (s.finer is not None) for s in p.scenarios.values())
            for p in patients
        ),
        () if first.scenarios else (first.result.reason,),
        gate_of(config),
    )


def _require(settings: PredictionSettings) -> None:
    if not settings.scenarios:
        raise ConfigurationError("prediction.scenarios is empty, expected at least one")
    counts = {"samples": settings.samples, "further_samples": settings.further_samples}
    for name, count in counts.items():
        if count < 2 or count & (count - 1):
            raise ConfigurationError(f"prediction.{name} = {count}, expected a power of two > 1")
    if settings.patients < 1:
        raise ConfigurationError(f"prediction.patients = {settings.patients}, expected >= 1")


def _observed(config: Values, vertices: int) -> Observed:
    truth, errors = config["truth"], config["observation"]
    return Observed(
        vertices=vertices,
        truth_cells=(truth["columns"], truth["rows"]),
        truth_element=truth["element"] or config["mechanics"]["element"],
        noise_mm=errors["noise_mm"],
        correlated_mm=errors["correlated_mm"],
        correlation_length_mm=errors["correlation_length_mm"],
    )


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
    data = twin.observe(twin.source, truth, rng)
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
    predicted = {}
    for name, model in models.items():
        finer = None if asked.finer is None else _on_mesh(model, asked.finer)
        predicted[name] = predict(model, result.filtered, samples, lambda _: step(), finer=finer)
        step()
    return _Patient(seed, truth, result, predicted, models)


def _true_scenarios(
    twin: Twin, patient: _Patient, scenarios: Asked, step: Callable[[], None]
) -> dict[str, tuple[Sample, Sample]]:
    """Every scenario with the true parameters: on the truth's mesh, and on the estimator's."""
    closed = {}
    for name, model in patient.models.items():
        own = model_under(replace(twin.truth_model, valve=model.valve), scenarios[name])
        closed[name] = closed_valve(own, patient.truth)[0], closed_valve(model, patient.truth)[0]
        step()
    return closed


def _stress_on_mesh(model: ClosureModel, cells: Sequence[int], truth: FloatArray) -> MeshStress:
    """Peak stress of the first patient as observed, on another mesh."""
    sample = closed_valve(model, truth)[0]
    stress = {k: v for k, v in sample.measures.items() if k.startswith("stress")}
    return MeshStress(tuple(cells), sample.measures.get("gap_mm2"), stress, sample.reason)


def _mesh_of(config: Values, cells: Sequence[int]) -> SolidMesh:
    """The configured mesh with ``cells`` around and along the leaflets."""
    columns, rows = cells
    return build_mesh(
        anatomy_of(config),
        {**config["mesh"], "columns": columns, "rows": rows},
        config["mechanics"]["element"],
        Path(config["paths"]["outputs"]) / "meshes",
    )


def _on_mesh(model: ClosureModel, mesh: SolidMesh) -> ClosureModel:
    """A fresh model of the same valve on another mesh, closed from the open valve."""
    return replace(model.fresh(), mesh=mesh, guide=None)


# -- findings -------------------------------------------------------------------------------------
def _patient(patient: _Patient, truths: Mapping[str, tuple[Sample, Sample]]) -> Patient:
    result = patient.result
    estimated, filtered = result.estimate, result.filtered
    error = None if estimated is None else (estimated - patient.truth) / patient.truth
    return Patient(
        seed=patient.seed,
        truth=vector(patient.truth),
        estimate=None if estimated is None else vector(estimated),
        std=None if result.std is None else vector(result.std),
        relative_error=None if error is None else vector(error),
        reason=result.reason,
        correlation=None if filtered is None else _correlation(filtered.covariance),
        scenarios={
            name: Scenario(
                failure=predicted.at_estimate.reason,
                samples=len(predicted.samples),
                failures=tuple(predicted.failures),
                sampled=tuple(s.measures for s in predicted.samples),
                truth_failure=truths[name][0].reason,
                finer_failure="" if predicted.finer is None else predicted.finer.reason,
                measures={
                    measure: Predicted.of(predicted, *truths[name], measure)
                    for measure in predicted.at_estimate.measures
                },
            )
            for name, predicted in patient.scenarios.items()
        },
    )


def _correlation(covariance: FloatArray) -> Rows:
    std = np.sqrt(np.diag(covariance))
    return rows(covariance / np.outer(std, std))


def _write_fields(path: Path, valve: Valve, patient: _Patient, scenarios: Asked) -> None:
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
    findings=Findings,
    run=run_prediction,
    words=prediction_words,
    write=write_prediction,
    keep_arrays=lambda record, path: read_npz(path),
    sections=(
        Section(
            "prediction",
            {
                "prediction": "A leaking valve closed as observed and under changed "
                "conditions, seen from "
                "the atrium, and measures of it with their 95 % intervals. Simulated."
            },
            answer=answer_of_main(prediction_answer),
        ),
    ),
)
