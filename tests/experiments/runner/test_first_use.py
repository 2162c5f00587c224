"""The first run after an installation says why it takes longer."""

import os
import subprocess
import sys
from pathlib import Path

from tests.places import ROOT

SAY = "from experiments.common.progress import announce_compilation as say; say()"


def said(cache: Path, before: str = "") -> str:
    finished = subprocess.run(
        [sys.executable, "-c", before + SAY],
        # What is compiled is not what is tested: it need not be fast.
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache), "NUMBA_OPT": "1"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return finished.stderr


def test_compilation_is_announced_until_the_kernels_are_cached(tmp_path):
    assert "compiling on first use" in said(tmp_path)
    use = (
        "import numpy as np; from mvest.mechanics import simulate_body, TransverselyIsotropic, box;"
        "x, e = box('tet4', (1, 1, 1), (1.0, 1.0, 1.0)); fixed = np.flatnonzero(x[:, 2] == 0);"
        "m = TransverselyIsotropic.isotropic(1.0, 0.3);"
        "simulate_body(x, e, 'tet4', fixed_nodes=fixed, material=m, times=[0.1]);"
    )
    assert said(tmp_path, use) == ""
    assert said(tmp_path) == ""
