"""NRRD files: one volume, or a sequence as 3D Slicer writes it (``.seq.nrrd``).

The axis of frames may be any of the four. Slicer puts it first (``kinds: list domain domain
domain``) or, in newer versions, last, and names the frames' times in ``axis A index values``, A
being 0 or 3 (Slicer's developer guide, "Sequences"); a multivolume has them in
``MultiVolume.FrameLabels``. Lengths are mm unless ``space units`` says otherwise, which is Slicer's
convention: it writes no units of length.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvest.imaging.reading.checks import check_size
from mvest.imaging.reading.nrrd_data import read_data, voxel_type
from mvest.imaging.reading.nrrd_header import NrrdHeader, read_header
from mvest.imaging.reading.stated import FieldNames, StatedTimes, StatedVolume, fault
from mvest.imaging.volume import Modality
from mvest.typing import FloatArray

__all__ = ["MODALITY_KEY", "read_nrrd"]

NAMES = FieldNames("sizes", "space directions", "space directions", "space origin", "data")
MODALITY_KEY = "mvest.modality"
"""Key under which this package writes what the voxels are."""

TO_LPS = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
}
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}
UNSTATED = ("", "???", "none")
KINDS_OF_SPACE = ("domain", "space", *UNSTATED)
KINDS_OF_FRAMES = ("list", "time", "range", "domain", *UNSTATED)


def read_nrrd(path: Path) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a NRRD file of three or four axes, with the files that it consists of.

    Raises
    ------
    InputError
        A field that is missing, contradicts another or is not supported; truncated data.
    """
    header = read_header(path)
    axis = _frame_axis(header)
    sizes = np.asarray(header.required("sizes", "a number for each axis"))
    steps, origin = _geometry(header, axis)
    of_space = [a for a in range(len(sizes)) if a != axis]
    frames = 1 if axis is None else int(sizes[axis])
    dtype = voxel_type(header)
    check_size(path, "sizes", [frames, *(int(sizes[a]) for a in of_space)], dtype.itemsize)
    times = _times(header, axis, frames)
    _check_meaning(header)
    data, files = read_data(header, dtype, tuple(int(n) for n in sizes))
    data = data[np.newaxis] if axis is None else np.moveaxis(data, axis, 0)
    return StatedVolume(data, steps, origin, times, _modality(header), NAMES), files


def _words(header: NrrdHeader, field: str) -> list[str]:
    """A field with a word for each axis; empty words where it is missing."""
    dimension = int(header.fields["dimension"])
    words = list(header.fields.get(field, [""] * dimension))
    if len(words) != dimension:
        raise fault(header.path, field, f"{len(words)} words", f"one for each of {dimension} axes")
    return words


def _frame_axis(header: NrrdHeader) -> int | None:
    """Number of the axis along which the frames lie; None for a single volume."""
    path = header.path
    dimension = header.required("dimension", "3 or 4")
    if dimension not in (3, 4):
        raise fault(path, "dimension", dimension, "3 (one volume) or 4 (volumes over time)")
    sizes = header.required("sizes", "a number for each axis")
    if len(sizes) != dimension:
        raise fault(path, "sizes", f"{len(sizes)} numbers", f"one for each of {dimension} axes")
    directions = header.required("space directions", "a vector in mm for each axis of space")
    kinds = [kind.lower() for kind in _words(header, "kinds")]
    for axis, kind in enumerate(kinds):
        if kind not in (*KINDS_OF_SPACE, *KINDS_OF_FRAMES):
            raise fault(
                path, "kinds", f"{kind!r} for axis {axis}", "one grey value, no colour or vector"
            )
    if np.ndim(directions) != 2 or len(directions) != dimension:
        raise fault(path, "space directions", directions, f"vectors for {dimension} axes")
    without = [axis for axis, vector in enumerate(directions) if np.isnan(vector).any()]
    if header.fields.get("space", "").endswith("-time") and not without:
        without = [axis for axis, vector in enumerate(directions) if vector[-1] != 0]
    if len(without) != dimension - 3:
        raise fault(
            path,
            "space directions",
            f"{dimension - len(without)} of {dimension} axes in space",
            "three, and 'none' for the frames",
        )
    for axis, kind in enumerate(kinds):
        allowed = KINDS_OF_FRAMES if axis in without else KINDS_OF_SPACE
        if kind not in allowed:
            raise fault(path, "kinds", f"{kind!r} for axis {axis}", "what its direction says")
    return without[0] if without else None


def _geometry(header: NrrdHeader, axis: int | None) -> tuple[FloatArray, FloatArray]:
    """Steps and origin in LPS."""
    path = header.path
    space = header.required("space", f"one of {', '.join(TO_LPS)}")
    with_time = space.endswith("-time")
    if space.removesuffix("-time") not in TO_LPS:
        raise fault(path, "space", repr(space), f"one of {', '.join(TO_LPS)}")
    width = 4 if with_time else 3
    vectors = np.asarray(header.fields["space directions"], dtype=np.float64)
    if vectors.shape[1] != width:
        raise fault(
            path, "space directions", f"vectors of {vectors.shape[1]}", f"{width} numbers in each"
        )
    origin = np.asarray(header.required("space origin", "the centre of the first voxel in mm"))
    if origin.shape != (width,):
        raise fault(path, "space origin", origin, f"{width} numbers")
    units = list(header.fields.get("space units", ["mm"] * 3))[:3]
    if any(unit not in MM_PER_UNIT for unit in units) or len(units) != 3:
        raise fault(path, "space units", " ".join(map(repr, units)), "mm, cm, m or um")
    for number, unit in enumerate(_words(header, "units")):
        if number != axis and unit not in ("mm", *UNSTATED):
            raise fault(path, "units", f"{unit!r} for axis {number}", "mm for an axis of space")
    scale = np.array(TO_LPS[space.removesuffix("-time")]) * [MM_PER_UNIT[unit] for unit in units]
    of_space = [a for a in range(len(vectors)) if a != axis]
    if with_time and np.any(vectors[of_space, 3] != 0):
        raise fault(path, "space directions", "an axis in space and time", "one or the other")
    return vectors[of_space, :3].T * scale[:, np.newaxis], origin[:3] * scale


def _times(header: NrrdHeader, axis: int | None, count: int) -> StatedTimes:
    if axis is None:
        return StatedTimes(None, "", "dimension")
    path = header.path
    unit = _words(header, "units")[axis]
    unit = "" if unit in UNSTATED else unit
    for number in (axis, 0, 3):
        field = f"axis {number} index values"
        if field in header.keys:
            kind = header.keys.get(f"axis {number} index type", "numeric")
            if kind != "numeric":
                raise fault(path, f"axis {number} index type", repr(kind), "numeric")
            return StatedTimes(_list(path, field, header.keys[field].split()), unit, field)
    field = "MultiVolume.FrameLabels"
    if field in header.keys:
        unit = header.keys.get("MultiVolume.FrameIdentifyingDICOMTagUnits", unit)
        return StatedTimes(_list(path, field, header.keys[field].split(",")), unit, field)
    step = np.asarray(header.fields.get("spacings", []))
    if len(step) > axis and np.isfinite(step[axis]):
        return StatedTimes(step[axis] * np.arange(count), unit, "spacings")
    if header.fields["space"].endswith("-time"):
        units = list(header.fields.get("space units", []))
        step = header.fields["space directions"][axis][3]
        return StatedTimes(
            step * np.arange(count), units[3] if len(units) == 4 else "", "space directions"
        )
    return StatedTimes(None, unit, f"axis {axis} index values")


def _list(path: Path, field: str, words: list[str]) -> FloatArray:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise fault(path, field, error, "numbers") from error


def _check_meaning(header: NrrdHeader) -> None:
    node = header.keys.get("DataNodeClassName", "vtkMRMLScalarVolumeNode")
    if node != "vtkMRMLScalarVolumeNode":
        raise fault(header.path, "DataNodeClassName", repr(node), "vtkMRMLScalarVolumeNode")
    if any(key.startswith("Segment0_") for key in header.keys):
        raise fault(header.path, "Segment0_ID", "a segmentation", "an image")


def _modality(header: NrrdHeader) -> Modality | None:
    name = header.keys.get(MODALITY_KEY)
    if name is None:
        return None
    try:
        return Modality(name)
    except ValueError as error:
        raise fault(
            header.path, MODALITY_KEY, repr(name), ", ".join(m.value for m in Modality)
        ) from error
