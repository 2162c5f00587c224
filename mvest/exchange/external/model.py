"""A program as an observation model: parameters in, positions and derivatives out, all in files.

Where the program gives no derivatives, they are differences of its predictions.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cache import Entry, get_or_make
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.prediction import Prediction
from mvest.exchange.external.contract import (
    ANSWERS,
    Command,
    RunRequest,
    files_of_command,
    read_answer,
    write_request,
)
from mvest.files import require_writable, sha256_of
from mvest.provenance import config_hash
from mvest.reading.documents import validated
from mvest.typing import FloatArray

SCHEMES = ("central", "forward")


@dataclass(frozen=True, slots=True)
class Differences:
    """Difference quotients ``(h(m + d) - h(m - d)) / 2d`` or ``(h(m + d) - h(m)) / d``.

    Central ones cost two runs for each parameter and err by the square of the step, forward ones
    cost one and err by the step itself. A program that solves to a tolerance puts that tolerance,
    divided by the step, on top: choose the step much larger than the tolerance.

    Attributes
    ----------
    scheme : str
        ``central`` or ``forward``.
    relative_step : float
        Part of a parameter's size by which it is changed.
    floor : float
        Size that a parameter has at least, in its unit: needed where one may be zero.
    processes : int
        Runs at a time.
    """

    scheme: str = "central"
    relative_step: float = 1e-3
    floor: float = 0.0
    processes: int = 1

    def __post_init__(self) -> None:
        for name, holds, expected in (
            ("scheme", self.scheme in SCHEMES, f"one of {', '.join(SCHEMES)}"),
            ("relative_step", 0 < self.relative_step < 1, "between 0 and 1"),
            ("floor", 0 <= self.floor < np.inf, "at least 0"),
            ("processes", self.processes >= 1, "at least 1"),
        ):
            if not holds:
                raise ConfigurationError(
                    f"differences {name} = {getattr(self, name)!r}, expected {expected}"
                )

    def neighbours(self, m: FloatArray) -> FloatArray:
        """Parameters ``(k, p)`` at which the model is to be run: upper ones, then lower ones.

        Raises
        ------
        InputError
            If a parameter is so small that its step has no size.
        """
        step = self.relative_step * np.maximum(np.abs(m), self.floor)
        if not np.all(m + step != m):
            k = int(np.flatnonzero(m + step == m)[0])
            raise InputError(
                f"parameter {k} is {m[k]:g}: a relative step of it is none; expected a floor, its "
                "usual size"
            )
        moves = np.diag(step)
        return np.concatenate([m + moves, m - moves] if self.scheme == "central" else [m + moves])

    def jacobian(self, m: FloatArray, y: FloatArray, predicted: Sequence[FloatArray]) -> FloatArray:
        """Derivatives ``(n, p)`` from predictions ``(n,)`` at `neighbours`, in their order."""
        points, values = self.neighbours(m), np.array(predicted)
        p = m.size
        lower, at = (values[p:], points[p:]) if self.scheme == "central" else (y, m)
        # What the parameters really differ by, rounding included.
        return np.asarray((values[:p] - lower).T / np.diagonal(points[:p] - at))


@dataclass(slots=True, eq=False)
class ProcessModel:
    """Coordinates ``(3 n,)`` mm that a program predicts for parameters ``(p,)``.

    An observation model of the filters: whatever goes wrong with a run is the reason of a failed
    prediction. Each run has a folder of its own below ``folder``, named by the hash of all that the
    run depends on; a run that is finished there is not done again.

    Parameters
    ----------
    command : Command
    folder : Path
        Where the runs are kept; made if need be.
    names : sequence of str
        Of the parameters.
    count : int
        Number n of observed points.
    units : sequence of str, optional
        Of the parameters; empty if not given.
    points : ndarray, optional
        ``(n, 3)`` mm reference positions of the points to be observed, where the program
        needs them.
    settings : mapping, optional
        Plain data for the program, handed on as they are.
    differences : Differences or None
        How derivatives are made if the program gives none; None demands them of the program.
    reuse : bool
        Whether finished runs serve again.
    inputs : sequence of Path
        Files and folders whose contents a run depends on beside those that the command names
        (`files_of_command`): after a change of one of them nothing finished serves any more, and a
        run during which one is changed counts as failed.

    Attributes
    ----------
    runs, reused : int
        How often a program was started, and how often a finished run served instead.
    own_jacobian : bool
        Whether the last prediction's derivatives are the program's own.

    Raises
    ------
    InputError, ConfigurationError
        If the folder cannot be made, an input cannot be read or the points have another shape.
    """

    command: Command
    folder: Path
    names: Sequence[str]
    count: int
    _: KW_ONLY
    units: Sequence[str] | None = None
    points: FloatArray | None = None
    settings: Mapping[str, Any] | None = None
    differences: Differences | None = Differences()
    reuse: bool = True
    inputs: Sequence[Path] = ()
    runs: int = field(default=0, init=False)
    reused: int = field(default=0, init=False)
    own_jacobian: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if self.points is not None and np.shape(self.points) != (self.count, 3):
            shape = np.shape(self.points)
            raise ConfigurationError(f"points: shape {shape}, expected ({self.count}, 3)")
        units = self.names if self.units is None else self.units
        if not len(set(self.names)) == len(self.names) == len(units):
            raise ConfigurationError(
                f"parameters {', '.join(self.names)} in {', '.join(units)}; expected different "
                "names, and a unit of each"
            )
        # Inputs, units and names are in order, or this says what is not.
        self._place(self._request(np.zeros(len(self.names)), True))
        require_writable(self.folder)

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Run the program at ``m``, and at its neighbours if it gives no derivatives."""
        if m.shape != (len(self.names),):
            raise InputError(f"{m.size} parameters, expected {', '.join(self.names)}")
        if not np.all(np.isfinite(m)):
            return Prediction.failed(f"the parameters {m} are not finite")
        (first,) = self._all(m[None], jacobian=True)
        self.own_jacobian = first.differentiated
        if not first.converged or first.differentiated:
            return first
        if self.differences is None:
            return Prediction.failed("the program gives no derivatives: jacobian.csv is missing")
        jacobian = self.by_differences(m, first.y)
        if isinstance(jacobian, str):
            return Prediction.failed(jacobian)
        return Prediction(first.y, jacobian)

    def by_differences(self, m: FloatArray, y: FloatArray) -> FloatArray | str:
        """Derivatives ``(3 n, p)`` by differences, or the reason why there are none.

        Parameters
        ----------
        m : ndarray
            ``(p,)``.
        y : ndarray
            ``(3 n,)`` mm, the prediction at ``m``.
        """
        if self.differences is None:
            return "no differences are configured"
        try:
            points = self.differences.neighbours(m)
        except InputError as error:
            return str(error)
        answers = self._all(points, jacobian=False)
        for at, answer in zip(points, answers, strict=True):
            if not answer.converged:
                values = ", ".join(f"{n} = {v:g}" for n, v in zip(self.names, at, strict=True))
                return f"run for a difference at {values}: {answer.reason}"
        return self.differences.jacobian(m, y, [answer.y for answer in answers])

    def _request(self, m: FloatArray, jacobian: bool) -> RunRequest:
        units = self.units or [""] * len(self.names)
        rows = zip(self.names, m.tolist(), units, strict=True)
        request = {
            "parameters": [{"name": n, "value": value, "unit": unit} for n, value, unit in rows],
            "points": self.count,
            "jacobian": jacobian,
            "settings": self.settings or {},
        }
        return validated(RunRequest, request, "request")

    def _all(self, points: FloatArray, jacobian: bool) -> list[Prediction]:
        """Answers at all points, several at a time; leaving early ends the programs."""
        requests = [self._request(m, jacobian) for m in points]
        folders = [self._place(request) for request in requests]
        entries = [
            Entry(folder / "answer", partial(read_answer, request=request))
            for folder, request in zip(folders, requests, strict=True)
        ]
        if not self.reuse:
            for entry in entries:
                shutil.rmtree(entry.path, ignore_errors=True)

        before = self.runs

        def answers(missing: list[int]) -> Iterator[Prediction]:
            self.runs += len(missing)
            size = 1 if self.differences is None else self.differences.processes
            for first in range(0, len(missing), size):
                with ExitStack() as stack:
                    ended = {
                        k: self._started(folders[k], requests[k], stack)
                        for k in missing[first : first + size]
                    }
                    yield from [self._read(folders[k], requests[k], ended[k]()) for k in ended]

        try:
            found = get_or_make(entries, answers, _move_answer, keep=attrgetter("converged"))
        except (OSError, InputError) as error:
            return [Prediction.failed(str(error))] * len(points)
        self.reused += len(points) - (self.runs - before)
        return found

    def _started(self, folder: Path, request: RunRequest, stack: ExitStack) -> Callable[[], str]:
        """Start a run; returns the function that waits for its end (`Command.started`)."""
        for name in ANSWERS:
            # An old answer is not to be taken for that of a program that writes none.
            (folder / name).unlink(missing_ok=True)
        write_request(folder, request, self.points)
        return stack.enter_context(self.command.started(folder))

    def _read(self, folder: Path, request: RunRequest, reason: str) -> Prediction:
        """The answer of a run whose program failed for a reason, which may be empty."""
        try:
            answer = read_answer(folder, request)
        except InputError as error:
            answer = Prediction.failed(str(error))
        if not answer.converged and not (reason and "missing" in answer.reason):
            reason = "; ".join(filter(None, [reason, answer.reason]))
        if not reason and self._place(request) != folder:
            reason = "a file that it depends on was changed while it ran"
        return Prediction.failed(f"{folder.name}: {reason}") if reason else answer

    def _place(self, request: RunRequest) -> Path:
        """The folder of a run, named by the SHA-256 of all that its answer depends on."""
        files = files_of_command(self.command.arguments, self.command.environment)
        files |= {str(path): path for path in self.inputs}
        named = config_hash(
            {
                "request": request.model_dump(),
                "command": self.command.arguments,
                "environment": self.command.environment,
                "points": self.points,
                "inputs": {name: sha256_of(path) for name, path in files.items()},
            }
        )
        return self.folder / f"run-{named[:24]}"


def _move_answer(target: Path, _: Prediction) -> None:
    """Move the files of an answer from the folder of their run to a folder there."""
    target.mkdir()
    for file in filter(Path.is_file, (target.parent / name for name in ANSWERS)):
        file.rename(target / file.name)
