"""Everything in ``results/`` from its records: ``python -m experiments.tables [FOLDER]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.interruption import interruptible
from experiments.results.keep import RECORDS, regenerate
from experiments.results.page import write_report
from experiments.sweeps.collected import read_sweeps
from experiments.sweeps.report import write_sweep
from mvest.errors import ConfigurationError


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Regenerate the tables and figures; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) > 1:
        raise ConfigurationError("expected at most one argument, the folder of the results")
    results = Path(given[0] if given else "results")
    sweeps = read_sweeps(results)
    # A folder that holds sweeps alone is complete; an empty one says what to run.
    single = (results / RECORDS).is_dir() or not sweeps
    written = regenerate(results) if single else []
    for sweep in sweeps:
        written += write_sweep(results, sweep)
    written.append(write_report(results))
    print(*written, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
