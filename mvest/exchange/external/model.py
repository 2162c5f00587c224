"""A program as an observation model: parameters in, positions and derivatives out, all in files.

If the program gives no derivatives, they are differences of its predictions.
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


@dataclass(frozen=True, slots=True)
class Differences:
    """Difference quotients ``(h(m + d) - h(m - d)) / 2d`` or ``(h(m + d) - h(m)) / d``.

    Central differences cost two runs per parameter, with an error of second order in the step;
    forward differences cost one run, with an error of first order. The tolerance of the program's
    solver adds an error of tolerance over step: choose a step much larger than the tolerance.

    Attributes
    ----------
    scheme : str
        ``central`` or ``forward``.
    relative_step : float
        Step over the size of a parameter.
    floor : float
        Least size of a parameter, in its unit; needed if it may be zero.
    processes : int
        Number of simultaneous runs.
    """

    scheme: str = "central"
    relative_step: float = 1e-3
    floor: float = 0.0
    processes: int = 1

    def __post_init__(self) -> None:
        if self.scheme not in ("central", "forward"):
            raise ConfigurationError(
                f"differences {self.scheme!r}, expected one of central, forward"
            )
        if not (0 < self.relative_step < 1 and self.floor >= 0 and self.processes >= 1):
            raise ConfigurationError(
                f"{self}, expected 0 < relative_step < 1 and no negative floor"
            )

    def neighbours(self, m: FloatArray) -> FloatArray:
        """Parameters ``(k, p)`` of the runs: upper neighbours of ``m``, then lower ones.

        Raises
        ------
        InputError
            A parameter is so small that its step vanishes.
        """
        step = self.relative_step * np.maximum(np.abs(m), self.floor)
        if len(bad := np.flatnonzero(m + step == m)):
            raise InputError(
                f"parameter {bad[0]} is {m[bad[0]]:g}, and so is its step; expected a floor, its "
                "usual size"
            )
        upper, lower = m + np.diag(step), m - np.diag(step)
        return np.concatenate([upper, lower]) if self.scheme == "central" else upper

    def jacobian(self, m: FloatArray, y: FloatArray, predicted: Sequence[FloatArray]) -> FloatArray:
        """Derivatives ``(n, p)`` from predictions ``(n,)`` at the `neighbours`."""
        points, values, p = self.neighbours(m), np.array(predicted), m.size
        lower, at = (values[p:], points[p:]) if self.scheme == "central" else (y, m)
        # The differences after rounding.
        return np.asarray((values[:p] - lower).T / np.diagonal(points[:p] - at))


@dataclass(slots=True, eq=False)
class ProcessModel:
    """Coordinates ``(3 n,)`` mm that a program predicts for parameters ``(p,)``.

    This is an observation model for the filters: a run that fails is a failed prediction with a
    reason. Each run has its own folder below ``folder``, named by the hash of all that the run
    depends on. A finished run is reused.

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
        ``(n, 3)`` mm, reference positions of the observed points for the program.
    settings : mapping, optional
        Plain data for the program.
    differences : Differences or None
        How to differentiate if the program does not; None requires derivatives of the program.
    reuse : bool
        Whether finished runs are reused.
    inputs : sequence of Path
        Files and folders that a run depends on in addition to those of the command
        (`files_of_command`). After a change of one of them no finished run is reused; a run during
        which one changes fails.

    Attributes
    ----------
    runs, reused : int
        Number of runs that were started, and of finished ones that were reused.
    own_jacobian : bool
        Whether the program itself gave the last derivatives.

    Raises
    ------
    InputError, ConfigurationError
        The folder cannot be made, an input cannot be read, or points, names and units do not fit.
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
        # Checks names and inputs.
        self._run_folder(self._request(np.zeros(len(self.names)), True))
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
        found = self.by_differences(m, first.y)
        return Prediction.failed(found) if isinstance(found, str) else Prediction(first.y, found)

    def by_differences(self, m: FloatArray, y: FloatArray) -> FloatArray | str:
        """Derivatives ``(3 n, p)`` of the prediction ``y (3 n,)`` mm, or why there are none."""
        if self.differences is None:
            return "no derivatives: jacobian.csv is missing, differences=none"
        try:
            points = self.differences.neighbours(m)
        except InputError as error:
            return str(error)
        found = self._predictions(points, jacobian=False)
        for at, one in zip(points, found, strict=True):
            if not one.converged:
                values = ", ".join(f"{n} = {v:g}" for n, v in zip(self.names, at, strict=True))
                return f"run for a difference at {values}: {one.reason}"
        return self.differences.jacobian(m, y, [one.y for one in found])

    def _request(self, m: FloatArray, jacobian: bool) -> RunRequest:
        rows = zip(self.names, m.tolist(), self.units or [""] * len(self.names), strict=True)
        request = {
            "parameters": [{"name": n, "value": value, "unit": unit} for n, value, unit in rows],
            "points": self.count,
            "jacobian": jacobian,
            "settings": self.settings or {},
        }
        return validated(RunRequest, request, "request")

    def _predictions(self, points: FloatArray, jacobian: bool) -> list[Prediction]:
        """Predictions at all points, several at a time; an exception ends all programs."""
        requests = [self._request(m, jacobian) for m in points]
        folders = [self._run_folder(request) for request in requests]
        entries = [
            Entry(folder / "answer", partial(read_answer, request=request))
            for folder, request in zip(folders, requests, strict=True)
        ]
        if not self.reuse:
            for entry in entries:
                shutil.rmtree(entry.path, ignore_errors=True)
        before = self.runs

        def run(missing: list[int]) -> Iterator[Prediction]:
            self.runs += len(missing)
            size = 1 if self.differences is None else self.differences.processes
            for first in range(0, len(missing), size):
                batch = missing[first : first + size]
                with ExitStack() as stack:
                    ended = [self._started(folders[k], requests[k], stack) for k in batch]
                    for k, end in zip(batch, ended, strict=True):
                        yield self._read(folders[k], requests[k], end())

        try:
            found = get_or_make(entries, run, _move_answer, keep=attrgetter("converged"))
        except (OSError, InputError) as error:
            return [Prediction.failed(str(error))] * len(points)
        self.reused += len(points) - (self.runs - before)
        return found

    def _started(self, folder: Path, request: RunRequest, stack: ExitStack) -> Callable[[], str]:
        for name in ANSWERS:  # of an earlier run, which the program may not overwrite
            (folder / name).unlink(missing_ok=True)
        write_request(folder, request, self.points)
        return stack.enter_context(self.command.started(folder))

    def _read(self, folder: Path, request: RunRequest, failure: str) -> Prediction:
        """The prediction of a run; ``failure`` is why the program failed, or empty."""
        try:
            answer = read_answer(folder, request)
        except InputError as error:
            answer = Prediction.failed(str(error))
        if not answer.converged and not (failure and "missing" in answer.reason):
            failure = "; ".join(filter(None, [failure, answer.reason]))
        if not failure and self._run_folder(request) != folder:
            failure = "a file that it depends on was changed while it ran"
        return Prediction.failed(f"{folder.name}: {failure}") if failure else answer

    def _run_folder(self, request: RunRequest) -> Path:
        """The folder of a run, named by the SHA-256 of all that the prediction depends on."""
        files = files_of_command(self.command.arguments, self.command.environment)
        files |= {str(path): path for path in self.inputs}
        digest = config_hash(
            {
                "request": request.model_dump(),
                "command": self.command.arguments,
                "environment": self.command.environment,
                "points": self.points,
                "inputs": {name: sha256_of(path) for name, path in files.items()},
            }
        )
        return self.folder / f"run-{digest[:24]}"


def _move_answer(target: Path, _: Prediction) -> None:
    """Move the response from the folder of its run to a subfolder."""
    target.mkdir()
    for file in filter(Path.is_file, (target.parent / name for name in ANSWERS)):
        file.rename(target / file.name)
