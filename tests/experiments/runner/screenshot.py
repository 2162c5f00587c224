"""A picture of the dashboard: ``make screenshot``.

Needs Chromium (Debian: ``apt install chromium``).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from experiments.runner.tracking import last_sweep, serving
from mvest.errors import InputError, MvestError
from mvest.processes import run

__all__ = ["look_at", "main"]

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--virtual-time-budget=30000",
)  # fmt: skip
"""Chromium as a program that speaks to nobody but the page, which it gives 30 s to draw itself."""

PICTURE = (1600, 970)
"""Pixels of the picture."""

PATIENCE = 120.0
"""Seconds of the clock that a page may take."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the picture of the last sweep's comparison; returns the exit status."""
    parser = argparse.ArgumentParser(prog="make screenshot", description=__doc__)
    parser.add_argument("outputs", nargs="?", default="outputs", type=Path)
    parser.add_argument("--to", default=Path("results/dashboard.png"), type=Path)
    given = parser.parse_args(arguments)
    try:
        place, page, _ = last_sweep(given.outputs)
        with serving(place, 0, quiet=True) as (address, _):
            look_at(address + page, f"--screenshot={given.to.resolve()}")
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(given.to)
    return 0


def look_at(address: str, what: str) -> str:
    """What Chromium prints of a page when it has been drawn, asked for with one of its options.

    Raises
    ------
    InputError
        If Chromium is not installed or fails.
    """
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        raise InputError("Chromium is not installed (Debian: apt install chromium)")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        window = f"--window-size={PICTURE[0]},{PICTURE[1]}"
        command = [program, *FLAGS, window, f"--user-data-dir={profile}", what, address]
        try:
            seen = run(
                command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, timeout=PATIENCE
            )
            seen.check_returncode()
        except (subprocess.SubprocessError, OSError) as error:
            raise InputError(f"Chromium shows no page: {error}") from error
    return str(seen.stdout)


if __name__ == "__main__":
    sys.exit(main())
