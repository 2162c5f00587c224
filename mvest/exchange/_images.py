"""Headers and voxels of NIfTI (nibabel), MetaImage (SimpleITK) and DICOM (pydicom) files.

Runs in the child process; `mvest.exchange._nrrd` reads NRRD. Libraries fill in missing fields (a
spacing of 1, an origin of 0); here a missing field is an error. The number of voxels must match
the header, because SimpleITK accepts some truncated files.
"""

import gzip
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.reading.text import one_line
from mvest.typing import FloatArray

Voxels = NDArray[np.generic]

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "meter": 1e3, "micron": 1e-3}
"""Units of length, by their names in NRRD and NIfTI."""


def fault(where: str, found: object, expected: str) -> InputError:
    """The error for a wrong field; the parent process adds the name of the file."""
    return InputError(f"{where}: {one_line(found, 120)}, expected {expected}")


def check(holds: object, where: str, found: object, expected: str) -> None:
    """Raise the `fault` unless ``holds``."""
    if not holds:
        raise fault(where, found, expected)


class Segment(NamedTuple):
    """A segment of a ``.seg.nrrd`` file: its name, voxel value and layer."""

    name: str
    tags: str
    label: int
    layer: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stated:
    """The header of a file, not checked for plausibility. Empty or None: not stated.

    ``shape`` is (F, I, J, K) with F frames or layers. The columns of ``steps`` (3, 3) are the steps
    to the next voxel along i, j and k, and ``origin`` is the centre of voxel (0, 0, 0); LPS, mm.
    ``names`` are the format's names of size, steps, origin, values and times. ``times`` (F,) are in
    ``unit``. ``labels`` is the field that marks the voxels as labels, ``data_file`` a separate file
    with the voxels.
    """

    shape: tuple[int, ...]
    dtype: str
    steps: FloatArray
    origin: FloatArray
    names: tuple[str, str, str, str, str]
    times: FloatArray | None = None
    unit: str = ""
    modality: str = ""
    labels: str = ""
    data_file: str = ""
    segments: tuple[Segment, ...] = ()
    is_layers: bool = False


Opened = tuple[Stated, Callable[[], Voxels]]
"""A header, and a function that reads the voxels ``(F, I, J, K)``."""


def required(fields: Mapping[str, Any], name: str, expected: str) -> Any:
    check(name in fields, name, "not stated", expected)
    return fields[name]


def neighbour_file(path: Path, where: str, name: str) -> Path:
    """The data file that a header names; it must be in the same folder."""
    other = path.parent / name
    inside = name.isprintable() and other.resolve().parent == path.parent.resolve()
    check(inside and "\\" not in name, where, repr(name), "the name of a file in the same folder")
    check(other.is_file(), where, f"{name!r} does not exist", "a file in the same folder")
    return other


def _check_length(where: str, found: int, sizes: Any, dtype: np.dtype[Any]) -> None:
    expected = int(np.prod(sizes, dtype=object)) * dtype.itemsize
    words = f"the {expected} bytes that the header states"
    check(found == expected, where, f"{found} bytes", words)


# NIfTI 1 and 2 are RAS. A missing unit of length is taken as mm: in any other unit the spacings
# would be implausible.

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])


def nifti(path: Path, begin: bytes) -> Opened:
    import nibabel

    kind: Any = nibabel.Nifti2Header if begin[4:6] == b"n+" else nibabel.Nifti1Header
    whole = b"ni" not in (begin[344:346], begin[4:6])
    check(whole, "magic", "a header without its image", "one file, .nii or .nii.gz")
    # nibabel's checks would guess corrections.
    header = kind(begin[: kind.template_dtype.itemsize], check=False)
    sizes, dtype = header.get_data_shape(), header.get_data_dtype()
    affine = np.asarray(header.get_best_affine(), dtype=np.float64)
    unit, unit_of_time = header.get_xyzt_units()
    slope, intercept = header.get_slope_inter()
    scaled = slope is not None and (slope, intercept) != (1.0, 0.0)
    check(len(sizes) in (3, 4), "dim", " ".join(map(str, sizes)), "3 or 4 axes")
    placed = header["sform_code"] > 0 or header["qform_code"] > 0
    check(placed, "sform_code", "0, as is qform_code", "a direction of the axes")
    lengths, zooms = np.linalg.norm(affine[:3, :3], axis=0), np.array(header.get_zooms())
    same = np.allclose(zooms[:3], lengths, rtol=1e-3, atol=0)
    check(same, "pixdim", zooms, f"the spacing of sform or qform, {lengths}")
    over_time = unit_of_time not in ("hz", "ppm", "rads")
    check(over_time, "xyzt_units", unit_of_time, "a fourth axis of time")
    scale, times = RAS_TO_LPS * MM_PER_UNIT.get(unit, 1.0), None
    if len(sizes) == 4 and zooms[3] > 0:
        times = float(header["toffset"]) + float(zooms[3]) * np.arange(sizes[3])

    def load() -> Voxels:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        offset = int(header["vox_offset"])
        _check_length("data", len(content) - offset, sizes, dtype)
        data = np.frombuffer(content, dtype, offset=offset).reshape((*sizes, 1)[:4], order="F")
        if scaled:
            data = data * np.float32(slope) + np.float32(intercept)
        return np.moveaxis(data, 3, 0)

    place = "sform or qform"
    return Stated(
        shape=((*sizes, 1)[3], *sizes[:3]),
        dtype="<f4" if scaled else dtype.str,
        steps=affine[:3, :3] * scale[:, np.newaxis],
        origin=affine[:3, 3] * scale,
        names=("dim", place, place, "data", "pixdim[4] with xyzt_units"),
        times=times,
        unit="" if unit_of_time == "unknown" else unit_of_time,
    ), load


# MetaImage is LPS in mm; the fourth spacing is the time between frames, without a unit. ITK makes
# up missing fields, and voxels where compressed data are damaged.

METAIMAGE_FIELDS = (
    ("ElementSpacing",),
    ("Offset", "Position", "Origin"),
    ("TransformMatrix", "Rotation", "Orientation"),
)
"""Required fields, each with the names under which ITK reads it."""


def metaimage(path: Path, head: bytes) -> Opened:
    import SimpleITK

    itk: Any = SimpleITK
    end = head.find(b"\n", head.index(b"ElementDataFile")) + 1 or len(head)
    lines = head[:end].decode(errors="replace").splitlines()
    fields = {name.strip(): value.strip() for name, _, value in (k.partition("=") for k in lines)}
    for names in METAIMAGE_FIELDS:
        check(any(name in fields for name in names), names[0], "not stated", "numbers")
    reader = itk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise fault("header", "damaged", "fields that SimpleITK reads") from error
    n = reader.GetDimension()
    check(n in (3, 4), "NDims", n, "3 (one volume) or 4 (volumes over time)")
    sizes = [*reader.GetSize(), 1][:4]
    spacing, origin = np.array(reader.GetSpacing()), np.array(reader.GetOrigin())
    direction = np.reshape(reader.GetDirection(), (n, n))
    unit = np.allclose(np.linalg.norm(direction, axis=0), 1, rtol=0, atol=1e-3)
    check(unit, "TransformMatrix", direction, "unit vectors")
    alone = n == 3 or direction[3].tolist() == direction[:, 3].tolist() == [0, 0, 0, 1]
    check(alone, "TransformMatrix", direction[-1], "the fourth axis to be time alone")
    check(spacing.min() > 0, "ElementSpacing", fields["ElementSpacing"], "positive numbers")
    check(fields.get("HeaderSize", "0") == "0", "HeaderSize", fields.get("HeaderSize"), "0")
    channels = reader.GetNumberOfComponents()
    check(channels == 1, "ElementNumberOfChannels", channels, "one grey value, no colour or vector")
    dtype = itk.GetArrayFromImage(itk.Image([1, 1, 1], reader.GetPixelID())).dtype
    name = fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else neighbour_file(path, "ElementDataFile", name)

    def load() -> Voxels:
        content = source.read_bytes()[end if local else 0 :]
        if fields.get("CompressedData", "")[:1] in ("T", "t", "1"):
            content = zlib.decompress(content, zlib.MAX_WBITS | 32)
        _check_length("ElementDataFile", len(content), sizes, dtype)
        data = itk.GetArrayFromImage(reader.Execute())
        return np.swapaxes(data.reshape(sizes[::-1]), 1, 3)

    return Stated(
        shape=(sizes[3], *sizes[:3]),
        dtype=dtype.str,
        steps=direction[:3, :3] * spacing[:3],
        origin=origin[:3],
        names=("DimSize", "ElementSpacing", "Offset", "ElementDataFile", "ElementSpacing"),
        times=origin[3] + spacing[3] * np.arange(sizes[3]) if n == 4 else None,
        data_file="" if local else name,
    ), load


# Philips Cartesian DICOM: 3D echo over time as QLAB exports it, one file per recording. It is not
# fully DICOM: unique identifiers and preamble may be missing. Columns, rows and frames are in
# standard fields, the number of slices is in (3001,1001); spacings in cm are PhysicalDeltaX,
# PhysicalDeltaY and (3001,1003); FrameTime is ms. The voxels, columns fastest, then rows, slices
# and frames, are the last bytes of PixelData.
#
# The file does not state its orientation. SlicerHeart's is used (DicomUltrasoundPlugin.py: an image
# without origin or directions, which 3D Slicer reads as RAS), so that landmarks from 3D Slicer fit.
# ITK-SNAP (GuidedNativeImageIO.cxx) uses the same origin but opposite rows and slices.

PHILIPS = "1.2.840.113543.6.6.1.3.10002"
PHILIPS_DIRECTION = np.diag([-1.0, -1.0, 1.0])
"""Columns run to the right, rows to the front and slices upwards; the first voxel is at 0."""
SLICES, SLICE_UNIT, SLICE_SPACING = "(3001,1001)", "(3001,1002)", "(3001,1003)"
PHILIPS_VALUES = (
    ("SamplesPerPixel", 1, "one grey value"),
    ("BitsAllocated", 8, "one grey value of a byte"),
    ("PhysicalUnitsXDirection", 3, "which is cm"),  # DICOM PS3.3, C.8.5.5.1.15
    ("PhysicalUnitsYDirection", 3, "which is cm"),
    (SLICE_UNIT, 3, "which is cm"),
)
CONVERT = (
    "Philips Cartesian DICOM; convert other DICOM with 3D Slicer, and save the volume as .nrrd or "
    "the sequence as .seq.nrrd"
)


def philips(path: Path) -> Opened:
    import pydicom

    data: Any = pydicom.dcmread(path, force=True, defer_size=2**16)

    def number(name: str) -> float:
        """A number; decoded from raw bytes if the file does not state its type."""
        key = (0x3001, int(name[6:10], 16)) if name.startswith("(") else name
        check(key in data, name, "not stated", "a number")
        value = data[key].value
        try:
            if isinstance(value, bytes):
                (value,) = struct.unpack({2: "<H", 4: "<I", 8: "<d"}[len(value)], value)
            return float(value)
        except (KeyError, TypeError, ValueError) as error:
            raise fault(name, value, "a number") from error

    kind = data.get("SOPClassUID", getattr(data, "file_meta", {}).get("MediaStorageSOPClassUID"))
    cartesian = kind == PHILIPS or (kind is None and (0x3001, 0x1001) in data)
    check(cartesian, "SOPClassUID", kind or "not stated", CONVERT)
    for name, expected, why in PHILIPS_VALUES:
        if name != SLICE_UNIT or (0x3001, 0x1002) in data:
            check(number(name) == expected, name, f"{number(name):g}", f"{expected}: {why}")
    shape = tuple(int(number(name)) for name in ("NumberOfFrames", "Columns", "Rows", SLICES))
    place = ("PhysicalDeltaX", "PhysicalDeltaY", SLICE_SPACING)
    spacing = np.array([number(name) for name in place])
    check((spacing > 0).all(), ", ".join(place), spacing, "positive lengths in cm")
    interval = number("FrameTime") if shape[0] > 1 else 0.0
    check("PixelData" in data, "PixelData", "not stated", "the voxels")

    def load() -> Voxels:
        element = data["PixelData"]
        content, size = element.value, int(np.prod(shape, dtype=object))
        # DICOM pads data to an even number of bytes.
        end = len(content) - (1 if size % 2 and len(content) % 2 == 0 else 0)
        whole = end >= size and not element.is_undefined_length
        check(whole, "PixelData", f"{end} bytes", f"{size} bytes, not compressed")
        values = np.frombuffer(content, np.uint8, count=size, offset=end - size)
        return values.reshape(shape[0], *shape[:0:-1]).transpose(0, 3, 2, 1)

    return Stated(
        shape=shape,
        dtype="u1",
        steps=PHILIPS_DIRECTION * spacing * MM_PER_UNIT["cm"],
        origin=np.zeros(3),
        names=(f"Columns, Rows, {SLICES}", ", ".join(place), "origin", "PixelData", "FrameTime"),
        times=interval * np.arange(shape[0], dtype=np.float64) if shape[0] > 1 else None,
        unit="ms",
        modality="ultrasound",
    ), load
