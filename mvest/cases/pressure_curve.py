"""The transmitral pressure over time, measured or generic.

The generic curve is left ventricular minus left atrial pressure, each a monotone cubic (PCHIP)
through the points that heart-valve simulations take from Yellin's data. Its clock is that of one
cardiac cycle: the pressure rises from 9 to 113 mmHg between 0.53 and 0.58 s and stays near 120 mmHg
up to 0.70 s. No curve is continued beyond its ends: a time outside is an error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mvest.errors import InputError
from mvest.typing import FloatArray

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
        time, pressure = np.asarray(self.time), np.asarray(self.pressure_mmHg)
        if time.ndim != 1 or len(time) < 2 or pressure.shape != time.shape:
            raise InputError(
                f"pressure curve: times {time.shape} and pressures {pressure.shape}, expected two "
                "or more of each"
            )
        if not (np.isfinite(time).all() and np.isfinite(pressure).all()):
            raise InputError("pressure curve: times and pressures must be finite numbers")
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
