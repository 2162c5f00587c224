"""Reading a case from its folder: ``case.yaml`` and the files that it names.

What a field means stands in ``README.md`` beside this module. Every error begins with the file and
the field it comes from.

Joint errors of all frames are one file of arrays by name, in NumPy's ``.npz``.

The transmitral pressure over time is measured or generic. The generic curve is left ventricular
minus left atrial pressure, each a monotone cubic (PCHIP) through the points that heart-valve
simulations take from Yellin's data. Its clock is that of one cardiac cycle: the pressure rises from
9 to 113 mmHg between 0.53 and 0.58 s and stays near 120 mmHg up to 0.70 s. No curve is continued
beyond its ends: a time outside is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from mvest.cases.case import ErrorSamples, Role, Uncertainty, ValveCase
from mvest.cases.checks import check_closing_pressure, check_names_and_frames
from mvest.cases.frames import SECONDS_PER, check_reference, place_frame, read_frame
from mvest.cases.schema import CASE_FILE, CaseFolder, ChordaeEntry, PointData
from mvest.cases.tissue import point_data, read_chordae, read_leaflets
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line, read_numbers
from mvest.typing import FloatArray
from mvest.units import kpa_to_mpa, mpa_to_mmhg
from mvest.valve.anatomy.valve import checked_floats

VENTRICLE = ((0.40, 6.0), (0.53, 14.0), (0.58, 120.0), (0.75, 130.0), (0.80, 8.0))
ATRIUM = ((0.40, 7.0), (0.47, 20.0), (0.53, 5.0), (0.58, 7.0), (0.70, 10.0))
"""(s, mmHg)."""
GENERIC_SAMPLES = 301
"""One for every ms from 0.40 to 0.70 s."""


@dataclass(frozen=True, slots=True, eq=False)
class PressureCurve:
    """Transmitral pressure, positive where it closes the valve; PCHIP between its points.

    Attributes
    ----------
    time : ndarray
        ``(k,)`` s, increasing, k >= 2.
    pressure_mmHg : ndarray
        ``(k,)``.

    Raises
    ------
    InputError
        On wrong shapes, values that are not finite, or times that do not increase.
    """

    time: FloatArray
    pressure_mmHg: FloatArray

    def __post_init__(self) -> None:
        time = checked_floats("pressure curve: times", self.time, (None,))
        checked_floats("pressure curve: pressures", self.pressure_mmHg, time.shape)
        if len(time) < 2:
            raise InputError(f"pressure curve: {len(time)} point, expected two or more")
        if (np.diff(time) <= 0).any():
            row = int(np.argmax(np.diff(time) <= 0)) + 1
            raise InputError(
                f"pressure curve: time {time[row]:g} s of point {row} does not follow "
                f"{time[row - 1]:g} s; expected increasing times"
            )

    def __call__(self, time: float) -> float:
        """Pressure in mmHg.

        Raises
        ------
        InputError
            The time lies outside the curve.
        """
        first, last = float(self.time[0]), float(self.time[-1])
        if not first <= time <= last:
            raise InputError(
                f"time {time:g} s lies outside the pressure curve, which runs from {first:g} to "
                f"{last:g} s"
            )
        return float(scipy.interpolate.PchipInterpolator(self.time, self.pressure_mmHg)(time))


def generic_curve() -> PressureCurve:
    """Ventricular minus atrial pressure from 0.40 to 0.70 s, where both are known."""
    end = min(VENTRICLE[-1][0], ATRIUM[-1][0])
    time = np.linspace(VENTRICLE[0][0], end, GENERIC_SAMPLES)
    ventricle, atrium = (
        scipy.interpolate.PchipInterpolator(*np.transpose(part))(time)
        for part in (VENTRICLE, ATRIUM)
    )
    return PressureCurve(time, ventricle - atrium)


ARRAYS = ("frames", "vertices", "tips")
SOURCE = "source"


def read_error_samples(file: Path, frames: Sequence[str]) -> ErrorSamples:
    """Read the samples of a case whose frames have these names, in this order.

    ``frames`` are names ``(f,)``, ``vertices (K, f, n, 3)`` and ``tips (K, f, t, 3)`` displacements
    in mm from where a point was seen to where it may have been. ``source (K,)`` may be there:
    integers, alike for samples that are not independent of each other.

    Raises
    ------
    InputError
        The file is no ``.npz``, holds other arrays, is of other frames, or a value is no
        displacement.
    """
    if file.suffix.lower() != ".npz":
        raise InputError(f"{file.name}: extension {file.suffix!r}, expected .npz")
    stored = read_npz(file, ARRAYS, exact=True, optional=(SOURCE,), where=file.name)
    names, vertices, tips = (stored[name] for name in ARRAYS)
    if names.ndim != 1 or names.dtype.kind != "U" or names.tolist() != list(frames):
        text = names.dtype.kind == "U"
        shown = one_line(names.tolist(), 80) if text else f"an array of {names.dtype}"
        raise InputError(f"{file.name}: frames {shown}, expected {one_line(list(frames), 120)}")
    return ErrorSamples(vertices, tips, stored.get(SOURCE))


def write_error_samples(file: Path, samples: ErrorSamples, frames: Sequence[str]) -> None:
    """Write samples so that they are read back unchanged."""
    source = {} if samples.source is None else {SOURCE: samples.source}
    arrays: dict[str, Any] = {"vertices": samples.vertices, "tips": samples.tips} | source
    np.savez_compressed(file, frames=np.array(list(frames)), **arrays)


GENERIC_UNCERTAINTY = Uncertainty(1.0, 10.0)
"""Leaflets tracked in echocardiography are about 1 mm off, and smoothly so."""


def read_case(path: Path | str) -> ValveCase:
    """Read a case folder.

    Parameters
    ----------
    path
        The folder with ``case.yaml``.

    Raises
    ------
    InputError, GeometryError
        Anything missing, unknown, inadmissible or contradictory: one error with file, field,
        numbers, and what would be right.
    """
    folder = CaseFolder(Path(path))
    if not folder.root.is_dir():
        raise InputError(f"{folder.root}: no such folder; expected a folder with {CASE_FILE}")
    if not folder.case.is_file():
        raise InputError(f"{folder.root}: no {CASE_FILE} in this folder")
    document, derived = folder.document, folder.derived
    check_names_and_frames(folder)
    seen = [read_frame(folder, number) for number in range(len(document.frames))]
    first = next(s for s in seen if s.entry.role == Role.REFERENCE.value)
    reference = check_reference(folder, first)
    pressures = _pressures(folder)
    placed = [place_frame(folder, reference, s, p) for s, p in zip(seen, pressures, strict=True)]
    surface = read_leaflets(folder, reference)
    chordae = read_chordae(folder, reference, placed)
    uncertainty, samples, given = GENERIC_UNCERTAINTY, None, document.observation
    if given is None:
        derived.append(
            f"observation: standard deviation {uncertainty.std_mm:g} mm and correlation length "
            f"{uncertainty.correlation_length_mm:g} mm assumed"
        )
    else:
        with folder.at("observation.std_mm"):
            std = given.std_mm
            seen_std = (
                point_data(first, std.point_data, 1)[:, 0] if isinstance(std, PointData) else std
            )
            uncertainty = Uncertainty(seen_std, given.correlation_length_mm)
        if given.error_samples is not None:
            file = folder.file(given.error_samples, "observation.error_samples")
            with folder.at("observation.error_samples"):
                samples = read_error_samples(file, [frame.name for frame in document.frames])
    entry = document.chordae
    case = ValveCase(
        name=document.name,
        description=document.description,
        source=document.source,
        licence=document.licence,
        simulated=document.simulated,
        surface=surface,
        annulus=reference.rims.annulus,
        free_edge=reference.rims.free_edge,
        frames=tuple(frame for frame, _ in placed),
        chordae=chordae,
        uncertainty=uncertainty,
        derived=tuple(derived),
        sha256=folder.sha256(),
        error_samples=samples,
        chordae_follow=entry is None or (isinstance(entry, ChordaeEntry) and entry.follow),
    )
    if entry is not None:
        with folder.at("chordae"):
            _ = case.valve  # whose chordae start at its tips and end on its leaflets
    return case


def _pressures(folder: CaseFolder) -> list[float]:
    """Transmitral pressure (mmHg) of every frame."""
    document = folder.document
    unit = document.units.pressure
    to_mmhg = 1.0 if unit == "mmHg" else mpa_to_mmhg(kpa_to_mpa(1.0))
    to_seconds = SECONDS_PER[document.units.time]
    curve = generic_curve()
    if document.pressure_curve is not None:
        file = folder.file(document.pressure_curve, "pressure_curve")
        with folder.at("pressure_curve"):
            table = read_numbers(file, ("time", "pressure"))
            curve = PressureCurve(to_seconds * table[:, 0], to_mmhg * table[:, 1])
    result = []
    for number, frame in enumerate(document.frames):
        with folder.at(f"frames.{number}.pressure"):
            if frame.pressure is not None:
                pressure = to_mmhg * frame.pressure
            else:
                pressure = _from_curve(curve, to_seconds * frame.time)
                if document.pressure_curve is None:
                    folder.derived.append(
                        f"pressure of frame {frame.name!r}: {pressure:.1f} mmHg of a generic "
                        "transmitral curve, whose clock is taken to be that of the frames"
                    )
            if frame.role != Role.REFERENCE.value:
                check_closing_pressure(pressure, unit)
        result.append(pressure)
    return result


def _from_curve(curve: PressureCurve, time: float) -> float:
    try:
        return curve(time)
    except InputError as fault:
        raise InputError(
            f"not given, and {fault}; give the pressure of this frame or a pressure_curve that "
            "covers it"
        ) from fault
