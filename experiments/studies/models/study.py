"""The same sheet in two finite-element codes: how alike they are, and what each estimates."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import mvest
from experiments.common.build import build_filter
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.schema import build
from experiments.common.study import Section, Study
from experiments.studies.models.report import models_text, write_models_tables
from experiments.studies.models.settings import Settings
from experiments.studies.models.sheet.own import OwnSheet
from experiments.studies.models.sheet.second import SecondSheet
from experiments.studies.models.sheet.sheet import PARAMETERS, Sheet
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Filter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import ObservationModel, Prediction
from mvest.estimation.transform import Transform
from mvest.external.differences import Differences
from mvest.external.model import ProcessModel
from mvest.external.process import Command
from mvest.provenance import config_hash as hash_of_data
from mvest.provenance import provenance
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_models", "sheet_program"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]

OWN, SECOND, OTHER_LAW = "this project", "scikit-fem", "scikit-fem, St. Venant-Kirchhoff"
PROGRAM, PROGRAM_ALONE = "scikit-fem as a program", "the same, by differences"


@dataclass(frozen=True, slots=True, eq=False)
class SheetProblem:
    """What every estimate of the study has in common."""

    filter: Filter
    transform: Transform
    prior: Gaussian
    variance: float
    truth: FloatArray


def run_models(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Compare the codes on finer meshes, then estimate with each from the data of each.

    Raises
    ------
    ConfigurationError
        If the parameters or their values do not fit the sheet, or scikit-fem is not installed.
    """
    if tuple(config["parameters"]) != PARAMETERS:
        raise ConfigurationError(
            f"parameters = {config['parameters']}, expected {list(PARAMETERS)}"
        )
    about = config["models"]
    sheet = build(Sheet, about["sheet"])
    filter_, transform, prior = build_filter(config["filter"], PARAMETERS, positive=True)
    variance = float(config["filter"]["R"])
    truth = np.array(config["truth"]["values"], dtype=float)
    problem = SheetProblem(filter_, transform, prior, variance, truth)
    own, second = OwnSheet(sheet), SecondSheet(sheet)
    record = _record(config, config_hash, sheet, truth, started)

    clean = {OWN: own(truth), SECOND: second(truth)}
    lost = [f"{name}: {p.reason}" for name, p in clean.items() if not p.converged]
    if lost:
        return {**record, "status": "failed", "reason": lost[0]}, []
    error = config["observation"]["noise_mm"] * np.random.default_rng(
        config["seed"]
    ).standard_normal(clean[OWN].y.size)
    runs = folder / "runs"
    models: dict[str, ObservationModel] = {
        OWN: own,
        SECOND: second,
        OTHER_LAW: SecondSheet(sheet, "st_venant_kirchhoff"),
        PROGRAM: sheet_program(sheet, runs, about, derivatives=True),
        PROGRAM_ALONE: sheet_program(sheet, runs, about, derivatives=False),
    }
    rows = [
        _estimate(data, clean[data].y + error, name, models[name], problem)
        for data, names in ((OWN, list(models)), (SECOND, [OWN, SECOND, OTHER_LAW]))
        for name in names
    ]
    record |= {
        "rows": rows,
        "shapes": {name: p.y.reshape(-1, 3).tolist() for name, p in clean.items()},
        "differences": [_difference(sheet, cells, truth) for cells in about["refinements"]],
        "forward_solves": sum(row["forward_solves"] for row in rows),
        "seconds": sum(row["seconds"] for row in rows),
        "seconds_total": time.time() - started,
    }
    return record, []


def sheet_program(sheet: Sheet, folder: Path, about: Values, *, derivatives: bool) -> ProcessModel:
    """The scikit-fem sheet as a program of its own.

    Parameters
    ----------
    sheet : Sheet
    folder : Path
        Where its runs are kept.
    about : mapping
        ``time_limit_s``, ``relative_step`` and ``processes``.
    derivatives : bool
        Whether the program tells its exact derivatives.
    """
    # The package itself, wherever the program is started.
    places = [str(Path(mvest.__file__).resolve().parent.parent), os.environ.get("PYTHONPATH", "")]
    command = Command(
        (sys.executable, "-m", "experiments.studies.models.sheet.solver", "{request}", "{folder}"),
        {"PYTHONPATH": os.pathsep.join(filter(None, places))},
        about["time_limit_s"],
    )
    return ProcessModel(
        command,
        folder,
        PARAMETERS,
        len(sheet.points),
        units=("MPa", "MPa"),
        points=sheet.points,
        settings={"sheet": asdict(sheet), "law": "biot", "derivatives": derivatives},
        differences=Differences("central", about["relative_step"], processes=about["processes"]),
        reuse=False,
    )


def _estimate(
    data: str, y: FloatArray, name: str, model: ObservationModel, problem: SheetProblem
) -> dict[str, Any]:
    """Moduli that one model finds in the data of one code."""
    print(f"{name} from data of {data}", file=sys.stderr, flush=True)
    runs = model.runs if isinstance(model, ProcessModel) else None
    began = time.perf_counter()
    with SolveBar(name, 0, TYPICAL_SOLVES, PARAMETERS) as bar:
        found = problem.filter(
            model,
            problem.prior,
            y,
            problem.variance,
            names=PARAMETERS,
            transform=problem.transform,
            on_iterate=bar.iterate,
        )
    row: dict[str, Any] = {
        "data": data,
        "model": name,
        "converged": found.converged,
        "reason": found.reason.value,
        "estimate": found.mean.tolist(),
        "std": found.std.tolist(),
        "relative_error": (found.mean / problem.truth - 1.0).tolist(),
        "residual_mm": None
        if found.prediction is None
        else float(np.sqrt(np.mean((y - found.prediction.y) ** 2))),
        "iterations": found.iterations,
        "forward_solves": found.forward_solves,
        "program_runs": None,
        "seconds": time.perf_counter() - began,
        "iterates": found.iterates.tolist(),
    }
    if isinstance(model, ProcessModel) and runs is not None:
        row["program_runs"] = model.runs - runs
    return row


def _difference(sheet: Sheet, cells: list[int], truth: FloatArray) -> dict[str, Any]:
    """How far apart the codes are on one mesh, at the true moduli."""
    along, across, layers = cells
    finer = replace(sheet, cells=(along, across), layers=layers)
    print(f"both codes on {along} x {across} x {layers} cells", file=sys.stderr, flush=True)
    second, alike = SecondSheet(finer)(truth), SecondSheet(finer, thickness_points=2)(truth)
    return {
        "cells": list(cells),
        "hex18": _apart(OwnSheet(finer)(truth), second),
        "hex27": _apart(OwnSheet(finer, "hex27")(truth), alike),
        "st_venant_kirchhoff": _apart(SecondSheet(finer, "st_venant_kirchhoff")(truth), second),
    }


def _apart(one: Prediction, other: Prediction) -> dict[str, float] | None:
    """Distances of the points (mm), and of the derivatives relative to their size."""
    if not (one.converged and other.converged):
        return None
    distance = np.linalg.norm((one.y - other.y).reshape(-1, 3), axis=1)
    change = np.linalg.norm(one.jacobian - other.jacobian) / np.linalg.norm(other.jacobian)
    return {
        "rms_mm": float(np.sqrt(np.mean(distance**2))),
        "max_mm": float(distance.max()),
        "derivatives": float(change),
    }


def _record(
    config: Values, config_hash: str, sheet: Sheet, truth: FloatArray, started: float
) -> dict[str, Any]:
    try:
        import skfem

        library: str | None = skfem.__version__
    except ImportError:
        library = None
    return {
        "schema": 1,
        **{key: config[key] for key in ("title", "row", "table", "parameters")},
        "experiment": config["name"],
        "status": "converged",
        "reason": "completed",
        "detail": "",
        "truth": truth.tolist(),
        "initial": list(config["filter"]["initial"]),
        "noise_mm": config["observation"]["noise_mm"],
        **dict.fromkeys(
            ("estimate", "std", "relative_error", "iterates", "iterate_std", "distance_mm",
             "distance_to_truth_mm", "moduli_error_percent")
        ),
        "iterations": 0,
        "forward_solves": 0,
        "seconds": 0.0,
        "seconds_total": time.time() - started,
        "rows": [],
        "differences": [],
        "shapes": {},
        "sheet": asdict(sheet),
        "library": {"scikit-fem": library},
        "mesh": {},
        "provenance": {
            **provenance(),
            "config_hash": config_hash,
            "mesh_hash": hash_of_data(asdict(sheet)),
            "seed": config["seed"],
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    }  # fmt: skip


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_models),
    words=lambda record: models_text(flat(record)),
    write=each(write_models_tables),
    sections=(
        Section(
            "models",
            {
                "models": "A pressed sheet in two finite-element codes: deformed, its moduli "
                "iterate by"
                " iterate under each model, and how the codes differ on finer meshes. "
                "Simulated."
            },
        ),
    ),
)
