"""From envelopes along beams to grey levels in a Cartesian volume."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.beams import BeamGrid
from mvest.imaging.simulator.probe import Probe
from mvest.typing import FloatArray

Float32Array = NDArray[np.float32]


def compress(envelope: Float32Array, acquisition: Acquisition) -> Float32Array:
    """Grey levels of an envelope: ``255 (1 + (20 log10 envelope + gain) / range)`` in [0, 255]."""
    a = acquisition
    level = np.log10(np.maximum(envelope, np.float32(1e-20)))
    level *= np.float32(255 * 20 / a.dynamic_range_db)
    level += np.float32(255 * (1 + a.gain_db / a.dynamic_range_db))
    return np.clip(level, 0, 255, out=level)


def volume_frame(
    acquisition: Acquisition, probe: Probe
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Spacing (3,), direction (3, 3) and origin (3,) of the volume.

    Its axes are azimuth, elevation and beam; it is centred across the beam and begins where the
    nearest sample of the middle beam lies.
    """
    spacing = np.full(3, acquisition.voxel_mm)
    i, j, _ = acquisition.shape
    corner = [
        -0.5 * (i - 1) * acquisition.voxel_mm,
        -0.5 * (j - 1) * acquisition.voxel_mm,
        acquisition.depth_mm[0],
    ]
    return spacing, probe.axes, probe.apex + probe.axes @ np.array(corner)


def scan_convert(levels: Float32Array, grid: BeamGrid) -> NDArray[np.uint8]:
    """Grey levels ``(I, J, K)``, by linear interpolation; 0 outside the pyramid.

    Parameters
    ----------
    levels : (A, E, D) float32
        0 to 255.
    grid : BeamGrid
    """
    a = grid.acquisition
    i, j, k = a.shape
    x = (np.arange(i) - 0.5 * (i - 1)) * a.voxel_mm
    y = (np.arange(j) - 0.5 * (j - 1)) * a.voxel_mm
    z = np.arange(k, dtype=np.float64) * a.voxel_mm + a.depth_mm[0]
    half = math.radians(a.azimuth_deg) / 2, math.radians(a.elevation_span_deg) / 2
    across = (np.arctan(x[:, None] / z) + half[0]) / grid.azimuth.step
    up = (np.arctan(y[:, None] / z) + half[1]) / grid.elevation.step
    square = (x[:, None] ** 2)[:, :, None] + (y[:, None] ** 2).T[None]
    return np.asarray(
        _convert(levels, across, up, square[:, 0], z, a.depth_mm[0], grid.distance.step)
    )


@nb.njit(cache=True, fastmath=True)
def _convert(
    levels: Float32Array,
    across: FloatArray,
    up: FloatArray,
    square: FloatArray,
    z: FloatArray,
    nearest: float,
    step: float,
) -> NDArray[np.uint8]:
    n0, n1, n2 = levels.shape
    out = np.zeros((len(across), len(up), len(z)), dtype=np.uint8)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                a, e = across[i, k], up[j, k]
                if a < 0 or a > n0 - 1 or e < 0 or e > n1 - 1:
                    continue
                d = (np.sqrt(square[i, j] + z[k] * z[k]) - nearest) / step
                if d < 0 or d > n2 - 1:
                    continue
                p, q, r = min(int(a), n0 - 2), min(int(e), n1 - 2), min(int(d), n2 - 2)
                u, v, w = np.float32(a - p), np.float32(e - q), np.float32(d - r)
                one = np.float32(1.0)
                low = (one - v) * ((one - w) * levels[p, q, r] + w * levels[p, q, r + 1])
                low += v * ((one - w) * levels[p, q + 1, r] + w * levels[p, q + 1, r + 1])
                high = (one - v) * ((one - w) * levels[p + 1, q, r] + w * levels[p + 1, q, r + 1])
                high += v * ((one - w) * levels[p + 1, q + 1, r] + w * levels[p + 1, q + 1, r + 1])
                out[i, j, k] = np.uint8((one - u) * low + u * high + np.float32(0.5))
    return out
