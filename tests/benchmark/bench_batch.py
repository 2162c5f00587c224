"""Throughput of a batch of closures on one core and on two."""

import numpy as np
import pytest

from mvest.closure.batch import predict_many
from tests.benchmark.valves import VALUES, model

CLOSURES = 8


@pytest.mark.parametrize("processes", [1, 2])
def test_batch(measure, processes):
    valve = model("hex18", "3k")
    values = VALUES * np.linspace(0.95, 1.05, CLOSURES)[:, None]

    def run():
        return predict_many(valve, values, processes=processes)

    # The first round, not counted, starts the processes; a study does so once. Building the
    # mechanics in each process is part of a batch.
    predictions = measure(
        run,
        rounds=1,
        warmup=1,
        element="hex18",
        size="3k",
        points=CLOSURES,
        threads=processes,
    )
    assert all(p.converged for p in predictions)
