"""Where the valve lies as seen from the transoesophageal probe."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Pose of the valve as seen from the probe, which scans from the world's origin along z.

    The axes of the world (LPS, mm) are azimuth, in which beats are stitched, elevation and beam.

    Attributes
    ----------
    rotation : (3, 3)
        Its columns are the x, y and z axes of the valve in the world; a proper rotation.
    translation : (3,) mm
        World position of the valve's origin.

    Raises
    ------
    InputError
        If the rotation is none, or a position is not finite.
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        orthonormal = np.allclose(self.rotation.T @ self.rotation, np.eye(3), atol=1e-6)
        if not (orthonormal and np.linalg.det(self.rotation) > 0):
            raise InputError(
                f"probe rotation: determinant {np.linalg.det(self.rotation):.3g}, expected "
                "orthonormal columns with determinant 1"
            )
        if not np.isfinite(self.translation).all():
            raise InputError(f"probe translation: {self.translation}, expected finite coordinates")

    def to_world(self, points: FloatArray) -> FloatArray:
        """Positions ``(..., 3)`` mm along azimuth, elevation and beam of points in valve axes."""
        return np.asarray(points @ self.rotation.T + self.translation)

    @property
    def apex_in_valve(self) -> FloatArray:
        """``(3,)`` mm, the apex of the pyramid in the valve's axes."""
        return np.asarray(-self.translation @ self.rotation)


RADIUS_MM = 20.0
"""mm, of the ball around the valve that lies in the pyramid."""


def draw_probe(
    rng: np.random.Generator,
    acquisition: Acquisition | None = None,
    *,
    distance_mm: tuple[float, float] = (35.0, 75.0),
    tilt_deg: tuple[float, float] = (0.0, 55.0),
) -> Probe:
    """A probe behind the atrium.

    Distance and tilt are uniform within their ranges, the roll and the direction of the tilt over
    the full circle; the valve's direction is uniform over those in which a ball around the valve
    lies in the pyramid (straight ahead, if it fits nowhere). The ranges are a choice.

    Parameters
    ----------
    rng : numpy Generator
    acquisition : Acquisition, optional
        Whose pyramid holds the valve; the default one if none is given.
    distance_mm : (float, float)
        From the apex to the valve's origin.
    tilt_deg : (float, float)
        Between the valve's axis and the line of sight to the probe.

    Raises
    ------
    InputError
        If a range is not one, or a distance is less than `RADIUS_MM`.
    """
    acquisition = acquisition or Acquisition()
    for name, (low, high) in (("distance_mm", distance_mm), ("tilt_deg", tilt_deg)):
        if not 0 <= low <= high < math.inf:
            raise InputError(f"probe {name}: {low:g} to {high:g}, expected 0 <= low <= high")
    if tilt_deg[1] > 90 or distance_mm[0] <= RADIUS_MM:
        raise InputError(
            f"probe: tilt to {tilt_deg[1]:g} degrees and distance from {distance_mm[0]:g} mm, "
            f"expected 90 at most, and more than {RADIUS_MM:g}"
        )
    distance = rng.uniform(*distance_mm)
    ball = math.degrees(math.asin(RADIUS_MM / distance))
    free = [
        math.radians(max(0.5 * span - ball, 0.0))
        for span in (acquisition.azimuth_deg, acquisition.elevation_span_deg)
    ]
    a, e = (rng.uniform(-f, f) for f in free)
    sight = np.array([math.tan(a), math.tan(e), 1.0])
    sight /= np.linalg.norm(sight)
    tilt, towards, roll = (
        math.radians(rng.uniform(*tilt_deg)),
        rng.uniform(0, 2 * math.pi),
        rng.uniform(0, 2 * math.pi),
    )
    # An orthonormal triad with the line of sight, and the valve's axis tilted away from it.
    u = np.cross(sight, [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(sight, u)
    z = -math.cos(tilt) * sight + math.sin(tilt) * (math.cos(towards) * u + math.sin(towards) * v)
    x = np.cross(u if abs(u @ z) < 0.9 else v, z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    x, y = math.cos(roll) * x + math.sin(roll) * y, math.cos(roll) * y - math.sin(roll) * x
    return Probe(np.stack([x, y, z], axis=1), distance * sight)
