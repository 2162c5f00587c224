"""Where the checkout is, for tests that read its files."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"

# The anatomies that ship; `folder` is whatever a case folder holds.
ANATOMIES = tuple(sorted({path.stem for path in (CONF / "valve").glob("*.yaml")} - {"folder"}))
