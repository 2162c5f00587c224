"""MLflow's pages: ``mvest dashboard``, on the comparison of the last sweep's runs."""

from __future__ import annotations

import json
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from experiments.runner.plan import PLAN
from experiments.runner.tracking import MANNERS, PARENT, opened, runs_of
from mvest.errors import InputError
from mvest.processes import Program, environment, python
from mvest.reading.documents import read_mapping

MOST = 100  # runs on MLflow's page of comparison, which reads them one by one

SERVED = MANNERS | {
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_ENABLE_ASSISTANT_SANDBOX": "true",
    "MLFLOW_ENABLE_REMOTE_ASSISTANT": "false",
    "PYTHONSAFEPATH": "1",
}
"""Environment of the server: no telemetry, no jobs, no assistant, no module of a case's folder."""

HOST = "mvest.localhost"
"""This machine, by a name at which MLflow's pages do not open their assistant."""


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
    kept = {k: v for k, v in environment().items() if not k.startswith("MLFLOW_SERVER_")} | SERVED
    streams = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL if quiet else None)
    # uvicorn looks for modules in the folder that it is started in.
    with Program(command, stdin=subprocess.DEVNULL, env=kept, cwd="/", **streams) as server:
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
