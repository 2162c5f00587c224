"""Whether a run came out as published: ``python -m experiments.results.reproduced [TABLE]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.results.published import records_of
from mvest.errors import InputError, MvestError
from mvest.problem.record import EstimateRecord
from mvest.reporting.markup import number

SAME = 1e-5
"""Relative difference of estimates that machines and versions of libraries may make."""


def compared(table: str, own: Path, published: Path) -> str:
    """One sentence: what each run gave, and whether that is what was published.

    Parameters
    ----------
    table : str
    own, published : Path
        Folders of results.

    Raises
    ------
    InputError
        If one of them has no records of the table.
    """
    mine, theirs = records_of(own, table), records_of(published, table)
    if mine is None or theirs is None:
        raise InputError(f"{own if mine is None else published}: no records of {table}")
    parts, furthest = [], 0.0
    for name, record in mine.records.items():
        for estimate, other in zip(record.estimates, theirs.records[name].estimates, strict=True):
            furthest = max([furthest, *_differences(estimate, other)])
        values = [number(one.estimate) for one in record.estimates[0].moduli]
        parts.append(f"{record.row} {' and '.join(values)} MPa")
    truth = [number(one.truth) for one in mine.first.estimates[0].moduli]
    verdict = "as published" if furthest <= SAME else "NOT as published"
    return (
        f"{table} came out {verdict} (largest relative difference {furthest:.1g}): "
        f"{'; '.join(parts)}; the truth is {' and '.join(truth)} MPa."
    )


def _differences(one: EstimateRecord, other: EstimateRecord) -> list[float]:
    """Relative differences of the estimates of the same unknowns."""
    pairs = [(u.estimate, other.unknown(u.name).estimate) for u in one.unknowns]
    if any((a is None) != (b is None) for a, b in pairs):
        return [float("inf")]
    return [abs(a / b - 1.0) for a, b in pairs if a is not None and b]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare a table of outputs/results with results; returns the exit status."""
    table, *_ = [*(sys.argv[1:] if arguments is None else arguments), "table1"]
    try:
        print(compared(table, Path("outputs/results"), Path("results")))
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
