"""Some damaged files for every reader, and all that once failed."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.child import Child
from tests.fuzz.mutation import CHANGES, Change, changed
from tests.fuzz.readers import READERS
from tests.fuzz.trial import Bench
from tests.places import ROOT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are those of Linux")

STORED = ROOT / "tests" / "fuzz" / "stored"
INPUTS = 80
"""Of each reader."""

a_change = st.builds(Change, st.sampled_from(list(CHANGES)), st.integers(0, 2**32 - 1))
some_changes = st.lists(a_change, min_size=1, max_size=4)


@pytest.fixture(scope="module")
def child() -> Iterator[Child]:
    with Child() as process:
        yield process


@pytest.fixture(scope="module")
def benches(child: Child, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bench]:
    folder = tmp_path_factory.mktemp("fuzz")
    return {name: Bench(reader, folder, child) for name, reader in READERS.items()}


@pytest.mark.parametrize("name", READERS)
def test_the_examples_are_valid(name: str, benches: dict[str, Bench]) -> None:
    assert [(found.kind, found.words) for found in benches[name].whole] == [
        ("read", "") for _ in READERS[name].makers
    ]


@pytest.mark.parametrize("name", READERS)
def test_damaged_files(name: str, benches: dict[str, Bench]) -> None:
    bench = benches[name]

    # The same inputs every time: what is new is found by `make fuzz`.
    @settings(
        max_examples=INPUTS,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(number=st.integers(0, len(bench.paths) - 1), changes=some_changes)
    def refused_or_read(number: int, changes: list[Change]) -> None:
        found = bench.tried(changed(bench.contents[number], changes), number)
        assert not found.faulty, found

    refused_or_read()


@pytest.mark.parametrize(
    "stored", sorted(STORED.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}"
)
def test_what_once_failed(stored: Path, benches: dict[str, Bench]) -> None:
    bench = benches[stored.parent.name]
    suffix = "".join(stored.suffixes)
    numbers = [k for k, path in enumerate(bench.paths) if "".join(path.suffixes) == suffix]
    assert not bench.tried(stored.read_bytes(), numbers[0]).faulty
