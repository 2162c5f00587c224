"""MLflow's pages on the last sweep: ``mvest dashboard``.

They open on MLflow's own comparison of runs, at the address that its button "Compare" leads to. It
draws parallel coordinates over the settings in which the runs differ and the first number that they
have in common, the mean error.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import time
import urllib.request
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from experiments.common.schema import require_within
from experiments.runner.jobs.interruption import raised
from experiments.runner.planning.plan import PLAN
from experiments.runner.tracking.store import open_store
from experiments.runner.tracking.summary import IS_SWEEP
from experiments.runner.tracking.sync import jobs_in
from mvest.errors import InputError, MvestError
from mvest.processes import ROOT, Program, environment, python
from mvest.quantities import within
from mvest.reading.documents import read_mapping

MAX_COMPARED = 100
"""Runs that MLflow's comparison of runs can show: it reads them one by one."""

PATIENCE = 600.0
"""Seconds within which a server that lives must answer; making a database can take minutes."""

SAY = 10.0
"""Seconds between two lines about a server that does not answer yet."""

HOSTS = ("127.0.0.1", "localhost", "[::1]")
"""This machine, in a browser's words."""

HTTP_PORT = 80
"""The port that browsers leave out."""

WIDER = "MLFLOW_SERVER_"
"""Beginning of the environment variables that change whom MLflow's server answers."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The runs of a sweep.

    Attributes
    ----------
    place : str
        Address of the store.
    experiment : str
        Id of the experiment.
    sweep_id : str
    runs : tuple of str
        Ids of its runs.
    summary : str
        Id of the run that stands for the whole sweep; empty if there is none.
    """

    place: str
    experiment: str
    sweep_id: str
    runs: tuple[str, ...]
    summary: str = ""

    def page(self, server: str) -> str:
        """Address of the page that compares the runs, or lists them where they are too many."""
        if not self.runs:
            return f"{server}/#/experiments/{self.experiment}/runs/{self.summary}"
        if len(self.runs) > MAX_COMPARED:
            chosen = quote(f'tags.sweep_id = "{self.sweep_id}"')
            return f"{server}/#/experiments/{self.experiment}/runs?searchFilter={chosen}"
        runs = json.dumps(self.runs, separators=(",", ":"))
        experiments = json.dumps([self.experiment])
        return (
            f"{server}/#/compare-runs?runs={quote(runs)}&experiments={quote(experiments)}"
            "&workflowType=machine_learning"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve MLflow's pages on the last sweep until interrupted."""
    parser = argparse.ArgumentParser(prog="mvest dashboard", description=__doc__)
    parser.add_argument("outputs", nargs="?", default="outputs", type=Path)
    parser.add_argument("--port", default=5000, type=int)
    given = parser.parse_args(arguments)
    try:
        require_within("--port", given.port, within(0, 65_535, "", "ports; 0: a free one"))
        comparison = last_comparison(given.outputs)
        with raised(), serving(comparison.place, given.outputs, given.port) as (address, server):
            page = comparison.page(address)
            print(f"last sweep, {len(comparison.runs)} runs: {page}", flush=True)
            webbrowser.open(page)
            return server.wait()
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


def last_comparison(outputs: Path) -> Comparison:
    """The runs of the sweep that was started last.

    Raises
    ------
    InputError
        If there is no sweep, or none of its runs has been logged.
    TrackingError
        If the store cannot be read.
    """
    plans = [(read_mapping(path), path.parent) for path in outputs.glob(f"*/{PLAN}")]
    for plan, folder in sorted(plans, key=lambda one: str(one[0]["created"]), reverse=True):
        names = {Path(job["folder"]).name for job in plan["jobs"]}
        jobs = [job for job in jobs_in(folder) if job.name in names]
        if not jobs:
            continue
        config = read_mapping(jobs[0] / "config.json")
        store = open_store(config["tracking"]["uri"], outputs, str(config["name"]))
        of_sweep = [
            run
            for run in store.list_runs()
            if run.data.tags.get("sweep_id") == plan.get("sweep_id")
            and run.info.status != "RUNNING"
        ]
        whole = [run.info.run_id for run in of_sweep if run.data.tags.get("kind") == IS_SWEEP]
        runs = [run.info.run_id for run in of_sweep if run.info.run_id not in whole]
        if not of_sweep:
            raise InputError(f"no run of {folder} is in {store.place}: try `make sync`")
        if len(runs) < len(jobs) and (runs or not whole):
            left = len(jobs) - len(runs)
            print(f"warning: {left} results are not in MLflow; `make sync`", file=sys.stderr)
        return Comparison(
            store.place, store.experiment, str(plan["sweep_id"]), tuple(runs), "".join(whole[:1])
        )
    raise InputError(f"{outputs} holds no finished sweep; run one, or name another folder")


@contextmanager
def serving(
    place: str, outputs: Path, port: int, *, quiet: bool = False
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """MLflow's pages on this machine only: their address, and the server, which ends with this.

    Raises
    ------
    InputError
        If the port is taken, or the server ends or is silent for too long.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise InputError(
                f"port {port} is taken ({error.strerror}); name another one with --port"
            ) from error
        port = int(probe.getsockname()[1])
    command = [
        *python("mlflow", "server"), "--backend-store-uri", place,
        "--default-artifact-root", (outputs.resolve() / "mlartifacts").as_uri(),
        "--host", HOSTS[0], "--port", str(port), "--workers", "1",
        "--allowed-hosts", ",".join(allowed_hosts(port)),
    ]  # fmt: skip
    # Whatever the login shell has set: nobody else is let in.
    # MLflow starts Python again, without -P, and uvicorn there would add the working folder.
    given = environment(PYTHONSAFEPATH="1", UVICORN_APP_DIR=str(ROOT))
    kept = {name: value for name, value in given.items() if not name.startswith(WIDER)}
    out = subprocess.DEVNULL if quiet else None
    with Program(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=kept) as server:
        _await(f"http://127.0.0.1:{port}", server.process)
        yield f"http://127.0.0.1:{port}", server.process


def allowed_hosts(port: int) -> list[str]:
    """The hosts that a request may name: a page of any other, led here by its name, reads nothing.

    MLflow's own list lets names like 192.168.evil.com in.
    """
    return [f"{host}:{port}" for host in HOSTS] + (list(HOSTS) if port == HTTP_PORT else [])


def _await(address: str, server: subprocess.Popen[bytes]) -> None:
    """Wait until the server answers, and say so while it does not."""
    began = said = time.monotonic()
    while server.poll() is None and (now := time.monotonic()) < began + PATIENCE:
        with suppress(OSError), urllib.request.urlopen(f"{address}/health", timeout=2.0):
            return
        if now > said + SAY:
            said = now
            print(f"MLflow's server is starting, {now - began:.0f} s so far", file=sys.stderr)
        time.sleep(0.2)
    raise InputError(f"MLflow's server at {address} did not start")


if __name__ == "__main__":
    sys.exit(main())
