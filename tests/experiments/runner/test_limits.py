"""Memory of a job: what is reserved and never touched does not count."""

import subprocess
import sys
from pathlib import Path

import pytest

REPORT = """
from experiments.runner.jobs import held_memory
with held_memory(1.5):
    import pandas
    pandas.DataFrame({"name": ["a", "b"]}).to_csv()
    kept = bytearray(2**29)
    try:
        more = bytearray(2**30)
    except MemoryError:
        print("held")
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="memory is limited on Linux only")
def test_libraries_leave_a_job_the_memory_that_its_limit_promises():
    found = subprocess.run([sys.executable, "-c", REPORT], capture_output=True, text=True)
    assert (found.stdout, found.returncode) == ("held\n", 0), found.stderr
