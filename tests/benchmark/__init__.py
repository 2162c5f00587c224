"""Benchmarks. One thread, set before a library reads how many, unless another number is given."""

import os

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

for _name in THREADS:
    os.environ.setdefault(_name, "1")
