"""The dashboard: MLflow's comparison of a real sweep in a real browser, for this machine only."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from experiments.runner import tracking
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


def asked(address: str, *, host: str, origin: str) -> int:
    """Status of the answer to a request for data, as a page of another origin would send it."""
    headers = {"Host": host, "Content-Type": "application/json", "Origin": origin}
    body = b'{"max_results": 1}'
    wanted = urllib.request.Request(f"{address}/api/2.0/mlflow/experiments/search", body, headers)
    try:
        with urllib.request.urlopen(wanted, timeout=30.0) as answer:
            return answer.status
    except urllib.error.HTTPError as refused:
        return refused.code


def test_only_its_own_page_is_answered(outputs, monkeypatch) -> None:
    # The settings of the login shell do not count.
    monkeypatch.setenv("MLFLOW_SERVER_ALLOWED_HOSTS", "*")
    monkeypatch.setenv("MLFLOW_SERVER_CORS_ALLOWED_ORIGINS", "*")
    with tracking.serving(tracking.last_sweep(outputs)[0], 0, quiet=True) as (at, _):
        address = at.replace(tracking.HOST, "127.0.0.1")
        host = address.removeprefix("http://")
        assert asked(address, host=host, origin=address) == 200
        assert asked(address, host="192.168.evil.com", origin=address) == 403
        assert asked(address, host=host, origin="http://evil.com") == 403


@pytest.mark.parametrize(("end", "status"), [(signal.SIGINT, 0), (signal.SIGKILL, -9)])
def test_a_stopped_dashboard_leaves_no_server_behind(outputs, tmp_path, end, status) -> None:
    def listening() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = ("-m", "experiments.cli", "dashboard", str(outputs), "--port", str(port))
    environment = os.environ | {"PYTHONPATH": PATHS, "BROWSER": "true"}
    shown = subprocess.Popen([sys.executable, *command], cwd=tmp_path, env=environment)
    try:
        while not listening():
            assert shown.poll() is None
            time.sleep(0.1)
        shown.send_signal(end)
        assert shown.wait(timeout=60) == status
    finally:
        shown.kill()
        shown.wait()
    until(lambda: not listening(), 5.0)
