"""One door for all files that hold a volume over time."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.imaging.reading.metaimage import is_metaimage, read_metaimage
from mvest.imaging.reading.nifti import is_nifti, read_nifti
from mvest.imaging.reading.nrrd_file import read_nrrd
from mvest.imaging.reading.philips import is_dicom, read_philips
from mvest.imaging.reading.plausible import MAX_BYTES, checked_sequence
from mvest.imaging.reading.stated import StatedVolume, fault
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.reading.bounded import refusing

READABLE = "NRRD, MetaImage, NIfTI or Philips Cartesian DICOM"


def read_volume(
    path: Path | str,
    *,
    modality: Modality | None = None,
    frame_interval_s: float | None = None,
    time_unit: str | None = None,
    max_bytes: int = MAX_BYTES,
    labels: bool = False,
) -> VolumeSequence:
    """Read a volume over time; what the file is, its content says, not its name.

    Nothing is guessed: what the file does not state must be given, and what it states must not be
    contradicted. Directions stay as the file has them, left-handed ones included. A file may hold a
    single frame.

    Parameters
    ----------
    path
        NRRD (``.nrrd``, ``.seq.nrrd``, ``.nhdr``), MetaImage (``.mha``, ``.mhd``), NIfTI (``.nii``,
        ``.nii.gz``) or Philips Cartesian DICOM.
    modality
        What the voxels are, for files that do not say: all but DICOM and those of this package.
    frame_interval_s
        Seconds between frames, for files that state no times in a unit of time.
    time_unit
        ``"s"`` or ``"ms"``, for files that state times without a unit.
    max_bytes
        Of all frames, decoded; reading them takes up to three times as much memory for a while.
    labels
        Whether the voxels are wanted as labels: a segmentation is no image and refused otherwise.
        Frames (or layers) without times are then taken to be a second apart.

    Raises
    ------
    InputError
        In one line the file, the field, what was found and what was expected: a file of another
        kind, truncated or damaged; not three or four axes; colour; no spacing, direction or origin,
        or such as no heart fits (0.05 to 5 mm, 20 to 500 mm in all, at least 16 voxels along each
        axis); axes that are not at right angles; a frame without contrast; values that are no
        numbers; times that do not increase, or by less than 2 ms or 1 s and more; more than
        `max_bytes`, or data compressed more than 100 times.
    """
    source = Path(path)
    if source.is_dir():
        raise fault(
            source,
            "path",
            "a folder",
            f"one file: {READABLE}; convert a DICOM series with 3D Slicer, to .nrrd or .seq.nrrd",
        )
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    # What overflows is refused with the numbers that are no finite ones.
    with np.errstate(all="ignore"), refusing(source, "volume"):
        stated, files = _stated(source, max_bytes, labels)
        sha256 = _sha256(files)
        if labels and stated.times.values is None:
            frame_interval_s = 1.0
        return checked_sequence(source, stated, sha256, modality, frame_interval_s, time_unit)


def _stated(path: Path, max_bytes: int, labels: bool) -> tuple[StatedVolume, tuple[Path, ...]]:
    """What the file states, and the files that it consists of."""
    with path.open("rb") as file:
        head = file.read(1024)
    if head.startswith(b"NRRD"):
        return read_nrrd(path, max_bytes, labels=labels)
    if is_nifti(path):
        return read_nifti(path, max_bytes)
    if is_dicom(head):
        return read_philips(path, max_bytes)
    if is_metaimage(head):
        return read_metaimage(path, max_bytes)
    raise fault(path, "content", f"{head[:8]!r}", READABLE)


def _sha256(files: tuple[Path, ...]) -> str:
    """Of the bytes of all files, one after the other."""
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            while chunk := file.read(2**20):
                digest.update(chunk)
    return digest.hexdigest()
