"""What a reader sees: MLflow's pages on a real sweep, in a real browser; and how they end."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import pytest

from experiments.runner import tracking
from mvest.errors import InputError
from tests.experiments.runner import screenshot
from tests.places import ROOT
from tests.processes import until

pytestmark = pytest.mark.slow

PATHS = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> Path:
    """A real sweep of four jobs."""
    place = tmp_path_factory.mktemp("sweep")
    subprocess.run(
        [sys.executable, "-m", "experiments.run", "-m", "sweep=debug"],
        cwd=place, env=os.environ | {"PYTHONPATH": PATHS}, check=True, timeout=600,
    )  # fmt: skip
    return place / "outputs"


@pytest.fixture(scope="module")
def shown(outputs) -> str:
    """The comparison's page as it is drawn."""
    place, page, _ = tracking.last_sweep(outputs)
    try:
        with tracking.serving(place, 0, quiet=True) as (address, _):
            return screenshot.look_at(address + page, "--dump-dom")
    except InputError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


def test_the_page_compares_every_run_and_calls_it_by_what_differs(shown, outputs) -> None:
    jobs = json.loads((outputs / "sweep_debug" / "plan.json").read_text())["jobs"]
    assert f"Comparing {len(jobs)} Runs" in shown
    runs = re.findall(r"[0-9a-f]{32}", unquote(tracking.last_sweep(outputs)[1]))
    assert set(re.findall(r"/runs/([0-9a-f]{32})", shown)) == set(runs)
    assert len(runs) == len(jobs) == 4
    for job in jobs:
        assert job["name"] in shown
        assert job["hash"] not in job["name"]


@pytest.fixture(scope="module")
def address(outputs) -> Iterator[str]:
    """Of a server on the sweep, whatever the login shell says of whom to answer."""
    place, _, _ = tracking.last_sweep(outputs)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MLFLOW_SERVER_ALLOWED_HOSTS", "*")
        patch.setenv("MLFLOW_SERVER_CORS_ALLOWED_ORIGINS", "*")
        patch.setenv("MLFLOW_SERVER_DISABLE_SECURITY_MIDDLEWARE", "true")
        with tracking.serving(place, 0, quiet=True) as (at, _):
            yield at.replace(tracking.HOST, "127.0.0.1")


def asked(address: str, *, host: str, origin: str = "", path: str = "experiments/search") -> int:
    """Status of the answer to a request for data, as a page of another origin would send it."""
    headers = {"Host": host, "Content-Type": "application/json"}
    headers |= {"Origin": origin} if origin else {}
    body = b'{"max_results": 1}'
    wanted = urllib.request.Request(f"{address}/api/2.0/mlflow/{path}", body, headers)
    try:
        with urllib.request.urlopen(wanted, timeout=30.0) as answer:
            return answer.status
    except urllib.error.HTTPError as refused:
        return refused.code


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("", "its own", 200),
        # `test_hosts` has more names.
        ("192.168.evil.com", "", 403),
        ("", "http://evil.com", 403),
        ("", "null", 403),
    ],
)
def test_only_its_own_page_is_answered(address, host, origin, status) -> None:
    host = host or address.removeprefix("http://")
    assert asked(address, host=host, origin=origin.replace("its own", address)) == status


def listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.parametrize(
    ("end", "status"),
    [(signal.SIGINT, 0), (signal.SIGKILL, -9)],
)
def test_a_stopped_dashboard_leaves_no_server_behind(outputs, tmp_path, end, status) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = ("-m", "experiments.cli", "dashboard", str(outputs), "--port", str(port))
    with (tmp_path / "said").open("w") as said:
        shown = subprocess.Popen(
            [sys.executable, *command],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": PATHS, "BROWSER": "true"},
            stdout=said,
            stderr=said,
        )
    try:
        while not listening(port):
            assert shown.poll() is None, (tmp_path / "said").read_text()
            time.sleep(0.1)
        shown.send_signal(end)
        assert shown.wait(timeout=60) == status
    finally:
        shown.kill()
        shown.wait()
    until(lambda: not listening(port), 5.0)
