"""The scikit-fem sheet as a program.

Started as ``python -m experiments.studies.models.sheet.solver REQUEST FOLDER``.

Reads a request of :mod:`mvest.external` whose settings name the sheet, its law and whether its
derivatives are wanted, and writes the answer into the folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from experiments.studies.models.sheet.second import SecondSheet
from experiments.studies.models.sheet.sheet import Sheet
from mvest.errors import MvestError
from mvest.external.contract import RunRequest, read_request, write_answer

__all__ = ["main", "sheet_of"]


def main(arguments: list[str] | None = None) -> int:
    """Answer one request; the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) != 2:
        sys.stderr.write("expected two arguments, the request and the folder of the answer\n")
        return 2
    try:
        request, folder = read_request(Path(given[0])), Path(given[1])
        model = SecondSheet(sheet_of(request), str(request.settings["law"]))
        wanted = request.jacobian and request.settings["derivatives"]
        prediction = model(np.array(request.values))
        write_answer(folder, prediction, request.names if wanted else None)
    except MvestError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def sheet_of(request: RunRequest) -> Sheet:
    """The sheet that the settings of a request describe."""
    about = dict(request.settings["sheet"])
    for name in ("cells", "observed"):
        about[name] = tuple(about[name])
    return Sheet(**about)


if __name__ == "__main__":
    sys.exit(main())
