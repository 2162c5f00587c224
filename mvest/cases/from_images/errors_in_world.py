"""Errors of detectors on other valves: of positions in a found valve's axes, and of measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student_t

from mvest.cases.case import ErrorSamples
from mvest.cases.from_images.expected_error import expected_error, in_mirror
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.cases.from_images.measures import BOUNDS, Row, is_open, leaflets_of
from mvest.errors import InputError
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray
from mvest.valve.measure.clinical import annulus_and_tips


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


BANDED = (
    "ap_diameter_mm",
    "commissural_diameter_mm",
    "annulus_height_mm",
    "annulus_area_mm2",
    "tip_depth_mm",
    "tip_separation_mm",
)
"""Measures that get a band: of annulus and tips, which take no fine detail of leaflets.

Detected leaflets are smoother than true ones, and differences between the two rougher than either:
areas of leaflets that are moved by them would say more of the roughness than of the area.
"""


def with_bands(
    sequence: ValveSequence, rows: Sequence[Row], errors: FloatArray, tip_errors: FloatArray
) -> list[Row]:
    """Measures of every frame, and between which bounds 95 % of true ones are expected.

    The valve of each frame is moved back by every error of the detectors on another valve, and
    measured again: a band is where one more of these values is expected (Student's bounds for one
    further normal number). It lies about where the valve is without the mean error, and so not
    always about what was measured. Errors are known of open and of closed frames; what is neither
    quite takes those of the nearer by its orifice (`OPEN_SHARE`).

    Parameters
    ----------
    sequence : ValveSequence
    rows : sequence of dict
        Its measures, from `mvest.cases.from_images.measures.measure_sequence`.
    errors : (K, 2, n, 3) mm
        Found less true, in the axes of each of K valves, in its open and its closed frame, as they
        are stated for a volume of this confidence.
    tip_errors : (K, 2, 2, 3) mm

    Returns
    -------
    list of dict
        The rows with ``NAME_low`` and ``NAME_high`` of each of `BANDED`; None where the measure is.

    Raises
    ------
    InputError
        They are of fewer than two valves, or not of this layout.
    """
    n, count = sequence.layout.size, len(errors)
    if count < 2 or errors.shape != (count, 2, n, 3) or tip_errors.shape != (count, 2, 2, 3):
        raise InputError(
            f"errors of shape {errors.shape} and of tips {tip_errors.shape}, expected (samples, 2, "
            f"{n}, 3) and (samples, 2, 2, 3) of two samples or more"
        )
    surface = leaflets_of(sequence.layout, 1.0)  # whose thickness these measures do not ask for
    reach = float(student_t.ppf(0.975, count - 1)) * np.sqrt(1.0 + 1.0 / count)
    banded = []
    for t, row in enumerate(rows):
        bounds: Row = dict.fromkeys(f"{name}_{end}" for name in BANDED for end in BOUNDS)
        if row[BANDED[0]] is not None:
            which, axes = (0 if is_open(row) else 1), valve_axes(sequence, t)
            vertices = sequence.vertices[t] - errors[:, which] @ axes.T
            tips = sequence.tips[t] - tip_errors[:, which] @ axes.T
            again = [
                annulus_and_tips(x, surface, x[sequence.layout.annulus], own)
                for x, own in zip(vertices, tips, strict=True)
            ]
            for name in BANDED:
                values = np.array([one.get(name, np.nan) for one in again], dtype=np.float64)
                middle, half = values.mean(), reach * values.std(ddof=1)
                if np.isfinite(half):
                    bounds[f"{name}_low"] = float(middle - half)
                    bounds[f"{name}_high"] = float(middle + half)
        banded.append(dict(row) | bounds)
    return banded
