"""Where the checkout is, for tests that read its files."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"

# The anatomies that ship; `folder` is whatever a case folder holds.
ANATOMIES = tuple(sorted({path.stem for path in (CONF / "valve").glob("*.yaml")} - {"folder"}))

FIELD_INPUTS = ROOT.parent / "shared" / "data" / "field_inputs"
"""Files of kinds that users have; they lie beside the project's folder, not in it."""


def field_input(name: str) -> Path:
    """One of them; the test is skipped where they are not there."""
    if not (FIELD_INPUTS / name).exists():
        pytest.skip(f"needs {FIELD_INPUTS / name}")
    return FIELD_INPUTS / name
