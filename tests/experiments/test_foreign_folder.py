"""Nothing of the folder where a command is typed is run: it may be a case of somebody else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

NAMES = (
    "filelock", "mlflow", "experiments", "mvest", "numpy", "joblib", "json", "hydra", "pydantic",
    "yaml", "numba", "scipy", "uvicorn", "multiprocessing", "sitecustomize",
)  # fmt: skip
SPY = "open(__file__ + '.ran', 'w').close()\nraise SystemExit('code of a case was run')\n"

POOL = (
    "from mvest.processes import side_by_side\n"
    "assert list(side_by_side(abs, ((-k,) for k in range(3)), 2)) == [0, 1, 2]"
)
COMMANDS = {
    # A worker, and what logs to MLflow.
    "run": ("-m", "mvest", "run", "experiment=debug", "time_limit_s=600", "figures=false"),
    "sweep": (
        *("-m", "mvest", "run", "-m", "experiment=debug", "seed=1,2", "figures=false"),
        *("hydra.launcher.n_jobs=2", "tracking.enabled=false"),
    ),
    "pool": ("-c", POOL),
}  # fmt: skip


@pytest.fixture
def case(tmp_path) -> Path:
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(SPY)
    return tmp_path


def run(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A Python that imports nothing from its folder, as the installed command does."""
    return subprocess.run(
        [sys.executable, "-P", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) for name in ("run", "sweep")] + ["pool"]
)
def test_code_beside_a_case_is_not_run(case, name):
    done = run(case, *COMMANDS[name])
    assert done.returncode == 0, done.stderr
    assert "Exception ignored" not in done.stderr
    assert list(case.rglob("*.ran")) == []


def test_another_package_of_experiments_does_not_come_first(tmp_path):
    (tmp_path / "experiments.py").write_text(SPY)
    places = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = run(tmp_path, "-m", "mvest", "list", PYTHONPATH=places)
    assert done.returncode == 0, done.stderr
    assert "table1" in done.stdout


def test_settings_of_numba_in_the_folder_are_refused(tmp_path):
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: here\n")
    done = run(tmp_path, "-m", "mvest", "list")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert ".numba_config.yaml" in done.stderr
