"""Throughput of a batch of closures on one core and on two."""

import numpy as np
import pytest

from mvest.processes import side_by_side
from tests.benchmark.valves import VALUES, model, predictions

CLOSURES = 8


@pytest.mark.parametrize("processes", [1, 2])
def test_batch(measure, processes):
    valve = model("hex18", "3k")
    values = VALUES * np.linspace(0.95, 1.05, CLOSURES)[:, None]

    def run():
        calls = ((valve.fresh(), values[k::processes]) for k in range(processes))
        return [p for share in side_by_side(predictions, calls, processes) for p in share]

    # The first round, not counted, starts the processes; a study does so once. Building the
    # mechanics in each process is part of a batch.
    found = measure(
        run,
        rounds=1,
        warmup=1,
        element="hex18",
        size="3k",
        points=CLOSURES,
        threads=processes,
    )
    assert all(p.converged for p in found)
