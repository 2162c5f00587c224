"""Stress of a thin sheet that is stretched along and across its fibres: what a biaxial test shows.

The stress across the thickness is zero, which decides the stretch of the thickness.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

MAX_ITERATIONS = 100
TOLERANCE = 1e-12
"""Change of the thickness strain at which the stretch of the thickness is found."""


class _Stressed(Protocol):
    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]: ...


def biaxial_stress(law: _Stressed, stretches: FloatArray, region: int = 0) -> FloatArray:
    """Nominal stresses ``(n, 2)`` MPa along and across the fibres.

    Parameters
    ----------
    law : Law
    stretches : (n, 2)
        Along and across the fibres.
    region : int
        Of the law.

    Raises
    ------
    InputError
        If stretches are not positive, or no thickness is found for them.
    """
    stretches = np.asarray(stretches, dtype=np.float64)
    if stretches.ndim != 2 or stretches.shape[1] != 2 or not np.all(stretches > 0):
        raise InputError("stretches: expected (n, 2) positive numbers")
    green = np.zeros((len(stretches), 1, 6))
    green[:, 0, :2] = 0.5 * (stretches**2 - 1)
    thickness = 1 / stretches.prod(axis=1)
    where, none = np.full(len(stretches), region), np.zeros_like(green)
    for _ in range(MAX_ITERATIONS):
        green[:, 0, 2] = 0.5 * (thickness**2 - 1)
        stress, tangent = law.response(green, where, none, 0.0)
        # In the logarithm of the thickness, which stays positive whatever the step.
        slope = tangent[:, 0, 2, 2] * thickness**2 + 2 * stress[:, 0, 2]
        change = -stress[:, 0, 2] / np.where(slope > 0, slope, tangent[:, 0, 2, 2] * thickness**2)
        thickness = thickness * np.exp(np.clip(change, -0.1, 0.1))
        if np.abs(change).max(initial=0.0) < TOLERANCE:
            return np.asarray(stretches * stress[:, 0, :2])
    raise InputError("no thickness without stress was found at these stretches")
