"""A synthetic study: simulate an observation, estimate from it, write down how close it came."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import Twin, build_twin
from experiments.common.estimate_record import (
    make_record,
    measure_frames,
    repeat_entry,
    write_fields,
)
from experiments.common.expectation import TwinExpectation
from experiments.common.plain import Plain, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.study import Section, Study
from experiments.studies.twin.publish import (
    require_twin,
    table1_answer,
    text_table_of,
    write_twin,
    write_twin_run,
)
from experiments.studies.twin.settings import Settings
from mvest.closure.model import ClosureModel
from mvest.estimation.wrappers import SharedStart
from mvest.observation.vertices import observed_frames
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.synthetic import simulate_observation

__all__ = ["STUDY", "run_twin"]

LOCKING = (
    "note: linear tetrahedra are many times too stiff in bending; moduli estimated with tet4 "
    "belong to the mesh, not to the tissue"
)


def run_twin(
    config: Mapping[str, Any], config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """A synthetic study: the record, and the figures written to ``folder``."""
    from mvest.reporting.figures import iterates_figure, save_figure, valve_figure

    twin = build_twin(config)
    if twin.model.mesh.element_type == "tet4":
        print(LOCKING, file=sys.stderr)
    began = time.perf_counter()
    seeds = range(config["seed"], config["seed"] + config["repeats"])
    results = _estimate_twin(twin, seeds)
    result = results[0]
    confirmed = _confirm(twin, result) if config["confirm"] else None
    computing = time.perf_counter() - began
    mesh = twin.model.mesh
    closure = None
    if config["measure"] and result.fitted is not None:
        thickness = float(twin.valve.surface.thickness.mean())
        reach = twin.model.settings.contact.activation_distance * thickness
        closure = measure_frames(twin.valve, result, reach)
    record = make_record(
        result,
        config,
        config_hash=config_hash,
        meshes={
            "sha256": mesh.sha256,
            "nodes": len(mesh.nodes),
            "elements": len(mesh.elements),
            "truth_sha256": twin.truth_model.mesh.sha256,
        },
        closure=closure,
        truth_values=twin.truth_values,
        started=started,
    )
    record["repeats"] = [repeat_entry(s, r) for s, r in zip(seeds, results, strict=True)]
    record["confirmed_mm"] = confirmed
    record["seconds_computing"] = computing
    record["truth_store"] = "hit" if twin.source.counts.hits else "miss"
    if confirmed is not None:
        record["forward_solves"] += 1
    files: list[Path] = []
    if not config["figures"]:
        return record, files
    if record["iterates"]:
        files += save_figure(folder / "iterates", iterates_figure(record), record)
    if result.fitted is not None:
        fields = folder / "fields.npz"
        write_fields(fields, twin.valve.surface, result)
        files += save_figure(folder / "valve", valve_figure(fields), record)
    return record, files


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
            data = simulate_observation(
                lambda m: truth,
                twin.problem.parameters,
                twin.truth_values,
                frames=twin.frames,
                variance=twin.variance,
                correlation=twin.correlation,
                errors=twin.errors,
                rng=np.random.default_rng(seed),
            )
            if data.observation is None:
                return [StudyResult.failed(twin.problem, data.reason, 0.0) for _ in seeds]
            result = estimate(problem, data.observation, on_iterate=bar.iterate)
            results.append(result.against(data.truth))
    return results


def _confirm(twin: Twin, result: StudyResult) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed anew from the open state.

    None where every closure started from the open state, so that there is nothing to confirm, or
    where the new closure failed.
    """
    usual = twin.model.continuation, twin.model.guide
    if result.estimate is None or result.fitted is None or usual == (False, None):
        return None
    twin.model.continuation, twin.model.guide = False, None
    with SolveBar("confirmation", len(_steps(twin.model)), 1) as bar:
        twin.model.on_step = bar.step
        anew = observed_frames(twin.model, twin.frames)(result.estimate)
    twin.model.continuation, twin.model.guide = usual
    if not anew.converged:
        return None
    last = anew.y.reshape(result.fitted.shape)[-1]
    return float(np.linalg.norm(last - result.fitted[-1], axis=1).max())


def _steps(model: ClosureModel) -> Sequence[object]:
    return model.settings.protocol.steps()


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_twin),
    words=lambda record: text_table_of(flat(record)),
    write=write_twin,
    write_run=write_twin_run,
    checks=lambda: (TwinExpectation(),),
    require=require_twin,
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
        Section("mesh_independence", title="Independence of the mesh", validation=True),
    ),
)
