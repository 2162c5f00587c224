"""The command of an external program, and the files of its requests and responses.

Text only: JSON and comma-separated numbers. One folder is one run::

    request.json      the request: parameters with values and units, settings
    points.csv        x,y,z mm: reference positions of the points to be observed, where given
    response.json     status, and the reason if there is no prediction; written last
    observation.csv   x,y,z mm of every observed point
    jacobian.csv      optional: one row for each coordinate (x, y, z of the first point, then of the
                      next), one column for each parameter, headed by its name
    stdout.txt, stderr.txt  the program's output

Reading is strict: any other content is refused with the file and the row.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from mvest.errors import ConfigurationError, InputError, message_of
from mvest.estimation.prediction import Prediction
from mvest.processes import Program, ending
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping, validated
from mvest.reading.text import one_line, read_numbers, write_columns
from mvest.typing import FloatArray

FORMAT: Literal["mvest-external"] = "mvest-external"
VERSION: Literal[1] = 1
REQUEST, POINTS = "request.json", "points.csv"
RESPONSE, OBSERVATION, JACOBIAN = "response.json", "observation.csv", "jacobian.csv"
ANSWERS = (RESPONSE, OBSERVATION, JACOBIAN)
OUTPUT, ERRORS = "stdout.txt", "stderr.txt"
COORDINATES = ("x", "y", "z")
MAX_JSON_SIZE = 1_000_000
"""Bytes of a response; more is none."""
PLACEHOLDER = re.compile(r"\{(request|folder|here)\}")
CODE = (".jl", ".m", ".py", ".r", ".sh")
"""Endings of programs that take others from the folder that they lie in."""


def files_of_command(arguments: Sequence[str], environment: Mapping[str, str]) -> dict[str, Path]:
    """Files that a command names and that exist; they decide what it answers.

    They are the program itself, arguments that are files, what follows a ``=`` in an argument, and
    beside a script all others of its kind, which it may import. Files that only the program knows
    of (its libraries, files named within files, modules by ``python -m``) are not among them.

    Parameters
    ----------
    arguments, environment
        As in `Command`.
    """
    path = {**os.environ, **environment}.get("PATH")
    files = {}
    for program in arguments[:1]:
        if found := shutil.which(program.replace("{here}", str(Path.cwd())), path=path):
            files[program] = Path(found).absolute()
    for name in (name for text in arguments for name in (text, text.partition("=")[2])):
        place = Path(name.replace("{here}", str(Path.cwd())))
        with contextlib.suppress(OSError, ValueError):  # a text that is no name
            # A run's own files are named by {request} and {folder}, or relative to its folder.
            if place.is_absolute() and place.is_file():
                files[name] = place
    for script in [file for file in files.values() if file.suffix.lower() in CODE]:
        beside = filter(Path.is_file, script.parent.glob(f"*{script.suffix}"))
        files |= {str(other): other for other in beside}
    return files


@dataclass(frozen=True, slots=True)
class Command:
    """How a program is started, and how long it may take.

    Attributes
    ----------
    arguments : tuple of str
        The program and its arguments; no shell reads them. ``{request}`` and ``{folder}`` stand for
        the request file and the folder of the run, ``{here}`` for the folder in which this process
        was started; nothing else is replaced. Programs run in the folder of their run.
    environment : mapping
        Variables beside those of this process.
    time_limit_s : float
        After which the program and all that it has started is stopped.

    Raises
    ------
    ConfigurationError
        If there is no such program, or the limit is inadmissible.
    """

    arguments: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    time_limit_s: float = 600.0

    def __post_init__(self) -> None:
        if not self.arguments or not self.arguments[0]:
            raise ConfigurationError("command is empty, expected a program and its arguments")
        if not self.time_limit_s > 0:
            raise ConfigurationError(f"time_limit_s = {self.time_limit_s}, expected > 0")
        program = self._filled(self.arguments[0], Path())
        if os.sep in program and not Path(program).is_absolute():
            raise ConfigurationError(
                f"program {program!r}: a relative path, but programs run in the folder of their "
                f"run; expected {{here}}{os.sep}{program} or an absolute path"
            )
        if shutil.which(program) is None:
            raise ConfigurationError(f"program {program!r} is not found or not executable")

    def run(self, folder: Path) -> str:
        """Run the program in ``folder``; returns why it failed, empty where it did not."""
        with self.started(folder) as ended:
            return ended()

    @contextlib.contextmanager
    def started(self, folder: Path) -> Iterator[Callable[[], str]]:
        """Start the program in ``folder``; yields the function that waits for its end.

        That function returns why the program failed, empty where it did not. All that the program
        has started is stopped with it: at the time limit, when it ends, on leaving, and when this
        process ends.
        """
        limit = time.monotonic() + self.time_limit_s
        # A user's program may import what lies beside it; `mvest.processes.side_by_side` forbids
        # that to the processes of its own.
        inherited = {k: value for k, value in os.environ.items() if k != "PYTHONSAFEPATH"}
        with contextlib.ExitStack() as stack:
            try:
                streams = [stack.enter_context((folder / k).open("wb")) for k in (OUTPUT, ERRORS)]
                program = Program(
                    [self._filled(text, folder.resolve()) for text in self.arguments],
                    cwd=folder,
                    env={**inherited, **self.environment},
                    stdin=subprocess.DEVNULL,
                    stdout=streams[0],
                    stderr=streams[1],
                )
                stack.enter_context(program)
            except (OSError, ValueError) as error:  # the latter of arguments with a NUL
                reason = f"the program could not be started: {message_of(error)}"
                yield lambda: reason
            else:
                yield lambda: self._ended(program, limit, folder / ERRORS)

    def _ended(self, program: Program, limit: float, errors: Path) -> str:
        try:
            code = program.process.wait(limit - time.monotonic())
            reason = ending(code) if code else ""
        except subprocess.TimeoutExpired:
            reason = f"stopped at the time limit of {self.time_limit_s:g} s"
        program.close()
        if not reason:
            return ""
        with errors.open("rb") as stream:
            stream.seek(max(0, stream.seek(0, os.SEEK_END) - 4096))
            said = stream.read().decode(errors="replace").splitlines()
        words = [line[:200] for line in map(one_line, said) if line]
        return f"{reason}; its last words: {' | '.join(words[-4:])}" if words else reason

    def _filled(self, text: str, folder: Path) -> str:
        request, here = str(folder / REQUEST), str(Path.cwd())
        places = {"request": request, "folder": str(folder), "here": here}
        return PLACEHOLDER.sub(lambda found: places[found[1]], text)


class RequestParameter(BaseModel):
    """A parameter of a request."""

    model_config = ConfigDict(frozen=True)
    name: str = Field(min_length=1)
    value: Annotated[float, Field(allow_inf_nan=False)]
    unit: str = ""


class RunRequest(BaseModel):
    """The request of one run, as ``request.json`` holds it.

    Attributes
    ----------
    parameters : tuple of RequestParameter, (p,)
    points : int
        Number of observed points.
    jacobian : bool
        Whether derivatives are of use.
    settings : mapping
        Whatever else the program needs; plain data.
    """

    model_config = ConfigDict(frozen=True)
    format: Literal["mvest-external"] = FORMAT
    version: Literal[1] = VERSION
    parameters: tuple[RequestParameter, ...] = Field(min_length=1)
    points: int = Field(ge=1)
    length_unit: Literal["mm"] = "mm"
    jacobian: bool = True
    settings: dict[str, Any] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters, ``(p,)``."""
        return tuple(one.name for one in self.parameters)

    @property
    def values(self) -> tuple[float, ...]:
        """Of the parameters, ``(p,)``."""
        return tuple(one.value for one in self.parameters)


class _Response(BaseModel):
    format: Literal["mvest-external"] = FORMAT
    version: Literal[1] = VERSION
    status: Literal["converged", "failed"]
    reason: str = ""


def write_request(folder: Path, request: RunRequest, points: FloatArray | None = None) -> None:
    """Write ``request.json`` and, where points ``(n, 3)`` mm are given, ``points.csv``.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    if points is not None:
        write_points(folder / POINTS, points)
    write_json(folder / REQUEST, request.model_dump())


def read_request(file: Path) -> RunRequest:
    """Read ``request.json``: the program's side.

    Raises
    ------
    InputError
        If the file is no request of this format.
    """
    return validated(RunRequest, read_mapping(file, MAX_JSON_SIZE), str(file))


def write_answer(folder: Path, prediction: Prediction, names: Sequence[str] | None = None) -> None:
    """Write a prediction as the answer to a request: the program's side.

    Without ``names`` of the parameters the derivatives are left out.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    if prediction.converged:
        write_points(folder / OBSERVATION, prediction.y.reshape(-1, 3))
        if names is not None:
            write_columns(folder / JACOBIAN, names, prediction.jacobian.tolist())
    status = "converged" if prediction.converged else "failed"
    answer = {"format": FORMAT, "version": VERSION, "status": status, "reason": prediction.reason}
    write_json(folder / RESPONSE, answer)


def read_answer(folder: Path, request: RunRequest) -> Prediction:
    """Read the answer of a run from its folder; undifferentiated without ``jacobian.csv``.

    Raises
    ------
    InputError
        If a file is missing or damaged, or its shape or its numbers differ from the request's.
    """
    data = read_mapping(folder / RESPONSE, MAX_JSON_SIZE, RESPONSE)
    answer = validated(_Response, data, RESPONSE)
    if answer.status == "failed":
        return Prediction.failed(answer.reason.strip() or "the program gives no reason")
    y = read_points(folder / OBSERVATION, request.points).ravel()
    if not (folder / JACOBIAN).exists():
        return Prediction.undifferentiated(y)
    return Prediction(y, _read_table(folder / JACOBIAN, request.names, y.size))


def read_points(file: Path, count: int | None = None) -> FloatArray:
    """Positions ``(n, 3)`` mm of a table ``x,y,z``.

    Raises
    ------
    InputError
        If the file is no such table, or (with ``count``) has another number of rows.
    """
    return _read_table(file, COORDINATES, count)


def write_points(file: Path, points: FloatArray) -> None:
    """Write positions ``(n, 3)`` mm as a table ``x,y,z``.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_columns(file, COORDINATES, points.tolist())


def _read_table(file: Path, header: Sequence[str], count: int | None) -> FloatArray:
    """Finite numbers ``(count, columns)`` below a header."""
    table = read_numbers(file, header, max_abs=math.inf, where=file.name)
    if count is not None and len(table) != count:
        raise InputError(f"{file.name}: {len(table)} rows, expected {count}")
    return table
