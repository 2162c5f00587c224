"""A simulated transoesophageal echo volume over time, and the truth in it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.moving_valve import MovingValve
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.beams import BeamGrid, Losses, render_window
from mvest.imaging.simulator.probe import Probe
from mvest.imaging.simulator.scan import compress, scan_convert, volume_frame
from mvest.imaging.simulator.scene import Echoes, make_scene
from mvest.imaging.valve_sequence import ValveSequence
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.typing import FloatArray


def simulate_volume(
    valve: MovingValve,
    acquisition: Acquisition,
    probe: Probe,
    seed: int,
    *,
    frames: Sequence[int] | None = None,
) -> VolumeSequence:
    """A simulated volume ``(T, I, J, K)`` uint8 of a valve and the heart around it.

    The same seed gives the same volume, and each frame of it whichever others are asked for.

    Parameters
    ----------
    valve : MovingValve
    acquisition : Acquisition
    probe : Probe
    seed : int
        Of the heart around the valve, the scatterers, the stitching and the noise.
    frames : sequence of int, optional
        Which frames of the valve, increasing; all if not given.

    Raises
    ------
    InputError
        If the seed is negative, the valve lies behind the probe, or a frame does not exist.
    """
    chosen = _chosen(valve, frames)
    if seed < 0:
        raise InputError(f"simulated volume, seed = {seed}, expected >= 0")
    depth = probe.to_probe(np.zeros(3))[2]
    if depth <= acquisition.depth_mm[0]:
        raise InputError(
            f"simulated volume, probe: the valve lies {depth:.1f} mm along the beam, "
            f"expected more than the nearest depth {acquisition.depth_mm[0]:g} mm"
        )
    rng = np.random.default_rng([seed, 0])
    scene = make_scene(valve, acquisition, probe, rng)
    grid = BeamGrid.of(acquisition)
    beats = _displacements(acquisition, probe, rng)
    contact = _contact(acquisition, rng)
    out = np.empty((len(chosen), *acquisition.shape), dtype=np.uint8)
    envelope = np.empty(grid.shape, dtype=np.float32)
    for k, frame in enumerate(chosen):
        noise = np.random.default_rng([seed, 1, frame])
        echoes = scene.echoes(frame)
        losses = Losses.of(grid, echoes, contact)
        for window, (turn, about, shift) in zip(grid.windows(), beats, strict=True):
            points = (echoes.points - about) @ turn.T + (about + shift)
            moved = Echoes(points, echoes.amplitude, echoes.loss)
            envelope[window[0] : window[1]] = render_window(grid, moved, losses, window, noise)
        out[k] = scan_convert(compress(envelope, acquisition), grid)
    spacing, direction, origin = volume_frame(acquisition, probe)
    return VolumeSequence(
        out,
        spacing,
        direction,
        origin,
        np.asarray(valve.times[chosen]),
        Modality.ULTRASOUND,
        f"simulated: {valve.name}, seed {seed}",
        hashlib.sha256(np.ascontiguousarray(out).data).hexdigest(),
    )


def true_sequence(
    valve: MovingValve, probe: Probe, frames: Sequence[int] | None = None
) -> ValveSequence:
    """Where the valve is in the world, in frames as of :func:`simulate_volume`; nothing unsure."""
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
    acquisition: Acquisition, probe: Probe, rng: np.random.Generator
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Turn (3, 3), centre (3,) and shift (3,) of the scene in each beat, in the probe's axes.

    The mean shift is zero: the truth is the mean of the beats.
    """
    about = probe.to_probe(np.zeros(3))
    turn = Rotation.from_rotvec(
        np.deg2rad(acquisition.beat_turn_deg) * rng.standard_normal((acquisition.beats, 3))
    ).as_matrix()
    shift = acquisition.beat_shift_mm * rng.standard_normal((acquisition.beats, 3))
    shift -= shift.mean(axis=0)
    if acquisition.beats == 1:
        turn = np.eye(3)[None]
    return [(turn[b], about, shift[b]) for b in range(acquisition.beats)]


def _contact(acquisition: Acquisition, rng: np.random.Generator) -> FloatArray:
    """Gain ``(7, 7)`` dB over the pyramid."""
    return np.asarray(acquisition.contact_db * rng.standard_normal((7, 7)))
