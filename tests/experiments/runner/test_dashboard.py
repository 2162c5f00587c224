"""What a reader sees: MLflow's pages on a real sweep, in a real browser; and how they end."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.runner import dashboard, screenshot
from mvest.errors import InputError
from tests.places import ROOT

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
    compared = dashboard.last_comparison(outputs)
    try:
        with dashboard.serving(compared.place, outputs, 0, quiet=True) as (address, _):
            return screenshot.look_at(compared.page(address), "--dump-dom")
    except InputError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


def test_the_page_compares_every_run_and_calls_it_by_what_differs(shown, outputs) -> None:
    jobs = json.loads((outputs / "sweep_debug" / "plan.json").read_text())["jobs"]
    assert f"Comparing {len(jobs)} Runs" in shown
    runs = set(dashboard.last_comparison(outputs).runs)
    assert set(re.findall(r"/runs/([0-9a-f]{32})", shown)) == runs
    assert len(runs) == len(jobs) == 4
    for job in jobs:
        assert job["name"] in shown
        assert job["hash"] not in job["name"]


def test_its_axes_are_settings_that_differ_and_the_error(shown) -> None:
    axes = re.findall(r'class="axis-title"[^>]*>([^<]*)<', shown)
    # P0 and the noise are the same in all of them: they have no axis.
    assert axes == ["initial.anterior", "initial.posterior", "seed", "error.mean"]
    # Numbers along the axes, not names: a setting that MLflow takes for text has no scale.
    ticks = [text.replace("−", "-") for text in re.findall(r"<text[^>]*>([\d.−-]+)</text>", shown)]
    assert {5.0, 4.0, 3.0, 2.0, 1.0} <= {float(tick) for tick in ticks}


def test_the_picture_is_made(outputs, shown, tmp_path) -> None:
    assert screenshot.main([str(outputs), "--to", str(tmp_path / "page.png")]) == 0
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")


def listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_stopped_dashboard_leaves_no_server_behind(outputs, tmp_path, end) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = ("-m", "experiments.runner.dashboard", str(outputs), "--port", str(port))
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
        assert shown.wait(timeout=60) == 0
    finally:
        shown.kill()
        shown.wait()
    assert not listening(port)


def test_a_server_that_ends_is_not_waited_for(outputs) -> None:
    with (
        pytest.raises(InputError, match="did not start"),
        dashboard.serving("nonsense://place", outputs, 0, quiet=True),
    ):
        pytest.fail("it cannot serve this")
