"""What a case needs that the file of a volume does not state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mvest.errors import InputError
from mvest.imaging.valve_sequence import MIN_CONFIDENCE
from mvest.imaging.volume import Modality
from mvest.quantities import BeatTime, Count, Pressure, Share, Thickness

LEAFLETS = ("anterior", "posterior")
"""Order of ``thickness_mm``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedSettings:
    """From a volume over time to a case.

    Attributes
    ----------
    model : str or None
        File of the detection model; None: the one for ultrasound that comes with the package.
    modality : str or None
        ``ultrasound``, ``ct`` or ``mr``, where the file does not state it.
    frame_interval_s : float or None
        Where the file states no times.
    time_unit : str or None
        ``s`` or ``ms``, where the file states times without a unit.
    landmarks : tuple of (frame, file)
        Landmarks placed by hand (``.mrk.json``), where the automatic ones fail.
    open_frame, closed_frame : int or None
        None: the frame with the largest orifice, and the one whose leaflets touch most.
    pressure_mmHg : float or None
        Transmitral, in the closed frame.
    pressure_curve : str or None
        File ``.csv`` of ``time,pressure`` (s, mmHg) at the times of the volume, instead.
    thickness_mm : tuple of float
        Of the `LEAFLETS`; empty: generic.
    min_confidence : float
        Below this the best frame shows no valve, and no other frame is chosen.
    error_samples : int
        At most, of held-out volumes, each also as seen in a mirror.
    name : str or None
        None: a name made of the content of the file, which may be called after a patient.
    description, source, licence : str
    simulated : bool
        Whether the volume comes from a simulation.
    """

    model: str | None = None
    modality: str | None = None
    frame_interval_s: BeatTime | None = None
    time_unit: str | None = None
    landmarks: tuple[Any, ...] = ()
    open_frame: Count | None = None
    closed_frame: Count | None = None
    pressure_mmHg: Pressure | None = None
    pressure_curve: str | None = None
    thickness_mm: tuple[Thickness, ...] = ()
    min_confidence: Share = MIN_CONFIDENCE
    error_samples: Count = 200
    name: str | None = None
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False

    def __post_init__(self) -> None:
        known = [modality.value for modality in Modality]
        if self.modality is not None and self.modality not in known:
            raise InputError(
                f"imaged.modality = {self.modality!r}, expected one of {', '.join(known)}"
            )
        if self.thickness_mm and len(self.thickness_mm) != len(LEAFLETS):
            raise InputError(
                f"imaged.thickness_mm = {list(self.thickness_mm)}, expected one number for each of "
                f"{', '.join(LEAFLETS)}, or none"
            )
        if self.pressure_mmHg is not None and self.pressure_curve is not None:
            raise InputError(
                "imaged.pressure_mmHg and imaged.pressure_curve are both given, expected one of "
                "them, the transmitral pressure on the closed valve"
            )
        for pair in self.landmarks:
            two = isinstance(pair, Sequence) and len(pair) == 2
            if not two or not isinstance(pair[0], int) or not isinstance(pair[1], str):
                raise InputError(f"imaged.landmarks has {pair!r}, expected [frame, FILE]")

    @property
    def states_pressure(self) -> bool:
        """Whether the pressure on the closed valve is given, so that a case can be estimated."""
        return self.pressure_mmHg is not None or self.pressure_curve is not None

    @property
    def thickness(self) -> Mapping[str, float] | None:
        """Leaflet -> mm; None: generic."""
        if not self.thickness_mm:
            return None
        return dict(zip(LEAFLETS, self.thickness_mm, strict=True))
