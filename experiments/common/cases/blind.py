"""Estimates a case in a process that cannot open what the case hides.

The truth of a virtual patient lies in a separate folder. This process gets only the folder of the
case, and refuses to open, list or rename anything within the sealed folder. Python's audit hooks
cannot be removed (PEP 578). They do not see what compiled libraries or child programs open.
"""

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

# Files that the process writes into the output folder.
ESTIMATE, ARRAYS = "estimate.json", "estimate.npz"
# Bytes that the process may allocate. A leaflet that crumples can take all memory there is.
MAX_MEMORY = 10 * 2**30
# Parts of a configuration that describe the patient; the estimator does not get them.
SECRET = ("patient", "echo", "truth", "valve", "seed", "parameters", "row", "factors")


def seal(folder: Path) -> None:
    """Refuse, from now on, to open anything within ``folder`` in this process."""
    sealed = os.path.realpath(folder)

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if not (event == "open" or event.startswith(("os.", "shutil.", "glob.", "sqlite3."))):
            return
        for argument in arguments:
            if not isinstance(argument, (str, bytes, os.PathLike)):
                continue
            path = os.path.realpath(os.fsdecode(argument))
            # If a folder above got another name, the sealed one would no longer be recognised.
            renamed = event in ("os.rename", "shutil.move") and sealed.startswith(path + os.sep)
            if renamed or path == sealed or path.startswith(sealed + os.sep):
                raise PermissionError(f"{path} is sealed: an estimator does not see the truth")

    sys.addaudithook(refuse)


def estimate_blindly(
    values: Mapping[str, Any], folder: Path, case: Path, sealed: Path, gate: str = NOT_GATED
) -> Result:
    """Personalise a ``case``, a folder or the file of a volume over time, in a separate process.

    The process cannot open the folder ``sealed``, and gets no part of the configuration that
    describes the patient. It writes into the job's output ``folder``, which exists. ``gate`` is the
    verdict of the gate on the anatomy.

    Raises an `InputError` if the process left no result; the message ends with its last line of
    output.
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
    """The result in the output folder; raises an `InputError` if there is none."""
    left, arrays = read_mapping(folder / ESTIMATE), folder / ARRAYS
    return Result(**left, arrays=read_npz(arrays) if arrays.is_file() else {})


def write_estimate(folder: Path, result: Result) -> None:
    """Write the result of a case for `read_estimate`."""
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
    # The written configuration describes the patient, too.
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
