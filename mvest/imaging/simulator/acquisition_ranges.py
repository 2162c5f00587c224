"""How acquisitions differ: the ranges that detectors are trained in, and ranges outside of them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, TypeAlias

import numpy as np

from mvest.errors import InputError
from mvest.imaging.simulator.acquisition import Acquisition

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
    """Ranges of settings, drawn independently of each other.

    Attributes
    ----------
    name : str
    ranges : tuple of Range
    """

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
