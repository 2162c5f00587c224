"""Logging to MLflow: flat runs, from the folders that jobs leave behind.

A job writes its files and is done. The process that a user started logs them at its end, a single
run's or a sweep's; ``make sync`` does so at any time. So workers neither import MLflow, which takes
seconds, nor need to reach its server, a store has one writer, and what could not be logged is
complete on disk. A folder whose ``tracked.json`` fits its ``result.json`` has been logged; every
other one is still to be.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.common.records.record import Record, read_record
from experiments.runner.collecting.comparison import metrics, parameters
from experiments.runner.jobs.folder import is_done
from experiments.runner.tracking.store import Store, open_store, telling
from mvest.errors import InputError, MvestError
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping

RECEIPT = "tracked.json"
"""File in a job's folder that says as which run its result was uploaded."""

NO_SWEEP = "none"
"""Sweep of a run that was started by itself."""

REMEDY = "every result is on disk, and `make sync` uploads what is missing"

FILES = ("*.json", "*.png", "*.csv", "*.md")
"""Files of a job kept with its run; of a figure the picture, not its PDF."""

PARAMETERS_AT_ONCE, VALUES_AT_ONCE = 100, 900
"""Parameters, and values of all kinds, that one call of MLflow takes at most."""

LONGEST_TEXT = 5000
"""Largest number of characters of a tag or parameter that MLflow takes."""


def track_job(folder: Path, config: Mapping[str, Any]) -> None:
    """Log the result of a run by itself, if it has one that is not logged yet.

    A store that fails costs a line of warning: the result is on disk, to be logged later.
    """
    try:
        if is_due(folder, config):
            outputs = Path(config["paths"]["outputs"])
            upload(open_store(config["tracking"]["uri"], outputs, str(config["name"])), folder)
    except MvestError as error:
        print(f"warning: {error}; {REMEDY}", file=sys.stderr)


def is_due(folder: Path, config: Mapping[str, Any]) -> bool:
    """Whether a run is to be logged, has a result, and has not been logged yet.

    Raises
    ------
    InputError
        If a file of the run cannot be read.
    """
    if not config["tracking"]["enabled"] or not (folder / "result.json").is_file():
        return False
    return is_complete(folder) and not is_tracked(folder)


def is_complete(job: Path) -> bool:
    """Whether a job has ended: it has failed, or its marker says that everything is on disk."""
    return is_done(job) or read_mapping(job / "result.json").get("status") != "converged"


def is_tracked(folder: Path) -> bool:
    """Whether the present result of a job has been uploaded, as far as its folder knows."""
    receipt = folder / RECEIPT
    if not receipt.is_file():
        return False
    return bool(read_mapping(receipt).get("result_hash") == _digest(folder / "result.json"))


def upload(
    store: Store, folder: Path, sweep_id: str | None = None, name: str | None = None
) -> bool:
    """Bring the store to the state of a job's folder; returns whether a run was added.

    A run of the same configuration and result is left as it is, save for its sweep and its name.
    One with another result, or one that was never finished, is replaced.

    Parameters
    ----------
    store : Store
    folder : Path
        With ``config.json`` and ``result.json``.
    sweep_id : str or None
        None keeps the sweep that the folder or the store knows.
    name : str, optional
        What sets the run apart from the others of its sweep; its row in a table if not given.

    Raises
    ------
    TrackingError
        If the store cannot be written.
    InputError
        If a file of the job cannot be read.
    """
    place = folder / "result.json"
    record, config = read_record(place), read_mapping(folder / "config.json")
    result_hash = _digest(place)
    receipt = read_mapping(folder / RECEIPT) if (folder / RECEIPT).is_file() else {}
    config_hash = record.provenance.config_hash
    present = None
    for run in store.runs(config_hash):
        tags = run.data.tags
        whole = run.info.status in ("FINISHED", "FAILED") and tags.get("result_hash") == result_hash
        sweep_id = sweep_id or tags.get("sweep_id")
        if whole and present is None:
            present = run
        else:
            store.changed.add(config_hash)
            with telling(store.place):
                store.client.delete_run(run.info.run_id)
    sweep_id = sweep_id or str(receipt.get("sweep_id", NO_SWEEP))
    if present is None:
        store.changed.add(config_hash)
        name = name or record.row
        run_id = _log(store, folder, record, config, name, sweep_id, result_hash)
    else:
        run_id = present.info.run_id
        with telling(store.place):
            if present.data.tags.get("sweep_id") != sweep_id:
                store.client.set_tag(run_id, "sweep_id", sweep_id)
            if name and present.info.run_name != name:
                store.client.update_run(run_id, name=name)
    written = {"run_id": run_id, "sweep_id": sweep_id, "result_hash": result_hash}
    if written != receipt:
        write_json(folder / RECEIPT, written)
    return present is None


def _log(
    store: Store,
    folder: Path,
    record: Record,
    config: Mapping[str, Any],
    name: str,
    sweep_id: str,
    result_hash: str,
) -> str:
    """Log one run, closed as the last step; returns its id."""
    from mlflow.entities import Metric, Param

    provenance = record.provenance
    end = int(1000 * (folder / "result.json").stat().st_mtime)
    begin = end - int(1000 * record.seconds_total)
    tags = {
        "sweep_id": sweep_id,
        "config_hash": provenance.config_hash,
        "result_hash": result_hash,
        "git_sha": provenance.git.sha,
        "mesh_hash": provenance.mesh_hash,
        "seed": provenance.seed,
        "status": record.status,
        "reason": record.reason,
        "verdict": next((one.verdict.trust for one in record.estimates if one.verdict), None),
        "folder": folder.name,
        "mlflow.source.name": "experiments.run",
        "mlflow.source.type": "LOCAL",
        "mlflow.source.git.commit": provenance.git.sha,
    }
    numbers = [Metric(k, v, end, step) for k, v, step in metrics(record)]
    settings = [
        Param(k, v[:LONGEST_TEXT]) for k, v in parameters(config, record.parameters).items()
    ]
    with telling(store.place):
        run_id = str(
            store.client.create_run(
                store.experiment,
                start_time=begin,
                run_name=name,
                tags={k: str(v)[:LONGEST_TEXT] for k, v in tags.items() if v is not None},
            ).info.run_id
        )
        for first in range(0, max(len(numbers), len(settings)), VALUES_AT_ONCE):
            store.client.log_batch(
                run_id,
                metrics=numbers[first : first + VALUES_AT_ONCE],
                params=settings[:PARAMETERS_AT_ONCE] if first == 0 else [],
            )
        for first in range(PARAMETERS_AT_ONCE, len(settings), PARAMETERS_AT_ONCE):
            store.client.log_batch(run_id, params=settings[first : first + PARAMETERS_AT_ONCE])
        for path in sorted(path for name in FILES for path in folder.glob(name)):
            if path.name != RECEIPT and not path.name.startswith("."):
                store.client.log_artifact(run_id, str(path))
        ended = "FINISHED" if record.converged else "FAILED"
        store.client.set_terminated(run_id, ended, end_time=end)
    return run_id


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
