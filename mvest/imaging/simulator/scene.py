"""Everything that sends echoes: the parts of the heart, and the scatterers sown into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.imaging.layout import ValveLayout
from mvest.imaging.moving_valve import MovingValve
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.chambers import Heart, make_heart
from mvest.imaging.simulator.probe import Probe
from mvest.imaging.simulator.tissue import Cord, Material, Part, Sheet
from mvest.typing import FloatArray

__all__ = ["Echoes", "Scene", "make_scene"]


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """The scatterers of one frame.

    Attributes
    ----------
    points : (n, 3) mm
        Along azimuth, elevation and beam from the apex.
    amplitude : (n,)
        So that, but for the size of the resolution cell, dense tissue of 0 dB has mean power 1.
    loss : (n,) dB mm^3 / cm
        One way attenuation beyond that of blood, times the volume that a scatterer stands for.
    """

    points: FloatArray
    amplitude: FloatArray
    loss: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Parts with their scatterers.

    Attributes
    ----------
    parts : tuple of Part
    seeds : tuple of (n, 3)
        Material coordinates in each part.
    strengths : tuple of (n,)
        Amplitude of each scatterer, but for the angle.
    losses : tuple of (n,)
    acquisition : Acquisition
    probe : Probe
    """

    parts: tuple[Part, ...]
    seeds: tuple[FloatArray, ...]
    strengths: tuple[FloatArray, ...]
    losses: tuple[FloatArray, ...]
    acquisition: Acquisition
    probe: Probe

    def echoes(self, frame: int) -> Echoes:
        """The scatterers where they are in one frame."""
        apex = self.probe.apex_in_valve
        floor = 10 ** (self.acquisition.angle_floor_db / 20)
        points, amplitudes = [], []
        for part, seeds, strength in zip(self.parts, self.seeds, self.strengths, strict=True):
            place, facing = part.place(frame, seeds, apex)
            points.append(self.probe.to_probe(place))
            if part.material.specular:
                seen = floor + (1 - floor) * facing**self.acquisition.angle_exponent
                amplitudes.append(strength * seen)
            else:
                amplitudes.append(strength)
        return Echoes(
            np.concatenate(points), np.concatenate(amplitudes), np.concatenate(self.losses)
        )


def cell_volume(acquisition: Acquisition, distance_mm: float) -> float:
    """Resolution cell in mm^3 at a depth: product of the three full widths at half maximum."""
    a, e = np.deg2rad([acquisition.lateral_deg, acquisition.elevation_deg])
    return float(acquisition.axial_mm * a * e * distance_mm**2)


def make_scene(
    valve: MovingValve, acquisition: Acquisition, probe: Probe, rng: np.random.Generator
) -> Scene:
    """The heart around a valve with scatterers.

    Their number gives each resolution cell at the valve as many as the acquisition says; the number
    in thin tissue is a multiple, and all are at least 8 per part.
    """
    heart = make_heart(valve, probe.apex_in_valve, rng)
    parts = _parts(valve, heart, acquisition, rng)
    distance = float(np.linalg.norm(probe.apex_in_valve))
    density = acquisition.scatterers_per_cell / cell_volume(acquisition, distance)
    seeds, strengths, losses = [], [], []
    for part in parts:
        count = max(8, round(density * part.material.fineness * part.volume))
        own = part.sow(rng, count)
        share = part.volume / count
        loss = acquisition.frequency_mhz * max(
            acquisition.attenuation_db_per_cm_mhz - acquisition.blood_attenuation_db_per_cm_mhz,
            0.0,
        ) + acquisition.shadow_db_per_cm * part.density_of_shadow(own)
        seeds.append(own)
        level = 10 ** (part.material.echo_db / 20) * np.sqrt(share)
        strengths.append(level * part.strength(own))
        losses.append(share * loss)
    return Scene(tuple(parts), tuple(seeds), tuple(strengths), tuple(losses), acquisition, probe)


def _parts(
    valve: MovingValve, heart: Heart, acquisition: Acquisition, rng: np.random.Generator
) -> list[Part]:
    layout = valve.layout
    grid = (layout.rows, layout.columns)
    frames = len(valve.times)
    leaflets = valve.vertices.reshape(frames, *grid, 3)
    a = acquisition
    wall = Material("wall", a.wall_db)
    vessel = Material("vessel", a.vessel_db)
    muscle = Material("papillary", a.papillary_db, specular=False)
    chord = Material("chord", a.chord_db, fineness=6.0)
    columns = layout.columns
    parts: list[Part] = [
        Sheet(
            Material("leaflet", a.leaflet_db, fineness=4.0),
            leaflets,
            valve.thickness.reshape(grid),
            (-0.5, 0.5),
            _dropouts(layout, acquisition, rng),
        ),
        Cord(
            Material("annulus", a.annulus_db, specular=False, fineness=2.0),
            leaflets[:, 0],
            np.full(columns, rng.uniform(1.3, 2.0)),
            True,
            _dense(columns, rng),
        ),
        Sheet(
            wall,
            heart.ventricle,
            heart.ventricle_thickness,
            (0.0, 1.0),
            np.ones(heart.ventricle_thickness.shape),
        ),
        Sheet(
            vessel,
            heart.atrium,
            heart.atrium_thickness,
            (-1.0, 0.0),
            np.ones(heart.atrium_thickness.shape),
        ),
        Sheet(
            vessel,
            heart.aorta,
            heart.aorta_thickness,
            (-0.5, 0.5),
            np.ones(heart.aorta_thickness.shape),
        ),
    ]
    foot = heart.muscle_radius
    parts += [Cord(muscle, line, foot, False, np.zeros(len(foot))) for line in heart.muscles]
    for phi, s, tip in zip(valve.chord_phi, valve.chord_s, valve.chord_tip, strict=True):
        line = _chord(valve, leaflets, float(phi), float(s), int(tip))
        parts.append(Cord(chord, line, np.full(2, rng.uniform(0.35, 0.6)), False, np.zeros(2)))
    return parts


def _chord(valve: MovingValve, leaflets: FloatArray, phi: float, s: float, tip: int) -> FloatArray:
    """From a papillary tip to the insertion ``(T, 2, 3)``."""
    rows, columns = leaflets.shape[1:3]
    c, r = phi / 360.0 * columns, s * (rows - 1)
    i, j = int(np.floor(c)), min(int(r), rows - 2)
    x, y = c - i, r - j
    k, l = i % columns, (i + 1) % columns
    end = (1 - y) * ((1 - x) * leaflets[:, j, k] + x * leaflets[:, j, l])
    end += y * ((1 - x) * leaflets[:, j + 1, k] + x * leaflets[:, j + 1, l])
    return np.stack([valve.tips[:, tip], end], axis=1)


def _dense(columns: int, rng: np.random.Generator) -> FloatArray:
    """Share of dense tissue along the annulus ``(columns,)``: a few smooth patches."""
    phi = 2 * np.pi * np.arange(columns) / columns
    total = np.zeros(columns)
    for _ in range(rng.integers(1, 4)):
        total += np.exp(4 * (np.cos(phi - rng.uniform(0, 2 * np.pi)) - 1)) * rng.uniform(0.3, 1.0)
    return np.minimum(total, 1.0)


def _dropouts(
    layout: ValveLayout, acquisition: Acquisition, rng: np.random.Generator
) -> FloatArray:
    """Amplitude factor ``(rows, columns)`` of the leaflets, low in smooth patches."""
    rows, columns = layout.rows, layout.columns
    if acquisition.dropout == 0:
        return np.ones((rows, columns))
    phi = 2 * np.pi * np.arange(columns) / columns
    s = np.linspace(0, 1, rows)[:, None]
    field = np.zeros((rows, columns))
    for m in range(1, 9):
        for n in range(4):
            a, b = rng.standard_normal(2) / np.hypot(m / 4, n + 0.5)
            field += np.cos(np.pi * n * s) * (a * np.cos(m * phi) + b * np.sin(m * phi))
    edge = np.quantile(field, 1 - acquisition.dropout)
    depth = 1 / (1 + np.exp(-(field - edge) / (0.08 * field.std())))
    return np.asarray(10 ** (acquisition.dropout_db / 20 * depth))
