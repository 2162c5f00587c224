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

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mvest.errors import InputError, cannot_write
from mvest.estimation.prediction import Prediction
from mvest.provenance import write_json
from mvest.typing import FloatArray

__all__ = [
    "ANSWERS",
    "FORMAT",
    "JACOBIAN",
    "OBSERVATION",
    "POINTS",
    "REQUEST",
    "RESPONSE",
    "VERSION",
    "Answer",
    "RunRequest",
    "read_answer",
    "read_points",
    "read_request",
    "write_answer",
    "write_points",
    "write_request",
]

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
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: no request: {error!r}") from error


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
            f"{file.name}: status {status!r}, expected 'converged' or 'failed' with a reason"
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
    try:
        with file.open("rb") as stream:
            text = stream.read(MAX_JSON_SIZE + 1)
        if len(text) > MAX_JSON_SIZE:
            raise InputError(f"{file.name}: more than {MAX_JSON_SIZE} bytes")
        data = json.loads(text, parse_constant=_refuse)
    except FileNotFoundError as error:
        raise InputError(f"{file.name} is missing") from error
    except OSError as error:
        raise InputError(f"{file.name} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file.name} is not JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f"{file.name} holds a {type(data).__name__}, expected a mapping")
    found = (data.get("format"), data.get("version"))
    if found != (FORMAT, VERSION):
        raise InputError(f"{file.name}: format and version {found}, expected {(FORMAT, VERSION)}")
    return data


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _read_table(file: Path, header: Sequence[str], count: int | None) -> FloatArray:
    """Finite numbers ``(count, columns)`` below a header; nothing is read beyond what is asked."""
    rows: list[list[float]] = []
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            found = next(reader, [])
            if found != list(header):
                raise InputError(
                    f"{file.name}: columns {','.join(found)[:80] or 'none'}, expected "
                    f"{','.join(header)}"
                )
            for row in reader:
                if len(rows) == count:
                    raise InputError(f"{file.name}: more than the {count} rows asked for")
                rows.append(_numbers(file, row, len(rows), header))
    except FileNotFoundError as error:
        raise InputError(f"{file.name} is missing") from error
    except OSError as error:
        raise InputError(f"{file.name} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{file.name}: byte {error.start} is no UTF-8 text") from error
    except csv.Error as error:
        raise InputError(f"{file.name}: no comma-separated text: {error}") from error
    if not rows or (count is not None and len(rows) != count):
        raise InputError(f"{file.name}: {len(rows)} rows, expected {count or 'at least one'}")
    return np.array(rows, dtype=np.float64)


def _numbers(file: Path, row: Sequence[str], number: int, header: Sequence[str]) -> list[float]:
    if len(row) != len(header):
        raise InputError(f"{file.name}: row {number} has {len(row)} cells, expected {len(header)}")
    values = []
    for name, cell in zip(header, row, strict=True):
        try:
            # Python alone reads 1_000 as a number.
            value = math.nan if "_" in cell else float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(
                f"{file.name}: {name} of row {number} is {cell[:40]!r}, expected a finite number"
            )
        values.append(value)
    return values


def _write_table(file: Path, header: Sequence[str], rows: Iterable[Iterable[float]]) -> None:
    """Numbers with all their digits."""
    try:
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            writer.writerows([repr(float(value)) for value in row] for row in rows)
    except OSError as error:
        raise cannot_write(file, error) from error
