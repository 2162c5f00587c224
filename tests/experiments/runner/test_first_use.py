"""The first compilation of a process is announced, a kernel from the cache is not."""

import os
import subprocess
import sys

from mvest._compiling import NOTE
from tests.places import ROOT


def said(folder) -> str:
    done = subprocess.run(
        [sys.executable, "-c", "import mvest.mechanics.solid, kernel; kernel.double(1.0)"],
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{folder}"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stderr


def test_compilation_is_announced_until_the_kernels_are_cached(tmp_path):
    text = "import numba as nb\n\n@nb.njit(cache=True)\ndef double(x):\n    return 2.0 * x\n"
    (tmp_path / "kernel.py").write_text(text)
    assert said(tmp_path) == f"{NOTE}\n"
    assert said(tmp_path) == ""
