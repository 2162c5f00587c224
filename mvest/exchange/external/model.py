"""A program as an observation model: parameters in, positions and derivatives out, all in files.

Where the program gives no derivatives, they are differences of its predictions.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from mvest.errors import ConfigurationError, InputError, cannot_write
from mvest.estimation.prediction import Prediction
from mvest.exchange.external.contract import ANSWERS, Answer, RunRequest, read_answer, write_request
from mvest.exchange.external.process import Command, files_of_command
from mvest.files import sha256_of
from mvest.provenance import config_hash, write_json
from mvest.reading.documents import read_mapping
from mvest.typing import FloatArray

SCHEMES = ("central", "forward")


@dataclass(frozen=True, slots=True)
class Differences:
    """Difference quotients ``(h(m + d) - h(m - d)) / 2d`` or ``(h(m + d) - h(m)) / d``.

    Central ones cost two runs for each parameter and err by the square of the step, forward ones
    cost one and err by the step itself. A program that solves to a tolerance puts that tolerance,
    divided by the step, on top: the step is not to be small beside it.

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
        if self.scheme not in SCHEMES:
            raise ConfigurationError(
                f"differences scheme = {self.scheme!r}, expected one of {', '.join(SCHEMES)}"
            )
        if not 0 < self.relative_step < 1:
            raise ConfigurationError(
                f"relative_step = {self.relative_step}, expected between 0 and 1"
            )
        if not (np.isfinite(self.floor) and self.floor >= 0):
            raise ConfigurationError(f"floor = {self.floor}, expected at least 0")
        if self.processes < 1:
            raise ConfigurationError(f"processes = {self.processes}, expected at least 1")

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
        if self.scheme == "central":
            # What the parameters really differ by, rounding included.
            change = np.diagonal(points[:p] - points[p:])
            return np.asarray(((values[:p] - values[p:]).T) / change)
        return np.asarray((values - y).T / np.diagonal(points - m))


FINISHED = "finished.json"
"""Written after an answer has been read and found in order."""


@dataclass(frozen=True, slots=True)
class _Run:
    """An answer, and where it is from: neither, where no program could be started for it."""

    answer: Answer
    started: bool = False
    reused: bool = False
    seconds: float = 0.0


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
    seconds : float
        Wall time of the started runs, summed over those that ran side by side.
    own_jacobian : bool
        Whether the last prediction's derivatives are the program's own.

    Raises
    ------
    InputError, ConfigurationError
        If the folder cannot be made, an input cannot be read or the points have another shape.
    """

    def __init__(
        self,
        command: Command,
        folder: Path,
        names: Sequence[str],
        count: int,
        *,
        units: Sequence[str] | None = None,
        points: FloatArray | None = None,
        settings: Mapping[str, Any] | None = None,
        differences: Differences | None = Differences(),
        reuse: bool = True,
        inputs: Sequence[Path] = (),
    ) -> None:
        self.command, self.folder, self.names = command, folder, tuple(names)
        self.units = ("",) * len(self.names) if units is None else tuple(units)
        self.count, self.settings = count, dict(settings or {})
        self.differences, self.reuse = differences, reuse
        self.runs = self.reused = 0
        self.seconds = 0.0
        self.own_jacobian = False
        self._points = None if points is None else np.asarray(points, dtype=np.float64)
        if self._points is not None and self._points.shape != (count, 3):
            raise ConfigurationError(f"points: shape {self._points.shape}, expected ({count}, 3)")
        self._inputs = tuple(inputs)
        self._contents()
        # Units and names are in order, or this says what is not.
        self._request(np.zeros(len(self.names)), True)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Run the program at ``m``, and at its neighbours if it gives no derivatives."""
        if m.shape != (len(self.names),):
            raise InputError(f"{m.size} parameters, expected {', '.join(self.names)}")
        if not np.all(np.isfinite(m)):
            return Prediction.failed(f"the parameters {m} are not finite")
        (first,) = self._all([m], jacobian=True)
        if first.reason:
            return Prediction.failed(first.reason)
        self.own_jacobian = first.jacobian is not None
        if first.jacobian is not None:
            return Prediction(first.y, first.jacobian)
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
            if answer.reason:
                values = ", ".join(f"{n} = {v:g}" for n, v in zip(self.names, at, strict=True))
                return f"run for a difference at {values}: {answer.reason}"
        return self.differences.jacobian(m, y, [answer.y for answer in answers])

    def _request(self, m: FloatArray, jacobian: bool) -> RunRequest:
        values = tuple(float(v) for v in m)
        return RunRequest(self.names, self.units, values, self.count, jacobian, self.settings)

    def _all(self, points: Iterable[FloatArray], jacobian: bool) -> list[Answer]:
        """Answers at all points, several at a time; none goes on where one is interrupted."""
        requests = [self._request(m, jacobian) for m in points]
        processes = 1 if self.differences is None else self.differences.processes
        if processes == 1 or len(requests) == 1:
            runs = [self._run(request, None) for request in requests]
        else:
            stop = threading.Event()
            with ThreadPoolExecutor(processes) as pool:
                try:
                    runs = list(pool.map(lambda request: self._run(request, stop), requests))
                except BaseException:
                    stop.set()
                    pool.shutdown(cancel_futures=True)
                    raise
        self.runs += sum(run.started for run in runs)
        self.reused += sum(run.reused for run in runs)
        self.seconds += sum(run.seconds for run in runs)
        return [run.answer for run in runs]

    def _run(self, request: RunRequest, stop: threading.Event | None) -> _Run:
        """One run in its folder, unless it is finished there."""
        folder = self._place(request)
        try:
            folder.mkdir(exist_ok=True)
            with FileLock(folder / ".lock"):
                done = self._finished(folder, request) if self.reuse else None
                if done is not None:
                    return _Run(done, reused=True)
                return self._start(folder, request, stop)
        except (OSError, InputError) as error:
            return _Run(Answer(f"{folder.name}: {error}", np.empty(0)))

    def _start(self, folder: Path, request: RunRequest, stop: threading.Event | None) -> _Run:
        for name in (FINISHED, *ANSWERS):
            # An old answer is not to be taken for that of a program that writes none.
            (folder / name).unlink(missing_ok=True)
        write_request(folder, request, self._points)
        ending = self.command.run(folder, stop)
        try:
            answer = read_answer(folder, request)
        except InputError as error:
            answer = Answer(str(error), np.empty(0))
        if ending.reason:
            said = [] if not answer.reason or "missing" in answer.reason else [answer.reason]
            answer = Answer("; ".join([ending.reason, *said]), np.empty(0))
        if not answer.reason and self._place(request) != folder:
            answer = Answer("a file that it depends on was changed while it ran", np.empty(0))
        if answer.reason:
            answer = Answer(f"{folder.name}: {answer.reason}", np.empty(0))
        else:
            write_json(folder / FINISHED, {"sha256": _answers(folder), "seconds": ending.seconds})
        return _Run(answer, started=True, seconds=ending.seconds)

    def _finished(self, folder: Path, request: RunRequest) -> Answer | None:
        """The answer of a finished run; None if there is none, or its files were changed since."""
        try:
            marker = read_mapping(folder / FINISHED)
            if marker.get("sha256") == _answers(folder):
                return read_answer(folder, request)
        except InputError:
            pass
        return None

    def _place(self, request: RunRequest) -> Path:
        """The folder of a run, named by the SHA-256 of all that its answer depends on."""
        named = config_hash(
            {
                "request": request.data(),
                "command": self.command.arguments,
                "environment": self.command.environment,
                "points": self._points,
                "inputs": self._contents(),
            }
        )
        return self.folder / f"run-{named[:24]}"

    def _contents(self) -> dict[str, str]:
        """SHA-256 of the files that the command names and of the inputs, as they are now."""
        named = files_of_command(self.command.arguments, self.command.environment)
        files = {**named, **{str(path): path for path in self._inputs}}
        return {name: sha256_of(path) for name, path in files.items()}


def _answers(folder: Path) -> dict[str, str]:
    """SHA-256 of the files of an answer that are there."""
    return {name: sha256_of(folder / name) for name in ANSWERS if (folder / name).is_file()}
