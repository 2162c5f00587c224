"""Settings of the simulated scanner, the pose of the probe, and how both are drawn.

Levels in dB are of amplitude, relative to the root mean square of fully developed speckle of an
echo strength of 0 dB, seen face on and without attenuation.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal, TypeAlias, get_args

import numpy as np

from mvest.errors import InputError, require_numbers
from mvest.quantities import (
    Angle,
    AxisCount,
    Count,
    Decibel,
    Factor,
    Frequency,
    Length,
    Share,
    Weight,
)
from mvest.typing import FloatArray

SPEED_OF_SOUND = 1540.0
"""m/s, mean of soft tissue that scanners assume (Szabo, Diagnostic Ultrasound Imaging, 2014)."""

LARGEST = 1000.0
"""Largest size of any setting, in its unit."""

BOUNDS = {
    **dict.fromkeys(
        ("attenuation_db_per_cm_mhz", "blood_attenuation_db_per_cm_mhz", "shadow_db_per_cm",
         "compensation_db_per_cm_mhz", "angle_exponent", "contact_db", "beat_shift_mm",
         "beat_turn_deg"), (0.0, LARGEST),
    ),
    **dict.fromkeys(("side_lobe_db", "angle_floor_db", "dropout_db"), (-LARGEST, 0.0)),
    **dict.fromkeys(("azimuth_deg", "elevation_span_deg"), (10.0, 120.0)),
    "dropout": (0.0, 0.6),
    "beats": (1.0, 12.0),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Acquisition:
    """One setting of the simulated scanner. A value without a source is a choice.

    Echo strengths are those of wall, leaflet, annulus, chordae, papillary muscles and vessels.
    Noise comes from blood (blurred as tissue is), the electronics (level at the nearest depth) and
    reverberations close to the probe (haze). InputError if a setting is not finite or out of range.
    """

    frequency_mhz: Frequency = 5.0  #: centre of the band; TEE matrix probes work at 3 to 8 MHz
    axial_mm: Length = 0.9  #: full width at half maximum of a point's image along the beam
    lateral_deg: Angle = 1.9  #: the same across it, in degrees, so that it grows with depth
    elevation_deg: Angle = 2.4
    side_lobe_db: Decibel = -28.0  #: first side lobes of the beam, below its main lobe
    azimuth_deg: Angle = 84.0  #: full opening of the pyramid
    elevation_span_deg: Angle = 76.0
    depth_mm: tuple[Length, Length] = (4.0, 116.0)  #: nearest and farthest sample from the apex
    dynamic_range_db: Decibel = 50.0  #: grey levels 0 to 255 show -range - gain to -gain
    gain_db: Decibel = 0.0
    attenuation_db_per_cm_mhz: Decibel = 0.5  #: one way, of tissue (Duck, Physical Properties of
    #: Tissue, 1990)
    blood_attenuation_db_per_cm_mhz: Decibel = 0.15  #: one way (Duck 1990: 0.15 to 0.2)
    compensation_db_per_cm_mhz: Decibel = 0.17  #: one way; it also amplifies electronic noise
    shadow_db_per_cm: Decibel = 20.0  #: one way, added in dense tissue (parts of the annulus)
    #: walls and leaflets send ``floor + (1 - floor) |n . beam|^exponent``
    angle_exponent: Factor = 1.5
    angle_floor_db: Decibel = -22.0
    dropout: Share = 0.1  #: share of the leaflets in patches with hardly any echo, 0 to 0.6
    dropout_db: Decibel = -20.0  #: level of that echo relative to the leaflets' own
    blood_db: Decibel = -49.0
    electronics_db: Decibel = -63.0
    haze_db: Decibel = -22.0
    haze_mm: Length = 7.0  #: distance over which reverberations fade by a factor e
    contact_db: Decibel = 2.0  #: standard deviation of the smooth variation of gain by direction
    wall_db: Decibel = -17.0
    leaflet_db: Decibel = -3.0
    annulus_db: Decibel = -3.0
    chord_db: Decibel = -9.0
    papillary_db: Decibel = -18.0
    vessel_db: Decibel = -10.0
    beats: Count = 4  #: sub-sectors in azimuth, one per heart beat, of the stitched volume
    beat_shift_mm: Length = 0.4  #: standard deviation of each component of a beat's displacement
    beat_turn_deg: Angle = 0.5  #: the same of its turn
    scatterers_per_cell: Weight = 10.0  #: in a resolution cell at the valve; >= 10 give fully
    #: developed speckle (Wagner et al., IEEE Trans. Sonics Ultrason. 30, 1983)
    voxel_mm: Length = 0.7  #: edge of the cubic voxels
    shape: tuple[AxisCount, AxisCount, AxisCount] = (160, 128, 160)  #: azimuth, elevation, depth

    def __post_init__(self) -> None:
        require_numbers(
            self, "acquisition", "frequency_mhz", "axial_mm", "dynamic_range_db",
            "scatterers_per_cell", "voxel_mm", "haze_mm",
        )  # fmt: skip
        if len(self.depth_mm) != 2 or not 0 < self.depth_mm[0] < self.depth_mm[1] < math.inf:
            self._refuse("depth_mm", "two increasing distances > 0")
        if len(self.shape) != 3 or min(self.shape) < 8:
            self._refuse("shape", "three numbers of voxels >= 8")
        bounds = {
            **BOUNDS,
            "lateral_deg": (0.2, self.azimuth_deg / 4),
            "elevation_deg": (0.2, self.elevation_span_deg / 4),
            "axial_mm": (0.0, (self.depth_mm[1] - self.depth_mm[0]) / 4),
        }
        for name in (f.name for f in fields(self) if f.name not in ("depth_mm", "shape")):
            low, high = bounds.get(name, (-LARGEST, LARGEST))
            if not low <= getattr(self, name) <= high:
                self._refuse(name, f"{low:g} to {high:g}")

    def _refuse(self, name: str, expected: str) -> None:
        raise InputError(f"acquisition {name} = {getattr(self, name)}, expected {expected}")

    @property
    def wave_number(self) -> float:
        """2 pi over the wavelength, rad/mm."""
        return 2e3 * math.pi * self.frequency_mhz / SPEED_OF_SOUND


Setting: TypeAlias = Literal["training", "wide", "shifted"]
"""Ranges from which an acquisition is drawn (`RANGES`)."""

Interval: TypeAlias = tuple[float, float]

RANGES: dict[str, tuple[Literal["times", "plus"], Interval, tuple[Interval, ...]]] = {
    "frequency_mhz": ("times", (0.8, 1.2), ((0.65, 0.75), (1.25, 1.4))),
    "axial_mm": ("times", (0.75, 1.3), ((1.35, 1.6),)),
    "lateral_deg": ("times", (0.75, 1.3), ((1.35, 1.6),)),
    "elevation_deg": ("times", (0.75, 1.3), ((1.35, 1.6),)),
    "side_lobe_db": ("plus", (-5.0, 4.0), ((4.5, 7.0),)),
    "dynamic_range_db": ("plus", (-6.0, 8.0), ((-10.0, -7.0), (9.0, 13.0))),
    "gain_db": ("plus", (-5.0, 5.0), ((-7.0, -5.5), (5.5, 7.0))),
    "attenuation_db_per_cm_mhz": ("times", (0.7, 1.3), ((1.35, 1.6),)),
    "compensation_db_per_cm_mhz": ("plus", (-0.05, 0.05), ((-0.05, 0.05),)),
    "shadow_db_per_cm": ("times", (0.0, 1.5), ((1.6, 2.2),)),
    "angle_exponent": ("times", (0.6, 1.4), ((0.4, 0.55), (1.45, 1.7))),
    "angle_floor_db": ("plus", (-5.0, 4.0), ((-7.0, -5.5), (4.5, 7.0))),
    "dropout": ("plus", (-0.08, 0.08), ((0.09, 0.16),)),
    "blood_db": ("plus", (-5.0, 5.0), ((5.5, 8.0),)),
    "electronics_db": ("plus", (-5.0, 5.0), ((5.5, 9.0),)),
    "haze_db": ("plus", (-10.0, 5.0), ((5.5, 8.0),)),
    "contact_db": ("times", (0.3, 1.5), ((1.6, 1.9),)),
    "wall_db": ("plus", (-4.0, 4.0), ((-6.0, 6.0),)),
    "leaflet_db": ("plus", (-4.0, 3.0), ((-6.0, -4.2),)),
    "annulus_db": ("plus", (-4.0, 3.0), ((-6.0, -4.2),)),
    "chord_db": ("plus", (-5.0, 5.0), ((-5.0, 5.0),)),
    "papillary_db": ("plus", (-4.0, 4.0), ((-4.0, 4.0),)),
    "vessel_db": ("plus", (-4.0, 4.0), ((-4.0, 4.0),)),
    "beat_shift_mm": ("times", (0.0, 1.5), ((1.6, 2.5),)),
    "beat_turn_deg": ("times", (0.0, 1.5), ((1.6, 2.5),)),
}
"""Variation of each setting about the base: whether the draw multiplies it or is added to it, its
interval in training, and the shifted ones.

Apart from echo strengths and compensation, shifted ranges are disjoint from those of training, and
mostly on the worse side. The widths are a choice.
"""


def draw_acquisition(
    rng: np.random.Generator, base: Acquisition | None = None, spread: str = "training"
) -> Acquisition:
    """An acquisition drawn about a base, each setting independently.

    The ``spread`` is "training", "shifted", or "wide": each setting from one of all its `RANGES`.
    InputError if it is none of these, or a drawn value is out of range.
    """
    base = base or Acquisition()
    if spread not in (known := get_args(Setting)):
        raise InputError(f"spread {spread!r}, expected one of {', '.join(known)}")
    drawn: dict[str, float] = {}
    for name, (how, within, outside) in RANGES.items():
        wide = tuple(dict.fromkeys((within, *outside)))
        intervals = {"training": (within,), "wide": wide, "shifted": outside}[spread]
        low, high = intervals[int(rng.integers(len(intervals)))]
        value, before = float(rng.uniform(low, high)), float(getattr(base, name))
        drawn[name] = before * value if how == "times" else before + value
    return replace(base, **drawn)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Pose of the valve relative to the probe, which scans from the world's origin along z.

    The axes of the world (LPS, mm) are azimuth, in which beats are stitched, elevation and beam.
    """

    rotation: FloatArray  #: (3, 3), its columns are the valve's axes in the world; proper
    translation: FloatArray  #: (3,) mm, world position of the valve's origin

    def to_world(self, points: FloatArray) -> FloatArray:
        """Positions ``(..., 3)`` mm along azimuth, elevation and beam of points in valve axes."""
        return np.asarray(points @ self.rotation.T + self.translation)

    @property
    def apex_in_valve(self) -> FloatArray:
        """Apex of the pyramid ``(3,)`` mm in the valve's axes."""
        return np.asarray(-self.translation @ self.rotation)


RADIUS_MM = 20.0
"""mm, radius of the ball around the valve that is in the pyramid."""


def draw_probe(
    rng: np.random.Generator,
    acquisition: Acquisition | None = None,
    *,
    distance_mm: tuple[float, float] = (35.0, 75.0),
    tilt_deg: tuple[float, float] = (0.0, 55.0),
) -> Probe:
    """A probe behind the atrium.

    Distance and tilt are uniform within their ranges, the roll and the direction of the tilt over
    the full circle. The valve's direction is uniform over those in which a ball around the valve
    is in the pyramid of the acquisition (straight ahead, if it fits nowhere). The ranges are a
    choice.

    Parameters
    ----------
    rng : numpy Generator
    acquisition : Acquisition, optional
    distance_mm : (float, float)
        From the apex to the valve's origin, more than `RADIUS_MM`.
    tilt_deg : (float, float)
        Between the valve's axis and the line of sight to the probe, at most 90.
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
