"""Checks that every volume passes, whatever file it came from, and the times of its frames.

Times are in seconds, from what the file states and what the user adds.

The bounds leave room for any 4D image of a heart, and are there to catch what is no such image:
pixels read in the wrong order, centimetres taken for millimetres, a mask, a localiser.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange.volumes.data import FieldNames, StatedTimes, StatedVolume, fault
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray

SECONDS_PER_UNIT = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1e-6),
}
"""Units of time by the names that files give them."""

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.002, 1.0
"""Bounds of the interval between two frames of a beating heart, the upper one excluded.

No scanner takes 500 volumes per second; a second between frames leaves one to a beat, and is what
many programs write where they know nothing. So milliseconds taken for seconds are seen, and seconds
taken for milliseconds.
"""


def times_in_seconds(
    path: Path,
    stated: StatedTimes,
    count: int,
    frame_interval_s: float | None,
    time_unit: str | None,
) -> FloatArray:
    """Times ``(count,)`` s of the frames.

    One frame needs no time: it is at 0 if the file states none.

    Parameters
    ----------
    path
        For messages.
    stated
        What the file says.
    count
        Number of frames.
    frame_interval_s
        The user's interval, for a file that states no times in a unit of time.
    time_unit
        The user's unit, for a file that states times without one.

    Raises
    ------
    InputError
        Times without unit, or none at all, and the user did not say; the user contradicts the file;
        times that do not increase, or by steps that no recording of a heart has.
    """
    factor = SECONDS_PER_UNIT.get(stated.unit.lower())
    known = stated.values is not None and factor is not None
    if frame_interval_s is not None:
        times = _user_times(path, stated, count, frame_interval_s, time_unit, known)
    elif stated.values is None or (factor is None and time_unit is None):
        if count == 1:
            return np.zeros(1)
        stated_so = "no times of frames"
        if stated.values is not None:
            stated_so = (
                f"times in the unit {stated.unit!r}" if stated.unit else "times without a unit"
            )
        raise fault(
            path,
            stated.field,
            stated_so,
            "times in s or ms; else give time_unit or frame_interval_s",
        )
    else:
        if time_unit is not None:
            if time_unit not in SECONDS_PER_UNIT:
                raise InputError(f"time_unit: {time_unit!r}, expected 's' or 'ms'")
            if factor is not None and factor != SECONDS_PER_UNIT[time_unit]:
                raise InputError(f"time_unit: {time_unit!r}, but {path} states {stated.unit!r}")
            factor = SECONDS_PER_UNIT[time_unit]
        assert factor is not None
        times = np.asarray(stated.values * factor)
    _check(path, stated.field, times, count)
    return times


def _user_times(
    path: Path,
    stated: StatedTimes,
    count: int,
    frame_interval_s: float,
    time_unit: str | None,
    known: bool,
) -> FloatArray:
    if time_unit is not None:
        raise InputError("frame_interval_s: given beside time_unit, expected one of the two")
    if known:
        raise InputError(f"frame_interval_s: {path} states its own times in {stated.field}")
    if not (np.isfinite(frame_interval_s) and frame_interval_s > 0):
        raise InputError(f"frame_interval_s: {frame_interval_s:g}, expected a positive number")
    return frame_interval_s * np.arange(count, dtype=np.float64)


def _check(path: Path, field: str, times: FloatArray, count: int) -> None:
    if times.shape != (count,):
        raise fault(path, field, f"{times.size} times", f"one for each of {count} frames")
    if not np.isfinite(times).all():
        frame = int(np.flatnonzero(~np.isfinite(times))[0])
        raise fault(path, field, f"{times[frame]} at frame {frame}", "finite times")
    steps = np.diff(times)
    if (steps <= 0).any():
        frame = int(np.flatnonzero(steps <= 0)[0])
        raise fault(
            path,
            field,
            f"{times[frame]:g} s at frame {frame}, then {times[frame + 1]:g} s",
            "increasing times",
        )
    bad = np.flatnonzero((steps < MIN_INTERVAL_S) | (steps >= MAX_INTERVAL_S))
    if len(bad):
        raise fault(
            path,
            field,
            f"{steps[bad[0]]:g} s between frames {bad[0]} and {bad[0] + 1}",
            f"at least {MIN_INTERVAL_S:g} s and less than {MAX_INTERVAL_S:g} s",
        )


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
        What `mvest.exchange.volumes.read_volume` says.
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
