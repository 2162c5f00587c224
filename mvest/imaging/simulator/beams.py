"""Echoes in the coordinates of the beams: distance, azimuth and elevation.

A direction is (tan a, tan e, 1) along azimuth, elevation and beam. The signal is complex baseband:
a scatterer at distance r adds its amplitude times ``exp(2 i k r)``, blurred by the point spread
function, which is separable in distance and the two angles (linear image formation, as in Gao et
al., IEEE Trans. Ultrason. Ferroelectr. Freq. Control 56, 2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.scene import Echoes
from mvest.typing import FloatArray

Float32Array = NDArray[np.float32]
DECIBEL = np.log(10.0) / 20.0


class Losses(NamedTuple):
    """Attenuation on a coarse grid over the whole pyramid."""

    decibel: Float32Array  #: (A, E, D) two-way, beyond that of blood
    start: FloatArray  #: (3,) of azimuth and elevation (rad) and distance (mm)
    step: FloatArray  #: (3,)


@nb.njit(cache=True)
def _beam(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Azimuth, elevation, distance, and the solid angle there over the product of both angles."""
    x, y = x / z, y / z
    square = 1 + x * x + y * y
    jacobian = (1 + x * x) * (1 + y * y) / square**1.5
    return np.arctan(x), np.arctan(y), z * np.sqrt(square), jacobian


@nb.njit(cache=True)
def add_losses(
    loss: Float32Array, points: FloatArray, amount: FloatArray, start: FloatArray, step: FloatArray
) -> None:
    """Spread every scatterer's loss (dB mm^3 / cm) over eight cells, over their volume."""
    n0, n1, n2 = loss.shape
    size = step[0] * step[1] * step[2]
    for i in range(len(points)):
        if points[i, 2] <= 0 or amount[i] == 0:
            continue
        azimuth, elevation, r, jacobian = _beam(points[i, 0], points[i, 1], points[i, 2])
        a, e = (azimuth - start[0]) / step[0], (elevation - start[1]) / step[1]
        d = (r - start[2]) / step[2]
        if a < 0 or a >= n0 - 1 or e < 0 or e >= n1 - 1 or d < 0 or d >= n2 - 1:
            continue
        ia, ie, k = int(a), int(e), int(d)
        fa, fe, fd = a - ia, e - ie, d - k
        w = amount[i] / (size * r * r * jacobian)
        for p in range(2):
            wa = w * (fa if p else 1 - fa)
            for q in range(2):
                wq = wa * (fe if q else 1 - fe)
                loss[ia + p, ie + q, k] += wq * (1 - fd)
                loss[ia + p, ie + q, k + 1] += wq * fd


@nb.njit(cache=True)
def _lost(losses: Losses, azimuth: float, elevation: float, distance: float) -> float:
    """Loss (dB) by linear interpolation, constant outside."""
    values, start, step = losses
    n0, n1, n2 = values.shape
    a = min(max((azimuth - start[0]) / step[0], 0.0), n0 - 1.001)
    e = min(max((elevation - start[1]) / step[1], 0.0), n1 - 1.001)
    d = min(max((distance - start[2]) / step[2], 0.0), n2 - 1.001)
    i, j, k = int(a), int(e), int(d)
    x, y, z = a - i, e - j, d - k
    low = (1 - y) * ((1 - z) * values[i, j, k] + z * values[i, j, k + 1])
    low += y * ((1 - z) * values[i, j + 1, k] + z * values[i, j + 1, k + 1])
    high = (1 - y) * ((1 - z) * values[i + 1, j, k] + z * values[i + 1, j, k + 1])
    high += y * ((1 - z) * values[i + 1, j + 1, k] + z * values[i + 1, j + 1, k + 1])
    return (1 - x) * low + x * high


@nb.njit(cache=True)
def add_noise(
    signal: Float32Array, level: FloatArray, start: FloatArray, step: FloatArray, losses: Losses
) -> None:
    """Scale noise to a level over distance, less the attenuation."""
    for a in range(signal.shape[0]):
        for e in range(signal.shape[1]):
            for d in range(signal.shape[3]):
                lost = _lost(
                    losses, start[0] + a * step[0], start[1] + e * step[1], start[2] + d * step[2]
                )
                g = np.float32(level[d] * np.exp(-DECIBEL * lost))
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
    losses: Losses,
) -> None:
    """Add every scatterer's echo to the eight samples around it, with its phase.

    The amplitude is divided by the root of the resolution cell's size, so that tissue is equally
    bright at any depth, and changed by ``gain`` dB/mm times distance less the attenuation.
    """
    n0, n1, n2 = signal.shape[0], signal.shape[1], signal.shape[3]
    for i in range(len(points)):
        if points[i, 2] <= 0:
            continue
        azimuth, elevation, r, jacobian = _beam(points[i, 0], points[i, 1], points[i, 2])
        a, e = (azimuth - start[0]) / step[0], (elevation - start[1]) / step[1]
        d = (r - start[2]) / step[2]
        if a < 0 or a >= n0 - 1 or e < 0 or e >= n1 - 1 or d < 0 or d >= n2 - 1:
            continue
        lost = _lost(losses, azimuth, elevation, r)
        w = amplitude[i] * np.exp(DECIBEL * (gain * r - lost)) / (r * np.sqrt(jacobian))
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
    """Convolve along both angles, without the margins of the kernels."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Samples along one coordinate of the beams, with the blur along it; mm or rad.

    With the ``kernel`` a point that is spread over its two neighbours by linear weights has the
    amplitude 1 and the set full width at half maximum.
    """

    start: float  #: first sample
    step: float
    count: int  #: samples shown; the blur needs ``margin`` more at either end
    kernel: Float32Array  #: (2 margin + 1,) blur of the samples
    energy: float  #: integral of the squared amplitude of a point's image

    @property
    def margin(self) -> int:
        """Half width of the kernel."""
        return len(self.kernel) // 2


PER_WIDTH_ACROSS, PER_WIDTH_ALONG = 2.2, 2.5
LOBES = ((1.45, 1.0, -1.0), (2.3, 0.5, 1.0))
"""Side lobes: distance over the full width, level over the first one's, sign."""


def _axis(low: float, high: float, width: float, lobe_db: float, per_width: float) -> Axis:
    count = max(2, math.ceil((high - low) / width * per_width) + 1)
    step = (high - low) / (count - 1)
    sigma = width / math.sqrt(8 * math.log(2))
    # Linear weights have variance step^2 / 6, which the kernel leaves out.
    narrow = math.sqrt(sigma**2 - step**2 / 6)
    level = 10 ** (lobe_db / 20)
    reach = 3 * sigma if level < 1e-6 else (LOBES[-1][0] + 0.6) * width
    margin = math.ceil(reach / step)

    def shape(x: FloatArray, spread: float) -> FloatArray:
        total = np.exp(-0.5 * (x / spread) ** 2)
        if level >= 1e-6:
            for place, share, sign in LOBES:
                for side in (-1, 1):
                    lobe = np.exp(-0.5 * ((x - side * place * width) / (0.8 * spread)) ** 2)
                    total += sign * share * level * lobe
        return np.asarray(total)

    kernel = sigma / narrow * shape(np.arange(-margin, margin + 1, dtype=np.float64) * step, narrow)
    fine = np.linspace(-4 * width, 4 * width, 4001)
    energy = float((shape(fine, sigma) ** 2).sum() * (fine[1] - fine[0]))
    return Axis(low, step, count, kernel.astype(np.float32), energy)


@dataclass(frozen=True, slots=True, eq=False)
class BeamGrid:
    """The samples of an acquisition."""

    acquisition: Acquisition
    azimuth: Axis  #: rad
    elevation: Axis  #: rad
    distance: Axis  #: mm

    @classmethod
    def of(cls, a: Acquisition) -> BeamGrid:
        """The grid that resolves an acquisition's point spread function."""
        half_a, half_e = math.radians(a.azimuth_deg) / 2, math.radians(a.elevation_span_deg) / 2
        lateral, elevation = math.radians(a.lateral_deg), math.radians(a.elevation_deg)
        return cls(
            a,
            _axis(-half_a, half_a, lateral, a.side_lobe_db, PER_WIDTH_ACROSS),
            _axis(-half_e, half_e, elevation, a.side_lobe_db, PER_WIDTH_ACROSS),
            _axis(*a.depth_mm, a.axial_mm, -math.inf, PER_WIDTH_ALONG),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Samples along azimuth, elevation and distance."""
        return self.azimuth.count, self.elevation.count, self.distance.count

    def windows(self) -> list[tuple[int, int]]:
        """First and past the last azimuth of each beat."""
        edges = np.linspace(0, self.azimuth.count, self.acquisition.beats + 1).round().astype(int)
        return [(a, b) for a, b in pairwise(edges.tolist())]


def losses_of(grid: BeamGrid, echoes: Echoes, contact: FloatArray) -> Losses:
    """Attenuation by the scatterers' tissue, summed along each beam.

    ``contact (p, q)`` dB is a gain over the pyramid, at directions evenly spaced from edge to edge.
    """
    axes = (grid.azimuth, grid.elevation, grid.distance)
    wide = (2.2, 2.2, 3.0)
    reach = np.array([(x.count + 2 * x.margin) * x.step for x in axes])
    start = np.array([x.start - x.margin * x.step for x in axes])
    count = [math.ceil(r / (w * x.step)) + 1 for r, w, x in zip(reach, wide, axes, strict=True)]
    step = reach / (np.array(count) - 1)
    start[2] = max(start[2], 0.5 * step[2])
    loss = np.zeros(count, dtype=np.float32)
    add_losses(loss, echoes.points, echoes.loss, start, step)
    # mm to cm, there and back; half of the own cell.
    path = (0.2 * step[2]) * (np.cumsum(loss, axis=2) - 0.5 * loss)
    p, q = (np.linspace(0, n - 1, m) for n, m in zip(contact.shape, count[:2], strict=True))
    i, j = (np.minimum(v.astype(int), n - 2) for v, n in zip((p, q), contact.shape, strict=True))
    x, y = (p - i)[:, None], (q - j)[None]
    gain = (1 - x) * (1 - y) * contact[i][:, j] + (1 - x) * y * contact[i][:, j + 1]
    gain += x * (1 - y) * contact[i + 1][:, j] + x * y * contact[i + 1][:, j + 1]
    return Losses((path - gain[..., None]).astype(np.float32), start, step)


def render_window(
    grid: BeamGrid,
    echoes: Echoes,
    losses: Losses,
    window: tuple[int, int],
    rng: np.random.Generator,
) -> Float32Array:
    """Envelope of the signal in the azimuths of one beat ``(a, E, D)``, 1 being 0 dB.

    The ``window`` is the first azimuth and the one past the last, and ``rng`` draws the noise.
    """
    a = grid.acquisition
    az, el, along = grid.azimuth, grid.elevation, grid.distance
    first = window[0] - az.margin
    wide = window[1] - window[0] + 2 * az.margin
    shape = (wide, el.count + 2 * el.margin, 2, along.count + 2 * along.margin)
    corner = [x.start + n * x.step for x, n in ((az, first), (el, -el.margin))]
    start = np.array([*corner, along.start - along.margin * along.step])
    step = np.array([az.step, el.step, along.step])
    distance = start[2] + step[2] * np.arange(shape[3])
    # Complex Gaussian noise of mean power 1, scaled to blood and reverberations.
    signal = rng.standard_normal(shape, dtype=np.float32)
    signal *= np.float32(math.sqrt(0.5))
    gain_per_mm = (
        0.2 * a.frequency_mhz * (a.compensation_db_per_cm_mhz - a.blood_attenuation_db_per_cm_mhz)
    )
    blood = 10 ** ((a.blood_db + gain_per_mm * distance) / 20)
    haze = 10 ** (a.haze_db / 20) * np.exp(-np.maximum(distance - a.depth_mm[0], 0) / a.haze_mm)
    level = np.hypot(blood, haze) / np.prod([np.linalg.norm(x.kernel) for x in (az, el, along)])
    add_noise(signal, level, start, step, losses)
    energy = az.energy * el.energy * along.energy
    deposit(
        signal, echoes.points, echoes.amplitude / math.sqrt(energy), 2 * a.wave_number, gain_per_mm,
        start, step, losses,
    )  # fmt: skip
    signal = blur_across(signal, az.kernel, el.kernel)
    compensation = 0.2 * a.frequency_mhz * a.compensation_db_per_cm_mhz
    hiss = 10 ** ((a.electronics_db + compensation * (distance - along.start)) / 20)
    hiss /= math.sqrt(2) * np.linalg.norm(along.kernel)
    signal += hiss.astype(np.float32) * rng.standard_normal(signal.shape, dtype=np.float32)
    return np.asarray(envelope(signal, along.kernel))
