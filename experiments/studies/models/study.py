"""The same sheet in two finite-element codes: how alike they are, and what each estimates."""

from __future__ import annotations

import importlib.metadata
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import mvest
from experiments.common.building.filters import build_filter
from experiments.common.progress import TYPICAL_SOLVES, SolveBar, say
from experiments.common.records.findings import rows, vector
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.models.findings import Apart, Difference, Findings, Row
from experiments.studies.models.report import (
    models_answer,
    models_figure,
    models_table,
    models_text,
)
from experiments.studies.models.settings import ModelsSettings, Settings
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
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_models", "sheet_program"]

Values = Mapping[str, Any]

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


def run_models(job: Job[Settings]) -> Outcome[Findings]:
    """Compare the codes on finer meshes, then estimate with each from the data of each.

    Raises
    ------
    ConfigurationError
        If the parameters or their values do not fit the sheet, or scikit-fem is not installed.
    """
    values, about = job.values, job.settings.models
    if tuple(values["parameters"]) != PARAMETERS:
        raise ConfigurationError(
            f"parameters = {values['parameters']}, expected {list(PARAMETERS)}"
        )
    sheet, noise = about.sheet, values["observation"]["noise_mm"]
    filter_, transform, prior = build_filter(values["filter"], PARAMETERS, positive=True)
    truth = np.array(values["truth"]["values"], dtype=float)
    problem = SheetProblem(filter_, transform, prior, float(values["filter"]["R"]), truth)
    own, second = OwnSheet(sheet), SecondSheet(sheet)
    findings = Findings(
        truth=vector(truth),
        noise_mm=noise,
        rows=(),
        differences=(),
        shapes={},
        sheet=sheet,
        library={"scikit-fem": importlib.metadata.version("scikit-fem")},
        seconds=0.0,
    )
    clean = {OWN: own(truth), SECOND: second(truth)}
    lost = [f"{name}: {p.reason}" for name, p in clean.items() if not p.converged]
    if lost:
        return Outcome(findings=findings, status="failed", reason=lost[0])
    rng = np.random.default_rng(values["seed"])
    error = noise * rng.standard_normal(clean[OWN].y.size)
    runs = job.folder / "runs"
    models: dict[str, ObservationModel] = {
        OWN: own,
        SECOND: second,
        OTHER_LAW: SecondSheet(sheet, "st_venant_kirchhoff"),
        PROGRAM: sheet_program(about, runs, derivatives=True),
        PROGRAM_ALONE: sheet_program(about, runs, derivatives=False),
    }
    estimates = tuple(
        _estimate(data, clean[data].y + error, name, models[name], problem)
        for data, names in ((OWN, list(models)), (SECOND, [OWN, SECOND, OTHER_LAW]))
        for name in names
    )
    return Outcome(
        findings=replace(
            findings,
            rows=estimates,
            shapes={name: rows(p.y.reshape(-1, 3)) for name, p in clean.items()},
            differences=tuple(_difference(sheet, cells, truth) for cells in about.refinements),
            seconds=sum(row.seconds for row in estimates),
        ),
        forward_solves=sum(row.forward_solves for row in estimates),
    )


def sheet_program(about: ModelsSettings, folder: Path, *, derivatives: bool) -> ProcessModel:
    """The scikit-fem sheet as a program of its own.

    Parameters
    ----------
    about : ModelsSettings
    folder : Path
        Where its runs are kept.
    derivatives : bool
        Whether the program gives its exact derivatives.
    """
    # The package itself, wherever the program is started.
    places = [str(Path(mvest.__file__).resolve().parent.parent), os.environ.get("PYTHONPATH", "")]
    command = Command(
        (sys.executable, "-m", "experiments.studies.models.sheet.solver", "{request}", "{folder}"),
        {"PYTHONPATH": os.pathsep.join(filter(None, places))},
        about.time_limit_s,
    )
    return ProcessModel(
        command,
        folder,
        PARAMETERS,
        len(about.sheet.points),
        units=("MPa", "MPa"),
        points=about.sheet.points,
        settings={"sheet": asdict(about.sheet), "law": "biot", "derivatives": derivatives},
        differences=Differences("central", about.relative_step, processes=about.processes),
        reuse=False,
    )


def _estimate(
    data: str, y: FloatArray, name: str, model: ObservationModel, problem: SheetProblem
) -> Row:
    """Moduli that one model estimates from the data of one code."""
    say(f"{name} from data of {data}")
    runs = model.runs if isinstance(model, ProcessModel) else 0
    began = time.perf_counter()
    with SolveBar(name, 0, TYPICAL_SOLVES, PARAMETERS) as bar:
        estimate = problem.filter(
            model,
            problem.prior,
            y,
            problem.variance,
            names=PARAMETERS,
            transform=problem.transform,
            on_iterate=bar.iterate,
        )
    return Row(
        data=data,
        model=name,
        converged=estimate.converged,
        reason=estimate.reason.value,
        estimate=vector(estimate.mean),
        std=vector(estimate.std),
        relative_error=vector(estimate.mean / problem.truth - 1.0),
        residual_mm=estimate.residual_rms(y),
        iterations=estimate.iterations,
        forward_solves=estimate.forward_solves,
        program_runs=model.runs - runs if isinstance(model, ProcessModel) else None,
        seconds=time.perf_counter() - began,
        iterates=rows(estimate.iterates),
    )


def _difference(sheet: Sheet, cells: tuple[int, ...], truth: FloatArray) -> Difference:
    """How far apart the codes are on one mesh, at the true moduli."""
    along, across, layers = cells
    finer = replace(sheet, cells=(along, across), layers=layers)
    say(f"both codes on {along} x {across} x {layers} cells")
    second, alike = SecondSheet(finer)(truth), SecondSheet(finer, thickness_points=2)(truth)
    return Difference(
        tuple(cells),
        _apart(OwnSheet(finer)(truth), second),
        _apart(OwnSheet(finer, "hex27")(truth), alike),
        _apart(SecondSheet(finer, "st_venant_kirchhoff")(truth), second),
    )


def _apart(one: Prediction, other: Prediction) -> Apart | None:
    """Distances of the points, and of the derivatives."""
    if not (one.converged and other.converged):
        return None
    distance = np.linalg.norm((one.y - other.y).reshape(-1, 3), axis=1)
    change = np.linalg.norm(one.jacobian - other.jacobian) / np.linalg.norm(other.jacobian)
    return Apart(float(np.sqrt(np.mean(distance**2))), float(distance.max()), float(change))


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_models,
    words=models_text,
    write=write_each(models_table, models_text, models_figure),
    sections=(
        Section(
            "models",
            {
                "models": "A pressed sheet in two finite-element codes: deformed, its moduli "
                "iterate by"
                " iterate under each model, and how the codes differ on finer meshes. "
                "Simulated."
            },
            answer=answer_of_main(models_answer),
        ),
    ),
)
