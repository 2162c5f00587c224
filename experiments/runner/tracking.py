"""Logging to MLflow: flat runs, from the folders that jobs leave behind.

A job writes its files and is done. The process that a user started logs them at its end, a single
run's or a sweep's; ``python -m experiments.runner.sync`` does so at any time. So workers neither
import MLflow, which takes seconds, nor need to reach its server, a store has one writer, and what
could not be logged is complete on disk. A folder whose ``tracked.json`` fits its ``result.json``
has been logged; every other one is still to be.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sqlite3
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from experiments.common.record import SCHEMA, Record, require_written
from experiments.runner.compared import Compared, compared
from experiments.runner.comparison import inputs, metrics, parameters
from experiments.runner.folder import is_done
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.files import remove_parts, write_atomically
from mvest.provenance import write_json
from mvest.reading.json_file import read_mapping

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

__all__ = [
    "NO_SWEEP",
    "RECEIPT",
    "REMEDY",
    "Store",
    "TrackingError",
    "first_line",
    "is_complete",
    "is_tracked",
    "open_store",
    "require_no_password",
    "track_job",
    "upload",
]

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

MANNERS = {
    # A server that is away is given up after seconds, not MLflow's minutes: nothing is lost.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    # What is computed here goes to the tracking store and nowhere else.
    "MLFLOW_DISABLE_TELEMETRY": "true",
}
"""Settings of MLflow's, unless the user has made them; its server inherits them."""

SQLITE = "sqlite:///"
"""How the address of a local database begins."""

BESIDE = ("-journal", "-wal", "-shm")
"""Ends of the names of files that SQLite keeps beside a database while it is written."""

DEFAULT = "0"
"""Id of the experiment that MLflow makes last in a new store."""

PASSWORD = re.compile(r"://[^/@:]*:[^/@]+@")
"""A password within the address of a store."""


class TrackingError(MvestError):
    """The tracking store cannot be opened or written."""


@dataclass
class Store:
    """An experiment of an open tracking store.

    Attributes
    ----------
    client : MlflowClient
    experiment : str
        Id of the experiment.
    place : str
        Address of the store.
    known : dict
        Hash of a configuration -> its runs in the store, once they have been listed.
    changed : set
        Configurations whose runs have changed since.
    """

    client: MlflowClient
    experiment: str
    place: str
    known: dict[str, list[Run]] | None = field(default=None, repr=False)
    changed: set[str] = field(default_factory=set, repr=False)

    def runs(self, config_hash: str) -> list[Run]:
        """The runs of a configuration that are in the store."""
        if self.known is not None and config_hash not in self.changed:
            return self.known.get(config_hash, [])
        with telling(self.place):
            return list(
                self.client.search_runs([self.experiment], f"tags.config_hash = '{config_hash}'")
            )

    def list_runs(self) -> list[Run]:
        """Every run of the experiment, remembered from now on for :meth:`runs`."""
        found: list[Run] = []
        token = None
        with telling(self.place):
            while True:
                page = self.client.search_runs(
                    [self.experiment], max_results=1000, page_token=token
                )
                found += page
                token = page.token
                if not token:
                    break
        self.known, self.changed = {}, set()
        for run in found:
            self.known.setdefault(run.data.tags.get("config_hash", ""), []).append(run)
        return found


def require_no_password(uri: str | None) -> None:
    """Refuse an address that would carry a password into every ``config.json``.

    Raises
    ------
    ConfigurationError
        If it holds one.
    """
    if uri is not None and PASSWORD.search(uri):
        raise ConfigurationError(
            "tracking.uri holds a password, which would be written into every config.json; leave "
            "it out and put it in ~/.pgpass or MLFLOW_TRACKING_PASSWORD"
        )


def open_store(uri: str | None, outputs: Path, experiment: str) -> Store:
    """Open the tracking store and the experiment, both created if need be.

    Only one process at a time creates a local store: several that open a fresh SQLite database at
    once can leave it broken for good. It takes its name once it is whole. One that is broken all
    the same is set aside, and a new one made; a database on a server is never touched.

    Raises
    ------
    TrackingError
        If the store cannot be opened.
    ConfigurationError
        If the address holds a password, which would be written down with every result.
    """
    require_no_password(uri)
    for name, value in MANNERS.items():
        os.environ.setdefault(name, value)
    from mlflow.tracking import MlflowClient

    _quieten()
    outputs = outputs.resolve()
    place = uri or f"sqlite:///{outputs / 'mlflow.db'}"
    artifacts = (outputs / "mlartifacts").as_uri() if _is_database(place) else None
    with telling(place):
        outputs.mkdir(parents=True, exist_ok=True)
        with FileLock(outputs / ".mlflow.lock"):
            if place.startswith(SQLITE):
                _make_whole(Path(place.removeprefix(SQLITE).partition("?")[0]))
            client = MlflowClient(tracking_uri=place)
            found = client.get_experiment_by_name(experiment)
            if found is not None:
                return Store(client, found.experiment_id, place)
            made = client.create_experiment(experiment, artifact_location=artifacts)
            return Store(client, made, place)


def _make_whole(path: Path) -> None:
    """Set a broken database aside, and make one that is not there."""
    broken = _broken(path) if path.exists() else ""
    if broken:
        number = 1 + len(list(path.parent.glob(f"{path.stem}.broken-*")))
        aside = path.with_name(f"{path.stem}.broken-{number}{path.suffix}")
        path.rename(aside)
        print(
            f"note: {path} cannot be used ({broken}) and is kept as {aside.name}; a new one is "
            "made, and `make sync` uploads every result that is on disk",
            file=sys.stderr,
        )
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        for beside in ("", *BESIDE):
            path.with_name(path.name + beside).unlink(missing_ok=True)
            remove_parts(path.parent, path.name + beside)
        write_atomically(path, _fill, sync=True)


def _fill(path: Path) -> None:
    """Make a database, which takes seconds."""
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=f"{SQLITE}{path}")
    client.get_experiment(DEFAULT)
    # Whatever it keeps beside the file is in it then.
    client._tracking_client.store.engine.dispose()


def _broken(path: Path) -> str:
    """Why a database is of no use; empty where it is sound, or only locked or out of reach.

    Of one that was made to its end MLflow's own experiment is there.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True)) as database:
            (state,) = database.execute("pragma quick_check(1)").fetchone()
            tables = database.execute("select name from sqlite_master").fetchall()
            if state != "ok":
                return " ".join(str(state).split())
            if ("experiments",) in tables:
                query = "select count(*) from experiments"
                if database.execute(query).fetchone() != (0,):
                    return ""
            return "it was never finished"
    except sqlite3.OperationalError:
        return ""
    except sqlite3.DatabaseError as error:
        return first_line(error)


def track_job(folder: Path, config: Mapping[str, Any]) -> None:
    """Log the result of a run by itself, if it has one that is not logged yet.

    A store that fails costs a line of warning: the result is on disk, to be logged later.
    """
    if not config["tracking"]["enabled"] or not (folder / "result.json").is_file():
        return
    try:
        if is_complete(folder) and not is_tracked(folder):
            outputs = Path(config["paths"]["outputs"])
            upload(open_store(config["tracking"]["uri"], outputs, str(config["name"])), folder)
    except MvestError as error:
        print(f"warning: {error}; {REMEDY}", file=sys.stderr)


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
    data, config = read_mapping(place), read_mapping(folder / "config.json")
    if data.get("schema") != SCHEMA:
        raise InputError(f"{place} was written by another version")
    record = compared(data, str(place))
    require_written(data, place)
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


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its kind."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


@contextmanager
def telling(place: str) -> Iterator[None]:
    """Turn whatever the driver of a store raises into one line that names the store."""
    try:
        yield
    except MvestError:
        raise
    except Exception as error:
        reason = "database is locked" if "locked" in str(error) else first_line(error)
        raise TrackingError(f"tracking store {place}: {reason}") from error


def _log(
    store: Store,
    folder: Path,
    record: Record[Compared],
    config: Mapping[str, Any],
    name: str,
    sweep_id: str,
    result_hash: str,
) -> str:
    """Log one run, closed as the last step; returns its id."""
    from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param

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
        "verdict": record.findings.verdict,
        "folder": folder.name,
        "mlflow.source.name": "experiments.run",
        "mlflow.source.type": "LOCAL",
        "mlflow.source.git.commit": provenance.git.sha,
    }
    numbers = [Metric(k, v, end, step) for k, v, step in metrics(record)]
    settings = [
        Param(k, v[:LONGEST_TEXT]) for k, v in parameters(config, record.parameters).items()
    ]
    data = [
        DatasetInput(
            Dataset(**{key: value for key, value in one.items() if key != "context"}),
            [InputTag("mlflow.data.context", one["context"])],
        )
        for one in inputs(config, record)
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
        store.client.log_inputs(run_id, datasets=data)
        for path in sorted(path for name in FILES for path in folder.glob(name)):
            if path.name != RECEIPT and not path.name.startswith("."):
                store.client.log_artifact(run_id, str(path))
        ended = "FINISHED" if record.converged else "FAILED"
        store.client.set_terminated(run_id, ended, end_time=end)
    return run_id


def _is_database(place: str) -> bool:
    return place.startswith(("sqlite:", "postgresql", "mysql", "mssql"))


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


def _quieten() -> None:
    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)
