"""Volumes and label maps in the variants that SimpleITK, nibabel, pynrrd and slicerio write."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import nibabel
import nrrd
import numpy as np
import pydicom
import SimpleITK
import slicerio
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
from scipy.spatial.transform import Rotation

from tests.exchange.variant import Variant, each_option

SHAPE = (3, 16, 17, 21)
SPACING = np.array([1.5, 1.25, 1.0])
ORIGIN = np.array([-12.5, 4.0, 30.25])
DIRECTION = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
MIRRORED = DIRECTION * [1.0, 1.0, -1.0]
TIMES = np.array([0.0, 0.04, 0.08])
"""s"""
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
AFFINE = np.eye(4)
"""LPS"""
AFFINE[:3, :3], AFFINE[:3, 3] = DIRECTION * SPACING, ORIGIN


def frames(dtype: str = "uint8") -> np.ndarray:
    """Voxels ``(T, I, J, K)``, different wherever axes are swapped."""
    return np.random.default_rng(7).integers(0, 100, SHAPE).astype(dtype)


def label_map() -> np.ndarray:
    """Voxels ``(I, J, K)`` of an anterior (1) and a posterior leaflet (2)."""
    result = np.zeros(SHAPE[1:], dtype=np.uint8)
    result[3:8, 4:12, 5:15], result[8:14, 4:12, 5:15] = 1, 2
    return result


def itk(values: np.ndarray, direction=DIRECTION) -> SimpleITK.Image:
    """An image of three or, with time as the last, of four axes."""
    image = SimpleITK.GetImageFromArray(
        np.ascontiguousarray(values.transpose(*range(values.ndim - 3), -1, -2, -3)), isVector=False
    )
    more, size = values.ndim - 3, values.ndim
    whole = np.eye(size)
    whole[:3, :3] = direction
    image.SetSpacing([*SPACING, *[0.04] * more])
    image.SetOrigin([*ORIGIN, *[0.0] * more])
    image.SetDirection(whole.ravel().tolist())
    return image


def by_itk(
    path: Path, what: str = "4D", dtype: str = "uint8", packed: str = "plain", direction=DIRECTION
) -> Path:
    values = frames(dtype)
    image = itk(values if what == "4D" else values[0], direction=direction)
    SimpleITK.WriteImage(image, str(path), packed == "compressed")
    return path


def nifti(path: Path, version: str, dtype: str, more: str = "", direction=DIRECTION) -> Path:
    values, matrix = frames(dtype), AFFINE.copy()
    matrix[:3, :3] = direction * SPACING
    values = values[0] if more == "3D" else np.moveaxis(values, 0, 3)
    kind = nibabel.Nifti2Image if version == "NIfTI-2" else nibabel.Nifti1Image
    image = kind(values * 1.0 if more == "scaled" else values, RAS @ matrix)
    if more in ("sform only", "qform only"):
        image.set_sform(RAS @ matrix, code=int(more == "sform only"))
        image.set_qform(RAS @ matrix, code=int(more == "qform only"))
    image.set_data_dtype(dtype)
    image.header.set_xyzt_units("mm", "sec" if more == "seconds" else "msec")
    if more != "3D":
        image.header["pixdim"][4] = 0.04 if more == "seconds" else 40
    nibabel.save(image, path)
    return path


def directions(axis: int | None) -> np.ndarray:
    """Rows of ``space directions``: none for the axis of frames."""
    rows = (DIRECTION * SPACING).T
    return rows if axis is None else np.insert(rows, axis, np.nan, axis=0)


def header(axis: int | None, encoding: str = "gzip") -> dict[str, Any]:
    """As 3D Slicer writes it, with the frames along an axis or without frames."""
    result: dict[str, Any] = {
        "space": "left-posterior-superior",
        "space directions": directions(axis),
        "kinds": ["domain"] * 3,
        "space origin": ORIGIN,
        "encoding": encoding,
    }
    if axis is not None:
        result["kinds"].insert(axis, "list")
        for name, word in (("labels", "time"), ("units", "s")):
            result[name] = [word if n == axis else "" for n in range(4)]
        result[f"axis {axis} index type"] = "numeric"
        result[f"axis {axis} index values"] = " ".join(map(str, TIMES))
    return result


def by_pynrrd(path: Path, frames_first: str, encoding: str, dtype: str) -> None:
    axis = 0 if frames_first == "frames first" else 3
    nrrd.write(str(path), np.moveaxis(frames(dtype), 0, axis), header(axis, encoding))


def more_nrrd(path: Path, what: str) -> None:
    """Conventions of Slicer's versions and of ITK."""
    fields, values = header(0), frames()
    if what == "RAS":
        fields["space"] = "right-anterior-superior"
        fields["space directions"] = directions(0) * [-1, -1, 1]
        fields["space origin"] = ORIGIN * [-1, -1, 1]
    elif what == "milliseconds":
        fields["units"] = ["ms", "", "", ""]
        fields["axis 0 index values"] = "0 40 80"
    elif what.startswith("slicerio"):
        made = [{"voxels": frame, "ijkToLPS": AFFINE} for frame in values]
        times: dict[str, Any] = {"index_values": list(map(str, TIMES))}
        if what == "slicerio with phases as text":
            times = {"index_values": ["ED", "mid", "ES"], "index_type": "text", "index_unit": ""}
        slicerio.write_volume(str(path), slicerio.create_sequence(made, **times))
        return
    elif what == "3D":
        fields, values = header(None), values[0]
    nrrd.write(str(path), values, fields)


def segments(path: Path, what: str) -> None:
    """A segmentation by slicerio, as Slicer has written it since 4.11."""
    made = slicerio.create_segmentation(SHAPE[1:], AFFINE)
    for label, name in ((1, "mitral_anterior_leaflet"), (2, "mitral_posterior_leaflet")):
        mask = label_map() == label
        if what == "overlapping layers":
            mask = np.roll(mask, 2 * (label == 1), axis=0)
        slicerio.add_segment(made, mask, {"id": f"Segment_{label}", "name": name})
    if what == "an empty layer":
        made["voxels"] = np.stack([made["voxels"], np.zeros_like(made["voxels"])])
        made["segments"].append({"id": "Segment_3", "name": "annulus", "labelValue": 1, "layer": 1})
    slicerio.write_segmentation(str(path), made)


def map_of_labels(path: Path, what: str) -> None:
    """Labels 1 and 2 in a plain image, or among empty frames."""
    values = label_map()
    values = values if what.startswith("4D") else values.astype(what)
    if what in ("4D in ms", "4D without a unit"):
        image = nibabel.Nifti1Image(np.stack([values * 0, values, values * 0], 3), RAS @ AFFINE)
        if what == "4D in ms":
            image.header.set_xyzt_units("mm", "msec")
            image.header["pixdim"][4] = 40
        nibabel.save(image, path)
    elif path.suffix == ".gz":
        nibabel.save(nibabel.Nifti1Image(values, RAS @ AFFINE, dtype=values.dtype), path)
    else:
        SimpleITK.WriteImage(itk(values), str(path))


PHILIPS = "1.2.840.113543.6.6.1.3.10002"
"""Class of Philips Cartesian DICOM: 3D echo over time in private fields, lengths in cm."""


def dataset() -> Dataset:
    """As QLAB exports it; voxels of the class have no direction but their own axes."""
    data, (count, i, j, k) = Dataset(), SHAPE
    data.SOPClassUID, data.Modality, data.FrameTime = PHILIPS, "US", "40"
    data.PhysicalUnitsXDirection = data.PhysicalUnitsYDirection = 3
    data.PhysicalDeltaX, data.PhysicalDeltaY, _ = SPACING / 10
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.NumberOfFrames, data.Rows, data.Columns = count, j, i
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 8, 8, 7, 0
    data.add_new((0x3001, 0x0010), "LO", "Philips3D")
    for element, kind, value in ((1, "UL", k), (2, "US", 3), (3, "FD", SPACING[2] / 10)):
        data.add_new((0x3001, 0x1000 + element), kind, value)
    data.add_new((0x7FE0, 0x0010), "OB", frames().transpose(0, 3, 2, 1).tobytes())
    return data


def philips(
    path: Path, syntax: str = "explicit", start: str = "bare", data: Dataset | None = None
) -> Path:
    data = dataset() if data is None else data
    if start == "bare":
        pydicom.dcmwrite(path, data, implicit_vr=syntax == "implicit", little_endian=True)
        return path
    data.file_meta = FileMetaDataset()
    data.file_meta.MediaStorageSOPClassUID = PHILIPS
    data.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    data.file_meta.TransferSyntaxUID = (
        ImplicitVRLittleEndian if syntax == "implicit" else ExplicitVRLittleEndian
    )
    pydicom.dcmwrite(path, data, enforce_file_format=True)
    return path


def volume_variants() -> Iterator[Variant]:
    """Images, their times in s, in ms or without unit."""
    kinds = ("uint8", "int16", "float32")
    for row in each_option(("NIfTI-1", "NIfTI-1", "NIfTI-2"), kinds, (".nii.gz", ".nii")):
        yield Variant("NIfTI", row, f"a{row[2]}", lambda p, o=row[:2]: nifti(p, *o))
    for what in ("sform only", "qform only", "scaled", "seconds", "3D"):
        how = partial(nifti, version="NIfTI-1", dtype="int16", more=what)
        yield Variant("NIfTI", (what,), "a.nii.gz", how)
    packed = ("compressed", "plain", "plain", "compressed")
    for form, ends in (("MetaImage", (".mha", ".mhd")), ("NRRD by ITK", (".nrrd", ".nhdr"))):
        for row in each_option(ends, ("4D", "4D", "3D", "3D"), kinds, packed):
            given = {"time_unit": "s"} if "4D" in row else {}
            write = lambda p, o=row[1:]: by_itk(p, *o)  # noqa: E731
            yield Variant(form, row, f"a{row[0]}", write, given=given)
    axes, packed = ("frames last", "frames first"), ("gzip", "gzip", "raw", "bzip2", "text", "raw")
    for row in each_option((".seq.nrrd", ".nhdr", ".nhdr"), axes, packed, kinds):
        yield Variant("NRRD by pynrrd", row, f"a{row[0]}", lambda p, o=row[1:]: by_pynrrd(p, *o))
    for what in ("RAS", "milliseconds", "3D", "slicerio", "slicerio with phases as text"):
        given = {"frame_interval_s": 0.04} if "phases" in what else {}
        yield Variant("NRRD", (what,), "a.seq.nrrd", partial(more_nrrd, what=what), given=given)
    for row in each_option(("explicit", "implicit"), ("preamble", "bare")):
        yield Variant("Philips Cartesian DICOM", row, "a.dcm", lambda p, o=row: philips(p, *o))


def label_variants() -> Iterator[Variant]:
    """Label maps of one frame, or of one that is not empty."""
    for what in ("one layer", "overlapping layers", "an empty layer"):
        yield Variant("Slicer segmentation", (what,), "a.seg.nrrd", partial(segments, what=what))
    for form, name, kinds in (
        ("NRRD", "a.nrrd", ("int16", "int64", "float32")),
        ("MetaImage", "a.mha", ("uint8", "float64")),
        ("NIfTI", "a.nii.gz", ("uint8", "int64", "4D in ms", "4D without a unit")),
    ):
        for what in kinds:
            yield Variant(f"{form} labels", (what,), name, partial(map_of_labels, what=what))
