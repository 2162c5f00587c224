"""Points and curves of 3D Slicer: reads and writes ``.mrk.json``, reads the older ``.fcsv``.

Rules and defaults follow the JSON schema ``markups-schema-v1.0.3.json`` of Slicer's Markups module
and its reader ``vtkMRMLMarkupsJsonStorageNode``. Positions here are LPS in mm.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.reading.documents import validated
from mvest.reading.text import MAX_NUMBER, number, one_line, read_bytes
from mvest.typing import FloatArray

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)
TO_LPS = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}
FCSV_AXES = {"0": "RAS", "1": "LPS"}  # before Slicer 4.11
MM_PER = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label"
MAX_BYTES = 2**24


@dataclass(frozen=True, slots=True, eq=False)
class PointList:
    """Labelled points; labels may be empty or repeated."""

    labels: tuple[str, ...]  # one per point
    points: FloatArray  # (n, 3) mm, LPS
    kind: str = "Fiducial"  # (single points), "Curve", "ClosedCurve", "Line", ...
    unplaced: tuple[str, ...] = ()  # labels of listed points without a position

    @classmethod
    def numbered(cls, name: str, points: FloatArray, kind: str = "Fiducial") -> PointList:
        """Points ``(n, 3)`` labelled ``name-1``, ``name-2``, ..."""
        return cls(tuple(f"{name}-{i + 1}" for i in range(len(points))), points, kind)


def write_markups(path: Path | str, lists: Mapping[str, PointList]) -> Path:
    """Write lists of points and curves, by name, to a ``.mrk.json`` file.

    InputError if the suffix differs, there are no lists, a position is not finite, or writing
    fails.
    """
    target = Path(path)
    if not target.name.endswith(".mrk.json") or not lists:
        raise InputError(f"{target}: expected a name that ends in .mrk.json, and at least one list")
    markups = [
        {
            "type": item.kind,
            "name": name,
            "controlPoints": [
                {"id": str(k), "label": label, "position": point.tolist()}
                for k, (label, point) in enumerate(zip(item.labels, item.points, strict=True), 1)
            ],
        }
        for name, item in lists.items()
    ]
    content = validated(_File, {"@schema": SCHEMA, "markups": markups}, str(target))
    return write_atomically(target, content.model_dump_json(by_alias=True, indent=1) + "\n")


def read_markups(path: Path | str) -> dict[str, PointList]:
    """Read lists of points, lines and curves by name (``.fcsv`` or Slicer's JSON).

    A list without a name is named after the file, as in Slicer. Points without a position go to
    `PointList.unplaced`.

    InputError if the file is missing, has neither format, or has an unknown coordinate system or
    length unit, or a placed point without three numbers.
    """
    source = Path(path)
    if source.suffix.lower() == ".fcsv":
        return {source.stem: _read_fcsv(source)}
    content = read_bytes(source, MAX_BYTES)
    try:
        data = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: no JSON as Slicer writes it: {one_line(error, 99)}") from error
    result: dict[str, PointList] = {}
    for item in validated(_File, data, str(source)).markups:
        name = item.name or source.name.removesuffix(".json").removesuffix(".mrk")
        while name in result:
            name = f"{name}_{len(result)}"
        scale = MM_PER[item.unit] * np.array(TO_LPS[item.system])
        labels: dict[bool, list[str]] = {True: [], False: []}
        positions = []
        for point in item.listed:
            placed = point.position is not None and point.status == "defined"
            labels[placed].append(one_line(point.label, 80))
            positions += [point.position] * placed
        points = np.reshape(np.array(positions, dtype=np.float64), (-1, 3)) * scale
        result[name] = PointList(
            tuple(labels[True]), points, one_line(item.type, 80), tuple(labels[False])
        )
    return result


Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_NUMBER, le=MAX_NUMBER)]


class _Point(BaseModel):
    """A control point; Slicer writes an empty string as the position of an unplaced point."""

    id: Any = ""
    label: str = ""
    position: Annotated[
        Annotated[list[Number], Field(min_length=3, max_length=3)] | None,
        BeforeValidator(lambda given: None if given == "" else given),
    ] = None
    selected: Any = True
    locked: Any = False
    visibility: Any = True
    status: Literal["undefined", "preview", "defined"] = Field("defined", alias="positionStatus")


def _code(unit: Any) -> Any:
    """The code of a unit, which may be given as ``[code, "UCUM", meaning]``."""
    return unit[0] if isinstance(unit, list) and unit[1:2] == ["UCUM"] else unit


class _Markup(BaseModel):
    type: str
    name: str = ""
    system: Literal["LPS", "RAS"] = Field("LPS", alias="coordinateSystem")
    unit: Annotated[Literal["um", "mm", "cm", "m"], BeforeValidator(_code)] = Field(
        "mm", alias="coordinateUnits"
    )
    locked: Any = False
    label_format: Any = Field("%N-%d", alias="labelFormat")
    listed: list[_Point] = Field([], alias="controlPoints")


class _File(BaseModel):
    address: str = Field(alias="@schema", pattern=r"(?i)markups-schema-v1\.\d+\.\d+\.json#*$")
    markups: list[_Markup] = Field(min_length=1)


def _read_fcsv(source: Path) -> PointList:
    text = read_bytes(source, MAX_BYTES).decode("utf-8-sig", "replace")
    head = dict(re.findall(r"(?m)^#[ \t]*(\w+)[ \t]*=(.*)$", text))
    axes = head.get("CoordinateSystem", "RAS").strip()
    if (axes := FCSV_AXES.get(axes, axes)) not in TO_LPS:
        raise InputError(f"{source}: CoordinateSystem: {one_line(axes, 40)}, expected LPS or RAS")
    columns = [name.strip() for name in head.get("columns", FCSV_COLUMNS).split(",")]
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    labels, points = [], []
    try:
        for row in csv.DictReader(lines, columns):
            points.append([number(row.get(axis) or "") for axis in "xyz"])
            labels.append(one_line(row.get("label") or "", 80))
    except (InputError, csv.Error) as error:
        raise InputError(f"{source}: position of point {len(points) + 1}: {error}") from error
    return PointList(tuple(labels), np.reshape(points, (-1, 3)) * TO_LPS[axes])
