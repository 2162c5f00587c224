"""Damaged files at all doors for a while, and a table of how they ended."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.doors import DOORS
from tests.fuzz.trial import ENDS, FAULTS, Bench
from tests.places import ROOT

ROUND = 100
"""Inputs of a door before it is the next one's turn."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first input")
    parser.add_argument("--door", action="append", choices=sorted(DOORS), default=None)
    given = parser.parse_args()
    end, seed = time.monotonic() + given.seconds, given.seed
    counts: dict[str, Counter[str]] = {name: Counter() for name in given.door or DOORS}
    with tempfile.TemporaryDirectory() as folder:
        benches = {name: Bench(*DOORS[name], Path(folder) / name) for name in counts}
        for name, bench in benches.items():
            if bad := [found for found in bench.whole if found[0] != "read"]:
                sys.exit(f"{name}: a valid file is not read: {bad[0]}")
        while time.monotonic() < end:
            for name, bench in benches.items():
                for one in range(seed, seed + ROUND):
                    if time.monotonic() < end:
                        _try(name, bench, one, counts[name])
            seed += ROUND
    print(f"seeds {given.seed} to {seed - 1}")
    print(f"{'door':24}" + "".join(f"{name:>10}" for name in ("inputs", *ENDS)))
    for name, count in [*counts.items(), ("all", sum(counts.values(), Counter()))]:
        print(f"{name:24}{count.total():>10}" + "".join(f"{count[kind]:>10}" for kind in ENDS))
    return int(any(count[kind] for count in counts.values() for kind in FAULTS))


def _try(name: str, bench: Bench, seed: int, count: Counter[str]) -> None:
    number, content = bench.damaged(seed)
    kind, words = bench.tried(content, number)
    count[kind] += 1
    if kind in (*FAULTS, "stopped"):
        suffixes = "".join(bench.paths[number].suffixes)
        place = ROOT / "outputs" / "fuzz" / name / f"{seed}-{number}{suffixes}"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        print(f"{name} {seed}: {kind}: {words.encode('unicode_escape').decode()[:400]}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
