"""An external program as an observation model: parameters in, positions and derivatives out.

All data pass through files. Without derivatives from the program, differences are used.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import ConfigurationError, InputError
from mvest.estimation.prediction import Prediction
from mvest.exchange.external.contract import (
    RESPONSE,
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


@dataclass(slots=True, eq=False)
class ProcessModel:
    """Coordinates ``(3 n,)`` mm that a program predicts for parameters ``(p,)``.

    This is an observation model for the filters: a failed run gives a failed prediction with a
    reason. Each run has its own folder below ``folder``. Converged runs are reused, so an
    interrupted study resumes where it stopped.

    InputError or ConfigurationError if the folder cannot be created, or points, names and units are
    inconsistent.

    Parameters
    ----------
    command : Command
    folder : Path
        Parent folder of the runs; created if missing.
    names : sequence of str
        Names of the parameters.
    count : int
        Number n of observed points.
    units : sequence of str, optional
        Units of the parameters.
    points : ndarray, optional
        ``(n, 3)`` mm, reference positions of the observed points, passed to the program.
    settings : mapping, optional
        Plain data, passed to the program.
    inputs : sequence of str
        Files and folders that affect the predictions, in addition to those named in the command. A
        run is not reused if any of their contents has changed.
    differences : bool
        Whether to use central differences ``(h(m + d) - h(m - d)) / 2d`` if the program gives no
        derivatives: two runs per parameter. Their error is second order in the step. The program's
        solver tolerance adds an error of tolerance over step, so choose a step much larger than it.
    relative_step, floor : float
        Step relative to the size of a parameter, and the smallest size, in its unit; needed if a
        parameter may be zero.
    processes : int
        Number of simultaneous runs.
    """

    command: Command
    folder: Path
    names: Sequence[str]
    count: int
    _: KW_ONLY
    units: Sequence[str] | None = None
    points: FloatArray | None = None
    settings: Mapping[str, Any] | None = None
    inputs: Sequence[str] = ()
    differences: bool = True
    relative_step: float = 1e-3
    floor: float = 0.0
    processes: int = 1
    runs: int = field(default=0, init=False)  #: number of started runs
    #: whether the program itself gave the last derivatives
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
        self._request(np.zeros(len(self.names)), True)  # checks the settings
        require_writable(self.folder)

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Run the program at ``m``, and at its neighbours if it gives no derivatives."""
        if m.shape != (len(self.names),):
            raise InputError(f"{m.size} parameters, expected {', '.join(self.names)}")
        if not np.all(np.isfinite(m)):
            return Prediction.failed(f"the parameters {m} are not finite")
        (first,) = self._predictions(m[None], jacobian=True)
        self.own_jacobian = first.differentiated
        if not first.converged or first.differentiated:
            return first
        found = self.by_differences(m)
        return Prediction.failed(found) if isinstance(found, str) else Prediction(first.y, found)

    def by_differences(self, m: FloatArray) -> FloatArray | str:
        """Derivatives ``(3 n, p)`` of the prediction at ``m``, or the reason why there are none."""
        if not self.differences:
            return "no derivatives: jacobian.csv is missing, differences=none"
        step = self.relative_step * np.maximum(np.abs(m), self.floor)
        if len(bad := np.flatnonzero(m + step == m)):
            return (
                f"parameter {bad[0]} is {m[bad[0]]:g}, and so is its step; expected a floor, its "
                "usual size"
            )
        points = np.concatenate([m + np.diag(step), m - np.diag(step)])
        found: list[Prediction] = []
        for first in range(0, len(points), self.processes):
            batch = points[first : first + self.processes]
            for at, one in zip(batch, self._predictions(batch, jacobian=False), strict=True):
                if not one.converged:
                    values = ", ".join(f"{n} = {v:g}" for n, v in zip(self.names, at, strict=True))
                    return f"run for a difference at {values}: {one.reason}"
                found.append(one)
        upper, lower = np.split(np.array([one.y for one in found]), 2)
        steps = np.diagonal(points[: m.size] - points[m.size :])  # the steps after rounding
        return np.asarray((upper - lower).T / steps)

    def _request(self, m: FloatArray, jacobian: bool) -> RunRequest:
        rows = zip(self.names, m.tolist(), self.units or [""] * len(self.names), strict=True)
        request = {
            "parameters": [{"name": n, "value": value, "unit": unit} for n, value, unit in rows],
            "points": self.count,
            "jacobian": jacobian,
            "settings": self.settings or {},
        }
        return validated(RunRequest, request, "request")

    def _folder(self, request: RunRequest) -> Path:
        """The folder of a run, named after a hash of everything that affects its result."""
        points = None if self.points is None else self.points.tolist()
        command = self.command
        files = {str(path): path for path in map(Path, self.inputs)}
        files |= files_of_command(command.arguments, command.environment)
        content = {
            "command": [command.arguments, command.environment],
            "files": {name: sha256_of(path) for name, path in files.items()},
            "points": points,
            "request": request.model_dump(),
        }
        return self.folder / f"run-{config_hash(content)[:16]}"

    def _predictions(self, points: FloatArray, jacobian: bool) -> list[Prediction]:
        """Predictions at all points, run in parallel; an exception stops all programs."""
        with ExitStack() as stack:
            started = []
            for request in [self._request(m, jacobian) for m in points]:
                folder = self._folder(request)
                ended: Callable[[], str] = str  # a finished run has no failure
                if not (folder / RESPONSE).exists():
                    self.runs += 1
                    try:
                        shutil.rmtree(folder, ignore_errors=True)  # an interrupted run
                        folder.mkdir(parents=True)
                        write_request(folder, request, self.points)
                    except (OSError, InputError) as error:
                        return [Prediction.failed(str(error))] * len(points)
                    ended = stack.enter_context(self.command.started(folder))
                started.append((folder, request, ended))
            return [_result(folder, request, ended()) for folder, request, ended in started]


def _result(folder: Path, request: RunRequest, failure: str) -> Prediction:
    """The prediction of a run; ``failure`` is the reason why the program failed, or empty.

    The response of a failed run is deleted, so that it is not reused.
    """
    try:
        answer = read_answer(folder, request)
    except InputError as error:
        # A program that failed has often written no response.
        explained = failure and "missing" in str(error)
        failure = failure if explained else "; ".join(filter(None, [failure, str(error)]))
    else:
        if not answer.converged:
            failure = "; ".join(filter(None, [failure, answer.reason]))
    if not failure:
        return answer
    (folder / RESPONSE).unlink(missing_ok=True)
    return Prediction.failed(f"{folder.name}: {failure}")
