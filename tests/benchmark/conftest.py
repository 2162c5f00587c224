"""Writes with every benchmark what it is compared by: nodes, and the calibration of the machine."""

import os
import time

import numpy as np
import pytest


@pytest.fixture(scope="session")
def calibration(pytestconfig) -> float:
    """Seconds for fixed work by the benchmarks' clock: dense products and long sums of vectors."""
    clock = getattr(time, str(pytestconfig.getoption("benchmark_timer")).rpartition(".")[2])
    random = np.random.default_rng(0)
    a, v = random.normal(size=(700, 700)), random.normal(size=4_000_000)
    times = []
    for _ in range(15):
        start = clock()
        for _ in range(2):
            a @ a
            v + 2.0 * v
        times.append(clock() - start)
    return float(np.median(times))


@pytest.fixture
def measure(benchmark, calibration):
    """Time a call: median of the rounds, in seconds and over the calibration."""

    def run(what, function, *, rounds=7, warmup=1, setup=None, **about):
        result = benchmark.pedantic(function, setup=setup, rounds=rounds, warmup_rounds=warmup)
        about.setdefault("threads", int(os.environ.get("MKL_NUM_THREADS", "0")))
        benchmark.extra_info.update(about, what=what, calibration=calibration)
        return result

    return run
