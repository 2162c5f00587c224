"""A picture of the dashboard: ``python -m experiments.screenshot [OUTPUTS] [--to FILE]``.

Needs the extra ``browser``, and Chromium with its driver (Debian: ``apt install chromium
chromium-driver``).
"""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.dashboard import Comparison, command, save_comparison, wait_for
from mvest.errors import InputError, MvestError

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

__all__ = ["await_axes", "axis_labels", "browser", "main", "served"]

WINDOW = (1600, 970)
"""Pixels."""

PATIENCE = 60.0
"""Seconds in which a page must have drawn itself."""

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars",
)  # fmt: skip
"""Chromium as a program that speaks to nobody but the page it is shown."""

AXIS_TITLES = "g.dimension text.label, text.axis-title"
"""Where the saved view and MLflow's own comparison write what an axis stands for."""

NO_ASSISTANT = "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true')"
"""A new profile is otherwise greeted by a panel that covers a third of the page."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the picture of the last sweep's comparison; returns the exit status."""
    parser = argparse.ArgumentParser(prog="experiments.screenshot", description=__doc__)
    parser.add_argument("outputs", nargs="?", default="outputs", type=Path)
    parser.add_argument("--to", default=Path("results/dashboard.png"), type=Path)
    given = parser.parse_args(arguments)
    try:
        with served(given.outputs) as (address, comparison), browser() as page:
            page.get(address)
            page.execute_script(NO_ASSISTANT)
            page.get(comparison.chart_page(address))
            await_axes(page, [*comparison.parameters, *comparison.metrics])
            page.save_screenshot(str(given.to))
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(given.to)
    return 0


@contextmanager
def served(outputs: Path) -> Iterator[tuple[str, Comparison]]:
    """MLflow's pages on the last sweep at some free port: their address, and the comparison.

    Raises
    ------
    MvestError
        If there is no sweep or the server does not start.
    """
    store, comparison = save_comparison(outputs)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    address = f"http://127.0.0.1:{port}"
    with subprocess.Popen(
        command(store.place, outputs, port), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as server:
        try:
            wait_for(address, server)
            yield address, comparison
        finally:
            server.terminate()


@contextmanager
def browser() -> Iterator[Chrome]:
    """Headless Chromium with a profile of its own.

    Raises
    ------
    InputError
        If Chromium, its driver or Selenium is not installed.
    """
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        raise InputError("Chromium is not installed (Debian: apt install chromium chromium-driver)")
    try:
        from selenium import webdriver
    except ImportError as error:
        raise InputError("Selenium is not installed: pip install -e .[browser]") from error
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in FLAGS:
        options.add_argument(flag)
    options.add_argument(f"--window-size={WINDOW[0]},{WINDOW[1]}")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options.add_argument(f"--user-data-dir={profile}")
        page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        try:
            yield page
        finally:
            page.quit()


def axis_labels(page: Chrome) -> list[str]:
    """Titles of the axes of parallel coordinates that the page shows now."""
    found = page.execute_script(
        "return [...document.querySelectorAll(arguments[0])].map(e => e.textContent)", AXIS_TITLES
    )
    return list(found)


def await_axes(page: Chrome, names: Sequence[str]) -> None:
    """Wait until the page has drawn an axis of each name.

    Raises
    ------
    InputError
        If it does not in time.
    """
    from selenium.common.exceptions import TimeoutException
    from selenium.webdriver.support.ui import WebDriverWait

    wanted = set(names)
    try:
        WebDriverWait(page, PATIENCE).until(lambda shown: wanted <= set(axis_labels(shown)))
    except TimeoutException as error:
        missing = sorted(wanted - set(axis_labels(page)))
        raise InputError(f"the page shows no axes {', '.join(missing)}") from error


if __name__ == "__main__":
    sys.exit(main())
