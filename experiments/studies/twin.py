"""Simulates an observation, estimates from it, and compares with the truth."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.common.building.filters import build_filter, observation_variance
from experiments.common.building.gate import gate_of
from experiments.common.building.twin import Twin, build_twin, estimate_twin, expect_twin
from experiments.common.records.record import Mesh, model_of_values
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.observation.vertices import Observation
from mvest.problem.estimate import StudyResult
from mvest.problem.fields import valve_fields
from mvest.problem.record import EstimateRecord, record_of
from mvest.problem.registration import unit_of
from mvest.problem.stored import Extrapolated
from mvest.reporting.tables import Column, Table, table
from mvest.scenarios.measures import measure_closed
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.strain import triangle_strains, weighted_quantiles

LOCKING = (
    "note: linear tetrahedra are many times too stiff in bending; moduli estimated with tet4 "
    "belong to the mesh, not to the tissue"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinSettings:
    """What is computed besides the estimate."""

    measure_truth: bool = False  # strain, stress and tenting of the closed valve that is observed


def run_twin(job: Job[TwinSettings]) -> Result:
    """Simulate an observation per seed and estimate from it; arrays come from the first."""
    values = job.values
    twin = build_twin(values)
    if twin.model.mesh.element_type == "tet4":
        print(LOCKING, file=sys.stderr)
    measured = _measured(twin) if job.settings.measure_truth else {}
    seeds = range(values["seed"], values["seed"] + values["repeats"])
    results = estimate_twin(twin, seeds)
    result = results[0]
    estimates = tuple(
        record_of(one, seed=seed, simulated=True) for seed, one in zip(seeds, results, strict=True)
    )
    solves = estimates[0].forward_solves or 0
    band, found = None, None if result.filtered is None else result.filtered.prediction
    if isinstance(twin.source, Extrapolated) and found is not None:
        # Change of the least-squares estimate due to extrapolating the truth.
        correction = twin.source.correction(twin.truth_values)
        shift = np.linalg.lstsq(found.jacobian, correction)[0]
        band = list(100 * np.abs(shift / twin.truth_values))
    row = _row(values, estimates[0], band) | measured | {"forward solves": solves}
    paper = [_paper_row(values, estimates[0])] if values["paper"] else []
    return Result(
        tables={"": _table([*paper, row])},
        estimates=estimates,
        arrays=_fields(twin, result) if values["figures"] and result.fitted is not None else {},
        status=estimates[0].status,
        reason=result.reason,
        detail=result.detail,
        mesh=Mesh.of(twin.model.mesh, twin.truth_model.mesh),
        forward_solves=solves,
        gate=gate_of(values),
    )


def _measured(twin: Twin) -> dict[str, float]:
    """Tenting, strains from the open valve, and stress of the truth; empty if it stays open."""
    model = twin.truth_model
    model.continuation = True  # the observation is made from this closed state
    closed = model.close(twin.truth_values, sensitivities=False)
    if not closed.simulation.converged:
        return {}
    x, surface = closed.simulation.frames[-1], model.valve.surface
    found = measure_closed(model, closed.system, x)
    strain = triangle_strains(surface.vertices, model.observed(x), surface)
    weight = areas(surface.vertices, surface.triangles)
    row = {"tenting": found["tenting_height_mm"]}
    for k, name in enumerate(surface.region_names):
        own = surface.region == k
        for direction, values in zip(("along", "across"), 100 * strain[own].T, strict=True):
            (median,) = weighted_quantiles(values, weight[own], [0.5])
            row[f"median strain {direction}, {name}"] = median
        row[f"99 % stress, {name}"] = found[f"stress_p99_{name}_mpa"]
    return row


def _fields(twin: Twin, result: StudyResult) -> dict[str, NDArray[Any]]:
    """The last observed and fitted frames, as case fields (`mvest.problem.fields`)."""
    assert isinstance(result.observation, Observation)
    assert result.fitted is not None
    return {
        **valve_fields(twin.model.valve, result.observation.frames[-1:]),
        "observed": result.observation.positions[-1:].astype(np.float32),
        "fitted": result.fitted[-1:].astype(np.float32),
        "distance_fitted": np.asarray(result.distance, dtype=np.float64)[None],
        "reach_mm": np.array(twin.model.contact_reach_mm),
    }


def require_twin(values: Mapping[str, Any]) -> None:
    """Raise a ConfigurationError for inadmissible settings of filter or observation."""
    build_filter(values["filter"], tuple(values["parameters"]))
    observation_variance(values["filter"]["R"])


def _row(
    values: Mapping[str, Any], record: EstimateRecord, band: Sequence[float] | None
) -> dict[str, Any]:
    """The table row of a run; errors are absolute."""
    row: dict[str, Any] = {"run": values["row"], "source": "mvest"}
    for k, name in enumerate(values["parameters"]):
        own = record.unknown(name)
        error = own.relative_error
        row |= {
            f"truth {name}": own.truth,
            f"estimate {name}": own.estimate,
            f"std {name}": own.std,
            f"error {name}": None if error is None else 100.0 * abs(error),
            f"truth of {name} known to": None if band is None else band[k],
        }
    moduli = [one for one in record.unknowns if one.kind != "nuisance"]
    errors = [abs(one.relative_error) for one in moduli if one.relative_error is not None]
    distance, model = record.distance_mm, model_of_values(values)
    return row | {
        "moduli error mean": 100 * float(np.mean(errors)) if errors else None,
        "moduli error SD": 100 * float(np.std(errors)) if errors else None,
        "distance mean": distance and distance.mean,
        "distance SD": distance and distance.std,
        "element": model.element,
        "cells": " x ".join(str(n) for n in model.cells),
        "status": record.status,
        "ended": record.reason.partition(":")[0],
        "reason": record.reason,
    }


def _paper_row(values: Mapping[str, Any], record: EstimateRecord) -> dict[str, Any]:
    """The paper's row for the same experiment."""
    paper, names = values["paper"], values["parameters"]
    columns = {
        "estimate": [f"estimate {name}" for name in names],
        "error_percent": [f"error {name}" for name in names],
        "moduli_error_percent": ["moduli error mean", "moduli error SD"],
        "distance_mm": ["distance mean", "distance SD"],
    }
    row: dict[str, Any] = {"run": f"paper, {paper['table']}", "source": "paper"}
    row |= {f"truth {name}": record.unknown(name).truth for name in names}
    for key, own in columns.items():
        row |= zip(own, paper[key] or (), strict=False)
    return row


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """A table of runs, with the meaning of its columns."""
    about: dict[str, Column] = {"run": Column()}
    for name in (key.partition(" ")[2] for key in rows[0] if key.startswith("estimate ")):
        unit, std, band = unit_of(name), f"std {name}", f"truth of {name} known to"
        about |= {
            f"truth {name}": Column(unit, hidden=True),
            f"estimate {name}": Column(unit, std=std, label=name),
            std: Column(unit),
            f"error {name}": Column("%", std=band, label=f"error {name}"),
            band: Column("%"),
        }
    about |= {
        "moduli error mean": Column("%", std="moduli error SD", label="error of all moduli"),
        "moduli error SD": Column("%"),
        "distance mean": Column("mm", std="distance SD", label="distance"),
        "distance SD": Column("mm"),
        **dict.fromkeys(("source", "status", "reason"), Column(hidden=True)),
    }
    measured = {"tenting": "mm", "median strain": "%", "99 % stress": "MPa"}
    for start, unit in measured.items():
        about |= {name: Column(unit) for name in rows[-1] if name.startswith(start)}
    return table(rows, **about)


def summary(results: Results) -> dict[str, Table]:
    """The paper's row, and a row for each run, including failed runs."""
    whole = results.table()
    paper = [row for row in whole.rows if row["source"] == "paper"][:1]
    rows = [row for row in whole.rows if row["source"] != "paper"]
    return {"": table([*paper, *rows], **whole.columns)}


def figure(results: Results) -> Figures:
    """Iterates of the main estimate, and the fitted valve if its arrays are stored."""
    from mvest.reporting.case.figures import case_figure
    from mvest.reporting.figures import iterates_figure

    name, record = next(iter(results.records.items()))
    drawn: dict[str, Any] = {}
    if len(results.records) > 1 and name != record.table:
        return drawn  # there is no main run
    if (iterates := iterates_figure(record.estimates[:1])) is not None:
        drawn[""] = iterates
    if name in results.arrays:
        drawn["valve"] = case_figure(results.arrays[name])
    return drawn


STUDY = Study(
    settings=TwinSettings,
    part="twin",
    run=run_twin,
    summary=summary,
    figure=figure,
    captions={
        "": "Estimates after each iteration, ± 2 standard deviations, and the truth. Simulated.",
        "valve": "The fitted valve by its distance from the observed one. Simulated.",
    },
    latex=("table1",),
    check=expect_twin,
    require=require_twin,
    keeps_failures=True,
    golden=("twin",),
)
