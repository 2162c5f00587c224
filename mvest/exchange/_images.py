"""What a file states of its volumes, and their voxels; runs in the child process.

pynrrd reads NRRD, nibabel NIfTI, SimpleITK MetaImage and pydicom DICOM. Libraries fill in what a
header leaves out (a spacing of 1, an origin of 0); here nothing is filled in. There must be exactly
as many voxels as the header says: libraries read some truncated files as if they were whole.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.reading.text import MAX_LINE, one_line
from mvest.typing import FloatArray

Voxels = NDArray[np.generic]

READABLE = "NRRD, MetaImage, NIfTI or Philips Cartesian DICOM"
MAX_HEADER = 2**20
"""Bytes within which a header ends."""
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "meter": 1e3, "micron": 1e-3}
"""Units of length by the names that NRRD and NIfTI give them."""


def fault(path: Path, where: str, value: object, expected: str) -> InputError:
    """What to raise where a file's field is not what it must be, in one line of bounded length."""
    left = MAX_LINE - len(f"{path.name}: {where}: , expected {expected}")
    return InputError(f"{path}: {where}: {one_line(value, max(left, 40))}, expected {expected}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stated:
    """What a file states of its volumes; nothing is checked for plausibility.

    ``shape`` is (F, I, J, K), F being the number of frames or layers. Places are LPS in mm: the
    columns of ``steps`` (3, 3) lead from one voxel to the next along i, j and k; ``origin`` is the
    centre of voxel (0, 0, 0). ``names`` is what the format calls size, place, origin, values and
    times. ``times`` (F,) are in ``unit``. ``labels`` is the field that says that the voxels are
    labels, ``data_file`` the file beside a header that holds them. A segment has a name, tags, a
    label and a layer. What is empty or None the file does not state.
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
    segments: tuple[tuple[str, str, int, int], ...] = ()
    is_layers: bool = False


Opened = tuple[Stated, Callable[[], Voxels]]
"""What a file states, and a function that reads its voxels ``(F, I, J, K)``."""


def stated(path: Path) -> dict[str, Any]:
    """The fields of `Stated`.

    Raises
    ------
    InputError
        A format that is not read, or a field that is missing, damaged or not supported.
    """
    return asdict(_opened(path)[0])


def voxels(path: Path) -> Voxels:
    """Voxels ``(F, I, J, K)`` of any type.

    Raises
    ------
    InputError
        Fewer or more data than the header says.
    """
    return np.ascontiguousarray(_opened(path)[1]())


def _opened(path: Path) -> Opened:
    with path.open("rb") as file:
        head = begin = file.read(MAX_HEADER)
    if head[:2] == b"\x1f\x8b":
        with gzip.open(path) as stream:
            begin = stream.read(540)
    if head.startswith(b"NRRD"):
        return _nrrd(path, head)
    if begin[344:347] in (b"n+1", b"ni1") or begin[4:7] in (b"n+2", b"ni2"):
        return _nifti(path, begin)
    if head[128:132] == b"DICM" or head[:2] in (b"\x08\x00", b"\x02\x00"):
        return _philips(path)
    if re.match(rb"\s*(ObjectType|NDims|Comment)\s*=", head) and b"ElementDataFile" in head:
        return _metaimage(path, head)
    raise fault(path, "content", f"{head[:8]!r}", READABLE)


def _required(path: Path, fields: Mapping[str, Any], name: str, expected: str) -> Any:
    if name not in fields:
        raise fault(path, name, "not stated", expected)
    return fields[name]


def _beside(path: Path, where: str, name: str) -> Path:
    """The data file that a header names; it must lie in the header's own folder."""
    other = path.parent / name
    if not name.isprintable() or "\\" in name or other.resolve().parent != path.parent.resolve():
        raise fault(path, where, repr(name), "the name of a file in the same folder")
    if not other.is_file():
        raise fault(path, where, f"{name!r} does not exist", "a file in the same folder")
    return other


def _check_length(path: Path, where: str, found: int, sizes: Any, dtype: np.dtype[Any]) -> None:
    expected = int(np.prod(sizes, dtype=object)) * dtype.itemsize
    if found != expected:
        raise fault(path, where, f"{found} bytes", f"the {expected} bytes that the header says")


# NRRD: https://teem.sourceforge.net/nrrd/format.html. 3D Slicer puts the axis of frames first
# (kinds: list domain domain domain) or last, and names their times in "axis N index values"
# (developer guide, "Sequences"); a multivolume has them in MultiVolume.FrameLabels. Lengths are mm
# unless "space units" says otherwise, which is Slicer's convention. ITK writes a volume over time
# as four axes of "space dimension: 4" and names no space; ITK's own is LPS.

MODALITY_KEY = "mvest.modality"
"""Key under which this package writes what the voxels are."""
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
"""To skip; pynrrd counts them also where there are none left."""
KINDS_OF_SPACE = ("domain", "space", *UNSTATED)
KINDS_OF_FRAMES = ("list", "time", "range", "domain", *UNSTATED)
IMAGE_NODE = "vtkMRMLScalarVolumeNode"
FRAME_LABELS = "MultiVolume.FrameLabels"
FRAME_UNIT = "MultiVolume.FrameIdentifyingDICOMTagUnits"


def _nrrd(path: Path, head: bytes) -> Opened:
    import nrrd

    end = re.search(rb"\n[ \t\r]*\n", head)
    lines: list[str] = []
    for line in head[: end.start() if end else None].decode(errors="replace").split("\n"):
        name, colon, value = line.partition(":")
        lines.append(line if value.startswith("=") or not lines else name.lower() + colon + value)
    try:
        fields = nrrd.read_header(list(dict.fromkeys(lines)))  # old writers repeat "space"
        kind = {key: fields[key] for key in ("type", "endian") if key in fields}
        if fields["encoding"].lower() in ("ascii", "text", "txt"):
            kind["endian"] = "little"  # text has no order of bytes
        empty = {**kind, "encoding": "raw", "dimension": 1, "sizes": np.zeros(1, dtype=int)}
        dtype = nrrd.read_data(empty, io.BytesIO()).dtype
    except Exception as error:  # pynrrd fails in many ways on a damaged header
        raise fault(path, "header", error, "fields and keys as NRRD defines them") from error
    sizes = [int(n) for n in _required(path, fields, "sizes", "a number for each axis")]
    if len(sizes) not in (3, 4) or fields.get("dimension") != len(sizes):
        found = f"{fields.get('dimension')}, with sizes {sizes}"
        raise fault(path, "dimension", found, "3 (one volume) or 4 (frames)")
    axis, steps, origin = _nrrd_place(path, fields)
    shape = (1, *sizes) if axis is None else (sizes.pop(axis), *sizes)
    data_file = fields.pop("datafile", fields.get("data file"))
    if data_file is not None:
        fields["data file"] = str(_beside(path, "data file", data_file))
    elif end is None:
        raise fault(path, "header", f"no end in {len(head)} bytes", "an empty line")
    if int(fields.get("line skip", fields.get("lineskip", 0))) > MAX_LINES:
        raise fault(path, "line skip", "more lines", f"at most {MAX_LINES}")
    field, times, unit = "dimension", None, ""
    if axis is not None:
        field, times, unit = _nrrd_times(path, fields, axis, shape[0])
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
        data_file=data_file or "",
        segments=_nrrd_segments(path, fields, shape[0]),
        is_layers=axis is not None and labels.startswith("Segment"),
    ), load


def _nrrd_words(path: Path, fields: Mapping[str, Any], name: str) -> list[str]:
    """A field with a word for each axis; empty words where it is missing."""
    words = list(fields.get(name, [""] * fields["dimension"]))
    if len(words) != fields["dimension"]:
        raise fault(path, name, words, f"a word for each of {fields['dimension']} axes")
    return words


def _nrrd_place(path: Path, fields: dict[str, Any]) -> tuple[int | None, FloatArray, FloatArray]:
    """The axis of frames, steps ``(3, 3)`` and origin ``(3,)`` in LPS, mm."""
    if fields.get("space dimension") == 4:
        fields.setdefault("space", "left-posterior-superior-time")
    space = str(_required(path, fields, "space", f"one of {', '.join(TO_LPS)}")).lower()
    space = SHORT.get(space, space)
    name, n, width = space.removesuffix("-time"), fields["dimension"], 3 + space.endswith("-time")
    vectors = _required(path, fields, "space directions", "a vector in mm for each axis of space")
    origin = _required(path, fields, "space origin", "the centre of the first voxel in mm")
    units = [*fields.get("space units", ["mm"] * 3)][:3]
    kinds, units_of_axes = (_nrrd_words(path, fields, field) for field in ("kinds", "units"))
    if name not in TO_LPS:
        raise fault(path, "space", repr(space), f"one of {', '.join(TO_LPS)}")
    if len(units) != 3 or not {*units} <= {*MM_PER_UNIT}:
        raise fault(path, "space units", " ".join(map(repr, units)), "mm, cm, m or um")
    if np.shape(vectors) != (n, width) or np.shape(origin) != (width,):
        raise fault(path, "space directions", vectors, f"{n} vectors of {width} numbers, as origin")
    other = np.isnan(vectors).any(axis=1)
    if width == 4 and not other.any():
        other = (vectors[:, 3] != 0) & ~vectors[:, :3].any(axis=1)
    if other.sum() != n - 3 or (width == 4 and vectors[~other, 3].any()):
        found = f"{n - other.sum()} of {n} axes in space"
        raise fault(path, "space directions", found, "three, and 'none' for the frames")
    for number, kind in enumerate(kinds):
        if kind.lower() not in (KINDS_OF_FRAMES if other[number] else KINDS_OF_SPACE):
            raise fault(path, "kinds", kind, "one grey value for a voxel, no colour or vector")
        if not other[number] and units_of_axes[number] not in ("mm", *UNSTATED):
            raise fault(path, "units", units_of_axes[number], "mm for an axis of space")
    scale = np.array(TO_LPS[name]) * [MM_PER_UNIT[unit] for unit in units]
    axis = int(np.argmax(other)) if n == 4 else None
    return axis, (vectors[~other, :3] * scale).T, origin[:3] * scale


def _nrrd_times(
    path: Path, fields: Mapping[str, Any], axis: int, count: int
) -> tuple[str, FloatArray | None, str]:
    """Where the times of frames stand, or would; the times, if stated; and their unit."""
    unit = _nrrd_words(path, fields, "units")[axis]
    unit = "" if unit in UNSTATED else unit
    for field in (*(f"axis {number} index values" for number in (axis, 0, 3)), FRAME_LABELS):
        kind = field.replace("values", "type")
        if field not in fields:
            continue
        if kind != field and fields.get(kind, "numeric") != "numeric":
            return kind, None, ""
        try:
            values = np.array([float(word) for word in fields[field].replace(",", " ").split()])
        except ValueError as error:
            raise fault(path, field, error, "numbers") from error
        return field, values, fields.get(FRAME_UNIT, unit)
    step = fields.get("spacings", [])
    if len(step) > axis and np.isfinite(step[axis]):
        return "spacings", step[axis] * np.arange(count), unit
    if len(fields["space origin"]) == 4 and not np.isnan(fields["space directions"][axis]).any():
        units = [*fields.get("space units", []), *[""] * 4]
        values = fields["space origin"][3] + fields["space directions"][axis][3] * np.arange(count)
        return "space directions", values, unit or units[3]
    return f"axis {axis} index values", None, unit


def _nrrd_segments(
    path: Path, fields: Mapping[str, Any], layers: int
) -> tuple[tuple[str, str, int, int], ...]:
    """The segments that 3D Slicer names.

    Before 4.11 Slicer wrote neither layer nor label: each segment had a layer of its own, and the
    label 1 (developer guide, "Segmentations").
    """
    found = (re.match(r"Segment(\d{1,4})_", key, re.ASCII) for key in fields)
    segments = []
    for n in sorted({int(match[1]) for match in found if match}):
        own = {key: fields.get(f"Segment{n}_{key}", "") for key in ("Name", "ID", "Tags")}
        whole = []
        for key, missing, end in (
            ("LabelValue", 1 if layers > 1 else n + 1, 2**31),
            ("Layer", n if layers > 1 else 0, layers),
        ):
            word = str(fields.get(f"Segment{n}_{key}", missing))
            if not re.fullmatch(r"\d{1,10}", word, re.ASCII) or int(word) >= end:
                raise fault(path, f"Segment{n}_{key}", repr(word), f"a number from 0 to {end - 1}")
            whole.append(int(word))
        segments.append((own["Name"] or own["ID"] or f"Segment_{n}", own["Tags"], *whole))
    return tuple(segments)


# NIfTI 1 and 2: the world is RAS. The unit of length may be missing: of those that the format
# knows only mm passes the checks of spacing.

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])


def _nifti(path: Path, begin: bytes) -> Opened:
    import nibabel

    kind: Any = nibabel.Nifti2Header if begin[4:6] == b"n+" else nibabel.Nifti1Header
    if b"ni" in (begin[344:346], begin[4:6]):
        raise fault(path, "magic", "a header without its image", "one file, .nii or .nii.gz")
    # Unchecked, as nibabel's checks put right by guessing what is wrong.
    header = kind(begin[: kind.template_dtype.itemsize], check=False)
    sizes, dtype = header.get_data_shape(), header.get_data_dtype()
    affine = np.asarray(header.get_best_affine(), dtype=np.float64)
    unit, unit_of_time = header.get_xyzt_units()
    slope, intercept = header.get_slope_inter()
    scaled = slope is not None and (slope, intercept) != (1.0, 0.0)
    if len(sizes) not in (3, 4):
        raise fault(path, "dim", " ".join(map(str, sizes)), "3 or 4 axes")
    if int(header["sform_code"]) <= 0 and int(header["qform_code"]) <= 0:
        raise fault(path, "sform_code", "0, as is qform_code", "a direction of the axes")
    lengths, zooms = np.linalg.norm(affine[:3, :3], axis=0), np.array(header.get_zooms())
    if not np.allclose(zooms[:3], lengths, rtol=1e-3, atol=0):
        raise fault(path, "pixdim", zooms, f"the spacing of sform or qform, {lengths}")
    if unit_of_time in ("hz", "ppm", "rads"):
        raise fault(path, "xyzt_units", unit_of_time, "a fourth axis of time")
    scale, times = RAS_TO_LPS * MM_PER_UNIT.get(unit, 1.0), None
    if len(sizes) == 4 and zooms[3] > 0:
        times = float(header["toffset"]) + float(zooms[3]) * np.arange(sizes[3])

    def load() -> Voxels:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        offset = int(header["vox_offset"])
        _check_length(path, "data", len(content) - offset, sizes, dtype)
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


# MetaImage: the world is LPS in mm; the fourth spacing is the time between frames, without a unit.
# ITK makes up what a header leaves out, and gives voxels of damaged compressed data.

METAIMAGE_SYNONYMS = {
    **dict.fromkeys(("Position", "Origin"), "Offset"),
    **dict.fromkeys(("Rotation", "Orientation"), "TransformMatrix"),
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}


def _metaimage(path: Path, head: bytes) -> Opened:
    import SimpleITK

    itk: Any = SimpleITK
    end = head.find(b"\n", head.index(b"ElementDataFile")) + 1 or len(head)
    fields: dict[str, str] = {}
    for line in head[:end].decode(errors="replace").splitlines():
        name, _, value = (word.strip() for word in line.partition("="))
        name = METAIMAGE_SYNONYMS.get(name, name)
        if fields.setdefault(name, value) != value:
            raise fault(path, name, f"{fields[name]!r} and {value!r}", "one value")

    def numbers(name: str, count: int) -> FloatArray:
        value = _required(path, fields, name, f"{count} numbers")
        if not re.fullmatch(r"[-+\d.eE\s]+", value, re.ASCII) or len(value.split()) != count:
            raise fault(path, name, repr(value), f"{count} numbers")
        return np.array(value.split(), dtype=np.float64)

    n = int(numbers("NDims", 1)[0])
    if n not in (3, 4):
        raise fault(path, "NDims", n, "3 (one volume) or 4 (volumes over time)")
    spacing, origin = numbers("ElementSpacing", n), numbers("Offset", n)
    direction = numbers("TransformMatrix", n * n).reshape(n, n).T
    sizes = [*numbers("DimSize", n).astype(int), 1][:4]
    if not np.allclose(np.linalg.norm(direction, axis=0), 1, rtol=0, atol=1e-3):
        raise fault(path, "TransformMatrix", fields["TransformMatrix"], "unit vectors")
    if n == 4 and not direction[3].tolist() == direction[:, 3].tolist() == [0, 0, 0, 1]:
        raise fault(path, "TransformMatrix", direction[3], "the fourth axis to be time alone")
    if spacing.min() <= 0:
        raise fault(path, "ElementSpacing", fields["ElementSpacing"], "positive numbers")
    if fields.get("HeaderSize", "0") != "0":
        raise fault(path, "HeaderSize", fields["HeaderSize"], "0")
    reader = itk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise fault(path, "header", "damaged", "fields that SimpleITK reads") from error
    if reader.GetNumberOfComponents() != 1:
        raise fault(path, "ElementNumberOfChannels", "not 1", "one grey value, no colour or vector")
    dtype = itk.GetArrayFromImage(itk.Image([1, 1, 1], reader.GetPixelID())).dtype
    if dtype.itemsize > 1:
        _required(path, fields, "BinaryDataByteOrderMSB", "the order of bytes")
    name = fields["ElementDataFile"]
    local = name.upper() == "LOCAL"
    source = path if local else _beside(path, "ElementDataFile", name)

    def load() -> Voxels:
        content = source.read_bytes()[end if local else 0 :]
        if fields.get("CompressedData", "")[:1] in ("T", "t", "1"):
            content = zlib.decompress(content, zlib.MAX_WBITS | 32)
        _check_length(path, "ElementDataFile", len(content), sizes, dtype)
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


# Philips Cartesian DICOM: 3D echo over time as QLAB exports it, one file for a recording. It is
# DICOM in form only: unique identifiers and preamble may be missing. Columns, rows and frames are
# where DICOM has them, the number of slices is (3001,1001); spacings are cm in PhysicalDeltaX,
# PhysicalDeltaY and (3001,1003); FrameTime is ms; the voxels, columns running fastest, then rows,
# slices and frames, are the last bytes of PixelData.
#
# How the volume lies in the patient is not stated. It is placed as SlicerHeart places it
# (DicomUltrasoundPlugin.py: an image of these spacings without origin or directions, which in 3D
# Slicer is RAS), so that landmarks from 3D Slicer fit.

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


def _philips(path: Path) -> Opened:
    import pydicom

    data: Any = pydicom.dcmread(path, force=True, defer_size=2**16)

    def number(name: str) -> float:
        """A number; its bytes count where the file does not state its type."""
        key = (0x3001, int(name[6:10], 16)) if name.startswith("(") else name
        if key not in data:
            raise fault(path, name, "not stated", "a number")
        value = data[key].value
        try:
            if isinstance(value, bytes):
                (value,) = struct.unpack({2: "<H", 4: "<I", 8: "<d"}[len(value)], value)
            return float(value)
        except (KeyError, TypeError, ValueError) as error:
            raise fault(path, name, value, "a number") from error

    kind = data.get("SOPClassUID", getattr(data, "file_meta", {}).get("MediaStorageSOPClassUID"))
    if kind != PHILIPS and (kind is not None or (0x3001, 0x1001) not in data):
        raise fault(path, "SOPClassUID", kind or "not stated", CONVERT)
    for name, expected, why in PHILIPS_VALUES:
        if (name != SLICE_UNIT or (0x3001, 0x1002) in data) and number(name) != expected:
            raise fault(path, name, f"{number(name):g}", f"{expected}: {why}")
    shape = tuple(int(number(name)) for name in ("NumberOfFrames", "Columns", "Rows", SLICES))
    place = ("PhysicalDeltaX", "PhysicalDeltaY", SLICE_SPACING)
    spacing = np.array([number(name) for name in place])
    if not (spacing > 0).all():
        raise fault(path, ", ".join(place), spacing, "positive lengths in cm")
    interval = number("FrameTime") if shape[0] > 1 else 0.0
    if "PixelData" not in data:
        raise fault(path, "PixelData", "not stated", "the voxels")

    def load() -> Voxels:
        element = data["PixelData"]
        content, size = element.value, int(np.prod(shape, dtype=object))
        # An odd number of bytes is followed by one that makes it even.
        end = len(content) - (1 if size % 2 and len(content) % 2 == 0 else 0)
        if element.is_undefined_length or end < size:
            raise fault(path, "PixelData", f"{end} bytes", f"{size} bytes, not compressed")
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
