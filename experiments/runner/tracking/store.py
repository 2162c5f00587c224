"""The store of MLflow: opened, made where there is none, and set aside where it is broken."""

from __future__ import annotations

import logging
import os
import re
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from mvest.errors import ConfigurationError, MvestError
from mvest.files import remove_parts, write_atomically

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

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


def load_client() -> None:
    """Import MLflow, which takes seconds, with our manners."""
    for name, value in MANNERS.items():
        os.environ.setdefault(name, value)
    import mlflow.store.tracking.sqlalchemy_store
    import mlflow.tracking  # noqa: F401

    _quieten()


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
    load_client()
    from mlflow.tracking import MlflowClient

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


def _is_database(place: str) -> bool:
    return place.startswith(("sqlite:", "postgresql", "mysql", "mssql"))


def _quieten() -> None:
    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)
