"""Errors measured on other valves, in the axes of a valve that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvest.cases.case import ErrorSamples
from mvest.cases.from_images.expected_error import expected_error, in_mirror
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.errors import InputError
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray


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
    n, count = sequence.layout.size, len(errors)
    if errors.shape[1:] != (2, n, 3) or tip_errors.shape[1:] != (2, 2, 3):
        raise InputError(
            f"errors of shape {errors.shape} and of tips {tip_errors.shape}, expected (samples, 2, "
            f"{n}, 3) and (samples, 2, 2, 3)"
        )
    moves = np.concatenate([errors, tip_errors], axis=2)
    moves = np.concatenate([moves, in_mirror(sequence.layout, moves)])
    numbers, which = _frames_and_errors(frames)
    axes = np.stack([valve_axes(sequence, number) for number in numbers])
    # Where it may have been is where it was found less the error.
    moves = -np.einsum("fij,kfnj->kfni", axes, moves[:, which])
    return ErrorSamples(moves[:, :, :-2], moves[:, :, -2:], np.tile(np.arange(count), 2))


def without_expected_error(
    sequence: ValveSequence, frames: CaseFrames, accuracy: DetectionAccuracy
) -> tuple[ValveSequence, FloatArray, FloatArray]:
    """The valve less the error that is expected of it, and errors of other valves about theirs.

    What detectors are off by on average where they find such a valve (`expected_error`), no spread
    of errors can make up for: closed free edges that lie where most do, for instance. Only the
    frames of the case are changed: the open one by the error of open frames, the others by that of
    closed ones.

    Parameters
    ----------
    sequence : ValveSequence
    frames : CaseFrames
    accuracy : DetectionAccuracy
        Of the detectors; errors about what is expected are as wide as is stated of a volume of this
        confidence.

    Returns
    -------
    sequence : ValveSequence
    errors : (K, 2, n, 3) mm
    tip_errors : (K, 2, 2, 3) mm

    Raises
    ------
    InputError
        They are not of this layout, or of fewer than two valves.
    """
    shape = np.stack([_in_own_axes(sequence, n) for n in (frames.open, frames.closed)])
    expected, samples = expected_error(sequence.layout, accuracy, shape)
    vertices, tips = np.array(sequence.vertices), np.array(sequence.tips)
    for number, which in zip(*_frames_and_errors(frames), strict=True):
        off = expected[which] @ valve_axes(sequence, number).T
        vertices[number] -= off[:-2]
        tips[number] -= off[-2:]
    samples *= accuracy.factor(sequence.confidence)
    return (
        replace(sequence, vertices=vertices, tips=tips),
        samples[:, :, :-2],
        samples[:, :, -2:],
    )


def _in_own_axes(sequence: ValveSequence, frame: int) -> FloatArray:
    """Leaflets and, after them, tips ``(n + 2, 3)`` mm in the axes of the valve in a frame."""
    vertices, tips = sequence.vertices[frame], sequence.tips[frame]
    pose = pose_of(vertices, tips, sequence.layout)
    return np.asarray((np.concatenate([vertices, tips]) - pose.centre) @ pose.rotation[0])


def _frames_and_errors(frames: CaseFrames) -> tuple[list[int], list[int]]:
    """Frames of the case, and for each whether it is open (0) or closed (1)."""
    numbers = list(frames.in_order)
    return numbers, [0 if number == frames.open else 1 for number in numbers]
