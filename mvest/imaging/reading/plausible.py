"""Checks that every volume passes, whatever file it came from.

The bounds leave room for any 4D image of a heart, and are there to catch what is no such image:
pixels read in the wrong order, centimetres taken for millimetres, a mask, a localiser.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.imaging.reading.stated import FieldNames, StatedVolume, fault
from mvest.imaging.reading.times import times_in_seconds
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray

SPACING_MM = (0.05, 5.0)
"""Between neighbouring voxels; 3D echo has 0.3 to 1.5, CT 0.2 to 1, MR up to 5."""
EXTENT_MM = (20.0, 500.0)
"""Of the volume along each axis: from an annulus to a whole chest."""
MIN_VOXELS = 16
"""Along each axis."""
MAX_BYTES = 4 * 2**30
"""Of all frames, decoded, if the caller states no other number.

Twenty frames of CT, 512 x 512 x 300 voxels of two bytes, have 2.9 GiB. A reader takes up to three
times as much memory for a while: what is read, its frames one after another, and those as float32.
"""
MAX_OFFSET_MM = 1e4
"""Of the origin from the world's zero."""
ORTHOGONAL = 1e-3
"""Largest cosine between axes, which files give with three digits or more."""


def check_size(path: Path, field: str, shape: Sequence[int], itemsize: int, max_bytes: int) -> None:
    """Refuse a number of voxels that is none, too few or too many, before anything is read.

    Parameters
    ----------
    path, field
        For messages.
    shape
        ``(T, I, J, K)``.
    itemsize
        Bytes per voxel.
    max_bytes
        Of all voxels.
    """
    counted = " x ".join(str(n) for n in shape)
    if shape[0] < 1:
        raise fault(path, field, f"{counted} frames and voxels", "at least one frame")
    if min(shape[1:]) < MIN_VOXELS:
        raise fault(
            path, field, f"{counted} frames and voxels", f"at least {MIN_VOXELS} along each axis"
        )
    total = itemsize
    for n in shape:
        total *= int(n)
    if total > max_bytes:
        raise fault(
            path,
            field,
            f"{counted} frames and voxels of {itemsize} bytes, together {total / 2**30:.1f} GiB",
            f"at most {max_bytes / 2**30:g} GiB; max_bytes of read_volume raises it",
        )


def checked_sequence(
    path: Path,
    stated: StatedVolume,
    sha256: str,
    modality: Modality | None,
    frame_interval_s: float | None,
    time_unit: str | None,
) -> VolumeSequence:
    """The volume over time that a file states, once everything about it is plausible.

    Raises
    ------
    InputError
        What `mvest.imaging.reading.read_volume` says.
    """
    names = stated.names
    spacing, direction = _axes(path, names, stated.steps)
    _check_extent(path, names, spacing, stated.frames.shape[1:])
    origin = np.asarray(stated.origin, dtype=np.float64)
    if not np.isfinite(origin).all() or np.abs(origin).max() > MAX_OFFSET_MM:
        raise fault(
            path,
            names.origin,
            _numbers(origin),
            f"coordinates in mm, none beyond {MAX_OFFSET_MM:g}",
        )
    times = times_in_seconds(path, stated.times, len(stated.frames), frame_interval_s, time_unit)
    kind = _modality(path, stated.modality, modality)
    return VolumeSequence(
        frames=_values(path, names.values, stated.frames),
        spacing=spacing,
        direction=direction,
        origin=origin,
        times=times,
        modality=kind,
        source=path.name,
        sha256=sha256,
    )


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value:g}" for value in np.ravel(values))


def _axes(path: Path, names: FieldNames, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Spacing and orthonormal axes; a left-handed system stays one."""
    spacing = np.linalg.norm(steps, axis=0)
    low, high = SPACING_MM
    if not np.isfinite(steps).all() or not ((spacing >= low) & (spacing <= high)).all():
        raise fault(
            path,
            names.spacing,
            f"{_numbers(spacing)} mm between voxels",
            f"{low:g} to {high:g} mm along each axis",
        )
    axes = steps / spacing
    if np.abs(axes.T @ axes - np.eye(3)).max() > ORTHOGONAL:
        raise fault(path, names.direction, f"axes {_numbers(axes.T)}", "axes at right angles")
    # The closest orthonormal axes take away what rounding in the file left; none is turned round.
    left, _, right = np.linalg.svd(axes)
    return spacing, left @ right


def _check_extent(
    path: Path, names: FieldNames, spacing: FloatArray, shape: tuple[int, ...]
) -> None:
    extent = spacing * shape
    low, high = EXTENT_MM
    if (extent < low).any() or (extent > high).any():
        raise fault(
            path,
            names.spacing,
            f"volume of {' x '.join(f'{e:.4g}' for e in extent)} mm",
            f"{low:g} to {high:g} mm along each axis",
        )


def _modality(path: Path, stated: Modality | None, given: Modality | None) -> Modality:
    if stated is not None and given is not None and stated is not given:
        raise InputError(f"modality: {given.value}, but {path} states {stated.value}")
    kind = stated or given
    if kind is None:
        raise InputError(
            f"{path}: modality: not stated by the file, expected as a setting: "
            f"{', '.join(m.value for m in Modality)}"
        )
    return kind


def _values(path: Path, field: str, frames: NDArray[np.generic]) -> NDArray[np.generic]:
    """The frames as uint8, int16 or float32, each of which shows something."""
    if frames.dtype.kind not in "iuf":
        raise fault(path, field, f"type {frames.dtype}", "one real number for each voxel")
    frames = np.ascontiguousarray(frames)
    lowest, highest = 0.0, 0.0
    for number, frame in enumerate(frames):
        low, high = float(np.min(frame)), float(np.max(frame))
        if not (np.isfinite(low) and np.isfinite(high)):
            bad = int(np.count_nonzero(~np.isfinite(frame)))
            raise fault(path, field, f"{bad} voxels of frame {number} are no numbers", "numbers")
        if low == high:
            raise fault(
                path, field, f"all voxels of frame {number} are {low:g}", "an image in every frame"
            )
        lowest, highest = min(lowest, low), max(highest, high)
    if frames.dtype == np.uint8:
        return frames
    if frames.dtype.kind in "iu":
        limits = np.iinfo(np.int16)
        if lowest >= limits.min and highest <= limits.max:
            return frames.astype(np.int16, copy=False)
    elif max(-lowest, highest) > np.finfo(np.float32).max:
        raise fault(path, field, f"{max(-lowest, highest):g}", "numbers in the range of 4 bytes")
    return frames.astype(np.float32, copy=False)
