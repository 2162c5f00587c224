"""Times of frames in seconds, from what the file states and what the user adds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.imaging.reading.stated import StatedTimes, fault
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
