"""How far measures over time may be off, by errors of the detectors on other valves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student_t

from mvest.cases.from_images.errors_in_world import valve_axes
from mvest.cases.from_images.measures import BOUNDS, Row, is_open, leaflets_of
from mvest.errors import InputError
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray
from mvest.valve.measure.clinical import annulus_and_tips

BANDED = (
    "ap_diameter_mm",
    "commissural_diameter_mm",
    "annulus_height_mm",
    "annulus_area_mm2",
    "tip_depth_mm",
    "tip_separation_mm",
)
"""Measures that get a band: of annulus and tips, which take no fine detail of leaflets.

Detected leaflets are smoother than true ones, and differences between the two rougher than either:
areas of leaflets that are moved by them would say more of the roughness than of the area.
"""


def with_bands(
    sequence: ValveSequence, rows: Sequence[Row], errors: FloatArray, tip_errors: FloatArray
) -> list[Row]:
    """Measures of every frame, and between which bounds 95 % of true ones are expected.

    The valve of each frame is moved back by every error of the detectors on another valve, and
    measured again: a band is where one more of these values is expected (Student's bounds for one
    further normal number). It lies about where the valve is without the mean error, and so not
    always about what was measured. Errors are known of open and of closed frames; what is neither
    quite takes those of the nearer by its orifice (`OPEN_SHARE`).

    Parameters
    ----------
    sequence : ValveSequence
    rows : sequence of dict
        Its measures, from `mvest.cases.from_images.measures.measure_sequence`.
    errors : (K, 2, n, 3) mm
        Found less true, in the axes of each of K valves, in its open and its closed frame, as they
        are stated for a volume of this confidence.
    tip_errors : (K, 2, 2, 3) mm

    Returns
    -------
    list of dict
        The rows with ``NAME_low`` and ``NAME_high`` of each of `BANDED`; None where the measure is.

    Raises
    ------
    InputError
        They are of fewer than two valves, or not of this layout.
    """
    n, count = sequence.layout.size, len(errors)
    if count < 2 or errors.shape != (count, 2, n, 3) or tip_errors.shape != (count, 2, 2, 3):
        raise InputError(
            f"errors of shape {errors.shape} and of tips {tip_errors.shape}, expected (samples, 2, "
            f"{n}, 3) and (samples, 2, 2, 3) of two samples or more"
        )
    surface = leaflets_of(sequence.layout, 1.0)  # whose thickness these measures do not ask for
    reach = float(student_t.ppf(0.975, count - 1)) * np.sqrt(1.0 + 1.0 / count)
    banded = []
    for t, row in enumerate(rows):
        bounds: Row = dict.fromkeys(f"{name}_{end}" for name in BANDED for end in BOUNDS)
        if row[BANDED[0]] is not None:
            which, axes = (0 if is_open(row) else 1), valve_axes(sequence, t)
            vertices = sequence.vertices[t] - errors[:, which] @ axes.T
            tips = sequence.tips[t] - tip_errors[:, which] @ axes.T
            again = [
                annulus_and_tips(x, surface, x[sequence.layout.annulus], own)
                for x, own in zip(vertices, tips, strict=True)
            ]
            for name in BANDED:
                values = np.array([one.get(name, np.nan) for one in again], dtype=np.float64)
                middle, half = values.mean(), reach * values.std(ddof=1)
                if np.isfinite(half):
                    bounds[f"{name}_low"] = float(middle - half)
                    bounds[f"{name}_high"] = float(middle + half)
        banded.append(dict(row) | bounds)
    return banded
