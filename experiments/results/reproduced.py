"""Whether a run came out as published: ``python -m experiments.results.reproduced [TABLE]``."""

import sys
from pathlib import Path

from experiments.console import interruptible
from experiments.results.published import records_of
from mvest.errors import InputError
from mvest.reporting.markup import number

SAME = 1e-5  # relative difference of estimates between machines and versions of libraries


def compared(table: str, own: Path, published: Path) -> str:
    """One sentence: the result of each run, and whether it is the published one.

    ``own`` and ``published`` are folders of results. Raises an `InputError` if one of them has no
    records of the table.
    """
    mine, theirs = records_of(own, table), records_of(published, table)
    for folder, found in ((own, mine), (published, theirs)):
        if not found.records:
            raise InputError(f"{folder}: no records of {table}")
    parts, furthest = [], 0.0
    for name, record in mine.records.items():
        for estimate, other in zip(record.estimates, theirs.records[name].estimates, strict=True):
            for one in estimate.unknowns:
                value, expected = one.estimate, other.unknown(one.name).estimate
                if value is not None and expected:
                    furthest = max(furthest, abs(value / expected - 1.0))
                elif value != expected:
                    furthest = float("inf")
        values = [number(one.estimate) for one in record.estimates[0].moduli]
        parts.append(f"{record.row} {' and '.join(values)} MPa")
    truth = [number(one.truth) for one in mine.first.estimates[0].moduli]
    verdict = "as published" if furthest <= SAME else "NOT as published"
    return (
        f"{table} came out {verdict} (largest relative difference {furthest:.1g}): "
        f"{'; '.join(parts)}; the truth is {' and '.join(truth)} MPa."
    )


@interruptible
def main() -> int:
    """Compare a table of outputs/results with results; returns the exit status."""
    table, *_ = [*sys.argv[1:], "table1"]
    print(compared(table, Path("outputs/results"), Path("results")))
    return 0


if __name__ == "__main__":
    sys.exit(main())
