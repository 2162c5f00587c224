"""Everything that sends echoes: the parts of the heart, and the scatterers sown into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.imaging.moving_valve import MovingValve
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.chambers import make_heart
from mvest.imaging.simulator.parts import make_parts
from mvest.imaging.simulator.probe import Probe
from mvest.imaging.simulator.scatterers import TissuePart
from mvest.typing import FloatArray


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
    parts : tuple of TissuePart
    seeds : tuple of (n, 3)
        Material coordinates in each part.
    strengths : tuple of (n,)
        Amplitude of each scatterer, but for the angle.
    losses : tuple of (n,)
    acquisition : Acquisition
    probe : Probe
    """

    parts: tuple[TissuePart, ...]
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
    parts = make_parts(valve, heart, acquisition, rng)
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
