"""The MLflow store: its address, and its database, made once."""

from __future__ import annotations

import logging
import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from filelock import FileLock

from mvest.errors import ConfigurationError, MvestError

MANNERS = {
    # A server that is away is given up after seconds, not MLflow's minutes.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}
"""Settings of MLflow, unless the user has made them; its server inherits them."""

ARTIFACTS, SQLITE = "mlartifacts", "sqlite:///"
"""Folder of MLflow's copies of files in the outputs; beginning of a local database's address."""

PASSWORD = re.compile(r"://[^/@:]*:[^/@]+@")
BROKEN = re.compile(r"malformed|not a database|no such (table|column)|out-of-date database schema")
"""What SQLite and MLflow say of a file that is no database, damaged, or was never finished."""


class TrackingError(MvestError):
    """The store cannot be opened or written."""


def require_no_password(uri: str | None) -> None:
    """Raise a `ConfigurationError` for an address that has a password."""
    if uri is not None and PASSWORD.search(uri):
        raise ConfigurationError(
            "tracking.uri holds a password, which would be written into every config.json; leave "
            "it out and put it in ~/.pgpass or MLFLOW_TRACKING_PASSWORD"
        )


@contextmanager
def opened(uri: str | None, outputs: Path, experiment: str) -> Iterator[str]:
    """MLflow, pointed at a store and an experiment, both made if need be; gives the address.

    Raises
    ------
    TrackingError
        If the store cannot be opened, or be written within: one line that names it.
    """
    require_no_password(uri)
    outputs = outputs.resolve()
    place = uri or f"{SQLITE}{outputs / 'mlflow.db'}"
    file = Path(place.removeprefix(SQLITE).partition("?")[0])
    if is_local := place.startswith(SQLITE):  # also for a server that is started elsewhere
        place = place.replace(str(file), str(file.resolve()))
    for name, value in MANNERS.items():
        os.environ.setdefault(name, value)
    try:
        import mlflow

        for name in ("alembic", "mlflow"):
            logging.getLogger(name).setLevel(logging.ERROR)
        outputs.mkdir(parents=True, exist_ok=True)
        # Several processes that open a fresh SQLite database at once would break it.
        with FileLock(outputs / ".mlflow.lock"):
            if is_local and file.exists() and file.stat().st_size:
                # MLflow would ask a broken one again for minutes.
                address = f"{file.resolve().as_uri()}?mode=ro"
                with closing(sqlite3.connect(address, 1.0, uri=True)) as database:
                    database.execute("select * from alembic_version, experiments").fetchone()
            mlflow.set_tracking_uri(place)
            if mlflow.get_experiment_by_name(experiment) is None:
                kept = None if place.startswith("http") else (outputs / ARTIFACTS).as_uri()
                kind = {"mlflow.experimentKind": "custom_model_development"}
                mlflow.create_experiment(experiment, kept, kind)
            mlflow.set_experiment(experiment)
        yield place
    except MvestError:
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if is_local and BROKEN.search(str(error)):
            raise TrackingError(f"{file} is broken ({reason}): remove it") from error
        reason = "database is locked" if "locked" in reason else reason
        raise TrackingError(f"tracking store {place}: {reason}") from error
