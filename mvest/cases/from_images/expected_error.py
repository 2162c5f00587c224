"""What the detectors are off by where they find such a valve, learned on other valves.

Detectors are drawn to what they were trained on: what they are off by depends on how far from it a
valve is, and so on what they find. The errors of S valves are regressed on the shapes in which
these were found, linearly, with a penalty on the square of the coefficients that is chosen by
leaving each valve out (ridge regression: Hoerl and Kennard, Technometrics 12, 1970; what is left of
a valve that is left out, r / (1 - h): Allen, Technometrics 16, 1974). As a Gaussian process with a
linear kernel (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sec. 2.1) it
also says how much wider the error of one more valve varies about what is expected of it.

Valves and detectors are nearly alike in a mirror across the middle of the leaflets, so what is even
in it and what is odd are regressed apart: neither tells of the other.
"""

from __future__ import annotations

import numpy as np

from mvest.errors import InputError
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import share_within
from mvest.typing import FloatArray

PENALTIES = np.append(np.logspace(-3.0, 3.0, 25), np.inf)
"""Those tried, over the mean variance of the shapes; at infinity the shape says nothing."""


def expected_error(
    layout: ValveLayout, accuracy: DetectionAccuracy, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The error that is expected of detectors, and how it may vary, in a volume of confidence 1.

    Parameters
    ----------
    layout : ValveLayout
    accuracy : DetectionAccuracy
    shape : (2, n + 2, 3) mm
        Leaflets and, after them, papillary tips of the open and the closed frame, each as it was
        found and in its own axes.

    Returns
    -------
    expected : (2, n + 2, 3) mm
        Found less true, in the valve's axes.
    samples : (S, 2, n + 2, 3) mm
        See `error_at_shape`; what of their size is owed to confidence is `accuracy.factor`.

    Raises
    ------
    InputError
        Errors are of fewer than two valves, or not of this layout.
    """
    n, count = layout.size, len(accuracy.samples)
    if accuracy.samples.shape[1:] != (2, n, 3) or accuracy.tip_samples.shape[1:] != (2, 2, 3):
        raise InputError(
            f"errors of shape {accuracy.samples.shape} and of tips {accuracy.tip_samples.shape}, "
            f"expected (samples, 2, {n}, 3) and (samples, 2, 2, 3)"
        )
    if count < 2:
        raise InputError(f"errors of {count} valves, expected two or more")
    errors = np.concatenate([accuracy.samples, accuracy.tip_samples], axis=2)
    shapes = None
    if accuracy.shapes is not None and accuracy.tip_shapes is not None:
        shapes = np.concatenate([accuracy.shapes, accuracy.tip_shapes], axis=2)
    return error_at_shape(layout, errors, shapes, shape)


def coverage(
    layout: ValveLayout,
    accuracy: DetectionAccuracy,
    errors: FloatArray,
    shapes: FloatArray,
    confidence: FloatArray,
) -> list[dict[str, float]]:
    """How true the stated errors are of valves that were not among the samples, by frame.

    Parameters
    ----------
    layout : ValveLayout
    accuracy : DetectionAccuracy
    errors : (S, 2, n, 3) mm
        Found less true, in the open and the closed frame.
    shapes : (S, 2, n + 2, 3) mm
        Where the valves were found; see `expected_error`.
    confidence : (S,)
        Of each volume.

    Returns
    -------
    list of dict
        For each frame ``within_95`` (% of coordinates within 1.96 of the stated deviations),
        ``rms`` and ``stated`` (mm, the actual and the stated root mean square); and the same
        ``..._handed_on``, less the error that is expected of such a shape.
    """
    n = layout.size
    factors = np.array([accuracy.factor(one) for one in confidence])[:, None, None, None]
    expected, samples = zip(
        *(expected_error(layout, accuracy, shape) for shape in shapes), strict=True
    )
    left = (errors - np.stack(expected)[:, :, :n]) / factors
    spread = np.stack([np.sqrt((one[:, :, :n] ** 2).mean(axis=(0, 3))) for one in samples])
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


def error_at_shape(
    layout: ValveLayout, errors: FloatArray, shapes: FloatArray | None, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The error that is expected where a valve is found so, and how it may vary about that.

    Parameters
    ----------
    layout : ValveLayout
    errors : (S, F, n + 2, 3) mm
        Of leaflets and, after them, papillary tips, of S >= 2 other valves in F frames.
    shapes : (S, F, n + 2, 3) mm, optional
        Where these valves were found, in the axes of each. None: not known, and nothing is learned
        of them.
    shape : (F, n + 2, 3) mm
        Where the valve was found, in its own axes.

    Returns
    -------
    expected : (F, n + 2, 3) mm
    samples : (S, F, n + 2, 3) mm
        The other valves' errors about what is expected of each, as large as those of one more valve
        of this shape: without shapes, sqrt((S + 1) / (S - 1)) times those about the mean.
    """
    if shapes is None:
        shapes, shape = np.zeros_like(errors), np.zeros_like(shape)
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
    """Leaflets and tips ``(..., n + 2, 3)``, in a valve's axes, as they are in a mirror."""
    rows, columns = np.divmod(np.arange(layout.size), layout.columns)
    other = rows * layout.columns + np.mod(layout.columns // 2 - columns, layout.columns)
    swapped = np.append(other, [layout.size + 1, layout.size])
    return np.asarray(moves[..., swapped, :] * np.array([-1.0, 1.0, 1.0]))


def _ridge(Z: FloatArray, E: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected error ``(m,)`` at features ``z (q,)``, and samples ``(S, m)`` about it.

    ``Z (S, q)`` and ``E (S, m)`` are those of the other valves. With a constant that is not
    penalised, the covariance of their residuals r is that of one error times 1 - h.
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
