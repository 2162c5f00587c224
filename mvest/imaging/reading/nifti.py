"""NIfTI files (``.nii``, ``.nii.gz``), versions 1 and 2, whose world is RAS.

The header is read by nibabel. The unit of length may be missing: of those that the format knows (m,
mm, um) only mm passes the checks of spacing. The unit of time has to be there.
"""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mvest.imaging.reading.data import read_exactly
from mvest.imaging.reading.plausible import check_size
from mvest.imaging.reading.stated import FieldNames, StatedTimes, StatedVolume, fault
from mvest.typing import FloatArray

NAMES = FieldNames("dim", "sform or qform", "sform or qform", "sform or qform", "data")
GZIP = b"\x1f\x8b"
MM_PER_UNIT = {"unknown": 1.0, "mm": 1.0, "meter": 1000.0, "micron": 1e-3}
TO_LPS = np.array([-1.0, -1.0, 1.0])
MAX_CODE = 5
"""Of the forms of coordinates that the format knows."""
ROUNDING = 1e-3
"""Relative difference of lengths that the header gives twice."""
BYTES_BEFORE = (352, 2**24)
"""Of header and extensions, before the voxels."""


def _begin(path: Path) -> bytes:
    """The first bytes, decompressed if need be."""
    with path.open("rb") as file:
        head = file.read(2)
        file.seek(0)
        if head != GZIP:
            return file.read(540)
        try:
            with gzip.GzipFile(fileobj=file) as stream:
                return stream.read(540)
        except (EOFError, OSError, zlib.error):
            return b""


def is_nifti(path: Path) -> bool:
    """Whether a file, compressed or not, has the mark of NIfTI 1 or 2, as one file or two."""
    head = _begin(path)
    return head[344:348] in (b"n+1\0", b"ni1\0") or head[4:8] in (b"n+2\0", b"ni2\0")


def read_nifti(path: Path, max_bytes: int) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a NIfTI file of three or four axes.

    Raises
    ------
    InputError
        A field that is missing, contradicts another or is not supported; truncated data.
    """
    import nibabel

    begin = _begin(path)
    second = begin[4:7] in (b"n+2", b"ni2")
    kind: Any = nibabel.Nifti2Header if second else nibabel.Nifti1Header
    if b"ni" in (begin[344:346], begin[4:6]):
        raise fault(path, "magic", "a header without its image", "one file, .nii or .nii.gz")
    try:
        # Unchecked, as nibabel's checks put right by guessing what is wrong.
        header = kind(begin[: kind.template_dtype.itemsize], check=False)
        shape = header.get_data_shape()
        dtype = header.get_data_dtype()
        affine = np.asarray(header.get_best_affine(), dtype=np.float64)
        units = header.get_xyzt_units()
        scaling = header.get_slope_inter()
    except Exception as error:  # nibabel fails in many ways on a damaged header
        raise fault(path, "header", error, "one that nibabel reads") from error
    if len(shape) not in (3, 4):
        raise fault(path, "dim", " ".join(map(str, shape)), "3 or 4 axes")
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise fault(path, "datatype", dtype, "one grey value, no colour or complex number")
    sizes = (*shape, 1)[:4]
    check_size(path, "dim", [sizes[3], *sizes[:3]], dtype.itemsize, max_bytes)
    steps, origin = _geometry(path, header, affine, units[0])
    times = _times(path, header, len(shape), int(sizes[3]), units[1])
    frames = _frames(path, header, dtype, sizes)
    slope, intercept = scaling
    if slope is not None and (slope, intercept) != (1.0, 0.0):
        frames = frames.astype(np.float32)
        frames *= np.float32(slope)
        frames += np.float32(intercept)
    return StatedVolume(frames, steps, origin, times, None, NAMES), (path,)


def _geometry(
    path: Path, header: Any, affine: FloatArray, unit: str
) -> tuple[FloatArray, FloatArray]:
    for field in ("sform_code", "qform_code"):
        if not 0 <= int(header[field]) <= MAX_CODE:
            raise fault(path, field, int(header[field]), f"0 to {MAX_CODE}")
    if int(header["sform_code"]) == 0 and int(header["qform_code"]) == 0:
        raise fault(path, "sform_code", "0, as is qform_code", "a direction of the axes")
    if unit not in MM_PER_UNIT:
        raise fault(path, "xyzt_units", unit, "mm")
    lengths = np.linalg.norm(affine[:3, :3], axis=0)
    zooms = np.array(header.get_zooms()[:3], dtype=np.float64)
    if not np.allclose(zooms, lengths, rtol=ROUNDING, atol=0):
        raise fault(
            path,
            "pixdim",
            " ".join(f"{zoom:g}" for zoom in zooms),
            f"the spacing of sform or qform, {' '.join(f'{length:g}' for length in lengths)}",
        )
    scale = TO_LPS * MM_PER_UNIT[unit]
    return affine[:3, :3] * scale[:, np.newaxis], affine[:3, 3] * scale


def _times(path: Path, header: Any, dimension: int, count: int, unit: str) -> StatedTimes:
    if dimension == 3:
        return StatedTimes(None, "", "dim")
    if unit in ("hz", "ppm", "rads"):
        raise fault(path, "xyzt_units", unit, "a fourth axis of time")
    step = float(header["pixdim"][4])
    if not step > 0:
        return StatedTimes(None, "", "pixdim[4]")
    values = float(header["toffset"]) + step * np.arange(count, dtype=np.float64)
    return StatedTimes(values, "" if unit == "unknown" else unit, "pixdim[4] with xyzt_units")


def _frames(path: Path, header: Any, dtype: np.dtype[Any], sizes: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(sizes, dtype=np.int64)) * dtype.itemsize
    offset = float(header["vox_offset"])
    if not BYTES_BEFORE[0] <= offset <= BYTES_BEFORE[1]:
        raise fault(path, "vox_offset", offset, f"{BYTES_BEFORE[0]} to {BYTES_BEFORE[1]} bytes")
    start = int(offset)
    with path.open("rb") as file:
        packed = "gzip" if file.read(2) == GZIP else ""
        file.seek(0)
        content = read_exactly(path, "data", file, start + size, packed)
    return np.moveaxis(content[start:].view(dtype).reshape(sizes, order="F"), 3, 0)
