"""Compiled loops over scatterers and samples of the beams."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.typing import FloatArray

Float32Array = NDArray[np.float32]
DECIBEL = np.log(10.0) / 20.0


@nb.njit(cache=True)
def _jacobian(x: float, y: float) -> float:
    """Solid angle over the product of both angles, at their tangents."""
    return (1 + x * x) * (1 + y * y) / (1 + x * x + y * y) ** 1.5


@nb.njit(cache=True)
def add_losses(
    loss: Float32Array, points: FloatArray, amount: FloatArray, start: FloatArray, step: FloatArray
) -> None:
    """Spread every scatterer's loss (dB mm^3 / cm) over eight cells, over their volume."""
    n0, n1, n2 = loss.shape
    size = step[0] * step[1] * step[2]
    for i in range(len(points)):
        z = points[i, 2]
        if z <= 0 or amount[i] == 0:
            continue
        x, y = points[i, 0] / z, points[i, 1] / z
        r = z * np.sqrt(1 + x * x + y * y)
        a, e = (np.arctan(x) - start[0]) / step[0], (np.arctan(y) - start[1]) / step[1]
        d = (r - start[2]) / step[2]
        if a < 0 or a >= n0 - 1 or e < 0 or e >= n1 - 1 or d < 0 or d >= n2 - 1:
            continue
        ia, ie, k = int(a), int(e), int(d)
        fa, fe, fd = a - ia, e - ie, d - k
        w = amount[i] / (size * r * r * _jacobian(x, y))
        for p in range(2):
            wa = w * (fa if p else 1 - fa)
            for q in range(2):
                wq = wa * (fe if q else 1 - fe)
                loss[ia + p, ie + q, k] += wq * (1 - fd)
                loss[ia + p, ie + q, k + 1] += wq * fd


@nb.njit(cache=True)
def _at(values: Float32Array, a: float, e: float, d: float) -> float:
    """Linear interpolation, constant outside."""
    n0, n1, n2 = values.shape
    a, e, d = (
        min(max(a, 0.0), n0 - 1.001),
        min(max(e, 0.0), n1 - 1.001),
        min(max(d, 0.0), n2 - 1.001),
    )
    i, j, k = int(a), int(e), int(d)
    x, y, z = a - i, e - j, d - k
    low = (1 - y) * ((1 - z) * values[i, j, k] + z * values[i, j, k + 1])
    low += y * ((1 - z) * values[i, j + 1, k] + z * values[i, j + 1, k + 1])
    high = (1 - y) * ((1 - z) * values[i + 1, j, k] + z * values[i + 1, j, k + 1])
    high += y * ((1 - z) * values[i + 1, j + 1, k] + z * values[i + 1, j + 1, k + 1])
    return (1 - x) * low + x * high


@nb.njit(cache=True)
def add_noise(
    signal: Float32Array,
    level: FloatArray,
    start: FloatArray,
    step: FloatArray,
    loss: Float32Array,
    loss_start: FloatArray,
    loss_step: FloatArray,
) -> None:
    """Scale noise to a level over distance, less what is lost on the way."""
    for a in range(signal.shape[0]):
        ca = (start[0] + a * step[0] - loss_start[0]) / loss_step[0]
        for e in range(signal.shape[1]):
            ce = (start[1] + e * step[1] - loss_start[1]) / loss_step[1]
            for d in range(signal.shape[3]):
                cd = (start[2] + d * step[2] - loss_start[2]) / loss_step[2]
                g = np.float32(level[d] * np.exp(-DECIBEL * _at(loss, ca, ce, cd)))
                signal[a, e, 0, d] *= g
                signal[a, e, 1, d] *= g


@nb.njit(cache=True)
def deposit(
    signal: Float32Array,
    points: FloatArray,
    amplitude: FloatArray,
    twice_k: float,
    gain: float,
    start: FloatArray,
    step: FloatArray,
    loss: Float32Array,
    loss_start: FloatArray,
    loss_step: FloatArray,
) -> None:
    """Add every scatterer's echo to the eight samples around it, with the phase of its place.

    The amplitude is divided by the root of the resolution cell's size there, so that tissue is as
    bright at any depth, and changed by ``gain`` dB/mm times distance less the loss.
    """
    n0, n1, n2 = signal.shape[0], signal.shape[1], signal.shape[3]
    for i in range(len(points)):
        z = points[i, 2]
        if z <= 0:
            continue
        x, y = points[i, 0] / z, points[i, 1] / z
        angle_a = np.arctan(x)
        a = (angle_a - start[0]) / step[0]
        if a < 0 or a >= n0 - 1:
            continue
        angle_e = np.arctan(y)
        e = (angle_e - start[1]) / step[1]
        r = z * np.sqrt(1 + x * x + y * y)
        d = (r - start[2]) / step[2]
        if e < 0 or e >= n1 - 1 or d < 0 or d >= n2 - 1:
            continue
        lost = _at(
            loss,
            (angle_a - loss_start[0]) / loss_step[0],
            (angle_e - loss_start[1]) / loss_step[1],
            (r - loss_start[2]) / loss_step[2],
        )
        w = amplitude[i] * np.exp(DECIBEL * (gain * r - lost)) / (r * np.sqrt(_jacobian(x, y)))
        re, im = w * np.cos(twice_k * r), w * np.sin(twice_k * r)
        ia, ie, k = int(a), int(e), int(d)
        fa, fe, fd = a - ia, e - ie, d - k
        for p in range(2):
            wa = fa if p else 1 - fa
            for q in range(2):
                wq = wa * (fe if q else 1 - fe)
                signal[ia + p, ie + q, 0, k] += np.float32(re * wq * (1 - fd))
                signal[ia + p, ie + q, 0, k + 1] += np.float32(re * wq * fd)
                signal[ia + p, ie + q, 1, k] += np.float32(im * wq * (1 - fd))
                signal[ia + p, ie + q, 1, k + 1] += np.float32(im * wq * fd)


@nb.njit(cache=True, fastmath=True)
def blur_across(
    signal: Float32Array, azimuth: Float32Array, elevation: Float32Array
) -> Float32Array:
    """Convolve along both angles; what is not covered by the kernels falls away."""
    n0, n1 = signal.shape[0] - len(azimuth) + 1, signal.shape[1] - len(elevation) + 1
    n2 = signal.shape[3]
    out = np.zeros((n0, n1, 2, n2), dtype=np.float32)
    row = np.empty((signal.shape[1], 2, n2), dtype=np.float32)
    for a in range(n0):
        row[:] = 0
        for k in range(len(azimuth)):
            w = azimuth[k]
            for e in range(row.shape[0]):
                for c in range(2):
                    for d in range(n2):
                        row[e, c, d] += w * signal[a + k, e, c, d]
        for e in range(n1):
            for k in range(len(elevation)):
                w = elevation[k]
                for c in range(2):
                    for d in range(n2):
                        out[a, e, c, d] += w * row[e + k, c, d]
    return out


@nb.njit(cache=True, fastmath=True)
def envelope(signal: Float32Array, along: Float32Array) -> Float32Array:
    """Modulus of the signal convolved along the beams."""
    n0, n1 = signal.shape[:2]
    n2 = signal.shape[3] - len(along) + 1
    out = np.empty((n0, n1, n2), dtype=np.float32)
    re, im = np.empty(n2, dtype=np.float32), np.empty(n2, dtype=np.float32)
    for a in range(n0):
        for e in range(n1):
            re[:], im[:] = 0, 0
            for k in range(len(along)):
                w = along[k]
                for d in range(n2):
                    re[d] += w * signal[a, e, 0, d + k]
                    im[d] += w * signal[a, e, 1, d + k]
            for d in range(n2):
                out[a, e, d] = np.sqrt(re[d] * re[d] + im[d] * im[d])
    return out
