"""Logging to MLflow: flat runs in one store that exists before any worker starts.

MLflow takes seconds to import, so it is imported where it is used.
"""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from mvest.errors import MvestError

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

__all__ = ["SWEEP_ID", "CreateStore", "log_run", "open_store"]

SWEEP_ID = "MVEST_SWEEP_ID"
"""Environment variable that names the sweep to its workers."""

BATCH_PARAMETERS = 100
"""Most parameters that one call of MLflow takes."""


class CreateStore(Callback):
    """Creates the store and the experiment in the parent, before a launcher starts workers.

    Several processes that open a fresh SQLite store at once can leave it broken for good.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Name the sweep and create its store."""
        os.environ[SWEEP_ID] = uuid.uuid4().hex[:12]
        if config.tracking.enabled:
            open_store(config.tracking.uri, Path(config.paths.outputs), config.name)


def open_store(uri: str | None, outputs: Path, experiment: str) -> tuple[MlflowClient, str]:
    """A client of the tracking store, and the id of the experiment, created if need be.

    Raises
    ------
    MvestError
        If the store cannot be opened.
    """
    from mlflow.tracking import MlflowClient

    _quieten()

    outputs = outputs.resolve()
    place = uri or f"sqlite:///{outputs / 'mlflow.db'}"
    artifacts = (outputs / "mlartifacts").as_uri() if uri is None else None
    try:
        if uri is None:
            outputs.mkdir(parents=True, exist_ok=True)
        client = MlflowClient(tracking_uri=place)
        found = client.get_experiment_by_name(experiment)
        if found is not None:
            return client, found.experiment_id
        return client, client.create_experiment(experiment, artifact_location=artifacts)
    except Exception as error:  # whatever the driver of the store raises
        raise MvestError(f"tracking store {place}: {_first_line(error)}") from error


def log_run(
    record: Mapping[str, Any], config: Mapping[str, Any], files: Sequence[Path], started: float
) -> None:
    """Log one finished run: settings, numbers, tags and files.

    Parameters
    ----------
    record : mapping
        The contents of ``result.json``.
    config : mapping
        The resolved configuration.
    files : sequence of Path
        Logged as artifacts.
    started : float
        Seconds since the epoch.

    Raises
    ------
    MvestError
        If the store cannot be written.
    """
    client, experiment = open_store(
        config["tracking"]["uri"], Path(config["paths"]["outputs"]), record["experiment"]
    )
    from mlflow.entities import Metric, Param, RunTag

    provenance = record["provenance"]
    begin = int(1000 * started)
    end = begin + int(1000 * record["seconds_total"])
    tags = {
        "sweep_id": os.environ.get(SWEEP_ID, "none"),
        "config_hash": provenance["config_hash"],
        "git_sha": provenance["git"]["sha"],
        "mesh_hash": provenance["mesh_hash"],
        "status": record["status"],
        "reason": record["reason"],
    }
    parameters = [Param(k, str(v)) for k, v in _flat(config) if not k.startswith("paths.")]
    try:
        run = client.create_run(experiment, start_time=begin, run_name=record["row"])
        run_id = run.info.run_id
        client.log_batch(
            run_id,
            metrics=[Metric(k, v, begin, step) for k, v, step in _metrics(record)],
            tags=[RunTag(k, str(v)) for k, v in tags.items()],
        )
        for first in range(0, len(parameters), BATCH_PARAMETERS):
            client.log_batch(run_id, params=parameters[first : first + BATCH_PARAMETERS])
        for file in files:
            client.log_artifact(run_id, str(file))
        finished = record["status"] == "converged"
        client.set_terminated(run_id, "FINISHED" if finished else "FAILED", end_time=end)
    except Exception as error:  # whatever the driver of the store raises
        raise MvestError(f"not logged to MLflow: {_first_line(error)}") from error


def _metrics(record: Mapping[str, Any]) -> list[tuple[str, float, int]]:
    """Name, value and iteration of every number worth comparing between runs."""
    found: list[tuple[str, float | None, int]] = []
    for k, name in enumerate(record["parameters"]):
        for key in ("estimate", "std", "relative_error"):
            if record[key] is not None:
                found.append((f"{key}.{name}", record[key][k], 0))
        for step, iterate in enumerate(record["iterates"] or []):
            found.append((f"iterate.{name}", iterate[k], step))
    for key in ("distance_mm", "moduli_error_percent"):
        found += [(f"{key}.{part}", v, 0) for part, v in (record[key] or {}).items()]
    found += [(key, record[key], 0) for key in ("iterations", "forward_solves", "seconds")]
    return [(name, float(value), step) for name, value, step in found if value is not None]


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Dotted names and values; numbers in lists get names of their own, so that they have axes."""
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            found += _flat(value, f"{name}.")
        elif isinstance(value, list) and prefix in ("truth.", "filter.") and value:
            found += [(f"{name}.{k}", item) for k, item in enumerate(value)]
        else:
            found.append((name, value))
    return found


def _quieten() -> None:
    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
