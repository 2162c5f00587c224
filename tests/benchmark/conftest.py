"""Writes with every benchmark what it is compared by: nodes, and the calibration of the machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
import pytest


@pytest.fixture(scope="session")
def clock(pytestconfig) -> Callable[[], float]:
    """The clock that the benchmarks are measured with: of the CPU or of the wall."""
    return getattr(time, str(pytestconfig.getoption("benchmark_timer")).rpartition(".")[2])


@pytest.fixture(scope="session")
def calibration(clock) -> float:
    """Seconds that this process takes for fixed work: dense products and long sums of vectors."""
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

    def run(function, *, rounds=7, warmup=1, setup=None, **about):
        result = benchmark.pedantic(function, setup=setup, rounds=rounds, warmup_rounds=warmup)
        about.setdefault("threads", int(os.environ.get("MKL_NUM_THREADS", "0")))
        benchmark.extra_info.update(about, calibration=calibration)
        return result

    return run
