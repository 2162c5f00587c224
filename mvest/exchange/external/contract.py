"""The command of an external program, and its request and response files.

All files are text: JSON or comma-separated numbers. Each run has a folder::

    request.json      the request: parameters with values and units, settings
    points.csv        x,y,z mm: reference positions of the observed points, if given
    response.json     status, and the reason if there is no prediction; written last
    observation.csv   x,y,z mm of every observed point
    jacobian.csv      optional: one row per coordinate (x, y, z of the first point, then of the
                      next), one column per parameter, headed by its name
    stdout.txt, stderr.txt  the program's output

Anything else raises an error that names the file and the row.
"""

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
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from mvest.errors import ConfigurationError, InputError, message_of
from mvest.estimation.prediction import Prediction
from mvest.processes import Program, ending
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping, validated
from mvest.reading.text import one_line, read_numbers, write_columns
from mvest.typing import FloatArray

REQUEST, POINTS = "request.json", "points.csv"
RESPONSE, OBSERVATION, JACOBIAN = "response.json", "observation.csv", "jacobian.csv"
OUTPUT, ERRORS = "stdout.txt", "stderr.txt"
COORDINATES = ("x", "y", "z")
MAX_JSON_SIZE = 1_000_000
"""Largest size of a request or response (bytes)."""
PLACEHOLDER = re.compile(r"\{(request|folder|here)\}")
CODE = (".jl", ".m", ".py", ".r", ".sh")
"""Suffixes of scripts, which may import other scripts from their folder."""


def files_of_command(arguments: Sequence[str], environment: Mapping[str, str]) -> dict[str, Path]:
    """Existing files named in a command; a prediction depends on their content.

    These are the program, arguments that are files (also after a ``=``), and all scripts of the
    same kind in a script's folder. Files that only the program knows are not found: its libraries,
    files named in other files, modules of ``python -m``. Parameters are those of `Command`.
    """
    here, files = str(Path.cwd()), dict[str, Path]()
    path = {**os.environ, **environment}.get("PATH")
    for program in arguments[:1]:
        if found := shutil.which(program.replace("{here}", here), path=path):
            files[program] = Path(found).absolute()
    for name in (name for text in arguments for name in (text, text.partition("=")[2])):
        place = Path(name.replace("{here}", here))
        with contextlib.suppress(OSError, ValueError):  # not a valid file name
            # The run's own files are named by placeholders, or relative to its folder.
            if place.is_absolute() and place.is_file():
                files[name] = place
    for script in [file for file in files.values() if file.suffix.lower() in CODE]:
        others = filter(Path.is_file, script.parent.glob(f"*{script.suffix}"))
        files |= {str(other): other for other in others}
    return files


@dataclass(frozen=True, slots=True)
class Command:
    """How to start a program, and its time limit.

    ConfigurationError if the program does not exist, or the limit is not positive.
    """

    #: the program and its arguments, not interpreted by a shell. ``{request}`` and ``{folder}`` are
    #: replaced by the request file and the run's folder, where the program runs; ``{here}`` by the
    #: working folder of this process.
    arguments: tuple[str, ...]
    #: environment variables added to those of this process
    environment: Mapping[str, str] = field(default_factory=dict)
    time_limit_s: float = 600.0  #: the program and all its children are stopped after this time

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

    @contextlib.contextmanager
    def started(self, folder: Path) -> Iterator[Callable[[], str]]:
        """Start the program in ``folder``; yield a function that waits for its end.

        The function returns why the program failed, or an empty text. The program and all its
        children stop at the time limit, when the program ends, and when the context is left.
        """
        limit = time.monotonic() + self.time_limit_s
        # `mvest.processes.side_by_side` sets this variable. Programs may import files from their
        # own folder.
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
            except (OSError, ValueError) as error:  # ValueError: an argument contains a NUL
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
            lines = stream.read().decode(errors="replace").splitlines()
        words = [line[:200] for line in map(one_line, lines) if line]
        return f"{reason}; its last words: {' | '.join(words[-4:])}" if words else reason

    def _filled(self, text: str, folder: Path) -> str:
        values = {"request": folder / REQUEST, "folder": folder, "here": Path.cwd()}
        return PLACEHOLDER.sub(lambda found: str(values[found[1]]), text)


class RequestParameter(BaseModel):
    """A parameter of a request."""

    model_config = ConfigDict(frozen=True)
    name: str = Field(min_length=1)
    value: FiniteFloat
    unit: str = ""


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True)
    format: Literal["mvest-external"] = "mvest-external"
    version: Literal[1] = 1


class RunRequest(_Message):
    """The request of one run, as stored in ``request.json``."""

    parameters: tuple[RequestParameter, ...] = Field(min_length=1)  # (p,)
    points: int = Field(ge=1)  # number of observed points
    length_unit: Literal["mm"] = "mm"
    jacobian: bool = True  # whether derivatives are useful
    settings: dict[str, Any] = {}  # plain data for the program

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, ``(p,)``."""
        return tuple(one.name for one in self.parameters)

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the parameters, ``(p,)``."""
        return tuple(one.value for one in self.parameters)


class _Response(_Message):
    status: Literal["converged", "failed"]
    reason: str = ""


def write_request(folder: Path, request: RunRequest, points: FloatArray | None = None) -> None:
    """Write ``request.json`` and, if points ``(n, 3)`` mm are given, ``points.csv``.

    InputError if a file cannot be written.
    """
    if points is not None:
        write_points(folder / POINTS, points)
    write_json(folder / REQUEST, request.model_dump())


def read_request(file: Path) -> RunRequest:
    """Read ``request.json`` (for the program); raise an InputError if it is invalid."""
    return validated(RunRequest, read_mapping(file, MAX_JSON_SIZE), str(file))


def write_answer(folder: Path, prediction: Prediction, names: Sequence[str] | None = None) -> None:
    """Write a prediction as the response to a request (for the program).

    Derivatives are written only if ``names`` of the parameters are given.

    InputError if a file cannot be written.
    """
    if prediction.converged:
        write_points(folder / OBSERVATION, prediction.y.reshape(-1, 3))
        if names is not None:
            write_columns(folder / JACOBIAN, names, prediction.jacobian.tolist())
    status: Any = "converged" if prediction.converged else "failed"
    response = _Response(status=status, reason=prediction.reason)
    write_json(folder / RESPONSE, response.model_dump())


def read_answer(folder: Path, request: RunRequest) -> Prediction:
    """Read the response of a run; without ``jacobian.csv`` it has no derivatives.

    InputError if a file is missing or damaged, or does not fit the request.
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
    """Read positions ``(n, 3)`` mm from a table ``x,y,z``.

    InputError if the file is not such a table, or does not have ``count`` rows.
    """
    return _read_table(file, COORDINATES, count)


def write_points(file: Path, points: FloatArray) -> None:
    """Write positions ``(n, 3)`` mm as a table ``x,y,z``; raises as `write_request`."""
    write_columns(file, COORDINATES, points.tolist())


def _read_table(file: Path, header: Sequence[str], count: int | None) -> FloatArray:
    table = read_numbers(file, header, max_abs=math.inf, where=file.name)
    if count is not None and len(table) != count:
        raise InputError(f"{file.name}: {len(table)} rows, expected {count}")
    return table
