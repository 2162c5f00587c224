"""Headers and voxels of NRRD files, by pynrrd; runs in the child process.

Format: https://teem.sourceforge.net/nrrd/format.html. 3D Slicer puts the frame axis first
(``kinds: list domain domain domain``) or last, and the frame times into ``axis N index values``
(developer guide, "Sequences"). Lengths are mm unless ``space units`` states another unit, as in
Slicer. ITK writes a volume over time with ``space dimension: 4`` and no space; such files are LPS.
"""

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nrrd
import numpy as np

from mvest.exchange._images import (
    MM_PER_UNIT,
    Opened,
    Segment,
    Stated,
    Voxels,
    check,
    fault,
    neighbour_file,
    required,
)
from mvest.typing import FloatArray

MODALITY_KEY = "mvest.modality"
"""The key under which this package stores the modality."""
TO_LPS = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
}
SHORT = {
    "".join(word[0] for word in space.split("-")): space
    for name in TO_LPS
    for space in (name, f"{name}-time")
}
UNSTATED = ("", "???", "none")
MAX_LINES = 1000
"""Largest number of lines to skip; pynrrd keeps counting past the end of a file."""
KINDS_OF_SPACE = ("domain", "space", *UNSTATED)
KINDS_OF_FRAMES = ("list", "time", "range", "domain", *UNSTATED)
IMAGE_NODE = "vtkMRMLScalarVolumeNode"


def nrrd_file(path: Path, head: bytes) -> Opened:
    """The header of a NRRD file; `head` is its first `MAX_HEADER` bytes."""
    end = re.search(rb"\n[ \t\r]*\n", head)
    lines: list[str] = []
    for line in head[: end.start() if end else None].decode(errors="replace").split("\n"):
        name, colon, value = line.partition(":")
        if name.lower() == "space":
            value = f" {SHORT.get(value.strip().lower(), value.strip().lower())}"
        lines.append(line if value.startswith("=") or not lines else name.lower() + colon + value)
    try:
        fields = nrrd.read_header(list(dict.fromkeys(lines)))  # old writers repeat "space"
        kind = {key: fields[key] for key in ("type", "endian") if key in fields}
        if fields["encoding"].lower() in ("ascii", "text", "txt"):
            kind["endian"] = "little"  # text has no byte order
        empty = {**kind, "encoding": "raw", "dimension": 1, "sizes": np.zeros(1, dtype=int)}
        dtype = nrrd.read_data(empty, io.BytesIO()).dtype
    except Exception as error:  # pynrrd fails in many ways on a damaged header
        raise fault("header", error, "fields and keys as NRRD defines them") from error
    sizes = [int(n) for n in required(fields, "sizes", "a number for each axis")]
    found = f"{fields.get('dimension')}, with sizes {sizes}"
    fits = len(sizes) in (3, 4) and fields.get("dimension") == len(sizes)
    check(fits, "dimension", found, "3 (one volume) or 4 (frames)")
    axis, steps, origin = _place(fields)
    shape = (1, *sizes) if axis is None else (sizes.pop(axis), *sizes)
    data_file = fields.pop("datafile", fields.get("data file", ""))
    if data_file:
        fields["data file"] = str(neighbour_file(path, "data file", data_file))
    check(data_file or end, "header", f"no end in {len(head)} bytes", "an empty line")
    lines_to_skip = int(fields.get("line skip", fields.get("lineskip", 0)))
    check(lines_to_skip <= MAX_LINES, "line skip", lines_to_skip, f"at most {MAX_LINES}")
    field, times, unit = "dimension", None, ""
    if axis is not None:
        field, times, unit = _times(fields, axis, shape[0])
    labels = next((key for key in fields if re.match(r"Segment(\d+|ation)_", key)), "")
    if not labels and fields.get("DataNodeClassName", IMAGE_NODE) != IMAGE_NODE:
        labels = "DataNodeClassName"

    def load() -> Voxels:
        with path.open("rb") as file:
            file.seek(end.end() if end else 0)
            data: Voxels = nrrd.read_data(fields, file)
        return data[np.newaxis] if axis is None else np.moveaxis(data, axis, 0)

    return Stated(
        shape=shape,
        dtype=dtype.str,
        steps=steps,
        origin=origin,
        names=("sizes", "space directions", "space origin", "data", field),
        times=times,
        unit=unit,
        modality=fields.get(MODALITY_KEY, ""),
        labels=labels,
        data_file=data_file,
        segments=_segments(fields, shape[0]),
        is_layers=axis is not None and labels.startswith("Segment"),
    ), load


def _words(fields: Mapping[str, Any], name: str) -> list[str]:
    """A field with one word per axis; empty words if it is missing."""
    n = fields["dimension"]
    words = list(fields.get(name, [""] * n))
    check(len(words) == n, name, words, f"a word for each of {n} axes")
    return words


def _place(fields: dict[str, Any]) -> tuple[int | None, FloatArray, FloatArray]:
    """The frame axis, and the steps ``(3, 3)`` and origin ``(3,)`` in LPS, mm."""
    if fields.get("space dimension") == 4:
        fields.setdefault("space", "left-posterior-superior-time")
    space = str(required(fields, "space", f"one of {', '.join(TO_LPS)}"))
    name, n, width = space.removesuffix("-time"), fields["dimension"], 3 + space.endswith("-time")
    vectors = required(fields, "space directions", "a vector in mm for each axis of space")
    origin = required(fields, "space origin", "the centre of the first voxel in mm")
    units = [*fields.get("space units", ["mm"] * 3)][:3]
    kinds, units_of_axes = (_words(fields, field) for field in ("kinds", "units"))
    check(name in TO_LPS, "space", repr(space), f"one of {', '.join(TO_LPS)}")
    known = len(units) == 3 and {*units} <= {*MM_PER_UNIT}
    check(known, "space units", " ".join(map(repr, units)), "mm, cm, m or um")
    fits = np.shape(vectors) == (n, width) and np.shape(origin) == (width,)
    check(fits, "space directions", vectors, f"{n} vectors of {width} numbers, as origin")
    other = np.isnan(vectors).any(axis=1)
    if width == 4 and not other.any():
        other = (vectors[:, 3] != 0) & ~vectors[:, :3].any(axis=1)
    apart = other.sum() == n - 3 and not (width == 4 and vectors[~other, 3].any())
    found = f"{n - other.sum()} of {n} axes in space"
    check(apart, "space directions", found, "three, and 'none' for the frames")
    for frames, kind, unit in zip(other, kinds, units_of_axes, strict=True):
        plain = kind.lower() in (KINDS_OF_FRAMES if frames else KINDS_OF_SPACE)
        check(plain, "kinds", kind, "one grey value for a voxel, no colour or vector")
        check(frames or unit in ("mm", *UNSTATED), "units", unit, "mm for an axis of space")
    scale = np.array(TO_LPS[name]) * [MM_PER_UNIT[unit] for unit in units]
    axis = int(np.argmax(other)) if n == 4 else None
    return axis, (vectors[~other, :3] * scale).T, origin[:3] * scale


def _times(fields: Mapping[str, Any], axis: int, count: int) -> tuple[str, FloatArray | None, str]:
    """The name of the field with the frame times, the times if stated, and their unit."""
    unit = _words(fields, "units")[axis]
    unit = "" if unit in UNSTATED else unit
    for field in (f"axis {number} index values" for number in (axis, 0, 3)):
        kind = field.replace("values", "type")
        if field not in fields:
            continue
        if fields.get(kind, "numeric") != "numeric":
            return kind, None, ""
        try:
            return field, np.array([float(word) for word in fields[field].split()]), unit
        except ValueError as error:
            raise fault(field, error, "numbers") from error
    step = fields.get("spacings", [])
    if len(step) > axis and np.isfinite(step[axis]):
        return "spacings", step[axis] * np.arange(count), unit
    if len(fields["space origin"]) == 4 and not np.isnan(fields["space directions"][axis]).any():
        units = [*fields.get("space units", []), *[""] * 4]
        values = fields["space origin"][3] + fields["space directions"][axis][3] * np.arange(count)
        return "space directions", values, unit or units[3]
    return f"axis {axis} index values", None, unit


def _segments(fields: Mapping[str, Any], layers: int) -> tuple[Segment, ...]:
    """The segments of 3D Slicer 4.11 or newer (developer guide, "Segmentations")."""
    found = (re.match(r"Segment(\d{1,4})_", key, re.ASCII) for key in fields)
    segments = []
    for n in sorted({int(match[1]) for match in found if match}):
        own = {key: fields.get(f"Segment{n}_{key}", "") for key in ("Name", "ID", "Tags")}
        whole = []
        for key, end in (("LabelValue", 2**31), ("Layer", layers)):
            word = str(fields.get(f"Segment{n}_{key}", "not stated"))
            fits = re.fullmatch(r"\d{1,10}", word, re.ASCII) and int(word) < end
            check(fits, f"Segment{n}_{key}", repr(word), f"a number from 0 to {end - 1}")
            whole.append(int(word))
        name = own["Name"] or own["ID"] or f"Segment_{n}"
        segments.append(Segment(name, own["Tags"], *whole))
    return tuple(segments)
