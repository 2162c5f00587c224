"""MLflow: what is logged of runs and sweeps (``mvest sync``), and its pages (``mvest dashboard``).

A run of the store with the same result is left, one with another is replaced, a missing one added.
The store's database is made once.
"""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from statistics import fmean
from typing import Any, TypeAlias
from urllib.parse import quote

from filelock import FileLock
from omegaconf import OmegaConf
from tqdm import tqdm

from experiments.common.records.record import read_record
from experiments.runner.compared import (
    Values,
    implausible,
    metrics,
    settings_of,
    text_of,
    together,
    varied,
)
from experiments.runner.jobs import CONFIG, RESULT, is_done
from experiments.runner.plan import PLAN
from experiments.sweeps.collected import read_sweep
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.files import sha256_of
from mvest.processes import Program, environment, python
from mvest.reading.documents import read_mapping

SWEEP, TYPED = "sweep.json", ".hydra/overrides.yaml"
"""Files of a sweep: its results; and of a run: what was typed."""

FILES = ("*.json", "*.png", "*.svg", "*.csv", "*.md", "*.html", "*.parquet")
"""Files that MLflow keeps a copy of; of a figure the picture, not its PDF."""

MANY = 1000
"""Jobs of a sweep above which only the sweep as a whole is a run."""

Entry: TypeAlias = tuple[Path, str, Values, dict[str, float], float]
"""Result file, name, tags (the first is no other run's), metrics, seconds computed."""

PARENT, WHOLE = "mlflow.parentRunId", "result_hash"
"""Tags: of a job, its sweep's run; of a run that was logged to its end, the hash of its result."""

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


MOST = 100
"""Runs on MLflow's page of comparison, which reads them one by one."""

SERVED = MANNERS | {
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_ENABLE_ASSISTANT_SANDBOX": "true",
    "MLFLOW_ENABLE_REMOTE_ASSISTANT": "false",
    "PYTHONSAFEPATH": "1",
}
"""Environment of the server: no telemetry, no jobs, no assistant, no module of a case's folder."""

HOST = "mvest.localhost"
"""This machine, by a name at which MLflow's pages do not open their assistant."""


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
                copies = None if place.startswith("http") else (outputs / ARTIFACTS).as_uri()
                kind = {"mlflow.experimentKind": "custom_model_development"}
                mlflow.create_experiment(experiment, copies, kind)
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


def log_run(folder: Path, config: Values) -> None:
    """Log a run by itself; a store that fails costs a line of warning, and nothing is lost."""
    if (folder / RESULT).is_file():
        log_sweep(folder, config)


def log_sweep(folder: Path, config: Values) -> None:
    """Log a sweep's folder, likewise, with the configuration of its first job."""
    outputs = Path(config["paths"]["outputs"])
    try:
        _log(folder, outputs, config)
    except (MvestError, OSError) as error:
        remedy = f"every result is on disk, and `mvest sync {outputs}` logs what is missing"
        print(f"warning: {error}; {remedy}", file=sys.stderr)


def sync(outputs: Path) -> int:
    """Bring the stores to the state of a folder of outputs; 1 if something was left out, else 0."""
    counts, swept = Counter[str](), set[Path]()
    for path in [*sorted(outputs.rglob(PLAN)), *sorted(outputs.rglob(RESULT))]:
        try:
            if ARTIFACTS not in path.parts and path.parent not in swept:
                read = read_mapping(path if path.name == PLAN else path.with_name(CONFIG))
                swept |= {path.parent / job["folder"] for job in read.get("jobs", ())}
                counts += _log(path.parent, outputs, read.get("values", read))
        except (MvestError, OSError, KeyError) as error:
            counts["left"] += _left_out(path, error)
    print(f"{outputs}: {counts['added']} runs added to MLflow, {counts['there']} were there")
    return int(counts["left"] > 0)


def _left_out(path: Path, error: Exception) -> int:
    tqdm.write(f"warning: {path} left out: {error}", file=sys.stderr)
    return 1


def _log(folder: Path, outputs: Path, config: Values) -> Counter[str]:
    """Log a run by itself, or a sweep as one run with its jobs below it; counts what was done."""
    counts, name, tracking = Counter[str](), str(config["name"]), config["tracking"]
    if not tracking["enabled"]:
        return counts
    is_sweep = (folder / PLAN).is_file()
    alone = [] if is_sweep else [{"folder": "", "overrides": _typed(folder), "factors": {}}]
    plan: dict[str, Any] = read_mapping(folder / PLAN) if is_sweep else {"jobs": alone}
    each = len(plan["jobs"]) <= MANY
    entries, rows, factors = [], [], []
    for job in plan["jobs"]:
        place = folder / job["folder"]
        try:
            if (place / RESULT).is_file():
                own = read_mapping(place / CONFIG)
                entries.append(_job(place, job.get("name")) if each else None)
                rows.append(settings_of(own, job["overrides"]))
                factors.append(job["factors"])
        except MvestError as error:
            counts["left"] += _left_out(place, error)
    with opened(tracking["uri"], outputs, name):
        known = runs_of(name, "" if is_sweep else f"tags.folder = '{folder.resolve().name}'")
        parent, shown = None, zip(entries, varied(rows, factors), strict=True)
        if is_sweep:
            parent, done = _put(_sweep(folder, plan), together(rows), known, None)
            counts[done] += 1
        for entry, row in tqdm(list(shown), "to MLflow", disable=None, leave=False):
            if entry is not None:
                counts[_put(entry, row, known, parent)[1]] += 1
    return counts


def _typed(folder: Path) -> list[str]:
    """What was typed for a run by itself."""
    place = folder / TYPED
    return list(map(str, OmegaConf.load(place))) if place.is_file() else []


def _job(folder: Path, name: str | None) -> Entry | None:
    """A job; None before all of it is on disk."""
    record = read_record(folder / RESULT)
    source, why = record.provenance, implausible(record)
    tags = {
        "config_hash": source.config_hash,
        "status": record.status,
        "reason": record.reason[:5000],  # as many letters as MLflow takes
        "verdict": next((one.verdict.trust for one in record.estimates if one.verdict), None),
        "plausible": f"no: {why}" if why else "yes",
        "mlflow.source.git.commit": source.git.sha,
    }
    entry = folder / RESULT, name or record.row, tags, metrics(record), record.seconds_total
    return entry if is_done(folder) or not record.converged else None


def _sweep(folder: Path, plan: Values) -> Entry:
    """A whole sweep, with its totals."""
    result, totals = folder / PLAN, {"jobs": float(len(plan["jobs"]))}
    name, tags = f"sweep of {len(plan['jobs'])} jobs", {"sweep_id": plan["sweep_id"]}
    if (folder / SWEEP).is_file():
        result, sweep = folder / SWEEP, read_sweep(folder / SWEEP)
        means = [one for record in sweep.records if (one := metrics(record).get("error.mean"))]
        totals = {"error.mean": fmean(means)} | totals if means else totals
        totals["failed"] = sum(not record.converged for record in sweep.records)
        totals["seconds"] = sum(record.seconds_total for record in sweep.records)
        tags["mlflow.source.git.commit"] = sweep.provenance.git.sha
    return result, name, tags, totals, totals.get("seconds", 0.0)


def _put(entry: Entry, row: Values, known: list[Any], parent: str | None) -> tuple[str, str]:
    """Bring one run to the state of an entry; its id, and whether it was added."""
    import mlflow

    result, name, tags, numbers, seconds = entry
    key, digest, client = next(iter(tags)), sha256_of(result), mlflow.MlflowClient()
    before = [run for run in known if run.data.tags.get(key) == tags[key]]
    same = [run for run in before if run.data.tags.get(WHOLE) == digest]
    texts = {key: text_of(value) for key, value in row.items() if value is not None}
    if same:
        run_id, data = same[0].info.run_id, same[0].data
        mlflow.log_params({k: v for k, v in texts.items() if k not in data.params}, run_id=run_id)
        if parent and data.tags.get(PARENT) != parent:
            client.set_tag(run_id, PARENT, parent)
            client.update_run(run_id, name=name)
    else:
        about = {"mlflow.source.name": "mvest run", "folder": result.resolve().parent.name, **tags}
        about = {key: value for key, value in about.items() if value is not None}
        with mlflow.start_run(run_name=name, parent_run_id=parent, tags=about) as run:
            mlflow.log_params(texts)
            mlflow.log_metrics(numbers, step=0)
            for path in sorted(path for name in FILES for path in result.parent.glob(name)):
                if path.name != PLAN and not path.name.startswith("."):
                    mlflow.log_artifact(str(path))
        # Its duration is that of the computation; the hash comes last and says that it is whole.
        run_id, end = run.info.run_id, run.info.start_time + int(1000 * seconds)
        ended = "FAILED" if tags.get("status") == "failed" else "FINISHED"
        client.set_terminated(run_id, ended, end)
        client.set_tag(run_id, WHOLE, digest)
    for old in before:
        if old.info.run_id != run_id:
            client.delete_run(old.info.run_id)
    return str(run_id), "there" if same else "added"


def runs_of(experiment: str, chosen: str) -> list[Any]:
    """The runs of an experiment in the open store that MLflow's filter chooses."""
    from mlflow import search_runs

    return list(search_runs(None, chosen, experiment_names=[experiment], output_format="list"))


def last_sweep(outputs: Path) -> tuple[str, str, str]:
    """Of the sweep that was planned last: its store, the path of its page, and a line on it.

    The page compares the runs with a plausible answer. It lists them where they are too many, and
    shows the sweep as a whole where there are none.

    Raises
    ------
    InputError
        If there is no sweep, or it has not been logged.
    """
    plans = sorted(outputs.glob(f"*/{PLAN}"), key=lambda path: path.stat().st_mtime)
    if not plans:
        raise InputError(f"{outputs} holds no sweep; run one, or name another folder")
    plan, sweep = read_mapping(plans[-1]), plans[-1].parent.name
    name = str(plan["values"]["name"])
    with opened(plan["values"]["tracking"]["uri"], outputs, name) as place:
        whole = runs_of(name, f"tags.sweep_id = '{plan['sweep_id']}'")
        if not whole:
            raise InputError(f"{sweep} is not in {place}; `mvest sync {outputs}` logs it")
        parent, experiment = whole[0].info.run_id, whole[0].info.experiment_id
        jobs = f"tags.`{PARENT}` = '{parent}'"
        chosen = f"{jobs} and tags.plausible = 'yes'"
        runs, count = [run.info.run_id for run in runs_of(name, chosen)], len(runs_of(name, jobs))
    page = f"/#/experiments/{experiment}/runs"
    if not runs:
        page += f"/{parent}"
    elif len(runs) > MOST:
        page += f"?searchFilter={quote(chosen)}"
    else:
        ids, experiments = (quote(json.dumps(some)) for some in (runs, [experiment]))
        page = f"/#/compare-runs?runs={ids}&experiments={experiments}&workflowType=machine_learning"
    left = f" ({count - len(runs)} failed or implausible)" if count > len(runs) else ""
    return place, page, f"{sweep}, {len(runs)} runs{left}"


@contextmanager
def serving(
    place: str, port: int, *, quiet: bool = False
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """MLflow's server, for this machine only: its address, and its process, which ends with this.

    Raises
    ------
    InputError
        If the port is taken, or the server does not start.
    """
    try:
        with socket.create_server(("127.0.0.1", port)) as probe:
            port = int(probe.getsockname()[1])
    except OSError as error:
        raise InputError(f"port {port} cannot be used ({error}); name one by --port") from error
    command = python("mlflow", "server", "--backend-store-uri", place)
    command += ["--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    command += ["--allowed-hosts", ",".join(hosts := allowed_hosts(port))]
    command += ["--cors-allowed-origins", ",".join("http://" + host for host in hosts)]
    # Whatever the login shell has set: nobody else is let in.
    own = {k: v for k, v in environment().items() if not k.startswith("MLFLOW_SERVER_")} | SERVED
    streams = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL if quiet else None)
    # uvicorn looks for modules in the folder that it is started in.
    with Program(command, stdin=subprocess.DEVNULL, env=own, cwd="/", **streams) as server:
        until = time.monotonic() + 120.0  # s
        while server.process.poll() is None and time.monotonic() < until:
            with suppress(OSError):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=2.0).close()
                break
            time.sleep(0.2)
        else:
            raise InputError(f"MLflow's server at port {port} did not start")
        yield "http://" + f"{HOST}:{port}", server.process


def allowed_hosts(port: int) -> list[str]:
    """The hosts that a request may name; MLflow's own list lets names like 10.evil.com in."""
    return [f"{host}:{port}" for host in (HOST, "127.0.0.1", "localhost", "[::1]")]
