"""How a simulated echo volume is acquired: every setting of the rendering, with its unit and range.

Levels in dB are of amplitude, relative to the root mean square of fully developed speckle of an
echo strength of 0 dB, seen face on and without attenuation.

Acquisitions are drawn from the ranges that detectors are trained in, or from ranges outside of
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal, TypeAlias

import numpy as np

from mvest.errors import InputError
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

SPEED_OF_SOUND = 1540.0
"""m/s, mean of soft tissue that scanners assume (Szabo, Diagnostic Ultrasound Imaging, 2014)."""


@dataclass(frozen=True, slots=True)
class Acquisition:
    """One setting of the simulated scanner. Where no source is named, a value is a choice.

    Attributes
    ----------
    frequency_mhz : float
        Centre of the band; transoesophageal matrix probes work at 3 to 8 MHz.
    axial_mm, lateral_deg, elevation_deg : float
        Full width at half maximum of the amplitude of a point's image: along, and in the two
        directions across the beam (these in degrees, so that they grow with depth).
    side_lobe_db : float
        First side lobes of the beam under its main lobe.
    azimuth_deg, elevation_span_deg : float
        Full opening of the pyramid.
    depth_mm : (float, float)
        Distance from the apex of the nearest and the farthest sample.
    dynamic_range_db, gain_db : float
        Grey levels 0 to 255 show ``-dynamic_range_db - gain_db`` to ``-gain_db``.
    attenuation_db_per_cm_mhz, blood_attenuation_db_per_cm_mhz : float
        One way, of tissue (0.5) and blood (0.15 to 0.2) (Duck, Physical Properties of Tissue,
        1990).
    compensation_db_per_cm_mhz : float
        One way, what the time gain compensation makes good; it also amplifies electronic noise.
    shadow_db_per_cm : float
        One way, added in dense tissue (parts of the annulus), so that it casts shadows.
    angle_exponent, angle_floor_db : float
        Walls and leaflets send the share ``floor + (1 - floor) |n . beam|^exponent`` of their echo.
    dropout : float
        Share of the leaflets in patches that send hardly any echo, 0 to 0.6.
    dropout_db : float
        Echo within such patches, under the leaflets' own.
    blood_db, electronics_db, haze_db : float
        Noise: of blood (blurred as tissue is), of the electronics (at the nearest depth), and of
        reverberations close to the probe.
    haze_mm : float
        Over which reverberations fade by a factor e.
    contact_db : float
        Standard deviation of the smooth variation of gain between directions.
    wall_db, leaflet_db, annulus_db, chord_db, papillary_db, vessel_db : float
        Echo strengths.
    beats : int
        Sub-sectors in azimuth, one per heart beat, from which the volume is stitched.
    beat_shift_mm, beat_turn_deg : float
        Standard deviation of each component by which the scene is displaced and turned in a beat.
    scatterers_per_cell : float
        In a resolution cell at the depth of the valve; at least 10 give fully developed speckle
        (Wagner et al., IEEE Trans. Sonics Ultrason. 30, 1983).
    voxel_mm : float
        Edge of the cubic voxels.
    shape : (int, int, int)
        Voxels along azimuth, elevation and depth.

    Raises
    ------
    InputError
        If a setting is not finite or has no meaning.
    """

    frequency_mhz: Frequency = 5.0
    axial_mm: Length = 0.9
    lateral_deg: Angle = 1.9
    elevation_deg: Angle = 2.4
    side_lobe_db: Decibel = -28.0
    azimuth_deg: Angle = 84.0
    elevation_span_deg: Angle = 76.0
    depth_mm: tuple[Length, Length] = (4.0, 116.0)
    dynamic_range_db: Decibel = 50.0
    gain_db: Decibel = 0.0
    attenuation_db_per_cm_mhz: Decibel = 0.5
    blood_attenuation_db_per_cm_mhz: Decibel = 0.15
    compensation_db_per_cm_mhz: Decibel = 0.17
    shadow_db_per_cm: Decibel = 20.0
    angle_exponent: Factor = 1.5
    angle_floor_db: Decibel = -22.0
    dropout: Share = 0.1
    dropout_db: Decibel = -20.0
    blood_db: Decibel = -49.0
    electronics_db: Decibel = -63.0
    haze_db: Decibel = -22.0
    haze_mm: Length = 7.0
    contact_db: Decibel = 2.0
    wall_db: Decibel = -17.0
    leaflet_db: Decibel = -3.0
    annulus_db: Decibel = -3.0
    chord_db: Decibel = -9.0
    papillary_db: Decibel = -18.0
    vessel_db: Decibel = -10.0
    beats: Count = 4
    beat_shift_mm: Length = 0.4
    beat_turn_deg: Angle = 0.5
    scatterers_per_cell: Weight = 10.0
    voxel_mm: Length = 0.7
    shape: tuple[AxisCount, AxisCount, AxisCount] = (160, 128, 160)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            for number in value if isinstance(value, tuple) else (value,):
                if not math.isfinite(number):
                    self._refuse(field.name, "a finite number")
        for name in (
            "frequency_mhz", "axial_mm", "dynamic_range_db", "scatterers_per_cell", "voxel_mm",
            "haze_mm",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                self._refuse(name, "> 0")
        for name in (
            "attenuation_db_per_cm_mhz", "blood_attenuation_db_per_cm_mhz", "shadow_db_per_cm",
            "compensation_db_per_cm_mhz", "angle_exponent", "contact_db", "beat_shift_mm",
            "beat_turn_deg",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                self._refuse(name, ">= 0")
        for name in ("side_lobe_db", "angle_floor_db", "dropout_db"):
            if not getattr(self, name) <= 0:
                self._refuse(name, "<= 0 dB")
        for name in ("azimuth_deg", "elevation_span_deg"):
            if not 10 <= getattr(self, name) <= 120:
                self._refuse(name, "10 to 120 degrees")
        for name, span in (
            ("lateral_deg", self.azimuth_deg),
            ("elevation_deg", self.elevation_span_deg),
        ):
            if not 0.2 <= getattr(self, name) <= span / 4:
                self._refuse(name, "0.2 degrees to a quarter of the opening")
        if not 0 <= self.dropout <= 0.6:
            self._refuse("dropout", "0 to 0.6")
        if len(self.depth_mm) != 2 or not 0 < self.depth_mm[0] < self.depth_mm[1]:
            self._refuse("depth_mm", "two increasing distances > 0")
        if self.axial_mm > (self.depth_mm[1] - self.depth_mm[0]) / 4:
            self._refuse("axial_mm", "a quarter of the depth range at most")
        if not 1 <= self.beats <= 12:
            self._refuse("beats", "1 to 12")
        if len(self.shape) != 3 or min(self.shape) < 8:
            self._refuse("shape", "three numbers of voxels >= 8")

    def _refuse(self, name: str, expected: str) -> None:
        raise InputError(f"acquisition {name} = {getattr(self, name)}, expected {expected}")

    @property
    def wave_number(self) -> float:
        """2 pi over the wavelength, rad/mm."""
        return 2e3 * math.pi * self.frequency_mhz / SPEED_OF_SOUND


SMALL = Acquisition(
    axial_mm=2.2,
    lateral_deg=4.0,
    elevation_deg=5.0,
    depth_mm=(4.0, 100.0),
    voxel_mm=2.0,
    shape=(48, 40, 48),
)
"""Coarse and fast, for tests."""


Interval: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Range:
    """How one setting varies about that of the base.

    Attributes
    ----------
    setting : str
        Name of a number in :class:`Acquisition`.
    how : "times" or "plus"
        Whether what is drawn multiplies the setting or is added to it.
    intervals : tuple of (float, float)
        One is chosen with equal chances, then a value in it.
    """

    setting: str
    how: Literal["times", "plus"]
    intervals: tuple[Interval, ...]

    def __post_init__(self) -> None:
        numbers = {f.name for f in fields(Acquisition) if f.name not in ("depth_mm", "shape")}
        if self.setting not in numbers or self.setting == "beats":
            raise InputError(f"range of {self.setting!r}, expected a number of an acquisition")
        if self.how not in ("times", "plus"):
            raise InputError(f"range of {self.setting}: {self.how!r}, expected times or plus")
        if not self.intervals or any(not low <= high for low, high in self.intervals):
            raise InputError(
                f"range of {self.setting}: {self.intervals}, expected intervals (low, high)"
            )


@dataclass(frozen=True, slots=True)
class AcquisitionRanges:
    """Ranges of settings, drawn independently of each other."""

    name: str
    ranges: tuple[Range, ...]


def _range(setting: str, how: Literal["times", "plus"], *intervals: Interval) -> Range:
    return Range(setting, how, intervals)


TRAINING = AcquisitionRanges(
    "training",
    (
        _range("frequency_mhz", "times", (0.8, 1.2)),
        _range("axial_mm", "times", (0.75, 1.3)),
        _range("lateral_deg", "times", (0.75, 1.3)),
        _range("elevation_deg", "times", (0.75, 1.3)),
        _range("side_lobe_db", "plus", (-5.0, 4.0)),
        _range("dynamic_range_db", "plus", (-6.0, 8.0)),
        _range("gain_db", "plus", (-5.0, 5.0)),
        _range("attenuation_db_per_cm_mhz", "times", (0.7, 1.3)),
        _range("compensation_db_per_cm_mhz", "plus", (-0.05, 0.05)),
        _range("shadow_db_per_cm", "times", (0.0, 1.5)),
        _range("angle_exponent", "times", (0.6, 1.4)),
        _range("angle_floor_db", "plus", (-5.0, 4.0)),
        _range("dropout", "plus", (-0.08, 0.08)),
        _range("blood_db", "plus", (-5.0, 5.0)),
        _range("electronics_db", "plus", (-5.0, 5.0)),
        _range("haze_db", "plus", (-10.0, 5.0)),
        _range("contact_db", "times", (0.3, 1.5)),
        _range("wall_db", "plus", (-4.0, 4.0)),
        _range("leaflet_db", "plus", (-4.0, 3.0)),
        _range("annulus_db", "plus", (-4.0, 3.0)),
        _range("chord_db", "plus", (-5.0, 5.0)),
        _range("papillary_db", "plus", (-4.0, 4.0)),
        _range("vessel_db", "plus", (-4.0, 4.0)),
        _range("beat_shift_mm", "times", (0.0, 1.5)),
        _range("beat_turn_deg", "times", (0.0, 1.5)),
    ),
)
"""What detectors are trained on; widths of ranges are a choice."""

SHIFTED = AcquisitionRanges(
    "shifted",
    (
        _range("frequency_mhz", "times", (0.65, 0.75), (1.25, 1.4)),
        _range("axial_mm", "times", (1.35, 1.6)),
        _range("lateral_deg", "times", (1.35, 1.6)),
        _range("elevation_deg", "times", (1.35, 1.6)),
        _range("side_lobe_db", "plus", (4.5, 7.0)),
        _range("dynamic_range_db", "plus", (-10.0, -7.0), (9.0, 13.0)),
        _range("gain_db", "plus", (-7.0, -5.5), (5.5, 7.0)),
        _range("attenuation_db_per_cm_mhz", "times", (1.35, 1.6)),
        _range("compensation_db_per_cm_mhz", "plus", (-0.05, 0.05)),
        _range("shadow_db_per_cm", "times", (1.6, 2.2)),
        _range("angle_exponent", "times", (0.4, 0.55), (1.45, 1.7)),
        _range("angle_floor_db", "plus", (-7.0, -5.5), (4.5, 7.0)),
        _range("dropout", "plus", (0.09, 0.16)),
        _range("blood_db", "plus", (5.5, 8.0)),
        _range("electronics_db", "plus", (5.5, 9.0)),
        _range("haze_db", "plus", (5.5, 8.0)),
        _range("contact_db", "times", (1.6, 1.9)),
        _range("wall_db", "plus", (-6.0, 6.0)),
        _range("leaflet_db", "plus", (-6.0, -4.2)),
        _range("annulus_db", "plus", (-6.0, -4.2)),
        _range("chord_db", "plus", (-5.0, 5.0)),
        _range("papillary_db", "plus", (-4.0, 4.0)),
        _range("vessel_db", "plus", (-4.0, 4.0)),
        _range("beat_shift_mm", "times", (1.6, 2.5)),
        _range("beat_turn_deg", "times", (1.6, 2.5)),
    ),
)
"""What detectors never saw: apart from echo strengths and compensation, every range is disjoint
from that of training, and mostly on the worse side."""


WIDE = AcquisitionRanges(
    "wide",
    tuple(
        Range(own.setting, own.how, tuple(dict.fromkeys((*own.intervals, *beyond.intervals))))
        for own, beyond in zip(TRAINING.ranges, SHIFTED.ranges, strict=True)
    ),
)
"""Each setting by itself inside the ranges of training or outside: half and half, or with chances
of one to two where both sides lie outside."""


def draw_acquisition(
    rng: np.random.Generator,
    base: Acquisition | None = None,
    spread: AcquisitionRanges | str = "training",
) -> Acquisition:
    """An acquisition drawn about a base; the result records every value.

    Parameters
    ----------
    rng : numpy Generator
    base : Acquisition, optional
        The default one if none is given.
    spread : AcquisitionRanges or its name, "training", "wide" or "shifted"
        What is drawn, and from where.

    Raises
    ------
    InputError
        If no spread has that name, or a value drawn makes no sense as an acquisition's.
    """
    base = base or Acquisition()
    if isinstance(spread, str):
        known = {s.name: s for s in (TRAINING, WIDE, SHIFTED)}
        if spread not in known:
            raise InputError(f"spread {spread!r}, expected one of {', '.join(known)}")
        spread = known[spread]
    drawn: dict[str, float] = {}
    for entry in spread.ranges:
        low, high = entry.intervals[int(rng.integers(len(entry.intervals)))]
        value, before = float(rng.uniform(low, high)), float(getattr(base, entry.setting))
        drawn[entry.setting] = before * value if entry.how == "times" else before + value
    return replace(base, **drawn)  # type: ignore[arg-type]
