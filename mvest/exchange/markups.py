"""Points and curves as 3D Slicer's markups (``.mrk.json``), written and read; its ``.fcsv`` read.

The format is the JSON schema ``markups-schema-v1.0.3.json`` of Slicer's module Markups. Positions
here are always LPS in mm.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.exchange.segmentations import checked_path
from mvest.files import write_atomically
from mvest.reading.bounded import refusing
from mvest.reading.text import (
    MAX_NUMBER,
    check_words,
    number,
    one_line,
    read_bytes,
    read_text,
)
from mvest.typing import FloatArray

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)
KINDS = ("Fiducial", "Curve", "ClosedCurve")
TO_LPS = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}
FCSV_AXES = {"LPS": "LPS", "RAS": "RAS", "0": "RAS", "1": "LPS"}
"""As numbers before Slicer 4.11."""
FCSV_COLUMNS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label")
MAX_BYTES = 2**24


def fault(path: Path, field: str, value: object, expected: str) -> InputError:
    """What to raise where a file's field is not what it must be."""
    return InputError(f"{path}: {field}: {one_line(value)}, expected {expected}")


@dataclass(frozen=True, slots=True, eq=False)
class PointList:
    """Points with their labels.

    Attributes
    ----------
    labels : tuple of str
        One for each point, all different.
    points : (n, 3) mm
        LPS.
    kind : str
        ``"Fiducial"`` (points by themselves), ``"Curve"`` or ``"ClosedCurve"``.
    """

    labels: tuple[str, ...]
    points: FloatArray
    kind: str = "Fiducial"

    def __post_init__(self) -> None:
        if np.shape(self.points) != (len(self.labels), 3) or not np.isfinite(self.points).all():
            raise InputError(
                f"points of shape {np.shape(self.points)}, expected {len(self.labels)} x 3 finite "
                "numbers, as there are labels"
            )
        if len(set(self.labels)) < len(self.labels) or not all(self.labels):
            raise InputError(
                f"labels {', '.join(self.labels)}, expected different ones, none empty"
            )
        if self.kind not in KINDS:
            raise InputError(f"kind {self.kind!r}, expected {', '.join(KINDS)}")

    @classmethod
    def numbered(cls, name: str, points: FloatArray, kind: str = "Fiducial") -> PointList:
        """Points ``(n, 3)`` labelled ``name-1``, ``name-2``, ..."""
        return cls(tuple(f"{name}-{i + 1}" for i in range(len(points))), points, kind)

    def point(self, label: str) -> FloatArray:
        """Position ``(3,)`` of the point with a label."""
        if label not in self.labels:
            raise InputError(f"no point {label!r}, found {', '.join(self.labels)}")
        return self.points[self.labels.index(label)]


def write_markups(path: Path | str, lists: Mapping[str, PointList]) -> Path:
    """Write lists of points and curves under their names.

    Parameters
    ----------
    path
        Ends in ``.mrk.json``.
    lists
        By name, at least one.

    Raises
    ------
    InputError
        Another extension, nothing to write, or a file that cannot be written.
    """
    target = checked_path(path, ".mrk.json")
    if not lists:
        raise InputError(f"{target}: no lists of points, expected at least one")
    content = {
        "@schema": SCHEMA,
        "markups": [
            {
                "type": item.kind,
                "name": name,
                "coordinateSystem": "LPS",
                "coordinateUnits": "mm",
                "locked": False,
                "labelFormat": "%N-%d",
                "controlPoints": [
                    {
                        "id": str(number + 1),
                        "label": label,
                        "position": [float(x) for x in point],
                        "selected": True,
                        "locked": False,
                        "visibility": True,
                        "positionStatus": "defined",
                    }
                    for number, (label, point) in enumerate(
                        zip(item.labels, item.points, strict=True)
                    )
                ],
            }
            for name, item in lists.items()
        ],
    }
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    return write_atomically(target, text)


def read_markups(path: Path | str) -> dict[str, PointList]:
    """Read lists of points and curves by their names, as Slicer or `write_markups` wrote them.

    Raises
    ------
    InputError
        No such file, no JSON of this schema; a list of another kind, with a name that another one
        has, in an unknown system or unit; a point without label or position, or not placed.
    """
    source = Path(path)
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    with refusing(source, "markups"):
        return _read(source)


def read_fcsv(path: Path | str) -> list[tuple[str, FloatArray]]:
    """Read the labels and positions ``(3,)`` (LPS, mm) of Slicer's older lists of points.

    Raises
    ------
    InputError
        No such file, unknown axes, a row without position.
    """
    source = Path(path)
    with refusing(source, "list of points"):
        axes, columns, rows = "RAS", list(FCSV_COLUMNS), []
        for line in csv.reader(io.StringIO(read_text(source, MAX_BYTES), newline=""), strict=True):
            key, _, value = ",".join(line).removeprefix("#").strip().partition("=")
            match key.strip():
                case "CoordinateSystem" if line[0].startswith("#"):
                    if value.strip() not in FCSV_AXES:
                        raise fault(source, "CoordinateSystem", repr(value.strip()), "LPS or RAS")
                    axes = FCSV_AXES[value.strip()]
                case "columns" if line[0].startswith("#"):
                    columns = [name.strip() for name in value.split(",")]
                case _ if line and not line[0].startswith("#"):
                    rows.append(line)
        if not {"x", "y", "z", "label"} <= set(columns):
            raise fault(source, "columns", ",".join(columns), "x, y, z and label")
        at = [columns.index(name) for name in ("x", "y", "z", "label")]
        result = []
        for row, cells in enumerate(rows):
            if len(cells) <= max(at):
                raise fault(source, f"row {row}", f"{len(cells)} cells", f"{len(columns)}")
            position = np.array([number(cells[k]) for k in at[:3]]) * TO_LPS[axes]
            result.append((check_words(cells[at[3]]).strip(), position))
        return result


def _read(source: Path) -> dict[str, PointList]:
    try:
        content = json.loads(read_bytes(source, MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise fault(source, "content", error, "JSON as Slicer writes it") from error
    content = _member(source, "content", content, dict)
    schema = _member(source, "@schema", content.get("@schema"), str)
    if "/markups-schema-v1." not in schema:
        raise fault(source, "@schema", repr(schema), "markups-schema-v1.0.3.json or alike")
    result: dict[str, PointList] = {}
    for index, item in enumerate(_member(source, "markups", content.get("markups"), list)):
        where = f"markups[{index}]"
        name, points = _read_list(source, where, _member(source, where, item, dict), index)
        if name in result:
            raise fault(source, f"{where}.name", repr(name), "another name in every list")
        result[name] = points
    if not result:
        raise fault(source, "markups", "nothing", "at least one list of points")
    return result


def _member(path: Path, field: str, value: object, kind: type) -> Any:
    if not isinstance(value, kind) or isinstance(value, bool):
        words = {"dict": "an object", "list": "a list", "str": "text"}[kind.__name__]
        raise fault(path, field, "missing" if value is None else repr(value), words)
    return value


def _read_list(path: Path, where: str, item: Any, number: int) -> tuple[str, PointList]:
    kind = item.get("type")
    if kind not in KINDS:
        raise fault(path, f"{where}.type", repr(kind), ", ".join(KINDS))
    system = item.get("coordinateSystem")
    if system not in TO_LPS:
        raise fault(path, f"{where}.coordinateSystem", repr(system), "LPS or RAS")
    unit = item.get("coordinateUnits", "mm")  # the schema's own default, before version 1.0.1
    if unit != "mm" and (not isinstance(unit, list) or unit[:2] != ["mm", "UCUM"]):
        raise fault(path, f"{where}.coordinateUnits", repr(unit), "mm")
    labels, points = [], []
    for index, point in enumerate(
        _member(path, f"{where}.controlPoints", item.get("controlPoints"), list)
    ):
        field = f"{where}.controlPoints[{index}]"
        point = _member(path, field, point, dict)
        label = _member(path, f"{field}.label", point.get("label"), str)
        status = point.get("positionStatus", "defined")
        if status != "defined":
            raise fault(path, f"{field}.positionStatus", repr(status), "a point that was placed")
        position = _member(path, f"{field}.position", point.get("position"), list)
        # Compared as they are: Python's whole numbers have no largest one, and NumPy's do.
        numbers = [x for x in position if type(x) in (int, float) and abs(x) <= MAX_NUMBER]
        if len(numbers) != 3 or len(position) != 3:
            raise fault(path, f"{field}.position", repr(position), "three numbers")
        if not label or label in labels:
            raise fault(path, f"{field}.label", repr(label), "a label that no other point has")
        labels.append(label)
        points.append(numbers)
    if not labels:
        raise fault(path, f"{where}.controlPoints", "nothing", "at least one point")
    name = _member(path, f"{where}.name", item.get("name", f"list {number + 1}"), str)
    array = np.array(points, dtype=np.float64) * TO_LPS[system]
    return name, PointList(tuple(labels), array, kind)
