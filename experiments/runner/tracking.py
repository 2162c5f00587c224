"""MLflow: logging of runs and sweeps (``mvest sync``), and its pages (``mvest dashboard``).

A run of the store with the same result stays, one with another result is replaced, and a missing
one is added. The store's database is made once.
"""

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
import webbrowser
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

from filelock import FileLock
from omegaconf import OmegaConf

from experiments.common.progress import PartBar, say
from experiments.common.records.record import read_record
from experiments.common.schema import Values, validated
from experiments.runner.jobs import CONFIG, RESULT, is_done
from experiments.runner.metrics import implausible, metrics, settings_of
from experiments.runner.plan import PLAN
from experiments.sweeps.collected import read_sweep
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.files import sha256_of
from mvest.processes import Program, environment, python
from mvest.quantities import within
from mvest.reading.documents import read_mapping

# Files: the results of a sweep; the overrides of a run.
SWEEP, TYPED = "sweep.json", ".hydra/overrides.yaml"
# Files that MLflow keeps a copy of.
FILES = ("*.json", "*.png", "*.svg", "*.csv", "*.md", "*.html", "*.parquet")
MANY = 1000  # a sweep with more jobs is one run of MLflow, without runs for its jobs
# Tags: the sweep's run of a job; the hash of the result, set when a run is logged completely.
PARENT, WHOLE = "mlflow.parentRunId", "result_hash"

MANNERS = {
    # Give up on an unreachable server after seconds, not minutes.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}
"""Default settings of MLflow; its server inherits them."""

# Folder of MLflow's copies in the outputs; beginning of a local database's address.
ARTIFACTS, SQLITE = "mlartifacts", "sqlite:///"
# Messages of SQLite and MLflow about a file that is no database, damaged, or incomplete.
BROKEN = re.compile(r"malformed|not a database|no such (table|column)|out-of-date database schema")
MOST = 100  # largest number of runs on MLflow's page of comparison, which reads them one by one

SERVED = MANNERS | {
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_ENABLE_ASSISTANT_SANDBOX": "true",
    "MLFLOW_ENABLE_REMOTE_ASSISTANT": "false",
    "PYTHONSAFEPATH": "1",
}
"""Environment of the server: no telemetry, no jobs, no assistant, no modules of the folder."""

HOST = "mvest.localhost"
"""A name of this machine at which MLflow's pages do not open their assistant."""


class TrackingError(MvestError):
    """The store cannot be opened or written."""


def require_no_password(uri: str | None) -> None:
    """Raise a `ConfigurationError` for an address with a password."""
    if uri is not None and re.search(r"://[^/@:]*:[^/@]+@", uri):
        raise ConfigurationError(
            "tracking.uri holds a password, which would be written into every config.json; leave "
            "it out and put it in ~/.pgpass or MLFLOW_TRACKING_PASSWORD"
        )


@contextmanager
def opened(uri: str | None, outputs: Path, experiment: str) -> Iterator[str]:
    """Point MLflow at a store and an experiment, which are made if missing; yields the address.

    Raises a `TrackingError` if the store cannot be opened, or a write in the context fails: one
    line that names it.
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
        # Processes that open a new SQLite database at the same time would break it.
        with FileLock(outputs / ".mlflow.lock"):
            if is_local and file.exists() and file.stat().st_size:
                # With a broken one MLflow would retry for minutes.
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
    """Log a run or a sweep; if the store fails, print a warning: every result is on disk."""
    outputs = Path(config["paths"]["outputs"])
    try:
        if (folder / RESULT).is_file() or (folder / PLAN).is_file():
            _log(folder, outputs, config)
    except (MvestError, OSError) as error:
        remedy = f"every result is on disk, and `mvest sync {outputs}` logs what is missing"
        print(f"warning: {error}; {remedy}", file=sys.stderr)


def sync(outputs: Path) -> int:
    """Log everything in a folder of outputs that its store lacks; 1 if a file was unreadable."""
    if not outputs.is_dir():
        raise InputError(f"{outputs}: there is no such folder")
    counts, swept = Counter[str](), set[Path]()
    for path in [*sorted(outputs.rglob(PLAN)), *sorted(outputs.rglob(RESULT))]:
        try:
            if ARTIFACTS not in path.parts and path.parent not in swept:
                read = read_mapping(path if path.name == PLAN else path.with_name(CONFIG))
                swept |= {path.parent / job["folder"] for job in read.get("jobs", ())}
                counts += _log(path.parent, outputs, read.get("values", read))
        except (MvestError, OSError, KeyError) as error:
            say(f"warning: {path} left out: {error}")
            counts["left"] += 1
    print(f"{outputs}: {counts['added']} runs added to MLflow, {counts['there']} were there")
    return int(counts["left"] > 0)


class Entry(NamedTuple):
    """A run for MLflow."""

    result: Path
    name: str
    tags: Values  # the first one identifies the run
    settings: Values
    numbers: dict[str, float]
    seconds: float  # of its computation


def _log(folder: Path, outputs: Path, config: Values) -> Counter[str]:
    """Log a single run, or a sweep as a run with its jobs as children; counts them."""
    counts, name, tracking = Counter[str](), str(config["name"]), config["tracking"]
    if not tracking["enabled"]:
        return counts
    plan: Any = read_mapping(folder / PLAN) if (folder / PLAN).is_file() else None
    typed = list(map(str, OmegaConf.load(folder / TYPED))) if (folder / TYPED).is_file() else []
    jobs: Any = plan["jobs"] if plan else [{"folder": "", "overrides": typed}]
    shown = jobs if len(jobs) <= MANY else []
    with (
        PartBar(f"{name}, to MLflow", len(shown), "run", quiet=True) as bar,
        opened(tracking["uri"], outputs, name),
    ):
        known = runs_of(name, "" if plan else f"tags.folder = '{folder.resolve().name}'")
        parent = None
        if plan:
            parent, done = _put(_sweep(folder, plan), known, None)
            counts[done] += 1
        for job in shown:
            bar.step()
            place = folder / job["folder"]
            try:
                if (place / RESULT).is_file() and (entry := _job(place, job)):
                    counts[_put(entry, known, parent)[1]] += 1
            except (MvestError, KeyError) as error:
                say(f"warning: {place} left out: {error}")
                counts["left"] += 1
    return counts


def _job(folder: Path, job: Values) -> Entry | None:
    """A job or single run; None while a file of it is missing."""
    record = read_record(folder / RESULT)
    if record.converged and not is_done(folder):
        return None
    source, why = record.provenance, implausible(record)
    tags = {
        "config_hash": source.config_hash,
        "status": record.status,
        "reason": record.reason[:5000],  # as many letters as MLflow takes
        "verdict": next((one.verdict.trust for one in record.estimates if one.verdict), None),
        "plausible": f"no: {why}" if why else "yes",
        "mlflow.source.git.commit": source.git.sha,
    }
    config = read_mapping(folder / CONFIG)
    settings = settings_of(config, job["overrides"], job.get("factors", {}))
    name = job.get("name") or record.row
    return Entry(folder / RESULT, name, tags, settings, metrics(record), record.seconds_total)


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
    return Entry(result, name, tags, {}, totals, totals.get("seconds", 0.0))


def _put(entry: Entry, known: list[Any], parent: str | None) -> tuple[str, str]:
    """Bring one run to the state of an entry; its id, and whether it was added."""
    import mlflow

    tags, digest, client = entry.tags, sha256_of(entry.result), mlflow.MlflowClient()
    key = next(iter(tags))
    before = [run for run in known if run.data.tags.get(key) == tags[key]]
    same = [run for run in before if run.data.tags.get(WHOLE) == digest]
    if same:
        run_id = same[0].info.run_id
        if parent and same[0].data.tags.get(PARENT) != parent:
            client.set_tag(run_id, PARENT, parent)
            client.update_run(run_id, name=entry.name)
    else:
        folder = entry.result.resolve().parent
        about = {"mlflow.source.name": "mvest run", "folder": folder.name, **tags}
        about = {key: value for key, value in about.items() if value is not None}
        with mlflow.start_run(run_name=entry.name, parent_run_id=parent, tags=about) as run:
            mlflow.log_params(entry.settings)
            mlflow.log_metrics(entry.numbers, step=0)
            for path in sorted(path for name in FILES for path in folder.glob(name)):
                if path.name != PLAN and not path.name.startswith("."):
                    mlflow.log_artifact(str(path))
        # Its duration is that of the computation. The hash comes last: the run is complete.
        run_id, end = run.info.run_id, run.info.start_time + int(1000 * entry.seconds)
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


def dashboard(outputs: Path, port: int) -> int:
    """Show the last sweep in MLflow's pages until interrupted; port 0 is any free one."""
    validated(Annotated[int, within(0, 65_535, "", "ports; 0: a free one")], port, "--port")
    try:
        place, page, title = last_sweep(outputs)
        with serving(place, port) as (address, server):
            print(f"{title}: {address}{page}", flush=True)
            webbrowser.open(address + page)
            return server.wait()
    except KeyboardInterrupt:
        return 0


def last_sweep(outputs: Path) -> tuple[str, str, str]:
    """Store of the sweep that was planned last, the path of its page, and a line about it.

    The page compares the plausible runs. It lists them if there are too many to compare, and shows
    the sweep as a whole if there are none.

    Raises an `InputError` if there is no sweep, or it has not been logged.
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
        jobs = runs_of(name, f"tags.`{PARENT}` = '{parent}'")
    runs = [run.info.run_id for run in jobs if run.data.tags.get("plausible") == "yes"]
    page = f"/#/experiments/{experiment}/runs"
    if not runs:
        page += f"/{parent}"
    elif len(runs) > MOST:
        chosen = f"tags.`{PARENT}` = '{parent}' and tags.plausible = 'yes'"
        page += f"?searchFilter={quote(chosen)}"
    else:
        ids, experiments = (quote(json.dumps(some)) for some in (runs, [experiment]))
        page = f"/#/compare-runs?runs={ids}&experiments={experiments}&workflowType=machine_learning"
    left = f" ({len(jobs) - len(runs)} failed or implausible)" if len(jobs) > len(runs) else ""
    return place, page, f"{sweep}, {len(runs)} runs{left}"


@contextmanager
def serving(
    place: str, port: int, *, quiet: bool = False
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run MLflow's server for this machine only; yields its address and its process.

    Raises an `InputError` if the port is taken, or the server does not start.
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
    # Settings of the login shell must not let others in.
    own = {k: v for k, v in environment().items() if not k.startswith("MLFLOW_SERVER_")} | SERVED
    streams = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL if quiet else None)
    # uvicorn looks for modules in its working folder.
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
    """The hosts that a request may name; MLflow's own list admits names like 10.evil.com."""
    return [f"{host}:{port}" for host in (HOST, "127.0.0.1", "localhost", "[::1]")]
