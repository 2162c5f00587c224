"""Philips Cartesian DICOM: 3D echo over time as QLAB exports it, one file for a recording.

The files are DICOM in form only: unique identifiers, and the preamble, may be missing. What they
hold is known from the readers of SlicerHeart (module DicomUltrasoundPlugin), MITK and ITK-SNAP:
columns, rows and frames are where DICOM has them, the number of slices is (3001,1001); spacings are
cm in PhysicalDeltaX, PhysicalDeltaY and (3001,1003); FrameTime is ms; the voxels, one byte each
with columns running fastest, then rows, slices and frames, are the last bytes of PixelData.

How the volume lies in the patient is not stated. Its axes are named as SlicerHeart and ITK-SNAP
name them, which agree: columns run to the right, rows to the back and slices downwards. So
(i, j, k) is right-handed, as both have it, and nothing is mirrored. The middle of the volume is the
world's zero.
"""

from __future__ import annotations

import io
import mmap
import os
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from mvest.exchange.volumes.data import FieldNames, StatedTimes, StatedVolume, fault
from mvest.exchange.volumes.plausible import check_size
from mvest.imaging.volume import Modality

SOP_CLASS = "1.2.840.113543.6.6.1.3.10002"
DEFLATED = b"1.2.840.10008.1.2.1.99"
SLICES, SLICE_UNIT, SLICE_SPACING = (0x3001, 0x1001), (0x3001, 0x1002), (0x3001, 0x1003)
CENTIMETRES = 3
"""Of PhysicalUnitsXDirection (DICOM PS3.3, C.8.5.5.1.15)."""
MM_PER_CM = 10.0
DIRECTION = np.diag([-1.0, 1.0, -1.0])
NAMES = FieldNames(
    "Columns, Rows, (3001,1001)",
    "PhysicalDeltaX, PhysicalDeltaY, (3001,1003)",
    "direction",
    "origin",
    "PixelData",
)
CONVERT = (
    "Philips Cartesian DICOM; convert other DICOM with 3D Slicer, and save the volume as .nrrd or "
    "the sequence as .seq.nrrd"
)
LONG = 2**16
"""Bytes beyond which pydicom leaves a value in the file."""


def is_dicom(head: bytes) -> bool:
    """Whether a file that begins so is DICOM, with or without preamble."""
    return head[128:132] == b"DICM" or head[:2] in (b"\x08\x00", b"\x02\x00")


def read_philips(path: Path, max_bytes: int) -> tuple[StatedVolume, tuple[Path, ...]]:
    """Read a Philips Cartesian DICOM file.

    Raises
    ------
    InputError
        DICOM of another kind, a field that is missing or not supported; truncated data.
    """
    with warnings.catch_warnings():
        # These files break DICOM's rules in ways that do not matter here.
        warnings.simplefilter("ignore")
        return _read(path, max_bytes), (path,)


def _read(path: Path, max_bytes: int) -> StatedVolume:
    _refuse_deflated(path)
    data = _dataset(path)
    sop_class = data.get("SOPClassUID")
    if sop_class is None:
        sop_class = getattr(data, "file_meta", {}).get("MediaStorageSOPClassUID")
    if sop_class != SOP_CLASS and (sop_class is not None or SLICES not in data):
        raise fault(path, "SOPClassUID", sop_class or "not stated", CONVERT)
    for field, expected in (("SamplesPerPixel", 1), ("BitsAllocated", 8)):
        if int(_number(path, data, field, "<H")) != expected:
            raise fault(path, field, data[field].value, f"{expected}: one grey value of a byte")
    for field in ("PhysicalUnitsXDirection", "PhysicalUnitsYDirection"):
        if int(_number(path, data, field, "<H")) != CENTIMETRES:
            raise fault(path, field, data[field].value, f"{CENTIMETRES}, which is cm")
    if SLICE_UNIT in data and int(_number(path, data, SLICE_UNIT, "<H")) != CENTIMETRES:
        raise fault(path, "(3001,1002)", data[SLICE_UNIT].value, f"{CENTIMETRES}, which is cm")
    shape = [
        int(_number(path, data, field, code))
        for field, code in (
            ("NumberOfFrames", ""),
            ("Columns", "<H"),
            ("Rows", "<H"),
            (SLICES, "<I"),
        )
    ]
    check_size(path, NAMES.size, shape, 1, max_bytes)
    spacing = MM_PER_CM * np.array(
        [
            _number(path, data, field, "<d")
            for field in ("PhysicalDeltaX", "PhysicalDeltaY", SLICE_SPACING)
        ]
    )
    if not (spacing > 0).all():
        raise fault(path, NAMES.spacing, spacing / MM_PER_CM, "positive lengths in cm")
    times = StatedTimes(None, "", "FrameTime")
    if shape[0] > 1:
        interval = _number(path, data, "FrameTime", "")
        times = StatedTimes(interval * np.arange(shape[0], dtype=np.float64), "ms", "FrameTime")
    steps = DIRECTION * spacing
    origin = -steps @ (np.array(shape[1:]) - 1) / 2
    frames = _pixels(path, data, shape)
    return StatedVolume(frames, steps, origin, times, Modality.ULTRASOUND, NAMES)


class _Clamped(io.BufferedReader):
    """A file that is never asked for more than it has: Python allocates what it is asked for."""

    def __init__(self, path: Path) -> None:
        super().__init__(path.open("rb", buffering=0))

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def _refuse_deflated(path: Path) -> None:
    """Of all transfer syntaxes pydicom inflates only this one, at once and without bound."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content.find(DEFLATED) >= 0:
            raise fault(path, "TransferSyntaxUID", DEFLATED.decode(), CONVERT)


def _dataset(path: Path) -> Any:
    """The fields, the pixels left in the file."""
    import pydicom

    try:
        with _Clamped(path) as file:
            data = pydicom.dcmread(file, force=True, defer_size=LONG)
            # Without its name nothing can be read later, where its length is not looked at.
            data.filename = None
            data.get("SOPClassUID")  # parsed only now
            return data
    except Exception as error:  # pydicom fails in many ways on a damaged file
        raise fault(path, "content", f"damaged DICOM ({error})", CONVERT) from error


def _number(path: Path, data: Any, field: Any, code: str) -> float:
    """A field's number; `code` unpacks it where the file does not state its type."""
    name = field if isinstance(field, str) else f"({field[0]:04x},{field[1]:04x})"
    try:
        value = data[field].value
        if isinstance(value, bytes) and code and len(value) == struct.calcsize(code):
            (value,) = struct.unpack(code, value)
        number = float(value)
    except KeyError as error:
        raise fault(path, name, "not stated", "a number") from error
    except Exception as error:  # pydicom fails in many ways on a damaged value
        raise fault(path, name, error, "a number") from error
    if not np.isfinite(number):
        raise fault(path, name, number, "a number")
    return number


def _pixels(path: Path, data: Any, shape: list[int]) -> np.ndarray:
    """Frames ``(T, I, J, K)``, without decoding by way of DICOM's own rows and columns."""
    if "PixelData" not in data:
        raise fault(path, "PixelData", "not stated", "the voxels")
    raw = data.get_item("PixelData", keep_deferred=True)
    length = int(raw.length)
    if length == 0xFFFFFFFF:
        raise fault(path, "PixelData", "compressed", "bytes as they are")
    size = int(np.prod(shape, dtype=np.int64))
    stored = path.stat().st_size - int(raw.value_tell)
    if stored < length or length < size:
        raise fault(path, "PixelData", f"{min(stored, length)} bytes", f"{max(size, length)} bytes")
    # An odd number of bytes is followed by one that makes it even.
    end = int(raw.value_tell) + length - (1 if size % 2 and length % 2 == 0 else 0)
    content = np.fromfile(path, dtype=np.uint8, count=size, offset=end - size)
    t, i, j, k = shape
    return content.reshape(t, k, j, i).transpose(0, 3, 2, 1)
