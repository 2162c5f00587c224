"""Estimates a case in a process that cannot open what the case hides.

A virtual patient's truth lies in a folder of its own. This process is started for the estimation
alone, is given nothing of the patient but the folder of its case, and refuses to open, list or
rename anything within the sealed folder for as long as it lives: Python's audit hooks cannot be
removed once they are set (PEP 578). They see what Python opens; a file that a compiled library or a
program started from here opened by itself would not be seen.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, PIPE
from typing import Any

import numpy as np

from experiments.common.cases.own_case import (
    ImagedInput,
    PersonalSettings,
    read_configured,
    run_case,
    run_volume,
)
from experiments.common.records.record import NOT_GATED
from experiments.common.schema import build
from experiments.common.study import Result
from mvest.errors import InputError, MvestError
from mvest.files import write_atomically
from mvest.processes import environment, python, run
from mvest.provenance import THREAD_VARIABLES, write_json
from mvest.reading.documents import read_mapping
from mvest.reading.npz import read_npz

ESTIMATE, ARRAYS = "estimate.json", "estimate.npz"
"""What the process leaves in the output folder."""

MAX_MEMORY = 10 * 2**30
"""Bytes that the process may ask for: a leaflet that crumples while no equilibrium is found can
take all there is, and what else runs on the machine with it."""

SECRET = ("patient", "echo", "truth", "valve", "seed", "parameters", "row", "factors")
"""Parts of a configuration that describe the patient, and that the estimator is not given."""


def seal(folder: Path) -> None:
    """From now on let this process open nothing within ``folder``."""
    sealed = os.path.realpath(folder)

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if not (event == "open" or event.startswith(("os.", "shutil.", "glob.", "sqlite3."))):
            return
        for argument in arguments:
            if not isinstance(argument, (str, bytes, os.PathLike)):
                continue
            path = os.path.realpath(os.fsdecode(argument))
            # Under another name of a folder above, the sealed one would not be known again.
            renamed = event in ("os.rename", "shutil.move") and sealed.startswith(path + os.sep)
            if renamed or path == sealed or path.startswith(sealed + os.sep):
                raise PermissionError(f"{path} is sealed: an estimator does not see the truth")

    sys.addaudithook(refuse)


def estimate_blindly(
    values: Mapping[str, Any], folder: Path, case: Path, sealed: Path, gate: str = NOT_GATED
) -> Result:
    """Personalise a case, or the valve in a volume, in a process apart.

    Parameters
    ----------
    values : mapping
        The configuration; what describes the patient is left out.
    folder : Path
        Output folder of the job, which exists.
    case : Path
        Folder of the case, or the file of a volume over time.
    sealed : Path
        Folder that the process cannot open.
    gate : str
        Verdict of the gate on the anatomy.

    Raises
    ------
    InputError
        If the process left no result; the message ends with its last words.
    """
    given = {"volume": str(case)} if case.is_file() else {"case": str(case)}
    request = {
        "values": {k: v for k, v in values.items() if k not in SECRET} | given,
        "folder": str(folder),
        "sealed": str(sealed),
        "gate": gate,
    }
    path = folder / ESTIMATE
    for left in (path, folder / ARRAYS):
        left.unlink(missing_ok=True)
    ended = run(
        python("experiments.common.cases.blind"),
        input=json.dumps(request),
        stdout=DEVNULL,
        stderr=PIPE,
        text=True,
        encoding="utf-8",
        env=environment(**dict.fromkeys(THREAD_VARIABLES, "1")),
    )
    if ended.returncode or not path.is_file():
        last = (ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"])[-1]
        raise InputError(f"the estimation of {case} left no result: {last.removeprefix('error: ')}")
    return read_estimate(folder)


def read_estimate(folder: Path) -> Result:
    """What the process left in the output folder.

    Raises
    ------
    InputError
        If it left nothing.
    """
    left, arrays = read_mapping(folder / ESTIMATE), folder / ARRAYS
    return Result(**left, arrays=read_npz(arrays) if arrays.is_file() else {})


def write_estimate(folder: Path, result: Result) -> None:
    """Leave the result of a case for `read_estimate`."""
    if result.arrays:
        arrays: dict[str, Any] = dict(result.arrays)
        write_atomically(folder / ARRAYS, partial(np.savez_compressed, **arrays))
    write_json(folder / ESTIMATE, result.model_dump(mode="json"))


def main() -> int:
    """Answer the one request on the standard input; returns the exit status."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, hard))
    request = json.load(sys.stdin)
    folder = Path(request["folder"])
    # The configuration describes the patient, too.
    for place in (Path(request["sealed"]), folder / ".hydra", folder.parent / ".hydra"):
        seal(place)
    values = request["values"]
    try:
        personal = build(PersonalSettings, values["personal"])
        if values.get("volume") is None:
            case = read_configured(values["case"])
            result = run_case(values, personal, case, gate=request["gate"])
        else:
            imaged = build(ImagedInput, values["imaged"])
            result = run_volume(values, values["volume"], imaged, personal, folder)
        write_estimate(folder, result)
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
