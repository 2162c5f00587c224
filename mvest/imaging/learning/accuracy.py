"""Errors of the detectors in held-out volumes, and their correlation length."""

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.imaging.detection.trained_model import UNLIKE_SHARE, DetectionAccuracy
from mvest.typing import FloatArray

BIN_MM = 1.0
"""mm, bin width of distances."""

FARTHEST_MM = 30.0
"""mm, largest distance of pairs from which the correlation length is fitted."""

LENGTHS_MM = (0.5, 60.0)
"""mm, range of the correlation length."""

NORMAL_95 = 1.959963984540054
"""Half width, in standard deviations, of the central 95 % of a normal distribution."""


def matern(distance: FloatArray, length: float) -> FloatArray:
    """Matérn correlation of smoothness 3/2, which the estimation assumes.

    ``(1 + sqrt(3) d / l) exp(-sqrt(3) d / l)`` (Rasmussen and Williams, Gaussian Processes for
    Machine Learning, 2006, eq. 4.17).
    """
    d = np.sqrt(3.0) * np.asarray(distance) / length
    return np.asarray((1.0 + d) * np.exp(-d))


def correlogram(errors: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean distance (mm) and correlation ``(B,)`` of the errors of pairs of vertices, in bins.

    ``errors (m, n)`` are m independent fields, each about zero, at ``points (n, 3)`` mm at rest.
    """
    size = np.sqrt((errors**2).mean(axis=0))
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise InputError("errors of detectors: none at some vertex, expected finite ones > 0")
    scaled = errors / size
    product = scaled.T @ scaled / len(scaled)
    first, second = np.triu_indices(len(points), 1)
    distance = cdist(points, points)[first, second]
    near = distance < FARTHEST_MM
    number = (distance[near] / BIN_MM).astype(np.int64)
    pairs = np.bincount(number).astype(np.float64)
    totals = (np.bincount(number, v[near]) for v in (distance, product[first, second]))
    means, correlations = (total[pairs > 0] / pairs[pairs > 0] for total in totals)
    return means, correlations


def fitted_length(distance: FloatArray, correlation: FloatArray) -> float:
    """The length (mm) of the Matérn correlation nearest to a correlogram (least squares)."""
    best = minimize_scalar(
        lambda log: float(((matern(distance, np.exp(log)) - correlation) ** 2).sum()),
        bounds=tuple(np.log(LENGTHS_MM)),
        method="bounded",
    )
    return float(np.exp(best.x))


def measure_accuracy(
    samples: FloatArray, tip_samples: FloatArray, rest: FloatArray
) -> DetectionAccuracy:
    """Errors of the detectors from S held-out sequences in F frames.

    The standard deviation of a vertex is the root mean square over sequences, frames and
    coordinates of its errors about their mean over the sequences (in each frame and coordinate, so
    that S - 1 of S are free). InputError if it is zero or not finite.

    ``samples (S, F, n, 3)`` and ``tip_samples (S, F, 2, 3)`` mm are detected minus true in the
    valve's axes, ``rest (n, 3)`` mm is the mean valve at rest.
    """
    count, frames, n = samples.shape[:3]
    about = samples - samples.mean(axis=0)
    std = np.sqrt((about**2).sum(axis=(0, 1, 3)) / ((count - 1) * frames * 3))
    length = fitted_length(*correlogram(about.transpose(0, 1, 3, 2).reshape(-1, n), rest))
    return DetectionAccuracy(std, length, samples, tip_samples)


def widened(
    accuracy: DetectionAccuracy,
    confidence: FloatArray,
    wide: FloatArray,
    wide_confidence: FloatArray,
) -> DetectionAccuracy:
    """Fit `DetectionAccuracy.widening` and `like_from` to the confidence of volumes.

    The factor on errors is exponential in the missing confidence. Its exponent is fitted to the
    size of the errors (least squares over volumes). Its start puts 95 % of all coordinates of all
    volumes within 1.96 standard deviations. A volume is unlike the sequences if its confidence is
    below the k-th smallest of theirs. For one more volume that happens in k of S + 1 cases,
    whatever the distribution (David and Nagaraja, Order Statistics, 2003, sec. 7.3), which is at
    most `UNLIKE_SHARE` if S is large enough (`unlike_share`).

    Each of the S sequences of ``accuracy``, of ``confidence (S,)``, is compared with the others.
    ``wide (W, F, n, 3)`` mm are errors of further sequences, of other valves and over wider
    acquisitions, of ``wide_confidence (W,)``.
    """
    samples, std = accuracy.samples, accuracy.std_mm
    count, frames = samples.shape[:2]
    mean = samples.mean(axis=0)
    compared = samples if count > 2 else samples[:0]  # a single other has no spread
    off = []
    for k, own in enumerate(compared):
        others = np.delete(samples, k, axis=0)
        about = others - others.mean(axis=0)
        one = np.sqrt((about**2).sum(axis=(0, 1, 3)) / ((count - 2) * frames * 3))
        off.append(np.abs(own - others.mean(axis=0)) / one[:, None])
    off += [np.abs(own - mean) / std[:, None] for own in wide]
    lacking = 1.0 - np.concatenate([confidence[: len(compared)], wide_confidence])
    size = np.log([np.quantile(one, 0.95) for one in off])
    from_mean = lacking - lacking.mean()
    spread = float((from_mean**2).sum())
    slope = max(0.0, float(from_mean @ size) / spread) if spread > 0 else 0.0
    z = np.stack(off) / np.exp(slope * lacking)[:, None, None, None]
    rank = round(unlike_share(count) * (count + 1))
    return replace(
        accuracy,
        widening=(float(np.quantile(z, 0.95)) / NORMAL_95, slope),
        like_from=float(np.sort(confidence)[rank - 1]),
    )


def unlike_share(count: int) -> float:
    """Share of volumes like ``count`` sequences that count as unlike them, see `widened`."""
    return max(1, int(UNLIKE_SHARE * (count + 1))) / (count + 1)


def share_within(errors: FloatArray, std_mm: FloatArray) -> float:
    """Share of errors ``(S, F, n, 3)`` mm within 1.96 standard deviations ``(n,)``."""
    return float((np.abs(errors) <= NORMAL_95 * std_mm[:, None]).mean())
