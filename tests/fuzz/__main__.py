"""Damaged files for all readers for a while, and a table of how they ended."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.child import Child
from tests.fuzz.readers import READERS
from tests.fuzz.trial import Bench
from tests.places import ROOT

ROUND = 200
"""Inputs of a reader before it is the next one's turn."""
COLUMNS = ("read", "refused", "outside", "message", "memory", "slow", "died")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first input")
    parser.add_argument("--reader", action="append", choices=sorted(READERS), default=None)
    parser.add_argument("--failed", type=Path, default=ROOT / "outputs" / "fuzz")
    given = parser.parse_args()
    end = time.monotonic() + given.seconds
    counts: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as folder, Child() as child:
        benches = [
            Bench(READERS[name], Path(folder), child) for name in given.reader or sorted(READERS)
        ]
        for bench in benches:
            bad = [found.words for found in bench.whole if found.kind != "read"]
            if bad:
                sys.exit(f"{bench.reader.name}: a valid file is refused: {bad[0]}")
            counts[bench.reader.name] = Counter()
        seed = given.seed
        while time.monotonic() < end:
            for bench in benches:
                for one in range(seed, seed + ROUND):
                    if time.monotonic() >= end:
                        break
                    _try(bench, one, counts[bench.reader.name], given.failed)
            seed += ROUND
    _print_table(counts, given.seed, seed)
    return int(any(count[kind] for count in counts.values() for kind in COLUMNS[2:]))


def _try(bench: Bench, seed: int, count: Counter[str], failed: Path) -> None:
    number, changes, content = bench.drawn(seed)
    found = bench.tried(content, number)
    count[found.kind] += 1
    if found.faulty:
        path = bench.paths[number]
        place = failed / bench.reader.name / f"{seed}-{number}{''.join(path.suffixes)}"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        names = " ".join(change.name for change in changes)
        words = found.words.encode("unicode_escape").decode()
        print(f"{bench.reader.name} {seed} ({names}): {found.kind}: {words[:400]}", flush=True)


def _print_table(counts: dict[str, Counter[str]], first: int, end: int) -> None:
    print(f"seeds {first} to {end - 1}")
    print(f"{'reader':24}{'inputs':>10}" + "".join(f"{name:>10}" for name in COLUMNS))
    total: Counter[str] = sum(counts.values(), Counter())
    for name, count in [*counts.items(), ("all", total)]:
        print(f"{name:24}{count.total():>10}" + "".join(f"{count[k]:>10}" for k in COLUMNS))


if __name__ == "__main__":
    sys.exit(main())
