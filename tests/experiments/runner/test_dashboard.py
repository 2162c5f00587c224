"""What a reader sees: MLflow's pages on a real sweep, in a real browser."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import screenshot
from mvest.errors import InputError
from tests.places import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def outputs(tmp_path_factory) -> Path:
    """A real sweep of four jobs."""
    place = tmp_path_factory.mktemp("sweep")
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    subprocess.run(
        [sys.executable, "-m", "experiments.run", "-m", "sweep=debug"],
        cwd=place, env=os.environ | {"PYTHONPATH": paths}, check=True, timeout=600,
    )  # fmt: skip
    return place / "outputs"


@pytest.fixture(scope="module")
def shown(outputs):
    """The server's address, what is compared, and the browser."""
    try:
        with screenshot.browser() as page, screenshot.served(outputs) as (address, compared):
            page.get(address)
            page.execute_script(screenshot.NO_ASSISTANT)
            yield page, address, compared
    except InputError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


def run_links(page) -> set[str]:
    return set(
        page.execute_script(
            "return [...document.querySelectorAll('a[href*=\"/runs/\"]')]"
            ".map(e => e.getAttribute('href').split('/runs/')[1].split(/[/?]/)[0])"
        )
    )


def jobs(outputs) -> int:
    return len(json.loads((outputs / "sweep_debug" / "plan.json").read_text())["jobs"])


def test_the_saved_view_shows_every_run_and_its_axes(shown, outputs) -> None:
    page, address, compared = shown
    page.get(compared.chart_page(address))
    names = [*compared.parameters, *compared.metrics]
    assert {"P0", "initial.anterior", "noise", "error.anterior", "seed"} <= set(names)
    screenshot.await_axes(page, names)
    assert run_links(page) == set(compared.runs)
    assert len(compared.runs) == jobs(outputs)
    assert page.execute_script(
        "return document.body.innerText.includes('Last sweep')"
        f" && document.body.innerText.includes('{len(compared.runs)} matching runs')"
    )
    # Numbers along the axes, not names: a setting that MLflow takes for text has no scale.
    ticks = page.execute_script(
        "return [...document.querySelectorAll('g.dimension')].map(axis =>"
        " [...axis.querySelectorAll('.tick text')].map(e => e.textContent))"
    )
    assert len(ticks) == len(names)
    for labels in ticks:
        assert labels
        assert all(float(label.replace("−", "-")) is not None for label in labels)


def test_the_page_that_compares_run_by_run_has_all_of_them(shown) -> None:
    page, address, compared = shown
    # Away from the other page, whose axes could be taken for this one's.
    page.get("about:blank")
    page.get(compared.compare_page(address))
    screenshot.await_axes(page, ["error.mean"])
    assert run_links(page) >= set(compared.runs)
    said = page.execute_script("return document.body.innerText")
    assert f"Comparing {len(compared.runs)} Runs" in said
    assert len(screenshot.axis_labels(page)) >= 3


def test_axes_that_are_not_there_are_missed(shown, monkeypatch) -> None:
    page, address, compared = shown
    monkeypatch.setattr(screenshot, "PATIENCE", 1.0)
    page.get(compared.chart_page(address))
    with pytest.raises(InputError, match="no axes nonsense"):
        screenshot.await_axes(page, ["nonsense"])


def test_the_picture_is_made(outputs, shown, tmp_path) -> None:
    assert screenshot.main([str(outputs), "--to", str(tmp_path / "page.png")]) == 0
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
