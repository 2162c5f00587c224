"""NRRD files: one volume, or a sequence as 3D Slicer writes it (``.seq.nrrd``).

The format is https://teem.sourceforge.net/nrrd/format.html; pynrrd parses the values. The axis of
frames may be any of the four. Slicer puts it first (``kinds: list domain domain domain``) or, in
newer versions, last, and names the frames' times in ``axis A index values``, A being 0 or 3
(Slicer's developer guide, "Sequences"); a multivolume has them in ``MultiVolume.FrameLabels``.
Lengths are mm unless ``space units`` says otherwise, which is Slicer's convention: it writes no
units of length.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from mvest.exchange.volumes.data import (
    FieldNames,
    Header,
    StatedTimes,
    StatedVolume,
    beside,
    fault,
    read_exactly,
)
from mvest.exchange.volumes.plausible import check_size
from mvest.imaging.volume import Modality
from mvest.typing import FloatArray

NAMES = FieldNames("sizes", "space directions", "space directions", "space origin", "data")
MODALITY_KEY = "mvest.modality"
"""Key under which this package writes what the voxels are."""
MAX_HEADER_BYTES = 2**20
"""Within which the empty line after a header must come, and lines to skip end."""
MAX_LINES = 1000
"""Of a header, and to skip; a recording of four axes has some 50."""

MAX_LIST = 4096
"""Characters of the fields that pynrrd takes apart."""
NUMERIC = (
    *("dimension", "space dimension", "line skip", "byte skip", "min", "max", "old min", "old max"),
    *("oldmin", "oldmax", "sizes", "spacings", "thicknesses", "axis mins", "axismins", "axis maxs"),
    *("axismaxs", "space origin", "measurement frame", "space directions"),
)
LISTS = ("kinds", "centerings", "labels", "units", "space units")

TO_LPS = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
}
SPACES = {
    "".join(word[0] for word in space.split("-")): space
    for name in TO_LPS
    for space in (name, f"{name}-time")
}
"""Spaces by their short names."""
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}
UNSTATED = ("", "???", "none")
KINDS_OF_SPACE = ("domain", "space", *UNSTATED)
KINDS_OF_FRAMES = ("list", "time", "range", "domain", *UNSTATED)
SYNONYMS = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"}


def read_nrrd(
    path: Path, max_bytes: int, *, labels: bool = False
) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a NRRD file of three or four axes, with the files that it consists of.

    Files whose voxels are labels are refused unless `labels` are wanted.

    Raises
    ------
    InputError
        A field that is missing, contradicts another or is not supported; truncated data.
    """
    header = _header(path)
    axis = _frame_axis(header)
    sizes = tuple(int(n) for n in header.required("sizes", "a number for each axis"))
    steps, origin = _geometry(header, axis)
    of_space = [n for a, n in enumerate(sizes) if a != axis]
    frames = 1 if axis is None else sizes[axis]
    dtype = _voxel_type(header)
    check_size(path, "sizes", [frames, *of_space], dtype.itemsize, max_bytes)
    times = StatedTimes(None, "", "dimension") if axis is None else _times(header, axis, frames)
    modality = _modality(header, labels)
    voxels, files = _voxels(header, dtype, sizes)
    voxels = voxels[np.newaxis] if axis is None else np.moveaxis(voxels, axis, 0)
    return StatedVolume(voxels, steps, origin, times, modality, NAMES), files


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of a ``.seg.nrrd`` file, as 3D Slicer writes it.

    Attributes
    ----------
    name, tags : str
    label : int
        Value of its voxels.
    layer : int
        Number of the frame that holds them.
    """

    name: str
    tags: str
    label: int
    layer: int


def segment_names(path: Path) -> tuple[Segment, ...]:
    """The segments that a file names (keys ``SegmentN_Name`` and so on); none of other formats.

    Raises
    ------
    InputError
        A damaged header, or a label or layer that is no whole number.
    """
    with path.open("rb") as file:
        if file.read(4) != b"NRRD":
            return ()
    fields = _header(path).fields
    segments = []
    for key in fields:
        if not (match := re.fullmatch(r"Segment(\d{1,4})_Name", key)):
            continue
        number = {}
        for field, missing in (("LabelValue", str(int(match[1]) + 1)), ("Layer", "0")):
            full = f"Segment{match[1]}_{field}"
            value = str(fields.get(full, missing))
            if not re.fullmatch(r"\d{1,6}", value, re.ASCII):
                raise fault(path, full, repr(value), "a whole number")
            number[field] = int(value)
        tags = str(fields.get(f"Segment{match[1]}_Tags", ""))
        segments.append(Segment(str(fields[key]), tags, number["LabelValue"], number["Layer"]))
    return tuple(segments)


def _header(path: Path) -> Header:
    """Fields and keys, each parsed by itself so that a message can name it.

    What stands twice with one meaning (old writers repeat ``space``) counts once.
    """
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    end = re.search(rb"\n\s*?\n", head)
    if end is None and len(head) == MAX_HEADER_BYTES:
        raise fault(path, "header", f"no end in {MAX_HEADER_BYTES} bytes", "an empty line")
    text = head[: end.start() if end else None].decode("utf-8", errors="replace")
    magic, *lines = text.split("\n")
    values: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if line.startswith("#"):
            continue
        if not colon or len(values) > MAX_LINES:
            raise fault(path, "header", f"line {line!r}", "'field: value' or 'key:=value'")
        name, value = name.strip(), " ".join(value.removeprefix("=").split())
        if ":=" not in line:
            name = SYNONYMS.get(name.lower(), name.lower())
        if name == "space":
            value = SPACES.get(value.lower(), value.lower())
        if values.setdefault(name, value) != value:
            raise fault(path, name, f"{values[name]!r} and {value!r}", "one value")
    fields = {}
    for name, value in values.items():
        numeric = name in NUMERIC
        if (numeric or name in LISTS) and len(value) > MAX_LIST:
            raise fault(path, name, f"{len(value)} characters", f"at most {MAX_LIST}")
        if numeric and ("_" in value or not value.isascii()):
            raise fault(path, name, repr(value), "decimal numbers")
        try:
            fields[name] = nrrd.read_header([magic, f"{name}: {value}"])[name]
        except Exception as error:  # pynrrd's parsers fail in many ways on a damaged value
            raise fault(path, name, f"{value!r} ({error})", "a value as NRRD defines it") from error
    return Header(path, fields, end.end() if end else len(head))


def _words(header: Header, field: str) -> list[str]:
    """A field with a word for each axis; empty words where it is missing."""
    dimension = header.fields["dimension"]
    words = list(header.fields.get(field, [""] * dimension))
    if len(words) != dimension:
        raise fault(header.path, field, f"{len(words)} words", f"one for each of {dimension} axes")
    return words


def _frame_axis(header: Header) -> int | None:
    """Number of the axis along which the frames lie; None for a single volume."""
    path = header.path
    dimension = header.required("dimension", "3 or 4")
    if dimension not in (3, 4):
        raise fault(path, "dimension", dimension, "3 (one volume) or 4 (volumes over time)")
    sizes = header.required("sizes", "a number for each axis")
    if len(sizes) != dimension:
        raise fault(path, "sizes", f"{len(sizes)} numbers", f"one for each of {dimension} axes")
    vectors = header.required("space directions", "a vector in mm for each axis of space")
    kinds = [kind.lower() for kind in _words(header, "kinds")]
    for axis, kind in enumerate(kinds):
        if kind not in KINDS_OF_SPACE + KINDS_OF_FRAMES:
            raise fault(
                path, "kinds", f"{kind!r} for axis {axis}", "one grey value, no colour or vector"
            )
    if np.ndim(vectors) != 2 or len(vectors) != dimension:
        raise fault(path, "space directions", vectors, f"vectors for {dimension} axes")
    without = [axis for axis, vector in enumerate(vectors) if np.isnan(vector).any()]
    if header.fields.get("space", "").endswith("-time") and not without:
        without = [axis for axis, vector in enumerate(vectors) if vector[-1] != 0]
    if len(without) != dimension - 3:
        raise fault(
            path,
            "space directions",
            f"{dimension - len(without)} of {dimension} axes in space",
            "three, and 'none' for the frames",
        )
    for axis, kind in enumerate(kinds):
        if kind not in (KINDS_OF_FRAMES if axis in without else KINDS_OF_SPACE):
            raise fault(path, "kinds", f"{kind!r} for axis {axis}", "what its direction says")
    return without[0] if without else None


def _geometry(header: Header, axis: int | None) -> tuple[FloatArray, FloatArray]:
    """Steps ``(3, 3)`` and origin ``(3,)`` in LPS, mm."""
    path, spaces = header.path, f"one of {', '.join(TO_LPS)}"
    space = header.required("space", spaces)
    name, with_time = space.removesuffix("-time"), space.endswith("-time")
    if name not in TO_LPS:
        raise fault(path, "space", repr(space), spaces)
    width = 4 if with_time else 3
    vectors = np.asarray(header.fields["space directions"], dtype=np.float64)
    origin = np.asarray(header.required("space origin", "the centre of the first voxel in mm"))
    for field, shape in (("space directions", vectors.shape[1:]), ("space origin", origin.shape)):
        if shape != (width,):
            raise fault(path, field, header.fields[field], f"{width} numbers in each vector")
    units = list(header.fields.get("space units", ["mm"] * 3))[:3]
    if any(unit not in MM_PER_UNIT for unit in units) or len(units) != 3:
        raise fault(path, "space units", " ".join(map(repr, units)), "mm, cm, m or um")
    for number, unit in enumerate(_words(header, "units")):
        if number != axis and unit not in ("mm", *UNSTATED):
            raise fault(path, "units", f"{unit!r} for axis {number}", "mm for an axis of space")
    of_space = [a for a in range(len(vectors)) if a != axis]
    if with_time and np.any(vectors[of_space, 3] != 0):
        raise fault(path, "space directions", "an axis in space and time", "one or the other")
    scale = np.array(TO_LPS[name]) * [MM_PER_UNIT[unit] for unit in units]
    return vectors[of_space, :3].T * scale[:, np.newaxis], origin[:3] * scale


def _times(header: Header, axis: int, count: int) -> StatedTimes:
    path, fields = header.path, header.fields
    unit = _words(header, "units")[axis]
    unit = "" if unit in UNSTATED else unit
    for number in (axis, 0, 3):
        field = f"axis {number} index values"
        if field in fields:
            kind = fields.get(f"axis {number} index type", "numeric")
            if kind != "numeric":
                raise fault(path, f"axis {number} index type", repr(kind), "numeric")
            return StatedTimes(_numbers(path, field, fields[field].split()), unit, field)
    field = "MultiVolume.FrameLabels"
    if field in fields:
        unit = fields.get("MultiVolume.FrameIdentifyingDICOMTagUnits", unit)
        return StatedTimes(_numbers(path, field, fields[field].split(",")), unit, field)
    step = np.asarray(fields.get("spacings", []))
    if len(step) > axis and np.isfinite(step[axis]):
        return StatedTimes(step[axis] * np.arange(count), unit, "spacings")
    if fields["space"].endswith("-time"):
        units = list(fields.get("space units", []))
        values = fields["space directions"][axis][3] * np.arange(count)
        return StatedTimes(values, units[3] if len(units) == 4 else "", "space directions")
    return StatedTimes(None, unit, f"axis {axis} index values")


def _numbers(path: Path, field: str, words: list[str]) -> FloatArray:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise fault(path, field, error, "numbers") from error


def _modality(header: Header, labels: bool) -> Modality | None:
    """What the voxels are, if the file says; they must not be labels unless these are wanted."""
    path, fields = header.path, header.fields
    if labels:
        return None
    node = fields.get("DataNodeClassName", "vtkMRMLScalarVolumeNode")
    if node != "vtkMRMLScalarVolumeNode":
        raise fault(path, "DataNodeClassName", repr(node), "vtkMRMLScalarVolumeNode")
    if any(key.startswith("Segment0_") for key in fields):
        raise fault(path, "Segment0_ID", "a segmentation", "an image")
    name = fields.get(MODALITY_KEY)
    names = [m.value for m in Modality]
    if name is not None and name not in names:
        raise fault(path, MODALITY_KEY, repr(name), ", ".join(names))
    return None if name is None else Modality(name)


def _voxel_type(header: Header) -> np.dtype[np.generic]:
    """The type of a voxel, with its order of bytes, as pynrrd reads none of them."""
    name = header.required("type", "the type of a voxel")
    order = header.fields.get("endian")
    none: dict[str, Any] = {"type": name, "endian": "little", "encoding": "raw", "dimension": 1}
    try:
        dtype = nrrd.read_data(none | {"sizes": np.zeros(1, dtype=int)}, io.BytesIO()).dtype
    except (KeyError, ValueError):
        dtype = np.dtype("V")
    if dtype.kind not in "iuf" or (dtype.kind != "f" and dtype.itemsize > 4):
        raise fault(header.path, "type", repr(name), "integers of up to 4 bytes, float or double")
    if dtype.itemsize > 1 and order not in ("little", "big"):
        raise fault(header.path, "endian", repr(order or "not stated"), "little or big")
    return dtype.newbyteorder(">") if order == "big" else dtype


def _voxels(
    header: Header, dtype: np.dtype[np.generic], sizes: tuple[int, ...]
) -> tuple[NDArray[np.generic], tuple[Path, ...]]:
    """Voxels in the shape `sizes`, first axis fastest, and the files that they came from."""
    path, name = header.path, header.fields.get("data file")
    encoding = header.required("encoding", "raw or gzip")
    if encoding not in ("raw", "gzip", "gz"):
        raise fault(path, "encoding", repr(encoding), "raw or gzip")
    source, field = (path, "data") if name is None else (beside(path, "data file", name), name)
    size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
    lines, skip = header.fields.get("line skip", 0), header.fields.get("byte skip", 0)
    stored = source.stat().st_size
    if not 0 <= lines <= MAX_LINES or not -1 <= skip <= stored or (skip and encoding != "raw"):
        raise fault(path, "byte skip", f"{skip}, with {lines} lines", "as NRRD defines it, no gzip")
    with source.open("rb") as file:
        file.seek(header.length if name is None else 0)
        start = file.tell()
        if lines:
            ends = [at.end() for at in re.finditer(rb"\n", file.read(MAX_HEADER_BYTES))]
            if len(ends) < lines:
                raise fault(path, "line skip", lines, f"no more than the {len(ends)} lines")
            start += ends[lines - 1]
        first = start + skip if skip >= 0 else stored - size
        if first < start:
            raise fault(path, field, f"{size + first} bytes", f"{size} bytes or more")
        file.seek(first)
        flat = read_exactly(path, field, file, size, "" if encoding == "raw" else "gzip")
    files = (path,) if name is None else (path, source)
    return flat.view(dtype).reshape(sizes, order="F"), files
