"""MLflow's pages on the last sweep: ``python -m experiments.dashboard [OUTPUTS] [--port N]``.

The last sweep is kept in its experiment as a saved view, "Last sweep", with parallel coordinates
over what was varied and the errors. MLflow 3 stores saved views as tags of the experiment; the
format is that of its pages, which read it back from ``viewStateShareKey`` in their address.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from experiments.runner.comparison import axes
from experiments.runner.tracking import RECEIPT, Store, open_store, read_json, telling
from experiments.sync import LAST_SWEEP, jobs_in
from mvest.errors import InputError, MvestError

__all__ = ["Comparison", "command", "main", "save_comparison", "wait_for"]

VIEW = "last_sweep"
"""Key of the saved view, the same for every sweep of an experiment."""

SAVED_VIEW = "mlflow.sharedViewState."
"""Tags of an experiment in which MLflow's pages keep saved views begin so."""

MOST_COMPARED = 100
"""Most runs whose ids fit the address of MLflow's own comparison page."""

PATIENCE = 60.0
"""Seconds within which the server must answer."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """A sweep as it is compared.

    Attributes
    ----------
    experiment : str
        Id of the experiment.
    sweep_id : str
    runs : tuple of str
        Ids of its runs.
    parameters, metrics : tuple of str
        Axes of the parallel coordinates.
    """

    experiment: str
    sweep_id: str
    runs: tuple[str, ...]
    parameters: tuple[str, ...]
    metrics: tuple[str, ...]

    def chart_page(self, server: str) -> str:
        """Address of the charts of the saved view."""
        return (
            f"{server}/#/experiments/{self.experiment}/runs"
            f"?viewStateShareKey={VIEW}&compareRunsMode=CHART&workflowType=machine_learning"
        )

    def compare_page(self, server: str) -> str:
        """Address of MLflow's page that compares runs one by one."""
        runs = json.dumps(list(self.runs[:MOST_COMPARED]), separators=(",", ":"))
        experiments = json.dumps([self.experiment])
        return (
            f"{server}/#/compare-runs?runs={quote(runs)}&experiments={quote(experiments)}"
            "&workflowType=machine_learning"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Save the comparison of the last sweep and serve MLflow's pages until interrupted."""
    parser = argparse.ArgumentParser(prog="experiments.dashboard", description=__doc__)
    parser.add_argument("outputs", nargs="?", default="outputs", type=Path)
    parser.add_argument("--port", default=5000, type=int)
    given = parser.parse_args(arguments)
    try:
        store, comparison = save_comparison(given.outputs)
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        with subprocess.Popen(command(store.place, given.outputs, given.port)) as server:
            address = f"http://127.0.0.1:{given.port}"
            try:
                wait_for(address, server)
                page = comparison.chart_page(address)
                print(f"last sweep, {len(comparison.runs)} runs: {page}")
                print(f"run by run: {comparison.compare_page(address)}", flush=True)
                webbrowser.open(page)
                return server.wait()
            finally:
                server.terminate()
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


def save_comparison(outputs: Path) -> tuple[Store, Comparison]:
    """Save the view of the last sweep in its experiment, replacing the one before.

    Raises
    ------
    InputError
        If there is no sweep, or none of its runs has been uploaded.
    TrackingError
        If the store cannot be read or written.
    """
    folder = last_sweep(outputs)
    sweep = read_json(folder / LAST_SWEEP)
    config = read_json(folder / sweep["jobs"][0] / "config.json")
    store = open_store(config["tracking"]["uri"], outputs, str(config["name"]))
    runs = [
        run
        for run in store.list_runs()
        if run.data.tags.get("sweep_id") == sweep["sweep_id"] and run.info.status != "RUNNING"
    ]
    if not runs:
        raise InputError(f"no run of {sweep['sweep_id']} is in {store.place}: try `make sync`")
    done = [run for run in runs if run.data.tags.get("status") == "converged"] or runs
    parameters, metrics = axes([(run.data.params, run.data.metrics) for run in done])
    comparison = Comparison(
        store.experiment,
        str(sweep["sweep_id"]),
        tuple(run.info.run_id for run in runs),
        tuple(parameters),
        tuple(metrics),
    )
    now = int(1000 * time.time())
    saved = {
        "name": "Last sweep",
        "createdAt": now,
        "updatedAt": now,
        "state": json.dumps(view_state(comparison)),
    }
    with telling(store.place):
        store.client.set_experiment_tag(store.experiment, SAVED_VIEW + VIEW, json.dumps(saved))
    left = [job for job in jobs_in(folder) if not (job / RECEIPT).is_file()]
    if left:
        print(f"warning: {len(left)} results are not uploaded; `make sync`", file=sys.stderr)
    return store, comparison


def last_sweep(outputs: Path) -> Path:
    """The folder of the experiment whose sweep was started last.

    Raises
    ------
    InputError
        If there is none.
    """
    found = [
        (read_json(path)["began"], path.parent)
        for path in outputs.glob(f"*/{LAST_SWEEP}")
        if read_json(path)["jobs"]
    ]
    if not found:
        raise InputError(f"{outputs} holds no finished sweep; run one, or name another folder")
    return max(found)[1]


def view_state(comparison: Comparison) -> dict[str, Any]:
    """What MLflow's pages call the state of a view: which runs, columns and charts."""
    parameters, metrics = list(comparison.parameters), list(comparison.metrics)
    section = {"display": True, "isReordered": True, "deleted": False, "isGenerated": False}
    card = {"metricSectionId": VIEW, "deleted": False, "isGenerated": False}
    charts: list[dict[str, Any]] = [
        {
            **card,
            "uuid": "coordinates",
            "type": "PARALLEL",
            "displayName": "Settings and errors (%)",
            "selectedParams": parameters,
            "selectedMetrics": metrics,
            "showAllRuns": False,
        }
    ]
    columns = [f"params.`{name}`" for name in parameters]
    columns += [f"metrics.`{name}`" for name in metrics]
    return {
        "searchFilter": f'tags.sweep_id = "{comparison.sweep_id}"',
        "orderByKey": f"metrics.`{metrics[-1]}`" if metrics else "attributes.start_time",
        "orderByAsc": True,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "datasetsFilter": [],
        "selectedColumns": columns,
        "runsHiddenMode": "SHOW_ALL",
        "compareRunCharts": charts,
        "compareRunSections": [
            {"uuid": VIEW, "name": "Last sweep", "columns": 1, "cardHeight": 460, **section}
        ],
        "isAccordionReordered": True,
        "hideEmptyCharts": True,
        "groupBy": None,
    }


def command(place: str, outputs: Path, port: int) -> list[str]:
    """The command that serves MLflow's pages on this machine only.

    Raises
    ------
    InputError
        If the port is taken.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise InputError(
                f"port {port} is taken ({error.strerror}); name another one with --port"
            ) from error
    artifacts = (outputs.resolve() / "mlartifacts").as_uri()
    return [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", place,
        "--default-artifact-root", artifacts, "--host", "127.0.0.1", "--port", str(port),
        "--workers", "1",
    ]  # fmt: skip


def wait_for(address: str, server: subprocess.Popen[bytes]) -> None:
    """Wait until the server answers.

    Raises
    ------
    InputError
        If it ends or is silent for too long.
    """
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and server.poll() is None:
        try:
            with urllib.request.urlopen(f"{address}/health", timeout=2.0):
                return
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
    raise InputError(f"MLflow's server at {address} did not start")


if __name__ == "__main__":
    sys.exit(main())
