"""Expected errors of the detectors, and samples of the remaining error for a case.

Detectors are biased towards the valves that they were trained on. So their error depends on how far
a valve is from these, and on the shape that they find. The errors of S held-out valves are
regressed linearly on the detected shapes (ridge regression: Hoerl and Kennard, Technometrics 12,
1970). The penalty is chosen by leaving each valve out; the error of prediction is then r / (1 - h)
(Allen, Technometrics 16, 1974). As a Gaussian process with a linear kernel (Rasmussen and Williams,
Gaussian Processes for Machine Learning, 2006, sec. 2.1) the regression also gives the variance of
one more valve's error about its expectation.

Valves and detectors are nearly symmetric about the middle of the leaflets. So the even and the odd
part of errors and shapes are regressed separately.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import t as student_t

from mvest.cases.case import ErrorSamples
from mvest.cases.from_images.build import CaseFrames
from mvest.cases.from_images.measures import Row, finite_or_none, is_open
from mvest.errors import InputError
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import share_within
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray
from mvest.valve.measure.clinical import annulus_and_tips

PENALTIES = np.append(np.logspace(-3.0, 3.0, 25), np.inf)
"""Penalties that are tried, over the mean variance of the shapes; at infinity the shape has no
effect."""

BANDED = (
    "ap_diameter_mm", "commissural_diameter_mm", "annulus_height_mm", "annulus_area_mm2",
    "tip_depth_mm", "tip_separation_mm",
)  # fmt: skip
"""Measures that get a band: those of annulus and tips, which need no fine detail of leaflets.

Detected leaflets are smoother than true ones, and differences between the two rougher than either.
Areas of leaflets that are moved by them would measure the roughness rather than the area.
"""


def valve_axes(sequence: ValveSequence, frame: int) -> FloatArray:
    """Axes of the valve in a frame, the columns of ``(3, 3)``, in which errors are measured."""
    pose = pose_of(sequence.vertices[frame], sequence.tips[frame], sequence.layout)
    return np.asarray(pose.rotation[0])


def _points(sequence: ValveSequence, frame: int) -> FloatArray:
    """Leaflets, then tips ``(n + 2, 3)`` mm."""
    return np.concatenate([sequence.vertices[frame], sequence.tips[frame]])


def _errors_of(layout: ValveLayout, accuracy: DetectionAccuracy) -> FloatArray:
    """Errors of leaflets, then tips ``(S, 2, n + 2, 3)`` mm of S >= 2 valves."""
    count, n = len(accuracy.samples), layout.size
    if count < 2:
        raise InputError(f"errors of {count} valves, expected two samples or more")
    shapes = accuracy.samples.shape, accuracy.tip_samples.shape
    if shapes != ((count, 2, n, 3), (count, 2, 2, 3)):
        raise InputError(
            f"errors of shape {shapes[0]} and of tips {shapes[1]}, expected (samples, 2, {n}, 3) "
            "and (samples, 2, 2, 3)"
        )
    return np.concatenate([accuracy.samples, accuracy.tip_samples], axis=2)


def samples_in_world(
    sequence: ValveSequence, frames: CaseFrames, errors: FloatArray
) -> ErrorSamples:
    """Displacements in the frames of a case, from errors measured on other valves.

    ``errors (K, 2, n + 2, 3)`` mm are those of `without_expected_error`, in the axes of each valve,
    in its open and its closed frame. Each is used a second time as its mirror image (see above).
    The two samples share a source, because they are not independent.
    """
    moves = np.concatenate([errors, in_mirror(sequence.layout, errors)])
    which = [int(number != frames.open) for number in frames.in_order]
    axes = np.stack([valve_axes(sequence, number) for number in frames.in_order])
    # The true position is the detected one minus the error.
    moves = -np.einsum("fij,kfnj->kfni", axes, moves[:, which])
    return ErrorSamples(moves[:, :, :-2], moves[:, :, -2:], np.tile(np.arange(len(errors)), 2))


def without_expected_error(
    sequence: ValveSequence, frames: CaseFrames, accuracy: DetectionAccuracy
) -> tuple[ValveSequence, FloatArray]:
    """Subtract the expected error from a valve, in the two frames of the case.

    Also returns errors ``(K, 2, n + 2, 3)`` mm (detected minus true) of leaflets, then tips, of
    other valves about their expectations. Their size is that stated for a volume of this
    confidence. InputError if the errors belong to another layout, or to fewer than two valves.
    """
    numbers = frames.open, frames.closed
    axes = [valve_axes(sequence, number) for number in numbers]
    shape = np.stack(
        [
            (_points(sequence, number) - sequence.annulus[number].mean(axis=0)) @ own
            for number, own in zip(numbers, axes, strict=True)
        ]
    )
    expected, samples = _expected_error(sequence.layout, accuracy, shape)
    vertices, tips = np.array(sequence.vertices), np.array(sequence.tips)
    for number, own, error in zip(numbers, axes, expected, strict=True):
        off = error @ own.T
        vertices[number] -= off[:-2]
        tips[number] -= off[-2:]
    samples *= accuracy.factor(sequence.confidence)
    return replace(sequence, vertices=vertices, tips=tips), samples


def with_bands(
    sequence: ValveSequence, rows: Sequence[Row], accuracy: DetectionAccuracy
) -> list[Row]:
    """Add the bounds between which 95 % of true measures are expected to the measures of frames.

    The valve of each frame is moved back by every error of the detectors on another valve, and
    measured again. The band is where one more of these values is expected (Student's bounds for one
    further normal number). It includes the correction of the mean error, so it need not be centred
    on the measured value. Frames use the errors of open or closed valves by their orifice
    (`OPEN_SHARE`). The accuracy is that in a volume of this confidence.

    Returns the rows of `measure_sequence` with ``NAME_low`` and ``NAME_high`` of each of `BANDED`,
    None where the measure is. InputError if the errors belong to fewer than two valves, or to
    another layout.
    """
    errors, annulus = _errors_of(sequence.layout, accuracy), sequence.layout.annulus
    count = len(errors)
    reach = float(student_t.ppf(0.975, count - 1)) * np.sqrt(1.0 + 1.0 / count)
    banded = []
    for t, row in enumerate(rows):
        again = []
        if row[BANDED[0]] is not None:
            off = errors[:, 0 if is_open(row) else 1] @ valve_axes(sequence, t).T
            again = [
                annulus_and_tips(x[:-2], sequence.layout, x[annulus], x[-2:])
                for x in _points(sequence, t) - off
            ]
        bounds: Row = {}
        for name in BANDED:
            values = np.array([one.get(name, np.nan) for one in again] or [np.nan] * count)
            middle, half = values.mean(), reach * values.std(ddof=1)
            bounds[f"{name}_low"] = finite_or_none(middle - half)
            bounds[f"{name}_high"] = finite_or_none(middle + half)
        banded.append(row | bounds)
    return banded


def coverage(
    layout: ValveLayout,
    accuracy: DetectionAccuracy,
    errors: FloatArray,
    shapes: FloatArray,
    confidence: FloatArray,
) -> list[dict[str, float]]:
    """How well the stated errors hold for valves that are not among the samples.

    Returns for each frame ``within_95`` (% of coordinates within 1.96 of the
    stated deviations), ``rms`` and ``stated`` (mm, the actual and the stated root mean square). The
    same with the suffix ``_handed_on`` after the expected error of such a shape is subtracted.

    Parameters
    ----------
    errors : (S, 2, n, 3) mm
        Detected minus true, in the open and the closed frame.
    shapes : (S, 2, n + 2, 3) mm
        Detected leaflets, then tips, in the valve's axes.
    confidence : (S,)
        Of each volume.
    """
    n = layout.size
    factors = np.array([accuracy.factor(one) for one in confidence])[:, None, None, None]
    pairs = [_expected_error(layout, accuracy, shape) for shape in shapes]
    left = (errors - np.stack([expected[:, :n] for expected, _ in pairs])) / factors
    spread = np.stack([np.sqrt((one[:, :, :n] ** 2).mean(axis=(0, 3))) for _, one in pairs])
    rows = []
    for k in range(2):
        own = errors[:, k : k + 1]
        handed_on = share_within(left[:, k] / spread[:, k, :, None], np.ones(n))
        rows.append(
            {
                "within_95": 100 * share_within(own / factors, accuracy.std_mm),
                "rms": _rms(own),
                "stated": _rms(accuracy.std_mm) * _rms(factors),
                "within_95_handed_on": 100 * handed_on,
                "rms_handed_on": _rms(factors[:, 0] * left[:, k]),
                "stated_handed_on": _rms(factors[:, 0, 0] * spread[:, k]),
            }
        )
    return rows


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _expected_error(
    layout: ValveLayout, accuracy: DetectionAccuracy, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`error_at_shape` by the detectors' accuracy in a volume of confidence 1."""
    errors = _errors_of(layout, accuracy)
    if accuracy.shapes is None or accuracy.tip_shapes is None:
        return error_at_shape(layout, errors, np.zeros_like(errors), np.zeros_like(shape))
    shapes = np.concatenate([accuracy.shapes, accuracy.tip_shapes], axis=2)
    return error_at_shape(layout, errors, shapes, shape)


def error_at_shape(
    layout: ValveLayout, errors: FloatArray, shapes: FloatArray, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Expected error of a valve that is detected with some shape, and samples about it.

    Parameters
    ----------
    errors, shapes : (S, F, n + 2, 3) mm
        Errors of leaflets, then tips, of S >= 2 other valves in F frames, and their detected
        shapes, each in its own axes. Equal shapes give the mean error.
    shape : (F, n + 2, 3) mm
        Detected shape of the valve, in its own axes.

    Returns
    -------
    expected : (F, n + 2, 3) mm
    samples : (S, F, n + 2, 3) mm
        The other valves' errors about their expectations, scaled to the error of one more valve of
        this shape. For equal shapes the factor is sqrt((S + 1) / (S - 1)).
    """
    expected, samples = np.zeros_like(shape), np.zeros_like(errors)
    for sign in (1.0, -1.0):
        e, z, own = (
            0.5 * (part + sign * in_mirror(layout, part)) for part in (errors, shapes, shape)
        )
        mean, about = _ridge(z.reshape(len(z), -1), e.reshape(len(e), -1), own.ravel())
        expected += mean.reshape(shape.shape)
        samples += about.reshape(errors.shape)
    return expected, samples


def in_mirror(layout: ValveLayout, moves: FloatArray) -> FloatArray:
    """Mirror images of leaflets, then tips ``(..., n + 2, 3)`` in a valve's axes."""
    rows, columns = np.divmod(np.arange(layout.size), layout.columns)
    other = rows * layout.columns + np.mod(layout.columns // 2 - columns, layout.columns)
    swapped = np.append(other, [layout.size + 1, layout.size])
    return np.asarray(moves[..., swapped, :] * np.array([-1.0, 1.0, 1.0]))


def _ridge(Z: FloatArray, E: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected error ``(m,)`` at features ``z (q,)``, and samples ``(S, m)`` about it.

    ``Z (S, q)`` and ``E (S, m)`` belong to the other valves. The constant is not penalised, so the
    covariance of their residuals r is that of one error times 1 - h.
    """
    count = len(Z)
    Z_mean, E_mean = Z.mean(axis=0), E.mean(axis=0)
    Z, z = Z - Z_mean, z - Z_mean
    eigenvalues, U = np.linalg.eigh(Z @ Z.T)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    scale = eigenvalues.mean() or 1.0
    rotated = U.T @ (E - E_mean)
    best = np.inf
    for penalty in scale * PENALTIES:
        left = 1.0 / (1.0 + eigenvalues / penalty)
        free = U**2 @ left - 1.0 / count
        residual = U @ (left[:, None] * rotated)
        cost = float((residual**2 / free[:, None] ** 2).sum())
        if cost <= best:
            best, chosen = cost, (penalty, left, residual / np.sqrt(free)[:, None])
    penalty, left, standard = chosen
    weights = (U.T @ (Z @ z)) * left / penalty
    spread = 1.0 + 1.0 / count + (z @ z - weights @ (U.T @ (Z @ z))) / penalty
    return E_mean + weights @ rotated, np.sqrt(spread) * standard
