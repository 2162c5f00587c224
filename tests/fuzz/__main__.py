"""Damaged files at all importers for a while, and a table of how they ended."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.importers import IMPORTERS
from tests.fuzz.trial import ENDS, FAULTS, Bench
from tests.places import ROOT

ROUND = 50
"""Inputs of an importer before it is the next one's turn."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first input")
    parser.add_argument("--importer", action="append", choices=sorted(IMPORTERS), default=None)
    given = parser.parse_args()
    end, seed = time.monotonic() + given.seconds, given.seed
    counts: dict[str, Counter[str]] = {name: Counter() for name in given.importer or IMPORTERS}
    with tempfile.TemporaryDirectory() as folder:
        benches = {name: Bench(*IMPORTERS[name], Path(folder) / name) for name in counts}
        while time.monotonic() < end:
            for name, bench in benches.items():
                counts[name].update(_end(name, bench, one) for one in range(seed, seed + ROUND))
            seed += ROUND
    print(f"seeds {given.seed} to {seed - 1}")
    print(f"{'importer':16}" + "".join(f"{name:>10}" for name in ENDS))
    for name, count in counts.items():
        print(f"{name:16}" + "".join(f"{count[kind]:>10}" for kind in ENDS))
    return int(any(count[kind] for count in counts.values() for kind in FAULTS))


def _end(name: str, bench: Bench, seed: int) -> str:
    """How an input ends; what is at fault, or meets the limits of the child, is kept."""
    number, content = bench.damaged(seed)
    kind, words = bench.tried(content, number)
    if kind not in ("read", "refused"):
        suffixes = "".join(bench.paths[number].suffixes)
        place = ROOT / "outputs" / "fuzz" / name / f"{seed}-{number}{suffixes}"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        print(f"{name} {seed}: {kind}: {words.encode('unicode_escape').decode()[:400]}", flush=True)
    return kind


if __name__ == "__main__":
    sys.exit(main())
