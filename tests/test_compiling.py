"""Kernels are compiled where neither the installation nor the home can be written."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.places import ROOT

SAY = "; import os; print(os.environ.get('NUMBA_CACHE_DIR'))"


@pytest.fixture(scope="module")
def read_only(tmp_path_factory):
    """A copy of the library, and a home, where whoever makes a cache meets a file in its place."""
    place = tmp_path_factory.mktemp("installed")
    shutil.copytree(ROOT / "mvest", place / "mvest", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [path for path in (place / "mvest").rglob("*") if path.is_dir()]:
        (folder / "__pycache__").touch()
    (place / "mvest" / "__pycache__").touch()
    (place / "home").touch()
    return place


def cache_of(place, code: str = "import mvest", **more: str) -> str:
    """The cache folder of numba in a process that runs some code."""
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code + SAY],
        env={**kept, "PYTHONPATH": str(place), "HOME": str(place / "home"), **more},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_private_temporary_folder_is_the_cache_where_nothing_else_can_be_written(
    read_only, tmp_path
):
    # Importing compiled kernels fails if numba finds no folder for them.
    kernels = "from mvest.valve.geometry import proximity"
    found = cache_of(read_only, kernels, TMPDIR=str(tmp_path))
    assert found == str(tmp_path / f"mvest-numba-{os.getuid()}")
    assert (tmp_path / f"mvest-numba-{os.getuid()}").stat().st_mode & 0o777 == 0o700
    # numba executes its cache: a folder into which others can write is none.
    (tmp_path / f"mvest-numba-{os.getuid()}").chmod(0o777)
    other = cache_of(read_only, TMPDIR=str(tmp_path))
    assert other.startswith(str(tmp_path / "mvest-numba-"))
    assert other != found


def test_a_cache_that_is_named_or_can_be_written_stays(read_only, tmp_path):
    assert cache_of(read_only, NUMBA_CACHE_DIR=str(tmp_path)) == str(tmp_path)
    assert cache_of(read_only, XDG_CACHE_HOME=str(tmp_path)) == "None"
