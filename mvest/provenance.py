"""Origin of a result as plain data: commit, configuration, versions, threads and machine."""

import hashlib
import importlib.metadata
import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mvest.errors import InputError
from mvest.files import write_atomically

KEY_PACKAGES = (
    "mvest", "numpy", "scipy", "numba", "pypardiso", "ipctk", "pytetwild", "vtk", "trimesh",
    "SimpleITK", "nibabel", "pynrrd", "pydicom", "lightgbm", "hydra-core", "mlflow",
)  # fmt: skip
"""Packages whose version can change a number or its record."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Environment variables that limit the threads of the numerical libraries."""

NUMBERS = {"twin": 1, "case": 7, "patient": 3, "volume": 3}
"""Kind of golden run -> generation of its numbers. A result of an earlier generation is stale.

Raise a kind whenever the golden numbers of its runs change (``tests/test_golden.py``): *twin* for
the default valve, *case* for cases with an uncertain geometry, *patient* for other virtual
patients, *volume* for an image.

Generation 1 is the default valve of three scallops with branching chordae; in generation 2 cases
and patients close without coarser meshes, and the pressure of a volume has a prior of 15 %; in
generation 3 the expected error of the mesh is taken from the observation, and the detectors are
trained on the valves of generation 2; in generations 4 and 5 (cases only) closures succeed that
failed; in generation 6 (cases only) assumed fibres turn as the template's, and errors of free edges
are correlated; in generation 7 (cases only) the geometry stays the measured
one, and errors of surfaces are correlated over a valve near them.
"""

GOLDEN = {
    "twin": "5f237e0fb427",
    "case": "6ed8b15c8432",
    "patient": "19ddd6814ab1",
    "volume": "eeeb18e1daa5",
}
"""Kind of golden run -> digest of its golden numbers at the present generation.

Another input of a golden run, such as another example case, changes the digest alone.
"""


def provenance(directory: Path | None = None) -> dict[str, Any]:
    """Describe the code and the machine of a computation.

    Returns a dict: ``git`` (see `git_state`), ``versions`` of packages and ``threads`` by
    environment variable (None if not installed or unset), the generations of ``numbers`` (see
    `NUMBERS`), ``python``, ``platform``, ``machine`` and ``cpu_count``.

    ``directory``: a folder of the checkout; by default that of this file.
    """
    versions: dict[str, str | None] = dict.fromkeys(KEY_PACKAGES)
    for name in KEY_PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "git": git_state(directory or Path(__file__).resolve().parent),
        "versions": versions,
        "threads": {name: os.environ.get(name) for name in THREAD_VARIABLES},
        "numbers": dict(NUMBERS),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpu_count": os.cpu_count(),
    }


def git_state(directory: Path) -> dict[str, Any]:
    """The commit of a folder, and whether its tracked files differ from it.

    Returns a dict: ``sha`` (40 hexadecimal digits) and ``dirty`` (True if a tracked file outside
    ``results/`` was changed). Both are None without git, without a commit, or without tracked files
    in the folder.
    """
    sha = _git(directory, "rev-parse", "--verify", "HEAD")
    # An installation within somebody's checkout does not belong to it.
    if sha is None or not _git(directory, "ls-files"):
        return {"sha": None, "dirty": None}
    # Runs write to results/.
    places = (":(top)", ":(top,exclude)results")
    changes = _git(directory, "status", "--porcelain", "--untracked-files=no", "--", *places)
    return {"sha": sha, "dirty": None if changes is None else bool(changes)}


def _git(directory: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(directory), *arguments]
    with suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
        return done.stdout.strip()
    return None


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 (64 hexadecimal digits) of a configuration as ASCII JSON with sorted keys.

    Tuples and NumPy values count as plain data, and paths as text; 1 and 1.0 differ. A value
    without a JSON form, such as NaN, is an InputError.
    """
    plain = _plain(config, "value")
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def write_json(path: Path, value: Any) -> None:
    """Write data as JSON, atomically; keys keep their order.

    InputError if the data have no JSON form, or the file cannot be written.
    """
    text = json.dumps(_plain(value, "value"), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_atomically(path, text, sync=True)


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data with a digest of their content for `require_sealed`, or an InputError."""
    plain = _plain(value, "value")
    return {"sha256": _sealing(plain), **{k: v for k, v in plain.items() if k != "sha256"}}


def require_sealed(data: Mapping[str, Any], where: str) -> None:
    """Raise an InputError that names ``where`` if the digest of `sealed` data does not match."""
    if data.get("sha256") != _sealing(data):
        raise InputError(f"{where}: its content is not what was written (SHA-256 does not match)")


def _sealing(data: Mapping[str, Any]) -> str:
    """Digest of plain data as written, with a ? for characters without UTF-8."""
    content = {key: value for key, value in data.items() if key != "sha256"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode(errors="replace")).hexdigest()


def _plain(value: Any, where: str) -> Any:
    # Imported here, since `experiments` limits the threads of numerical libraries first.
    import numpy as np

    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise InputError(
                f"{where} is {value}; JSON holds finite numbers only, use None for a missing one"
            )
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        wrong = [key for key in value if not isinstance(key, str)]
        if wrong:
            raise InputError(f"{where} has the key {wrong[0]!r}; JSON keys are text")
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise InputError(f"{where} is a {type(value).__name__}, which has no JSON form")
