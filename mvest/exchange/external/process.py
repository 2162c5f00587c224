"""A program that is started, watched and stopped with all that it has started.

No shell is involved: each argument reaches the program as it stands, whatever characters it holds.
The program leads a process group of its own, which is stopped as a whole, whatever becomes of this
process.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mvest.errors import ConfigurationError
from mvest.exchange.external.contract import REQUEST
from mvest.processes import Program, ending

OUTPUT, ERRORS = "stdout.txt", "stderr.txt"
"""Files of a run's folder that hold what its program said."""

PLACEHOLDER = re.compile(r"\{(request|folder|here)\}")
POLL_S = 0.05
TAIL_BYTES, TAIL_LINES, LINE_LENGTH = 4096, 4, 200


CODE = (".jl", ".m", ".py", ".r", ".sh")
"""Endings of programs that take others from the folder that they lie in."""


def files_of_command(arguments: Sequence[str], environment: Mapping[str, str]) -> dict[str, Path]:
    """What a command names of the files that are there: these decide what it answers.

    They are the program itself, arguments that are files, what follows a ``=`` in an argument, and
    beside a script all others of its kind, which it may import. What only the program knows of
    (its libraries, files named within files, modules by ``python -m``) is not among them.

    Parameters
    ----------
    arguments, environment
        As in `Command`.
    """
    path = {**os.environ, **environment}.get("PATH")
    files = {}
    for k, text in enumerate(arguments):
        for name in (text, text.partition("=")[2]):
            place = Path(name.replace("{here}", str(Path.cwd())))
            if k == 0:
                place = Path(shutil.which(place, path=path) or place).absolute()
            with contextlib.suppress(OSError, ValueError):  # a text that is no name
                # A run's own files are named by {request} and {folder}, or relative to its folder.
                if place.is_absolute() and place.is_file():
                    files[name] = place
    scripts = [file for file in files.values() if file.suffix.lower() in CODE]
    return files | {
        str(other): other
        for script in scripts
        for other in script.parent.glob(f"*{script.suffix}")
        if other.is_file()
    }


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run of a program ended.

    Attributes
    ----------
    reason : str
        Empty where the exit status is 0.
    seconds : float
        Wall time.
    """

    reason: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Command:
    """How a program is started, and how long it may take.

    Attributes
    ----------
    arguments : tuple of str
        The program and its arguments. ``{request}`` and ``{folder}`` stand for the request file and
        the folder of the run, ``{here}`` for the folder in which this process was started; nothing
        else is replaced. Programs run in the folder of their run.
    environment : mapping
        Variables beside those of this process.
    time_limit_s : float
        After which the program and all that it has started is stopped.

    Raises
    ------
    ConfigurationError
        If there is no such program, or an argument, a variable or the limit is inadmissible.
    """

    arguments: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    time_limit_s: float = 600.0

    def __post_init__(self) -> None:
        if not self.arguments or not self.arguments[0]:
            raise ConfigurationError("command is empty, expected a program and its arguments")
        for text in (*self.arguments, *self.environment, *self.environment.values()):
            if "\0" in text:
                raise ConfigurationError(f"command: {text!r} holds a NUL character")
        wrong = [name for name in self.environment if not name or "=" in name]
        if wrong:
            raise ConfigurationError(f"environment: {wrong[0]!r} is no name of a variable")
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

    def run(self, folder: Path, stop: threading.Event | None = None) -> Ending:
        """Run the program in ``folder``; how it ended.

        What it says goes to ``stdout.txt`` and ``stderr.txt`` there. It is stopped at the time
        limit, when ``stop`` is set, and when this process is interrupted.
        """
        started = time.monotonic()
        arguments = [self._filled(text, folder.resolve()) for text in self.arguments]
        try:
            with (folder / OUTPUT).open("wb") as output, (folder / ERRORS).open("wb") as errors:
                program = Program(
                    arguments,
                    cwd=folder,
                    env={**os.environ, **self.environment},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=errors,
                )
        except OSError as error:
            reason = f"the program could not be started: {error.strerror or error}"
            return Ending(reason, time.monotonic() - started)
        # Left, nothing that it has started writes into files that are read by now.
        with program:
            stopped = self._watch(program.process, started, stop)
        seconds = time.monotonic() - started
        code = program.process.returncode
        reason = stopped or (ending(code) if code else "")
        return Ending(reason + _last_words(folder) if reason else "", seconds)

    def _watch(
        self, process: subprocess.Popen[bytes], started: float, stop: threading.Event | None
    ) -> str:
        """Wait for the program; why it was not let finish, empty where it was."""
        while True:
            left = started + self.time_limit_s - time.monotonic()
            try:
                process.wait(max(0.0, min(POLL_S, left)))
            except subprocess.TimeoutExpired:
                if stop is not None and stop.is_set():
                    return "stopped with the study"
                if left <= POLL_S:
                    return f"stopped at the time limit of {self.time_limit_s:g} s"
            else:
                return ""

    def _filled(self, text: str, folder: Path) -> str:
        places = {
            "request": str(folder / REQUEST),
            "folder": str(folder),
            "here": str(Path.cwd()),
        }
        return PLACEHOLDER.sub(lambda found: places[found[1]], text)


def _last_words(folder: Path) -> str:
    """The last lines that a program wrote to its standard error."""
    try:
        with (folder / ERRORS).open("rb") as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(0, stream.tell() - TAIL_BYTES))
            text = stream.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    shown = "".join(c if c.isprintable() or c == "\n" else " " for c in text)
    lines = [line.strip()[:LINE_LENGTH] for line in shown.splitlines() if line.strip()]
    return f"; its last words: {' | '.join(lines[-TAIL_LINES:])}" if lines else ""
