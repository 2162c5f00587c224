"""Points as 3D Slicer's versions write them: ``.mrk.json`` and ``.fcsv``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import slicerio

from tests.exchange.variant import Variant, each_option

LABELS = ("anterolateral", "posteromedial", "F-3")
POSITIONS = np.array([[1.5, -2.0, 3.0], [4.0, 5.0, -6.25], [-7.5, 8.0, 90.0]])
"""LPS, mm."""
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v{}.json#"
)
BESIDE = ("Line", "ROI", "an empty list", "a point that is not placed")


def points(system: str) -> list[dict[str, Any]]:
    sign = [-1, -1, 1] if system == "RAS" else [1, 1, 1]
    return [
        {"id": str(k + 1), "label": label, "position": (position * sign).tolist(),
         "positionStatus": "defined"}
        for k, (label, position) in enumerate(zip(LABELS, POSITIONS, strict=True))
    ]  # fmt: skip


def markups(
    path: Path, version: str, system: str, kind: str = "Fiducial", beside: str = ""
) -> None:
    own: dict[str, Any] = {"type": kind, "name": "tips", "controlPoints": points(system)}
    if system != "no system":
        own["coordinateSystem"] = system
    if version >= "1.0.2":
        own["coordinateUnits"] = "mm" if version == "1.0.2" else ["mm", "UCUM"]
    lists = [own]
    if beside == "a point that is not placed":
        own["controlPoints"].append(
            {"id": "4", "label": "F-4", "position": [0, 0, 0], "positionStatus": "undefined"}
        )
    elif beside == "an empty list":
        lists.append({"type": "Fiducial", "name": "empty", "controlPoints": []})
    elif beside:
        lists.append(own | {"type": beside, "name": "beside", "controlPoints": points(system)[:2]})
    path.write_text(json.dumps({"@schema": SCHEMA.format(version), "markups": lists}))


def fcsv(path: Path, version: str, system: str) -> None:
    lines = [f"# Markups fiducial file version = {version}", f"# CoordinateSystem = {system}"]
    lines.append("# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID")
    for k, (label, position) in enumerate(zip(LABELS, POSITIONS, strict=True)):
        x, y, z = position if system == "LPS" else position * [-1, -1, 1]
        lines.append(f"vtkMRMLMarkupsFiducialNode_{k},{x},{y},{z},0,0,0,1,1,1,0,{label},,")
    path.write_text("\n".join(lines) + "\n")


def converted(path: Path) -> None:
    """A list of Slicer 5.0 in today's form, by slicerio."""
    older = path.with_name("older.fcsv")
    fcsv(older, "5.0", "LPS")
    slicerio.fcsv_to_markups_json(older, path)
    older.unlink()


def markup_variants() -> Iterator[Variant]:
    """Lists of the same three points."""
    for row in each_option(("1.0.0", "1.0.2", "1.0.3"), ("no system", "RAS", "LPS")):
        yield Variant("Markups", row, "a.mrk.json", lambda p, o=row: markups(p, *o))
    now = partial(markups, version="1.0.3", system="LPS")
    for kind in ("Curve", "ClosedCurve"):
        yield Variant("Markups", (kind,), "a.mrk.json", partial(now, kind=kind))
    for what in BESIDE:
        yield Variant("Markups", (f"beside: {what}",), "a.mrk.json", partial(now, beside=what))
    yield Variant("Markups", ("slicerio",), "a.mrk.json", converted)
    for row in each_option(("4.11", "5.0"), ("RAS", "LPS")):
        yield Variant("fcsv", row, "a.fcsv", lambda p, o=row: fcsv(p, *o))
