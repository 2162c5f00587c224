"""Some damaged files at every importer, and all that once failed."""

import sys
from pathlib import Path

import pytest

from tests.fuzz.importers import IMPORTERS
from tests.fuzz.trial import FAULTS, Bench
from tests.places import ROOT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")

STORED = ROOT / "tests" / "fuzz" / "stored"
INPUTS = 10
"""For each valid file, the same ones every time: what is new is found by `make fuzz`."""


@pytest.mark.parametrize("name", IMPORTERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    bench = Bench(*IMPORTERS[name], tmp_path)
    assert bench.whole == [("read", "")] * len(bench.paths)
    for seed in range(INPUTS * len(bench.paths)):
        number, content = bench.damaged(seed)
        kind, words = bench.tried(content, number)
        assert kind not in FAULTS, (seed, kind, words)


@pytest.mark.parametrize("name", sorted({path.parent.name for path in STORED.glob("*/*")}))
def test_what_once_failed_is_read_or_refused(name: str, tmp_path: Path) -> None:
    bench = Bench(*IMPORTERS[name], tmp_path)
    for stored in sorted((STORED / name).iterdir()):
        kinds = ["".join(path.suffixes) for path in bench.paths]
        kind, words = bench.tried(stored.read_bytes(), kinds.index("".join(stored.suffixes)))
        assert kind not in FAULTS, (stored.name, kind, words)
