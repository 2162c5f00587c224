"""Errors measured on other valves, in the axes of a valve that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvest.cases.case import ErrorSamples
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.errors import InputError
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray

__all__ = ["samples_in_world", "valve_axes", "without_mean_error"]


def valve_axes(sequence: ValveSequence, frame: int) -> FloatArray:
    """Axes of the valve in a frame, the columns of ``(3, 3)``, in which errors are measured."""
    pose = pose_of(sequence.vertices[frame], sequence.tips[frame], sequence.layout)
    return np.asarray(pose.rotation[0])


def samples_in_world(
    sequence: ValveSequence, frames: CaseFrames, errors: FloatArray, tip_errors: FloatArray
) -> ErrorSamples:
    """Errors measured on other valves, as displacements in the frames of a case.

    With each of them goes what it would be on the other side, as in a mirror: valves are nearly
    alike on both sides of the middle of their leaflets, and so is what is wrong with how they are
    seen. Few samples stand for twice as many, though not for as many that are independent.

    Parameters
    ----------
    sequence : ValveSequence
    frames : CaseFrames
    errors : (K, 2, n, 3) mm
        Found less true, in the axes of each valve, in its open and its closed frame.
    tip_errors : (K, 2, 2, 3) mm

    Raises
    ------
    InputError
        They are not of this layout.
    """
    _require_layout(sequence, errors, tip_errors)
    count = len(errors)
    errors, tip_errors = _with_mirror_images(sequence.layout, errors, tip_errors)
    numbers, which = _frames_and_errors(frames)
    axes = np.stack([valve_axes(sequence, number) for number in numbers])
    # Where it may have been is where it was found less the error.
    return ErrorSamples(
        -np.einsum("fij,kfnj->kfni", axes, errors[:, which]),
        -np.einsum("fij,kfnj->kfni", axes, tip_errors[:, which]),
        np.tile(np.arange(count), 2),
    )


def without_mean_error(
    sequence: ValveSequence, frames: CaseFrames, errors: FloatArray, tip_errors: FloatArray
) -> tuple[ValveSequence, FloatArray, FloatArray]:
    """The valve less the mean error of other valves, and the errors that are left of these.

    What detectors are off by on average, closed free edges that lie where most do for instance, no
    spread of errors can make up for. Only the frames of the case are changed: the open one by the
    mean error of open frames, the others by that of closed ones.

    Parameters
    ----------
    sequence, frames, errors, tip_errors
        As of :func:`samples_in_world`.

    Returns
    -------
    sequence : ValveSequence
    errors, tip_errors : as they were
        About their mean, and larger by sqrt((K + 1) / (K - 1)): of a valve that is none of the K
        the error varies so much about the mean of these.

    Raises
    ------
    InputError
        They are not of this layout, or of fewer than two valves.
    """
    _require_layout(sequence, errors, tip_errors)
    if len(errors) < 2:
        raise InputError(f"errors of {len(errors)} valves, expected two or more")
    mean, tip_mean = errors.mean(axis=0), tip_errors.mean(axis=0)
    vertices, tips = np.array(sequence.vertices), np.array(sequence.tips)
    for number, which in zip(*_frames_and_errors(frames), strict=True):
        axes = valve_axes(sequence, number)
        vertices[number] -= mean[which] @ axes.T
        tips[number] -= tip_mean[which] @ axes.T
    larger = np.sqrt((len(errors) + 1) / (len(errors) - 1))
    return (
        replace(sequence, vertices=vertices, tips=tips),
        larger * (errors - mean),
        larger * (tip_errors - tip_mean),
    )


def _with_mirror_images(
    layout: ValveLayout, errors: FloatArray, tip_errors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors as of :func:`samples_in_world` and, after them, what they are in a mirror."""
    rows, columns = np.divmod(np.arange(layout.size), layout.columns)
    other = rows * layout.columns + np.mod(layout.columns // 2 - columns, layout.columns)
    across = np.array([-1.0, 1.0, 1.0])
    return (
        np.concatenate([errors, across * errors[:, :, other]]),
        np.concatenate([tip_errors, across * tip_errors[:, :, ::-1]]),
    )


def _frames_and_errors(frames: CaseFrames) -> tuple[list[int], list[int]]:
    """Frames of the case, and for each whether it is open (0) or closed (1)."""
    numbers = list(frames.in_order)
    return numbers, [0 if number == frames.open else 1 for number in numbers]


def _require_layout(sequence: ValveSequence, errors: FloatArray, tip_errors: FloatArray) -> None:
    n = sequence.layout.size
    if errors.shape[1:] != (2, n, 3) or tip_errors.shape[1:] != (2, 2, 3):
        raise InputError(
            f"errors of shape {errors.shape} and of tips {tip_errors.shape}, expected (samples, 2, "
            f"{n}, 3) and (samples, 2, 2, 3)"
        )
