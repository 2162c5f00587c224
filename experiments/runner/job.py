"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from experiments.common.cases.own_case import check_case, run_case
from experiments.common.cases.report import case_text, publish_patient, write_case_tables
from experiments.common.cases.volume import check_volume, run_volume
from experiments.common.config import register
from experiments.common.expectation import (
    TwinForesight,
    foresee_cycle,
    foresee_own,
    foresee_patient,
)
from experiments.runner.folder import (
    CONFIG,
    RESULT,
    FailedRunError,
    clear,
    finished_record,
    lock,
    mark_done,
    require_writable,
)
from experiments.runner.guard import run_apart
from experiments.runner.request import Request
from experiments.runner.tracking import require_no_password
from experiments.studies.chord.report import chord_text, write_chord
from experiments.studies.chord.study import run_chord_study
from experiments.studies.closure.report import closure_text, publish_closure, write_closure_tables
from experiments.studies.closure.study import run_closure_study
from experiments.studies.cycle.report import cycle_text, write_cycle
from experiments.studies.cycle.study import run_cycle_study
from experiments.studies.donor.report import donor_text, publish_donor, write_donor_tables
from experiments.studies.donor.study import run_donor
from experiments.studies.external.report import external_text, write_external_tables
from experiments.studies.external.study import check_external, run_external
from experiments.studies.filters.report import filters_text, write_filter_study, write_filter_tables
from experiments.studies.filters.study import run_filter_study
from experiments.studies.gate.report import gate_text, write_gate_tables
from experiments.studies.gate.study import run_gate_study
from experiments.studies.identifiability.report import (
    identifiability_text,
    write_identifiability_study,
    write_identifiability_tables,
)
from experiments.studies.identifiability.study import run_identifiability
from experiments.studies.imaged_patient.report import publish_volume
from experiments.studies.imaged_patient.study import run_imaged_patient
from experiments.studies.imaging.report import imaging_text, publish_imaging, write_imaging_study
from experiments.studies.imaging.study import publish_model, run_imaging
from experiments.studies.joint.report import joint_text, write_joint
from experiments.studies.joint.study import run_joint_study
from experiments.studies.law.report import law_text, write_law_tables
from experiments.studies.law.study import run_law_study
from experiments.studies.models.report import models_text, write_models_tables
from experiments.studies.models.study import run_models
from experiments.studies.patch.report import patch_text, write_patch
from experiments.studies.patch.study import run_patch_study
from experiments.studies.patient.study import run_patient
from experiments.studies.prediction.report import (
    prediction_text,
    publish_prediction,
    write_prediction_tables,
)
from experiments.studies.prediction.study import run_prediction
from experiments.studies.twin.publish import publish
from experiments.studies.twin.study import run_twin
from experiments.studies.twin.tables import text_table, write_tables
from mvest.errors import ConfigurationError
from mvest.provenance import write_json
from mvest.reporting.files import keep_record

__all__ = ["STUDIES", "FailedRunError", "Study", "compute", "require_study", "run_job"]

# Workers of a launcher import this module before they compose their configuration.
register()


def run_job(config: DictConfig) -> None:
    """Run one composed configuration by itself in Hydra's output folder, unless it is done.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    FailedRunError
        If the computation found no estimate; the run is recorded all the same.
    """
    request = Request.of(config)
    values, folder = request.values, request.folder
    study = require_study(values)
    require_no_password(values["tracking"]["uri"])
    require_writable(folder)
    if values["check"]:
        for check in study.checks() or (_nothing_to_check,):
            print(check(values, folder), flush=True)
        return
    if values["time_limit_s"] is not None:
        # Only another process can be stopped at any moment.
        record = run_apart(request)
        _raise_failure(record, folder)
        print(study.text(record))
        print(f"Written to {folder}")
        return
    with lock(folder):
        done = None if values["force"] else finished_record(folder, request.config_hash)
        if done is None:
            clear(folder)
            compute(request)
            return
    print(study.text(done))
    source = done["provenance"]
    print(
        f"Done on {source['finished']} by commit {(source['git']['sha'] or 'unknown')[:12]}, in "
        f"{folder}; force=true runs it again"
    )
    _publish(request, done)
    study.finish(values, done, folder)


def compute(request: Request) -> dict[str, Any]:
    """Run a job in its folder, which exists: its record, which is then on disk with its figures.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    FailedRunError
        If the computation found no estimate; the run is recorded all the same.
    """
    started = time.time()
    values, folder = request.values, request.folder
    study = require_study(values)
    record, _ = study.run(values, request.config_hash, folder, started)
    record["factors"] = values["factors"]

    write_json(folder / CONFIG, values)
    write_json(folder / RESULT, record)
    if values["figures"]:
        study.tables(folder, record)
    print(study.text(record))
    print(f"Written to {folder}")
    _publish(request, record)
    if record["status"] == "converged":
        mark_done(folder)
    study.finish(values, record, folder)
    _raise_failure(record, folder)
    return record


def _publish(request: Request, record: Mapping[str, Any]) -> None:
    """Let the results take over a run of an experiment as it is configured."""
    values = request.values
    kept = record["status"] == "converged" or require_study(values).keeps_failures
    if not values["publish"] or values["sweep"] or not kept:
        return
    results = Path(values["paths"]["results"])
    if request.publish_as is None:
        print(f"{results} left as it is: this run has overrides")
        return
    require_study(values).publish(results, request.publish_as, record, request.folder)
    print(f"Results in {results}")


def _raise_failure(record: Mapping[str, Any], folder: Path) -> None:
    if record["status"] != "converged":
        detail = f" ({record['detail']})" if record["detail"] else ""
        raise FailedRunError(record["reason"] + detail, folder)


def _leave(values: Mapping[str, Any], record: Mapping[str, Any], folder: Path) -> None:
    """Nothing more is done with a finished run."""


def _kept(
    write: Callable[[Path, Mapping[str, Any]], list[Path]],
) -> Callable[[Path, str, Mapping[str, Any], Path], list[Path]]:
    """Publish the record, with tables and figures from it alone."""

    def publish_record(
        results: Path, _name: str, record: Mapping[str, Any], _folder: Path
    ) -> list[Path]:
        keep_record(results, record)
        return write(results, record)

    return publish_record


def _nothing_to_check(values: Mapping[str, Any], folder: Path) -> str:
    kinds = ", ".join(kind for kind, study in STUDIES.items() if study.checks())
    raise ConfigurationError(
        f"experiment {values['name']}: check=true has nothing to say of a study of the kind "
        f"{values['study']}; expected one of {kinds}"
    )


@dataclass(frozen=True, slots=True)
class Study:
    """A kind of study: how it is run, told, tabulated and published.

    Attributes
    ----------
    run : callable
        (configuration, its hash, output folder, start time) -> record and the files written.
    text : callable
        record -> text for the terminal.
    tables : callable
        (folder, record) -> table files written there.
    publish : callable
        (results folder, name, record, output folder) -> files written.
    keeps_failures : bool
        Whether the results also take over a run that found no estimate: where a share of runs is
        counted, those must count that failed.
    finish : callable
        (configuration, record, output folder): what is done with a run that is on disk, also with
        one that was done before.
    checks : callable
        () -> what ``check=true`` says, one after another, without estimating anything, each
        (configuration, output folder) -> text. Made once for all jobs of a sweep.
    """

    run: Callable[[Mapping[str, Any], str, Path, float], tuple[dict[str, Any], list[Path]]]
    text: Callable[[Mapping[str, Any]], str]
    tables: Callable[[Path, Mapping[str, Any]], list[Path]]
    publish: Callable[[Path, str, Mapping[str, Any], Path], list[Path]]
    keeps_failures: bool = False
    finish: Callable[[Mapping[str, Any], Mapping[str, Any], Path], None] = _leave
    checks: Callable[[], tuple[Callable[[Mapping[str, Any], Path], str], ...]] = tuple


STUDIES: dict[str, Study] = {
    "twin": Study(
        run_twin,
        lambda record: text_table([record]),
        lambda folder, record: write_tables(folder, record["table"], [record]),
        lambda results, name, record, folder: publish(results, name, record, folder / "fields.npz"),
        checks=lambda: (TwinForesight(),),
    ),
    "closure": Study(
        run_closure_study,
        closure_text,
        write_closure_tables,
        lambda results, _, record, folder: publish_closure(results, record, folder),
    ),
    "gate": Study(
        run_gate_study,
        gate_text,
        write_gate_tables,
        _kept(write_gate_tables),
    ),
    "law": Study(
        run_law_study,
        law_text,
        write_law_tables,
        _kept(write_law_tables),
    ),
    "joint": Study(
        run_joint_study,
        joint_text,
        write_joint,
        _kept(write_joint),
        checks=lambda: (foresee_cycle,),
    ),
    "cycle": Study(
        run_cycle_study,
        cycle_text,
        write_cycle,
        _kept(write_cycle),
        keeps_failures=True,
        checks=lambda: (foresee_cycle,),
    ),
    "identifiability": Study(
        run_identifiability,
        identifiability_text,
        write_identifiability_tables,
        _kept(write_identifiability_study),
    ),
    "prediction": Study(
        run_prediction,
        prediction_text,
        write_prediction_tables,
        lambda results, _, record, folder: publish_prediction(
            results, record, folder / "fields.npz"
        ),
    ),
    "filters": Study(
        run_filter_study,
        filters_text,
        write_filter_tables,
        _kept(write_filter_study),
    ),
    "chord": Study(
        run_chord_study,
        chord_text,
        write_chord,
        _kept(write_chord),
        keeps_failures=True,
        checks=lambda: (foresee_cycle,),
    ),
    "patch": Study(
        run_patch_study,
        patch_text,
        write_patch,
        _kept(write_patch),
        checks=lambda: (foresee_cycle,),
    ),
    "donor": Study(
        run_donor,
        donor_text,
        write_donor_tables,
        lambda results, _, record, folder: publish_donor(results, record, folder / "fields.npz"),
    ),
    "case": Study(
        run_case,
        case_text,
        write_case_tables,
        lambda _results, _name, _record, _folder: [],
        checks=lambda: (check_case, foresee_own),
    ),
    "volume": Study(
        run_volume,
        case_text,
        write_case_tables,
        lambda _results, _name, _record, _folder: [],
        checks=lambda: (check_volume,),
    ),
    "imaged_patient": Study(
        run_imaged_patient,
        case_text,
        write_case_tables,
        lambda results, name, record, _folder: publish_volume(results, name, record),
        keeps_failures=True,
    ),
    "patient": Study(
        run_patient,
        case_text,
        write_case_tables,
        lambda results, name, record, folder: publish_patient(
            results, name, record, folder / "fields.npz"
        ),
        keeps_failures=True,
        checks=lambda: (foresee_patient,),
    ),
    "imaging": Study(
        run_imaging,
        imaging_text,
        write_imaging_study,
        lambda results, _name, record, _folder: publish_imaging(results, record),
        finish=publish_model,
    ),
    "models": Study(
        run_models,
        models_text,
        write_models_tables,
        _kept(write_models_tables),
    ),
    "external": Study(
        run_external,
        external_text,
        write_external_tables,
        lambda _results, _name, _record, _folder: [],
        checks=lambda: (check_external,),
    ),
}
"""Kinds of studies that a configuration can name."""


def require_study(values: Mapping[str, Any]) -> Study:
    """The kind of study that a configuration names.

    Raises
    ------
    ConfigurationError
        If there is no such kind.
    """
    if values["study"] not in STUDIES:
        raise ConfigurationError(
            f"study = {values['study']!r}, expected one of {', '.join(STUDIES)}"
        )
    return STUDIES[values["study"]]
