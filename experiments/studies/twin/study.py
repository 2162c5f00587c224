"""A synthetic study: simulate an observation, estimate from it, write down how close it came."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.extrapolated import Extrapolated
from experiments.common.building.filters import build_filter
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import Twin, build_twin
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.records.estimate_record import (
    identified_of,
    innovation_of,
    moduli_error,
    seed_run,
)
from experiments.common.records.estimates import Paper
from experiments.common.records.findings import Vector, vector
from experiments.common.records.record import Mesh, Outcome
from experiments.common.study import Check, Job, Section, Study
from experiments.studies.twin.findings import Findings
from experiments.studies.twin.report import (
    meshes_answer,
    table1_answer,
    text_table,
    write_twin,
    write_twin_run,
)
from experiments.studies.twin.settings import Settings
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.estimation.noise import observation_noise
from mvest.estimation.wrappers import SharedStart
from mvest.files import write_atomically
from mvest.observation.vertices import Observation
from mvest.problem.estimate import StudyResult, estimate
from mvest.scenarios.measures import contact_reach
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.measurements import ClosureMeasurements, measure_closure

__all__ = ["STUDY", "run_twin"]

LOCKING = (
    "note: linear tetrahedra are many times too stiff in bending; moduli estimated with tet4 "
    "belong to the mesh, not to the tissue"
)


def run_twin(job: Job[Settings]) -> Outcome[Findings]:
    """Simulate an observation for each seed and estimate from it; the arrays of the first."""
    values = job.values
    twin = build_twin(values)
    if twin.model.mesh.element_type == "tet4":
        print(LOCKING, file=sys.stderr)
    began = time.perf_counter()
    seeds = range(values["seed"], values["seed"] + values["repeats"])
    results = _estimate_twin(twin, seeds)
    result = results[0]
    confirmed = _confirm(twin, result) if values["confirm"] else None
    computing = time.perf_counter() - began
    if values["figures"] and result.fitted is not None:
        _write_fields(job.folder / "fields.npz", twin, result)
    repeats = tuple(seed_run(s, r) for s, r in zip(seeds, results, strict=True))
    first, paper = repeats[0], values["paper"]
    mesh = twin.model.mesh
    findings = Findings(
        paper=paper and Paper(**paper),
        truth=vector(twin.truth_values),
        initial=tuple(values["filter"]["initial"]),
        repeats=repeats,
        moduli=result.moduli,
        moduli_error_percent=moduli_error(result),
        closure=_measured(twin, result) if values["measure"] else None,
        innovation=innovation_of(result.filtered),
        identifiability=identified_of(result),
        confirmed_mm=confirmed,
        seconds_computing=computing,
        truth_store="hit" if twin.source.counts.hits else "miss",
        truth_band_percent=_truth_band(twin, result),
    )
    return Outcome(
        findings=findings,
        status=first.status,
        reason=result.reason,
        detail=result.detail,
        mesh=Mesh(mesh.sha256, len(mesh.nodes), len(mesh.elements), twin.truth_model.mesh.sha256),
        forward_solves=(first.forward_solves or 0) + (confirmed is not None),
        gate=gate_of(values),
    )


def _estimate_twin(twin: Twin, seeds: Sequence[int]) -> list[StudyResult]:
    """One estimate for each seed; simulation and first closure are common to all."""
    with SolveBar("observation", len(_steps(twin.truth_model)), 1) as bar:
        twin.truth_model.on_step = bar.step
        truth = twin.source(twin.truth_values)
    problem = replace(twin.problem, model=SharedStart(twin.model, twin.problem.start))
    results = []
    steps, solves = len(_steps(twin.model)), TYPICAL_SOLVES * len(seeds)
    with SolveBar("estimation", steps, solves, problem.parameters) as bar:
        twin.model.on_step = bar.step
        for seed in seeds:
            data = twin.observe(lambda m: truth, twin.truth_values, np.random.default_rng(seed))
            if data.observation is None:
                return [StudyResult.failed(twin.problem, data.reason, 0.0) for _ in seeds]
            result = estimate(problem, data.observation, on_iterate=bar.iterate)
            results.append(result.against(data.truth))
    return results


def _confirm(twin: Twin, result: StudyResult) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed anew from the open state.

    None where every closure started from the open state or the closed frame is not observed, so
    that there is nothing to confirm, or where the new closure failed.
    """
    usual = twin.model.continuation, twin.model.guide
    if result.estimate is None or result.fitted is None or usual == (False, None):
        return None
    fitted = dict(zip(twin.frames, result.fitted, strict=True)).get("closed")
    if fitted is None:
        return None
    twin.model.continuation, twin.model.guide = False, None
    with SolveBar("confirmation", len(_steps(twin.model)), 1) as bar:
        twin.model.on_step = bar.step
        anew = twin.model.close(result.estimate, sensitivities=False).simulation
    twin.model.continuation, twin.model.guide = usual
    if not anew.converged:
        return None
    return float(np.linalg.norm(twin.model.observed(anew.frames[-1]) - fitted, axis=1).max())


def _truth_band(twin: Twin, result: StudyResult) -> Vector | None:
    """By how many percent the least-squares estimate follows the extrapolation of the truth."""
    predicted = None if result.filtered is None else result.filtered.prediction
    if not isinstance(twin.source, Extrapolated) or predicted is None:
        return None
    correction = twin.source.correction(twin.truth_values)
    shift = np.linalg.lstsq(predicted.jacobian, correction)[0]
    return vector(100 * np.abs(shift / twin.truth_values))


def _measured(twin: Twin, result: StudyResult) -> dict[str, ClosureMeasurements | str] | None:
    """Measurements of each fitted frame, or why they could not be taken."""
    if result.observation is None or result.fitted is None:
        return None
    valve, surface = twin.valve, twin.valve.surface
    reach = twin.model.settings.contact.activation_distance * float(surface.thickness.mean())
    first = np.unique(surface.triangles[surface.region == 0])
    measured: dict[str, ClosureMeasurements | str] = {}
    for frame, points in zip(result.observation.frames, result.fitted, strict=True):
        annulus = points[valve.annulus]
        anterior = points[np.intersect1d(valve.annulus, first)].mean(axis=0)
        try:
            measured[frame] = measure_closure(
                points,
                surface.triangles,
                surface.region,
                surface.thickness,
                annulus,
                annulus_plane(annulus, valve.papillary_tips.mean(axis=0), anterior),
                reach,
            )
        except MvestError as error:
            # An estimate is not lost because the valve's shape defies a measurement.
            measured[frame] = str(error)
    return measured


def _write_fields(path: Path, twin: Twin, result: StudyResult) -> None:
    """The last observed and fitted frame as compressed arrays, as those of a case."""
    assert isinstance(result.observation, Observation)
    assert result.fitted is not None
    valve, surface = twin.valve, twin.valve.surface
    arrays: dict[str, Any] = {
        "triangles": surface.triangles.astype(np.int32),
        "region": surface.region.astype(np.int8),
        "rest": surface.vertices.astype(np.float32),
        "annulus": valve.annulus.astype(np.int32),
        "free_edge": valve.free_edge.astype(np.int32),
        "frames": np.array(result.observation.frames[-1:]),
        "seen": np.array([True]),
        "tips": np.stack([valve.papillary_tips] * 2).astype(np.float32),
        "observed": result.observation.positions[-1:].astype(np.float32),
        "fitted": result.fitted[-1:].astype(np.float32),
        "distance_fitted": np.asarray(result.distance, dtype=np.float64)[None],
        "reach_mm": contact_reach(twin.model),
    }
    write_atomically(path, partial(np.savez_compressed, **arrays))


def _steps(model: ClosureModel) -> Sequence[object]:
    return model.settings.protocol.steps()


def require_twin(values: Mapping[str, Any]) -> None:
    """Refuse settings of filter and observation that no job could run with.

    Raises
    ------
    ConfigurationError
        If a setting is inadmissible; the message names it.
    """
    build_filter(values["filter"], tuple(values["parameters"]))
    variance = values["filter"]["R"]
    try:
        observation_noise(np.atleast_1d(np.asarray(variance, dtype=float)), np.size(variance))
    except (InputError, TypeError, ValueError) as error:
        text = str(error) if isinstance(error, MvestError) else "expected a number or numbers"
        raise ConfigurationError(f"filter.R = {variance}: {text}") from error
    noise = values["observation"]["noise_mm"]
    if noise < 0:
        raise ConfigurationError(f"observation.noise_mm = {noise}, expected at least 0")


def _checks() -> tuple[Check, ...]:
    # Imports what personalises cases, which an estimate does not need.
    from experiments.common.expectation import TwinExpectation

    return (TwinExpectation(),)


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_twin,
    words=lambda record: text_table([record]),
    write=write_twin,
    write_run=write_twin_run,
    checks=_checks,
    require=require_twin,
    keeps_failures=True,
    sections=(
        Section(
            "table1",
            {
                "table1": "Estimates after each iteration, ± 2 standard deviations, and the truth. "
                "Simulated.",
                "table1_valve": "The fitted valve, open and closed. Simulated.",
            },
            "Table 1",
            validation=True,
            answer=table1_answer,
            headline=True,
            opens="table1_valve",
        ),
        Section(
            "mesh_independence",
            title="Independence of the mesh",
            validation=True,
            answer=meshes_answer,
        ),
    ),
)
