"""Everything in ``results/`` from its records: ``python -m experiments.tables [FOLDER]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from mvest.errors import MvestError
from mvest.reporting.publish import regenerate

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Regenerate the tables and figures; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) > 1:
        print("error: expected at most one argument, the folder of the results", file=sys.stderr)
        return 2
    try:
        for path in regenerate(Path(given[0] if given else "results")):
            print(path)
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
