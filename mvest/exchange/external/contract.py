"""The files through which a program is asked for a prediction, and answers.

Text only: JSON and comma-separated numbers. One folder is one run::

    request.json      what is asked: parameters with values and units, settings
    points.csv        x,y,z mm: reference positions of the points to be observed, where given
    response.json     status, and the reason if there is no prediction; written last
    observation.csv   x,y,z mm of every observed point
    jacobian.csv      optional: one row for each coordinate (x, y, z of the first point, then of the
                      next), one column for each parameter, headed by its name

Reading is strict: what is not exactly that is refused with the file and the row.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.provenance import write_json
from mvest.reading.documents import read_mapping
from mvest.reading.text import one_line, read_numbers, write_columns
from mvest.typing import FloatArray

FORMAT, VERSION = "mvest-external", 1
REQUEST, POINTS = "request.json", "points.csv"
RESPONSE, OBSERVATION, JACOBIAN = "response.json", "observation.csv", "jacobian.csv"
ANSWERS = (RESPONSE, OBSERVATION, JACOBIAN)

COORDINATES = ("x", "y", "z")
MAX_JSON_SIZE = 1_000_000
"""Bytes of a response; more is none."""


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What one run is asked for.

    Attributes
    ----------
    names, units : tuple of str, (p,)
        Of the parameters; a unit may be empty.
    values : tuple of float, (p,)
    count : int
        Number of observed points.
    jacobian : bool
        Whether derivatives are of use.
    settings : mapping
        Whatever else the program needs; plain data.

    Raises
    ------
    InputError
        If the numbers of names, units and values differ, or a value is not finite.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[float, ...]
    count: int
    jacobian: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.units) == len(self.values) > 0:
            raise InputError(
                f"a request has {len(self.names)} names, {len(self.units)} units and "
                f"{len(self.values)} values; expected as many of each, at least one"
            )
        if len(set(self.names)) != len(self.names) or not all(self.names):
            raise InputError(f"parameters {self.names}: expected different names")
        if not all(map(math.isfinite, self.values)):
            raise InputError(f"values {self.values} of a request, expected finite numbers")
        if self.count < 1:
            raise InputError(f"a request for {self.count} points, expected at least one")

    def data(self) -> dict[str, Any]:
        """As it stands in ``request.json``."""
        parameters = zip(self.names, self.values, self.units, strict=True)
        return {
            "format": FORMAT,
            "version": VERSION,
            "parameters": [{"name": n, "value": v, "unit": u} for n, v, u in parameters],
            "points": self.count,
            "length_unit": "mm",
            "jacobian": self.jacobian,
            "settings": dict(self.settings),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a run answered.

    Attributes
    ----------
    reason : str
        Why there is no observation; empty where there is one.
    y : (3 n,) mm
        Coordinates point by point; empty where the program failed.
    jacobian : (3 n, p) mm per unit of each parameter, or None
    """

    reason: str
    y: FloatArray
    jacobian: FloatArray | None = None


def write_request(folder: Path, request: RunRequest, points: FloatArray | None = None) -> None:
    """Write ``request.json`` and, where points ``(n, 3)`` mm are given, ``points.csv``.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    if points is not None:
        write_points(folder / POINTS, points)
    write_json(folder / REQUEST, request.data())


def read_request(file: Path) -> RunRequest:
    """What ``request.json`` asks for: the program's side.

    Raises
    ------
    InputError
        If the file is no request of this format.
    """
    data = _read_json(file)
    try:
        parameters = data["parameters"]
        return RunRequest(
            tuple(str(p["name"]) for p in parameters),
            tuple(str(p["unit"]) for p in parameters),
            tuple(float(p["value"]) for p in parameters),
            int(data["points"]),
            bool(data["jacobian"]),
            dict(data["settings"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{file}: no request: {one_line(repr(error), 120)}") from error


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
            _write_table(folder / JACOBIAN, names, prediction.jacobian)
    status = "converged" if prediction.converged else "failed"
    answer = {"format": FORMAT, "version": VERSION, "status": status, "reason": prediction.reason}
    write_json(folder / RESPONSE, answer)


def read_answer(folder: Path, request: RunRequest) -> Answer:
    """What a run has answered in its folder.

    Raises
    ------
    InputError
        If a file is missing or damaged, or its shape or its numbers are not what was asked for.
    """
    file = folder / RESPONSE
    data = _read_json(file)
    status, reason = data.get("status"), data.get("reason", "")
    if status not in ("converged", "failed") or not isinstance(reason, str):
        raise InputError(
            f"{file.name}: status {one_line(repr(status), 60)}, expected 'converged' or 'failed' "
            "with a reason"
        )
    if status == "failed":
        return Answer(reason.strip() or "the program gives no reason", np.empty(0))
    y = _read_table(folder / OBSERVATION, COORDINATES, request.count).ravel()
    if not (folder / JACOBIAN).exists():
        return Answer("", y)
    return Answer("", y, _read_table(folder / JACOBIAN, request.names, y.size))


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
    _write_table(file, COORDINATES, points)


def _read_json(file: Path) -> dict[str, Any]:
    """A mapping of this format and version."""
    data = read_mapping(file, MAX_JSON_SIZE, file.name)
    found = (data.get("format"), data.get("version"))
    if found != (FORMAT, VERSION):
        raise InputError(
            f"{file.name}: format and version {one_line(found, 80)}, expected {(FORMAT, VERSION)}"
        )
    return data


def _read_table(file: Path, header: Sequence[str], count: int | None) -> FloatArray:
    """Finite numbers ``(count, columns)`` below a header; nothing is read beyond what is asked."""
    return read_numbers(file, header, strict=True, count=count, max_abs=math.inf, where=file.name)


def _write_table(file: Path, header: Sequence[str], rows: Iterable[Iterable[float]]) -> None:
    """Numbers with all their digits."""
    write_columns(file, header, ([repr(float(value)) for value in row] for row in rows))
