"""A simulated transoesophageal echo volume over time, and the true valve in it.

Envelopes along beams become grey levels in a Cartesian volume.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import Acquisition, Probe
from mvest.imaging.simulator.beams import BeamGrid, Float32Array, losses_of, render_window
from mvest.imaging.simulator.scene import make_scene, scene_echoes
from mvest.imaging.valve_sequence import MovingValve, ValveSequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray


def compress(envelope: Float32Array, acquisition: Acquisition) -> Float32Array:
    """Grey levels of an envelope: ``255 (1 + (20 log10 envelope + gain) / range)`` in [0, 255]."""
    a = acquisition
    level = np.log10(np.maximum(envelope, np.float32(1e-20)))
    level *= np.float32(255 * 20 / a.dynamic_range_db)
    level += np.float32(255 * (1 + a.gain_db / a.dynamic_range_db))
    return np.clip(level, 0, 255, out=level)


def volume_origin(acquisition: Acquisition) -> FloatArray:
    """``(3,)`` mm: the volume is centred across the beam and starts at the nearest depth."""
    i, j, _ = acquisition.shape
    across = (-0.5 * (i - 1) * acquisition.voxel_mm, -0.5 * (j - 1) * acquisition.voxel_mm)
    return np.array([*across, acquisition.depth_mm[0]])


def scan_convert(levels: Float32Array, grid: BeamGrid) -> NDArray[np.uint8]:
    """Voxels ``(I, J, K)`` from levels ``(A, E, D)``, linear between them; 0 outside."""
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


def simulate_volume(
    valve: MovingValve,
    acquisition: Acquisition,
    probe: Probe,
    seed: int,
    *,
    frames: Sequence[int] | None = None,
) -> VolumeSequence:
    """A simulated volume ``(T, I, J, K)`` uint8 of a valve and the heart around it.

    The seed determines the heart, the scatterers, the stitching and the noise of each frame,
    whichever ``frames`` (increasing; default: all) are simulated. InputError if the seed is
    negative, the valve is behind the probe, or a frame does not exist.
    """
    chosen = _chosen(valve, frames)
    if seed < 0:
        raise InputError(f"simulated volume, seed = {seed}, expected >= 0")
    about = probe.to_world(np.zeros(3))
    if about[2] <= acquisition.depth_mm[0]:
        raise InputError(
            f"simulated volume, probe: the valve lies {about[2]:.1f} mm along the beam, "
            f"expected more than the nearest depth {acquisition.depth_mm[0]:g} mm"
        )
    rng = np.random.default_rng([seed, 0])
    scene = make_scene(valve, acquisition, probe, rng)
    grid = BeamGrid.of(acquisition)
    beats = _displacements(acquisition, rng)
    contact = acquisition.contact_db * rng.standard_normal((7, 7))
    out = np.empty((len(chosen), *acquisition.shape), dtype=np.uint8)
    envelope = np.empty(grid.shape, dtype=np.float32)
    for k, frame in enumerate(chosen):
        noise = np.random.default_rng([seed, 1, frame])
        echoes = scene_echoes(scene, frame, acquisition, probe)
        losses = losses_of(grid, echoes, contact)
        for window, turn, shift in zip(grid.windows(), *beats, strict=True):
            points = (echoes.points - about) @ turn.T + (about + shift)
            moved = replace(echoes, points=points)
            envelope[window[0] : window[1]] = render_window(grid, moved, losses, window, noise)
        out[k] = scan_convert(compress(envelope, acquisition), grid)
    return VolumeSequence(
        out,
        np.full(3, acquisition.voxel_mm),
        np.eye(3),
        volume_origin(acquisition),
        np.asarray(valve.times[chosen]),
        Modality.ULTRASOUND,
        f"simulated: {valve.name}, seed {seed}",
        hashlib.sha256(np.ascontiguousarray(out).data).hexdigest(),
    )


def true_sequence(
    valve: MovingValve, probe: Probe, frames: Sequence[int] | None = None
) -> ValveSequence:
    """The true valve in the world, in the frames of :func:`simulate_volume`, without errors."""
    chosen = _chosen(valve, frames)
    n = valve.layout.size
    return ValveSequence(
        valve.layout,
        np.asarray(valve.times[chosen]),
        probe.to_world(valve.vertices[chosen]),
        probe.to_world(valve.tips[chosen]),
        np.ones(len(chosen)),
        np.ones((len(chosen), n)),
        np.zeros(n),
        0.0,
    )


def _chosen(valve: MovingValve, frames: Sequence[int] | None) -> list[int]:
    count = len(valve.times)
    chosen = list(range(count)) if frames is None else [int(k) for k in frames]
    if not chosen or min(chosen) < 0 or max(chosen) >= count or np.any(np.diff(chosen) <= 0):
        raise InputError(
            f"frames {chosen} of valve {valve.name}, expected increasing ones of 0 to {count - 1}"
        )
    return chosen


def _displacements(
    acquisition: Acquisition, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Turns ``(B, 3, 3)`` about the valve and shifts ``(B, 3)`` of the scene in each beat.

    The mean shift is zero: the truth is the mean of the beats.
    """
    turn = Rotation.from_rotvec(
        np.deg2rad(acquisition.beat_turn_deg) * rng.standard_normal((acquisition.beats, 3))
    ).as_matrix()
    shift = acquisition.beat_shift_mm * rng.standard_normal((acquisition.beats, 3))
    return turn if acquisition.beats > 1 else np.eye(3)[None], shift - shift.mean(axis=0)
