"""A simulated valve over time, as the TEE simulator images it and as detectors learn from it.

All positions are mm in the valve's own axes: the annulus about the plane z = 0, z towards the
atrium, y to the anterior side, x to the line between the leaflets at phi = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class MovingValve:
    """One simulated valve in every frame.

    Attributes
    ----------
    name : str
        Tells valves (not frames) apart when some are held out.
    layout : ValveLayout
    times : (T,) s
        Increasing.
    vertices : (T, n, 3)
        Midsurface.
    tips : (T, 2, 3)
        Papillary tips, the first that at phi = 0.
    thickness : (n,) mm
    chord_phi, chord_s : (c,)
        Where chordae insert, degrees and 0 to 1.
    chord_tip : (c,)
        From which tip.
    """

    name: str
    layout: ValveLayout
    times: FloatArray
    vertices: FloatArray
    tips: FloatArray
    thickness: FloatArray
    chord_phi: FloatArray
    chord_s: FloatArray
    chord_tip: IntArray

    def __post_init__(self) -> None:
        t, n, c = len(self.times), self.layout.size, len(self.chord_phi)
        for name, shape in (
            ("vertices", (t, n, 3)),
            ("tips", (t, 2, 3)),
            ("thickness", (n,)),
            ("chord_s", (c,)),
            ("chord_tip", (c,)),
        ):
            given = np.shape(getattr(self, name))
            if given != shape:
                raise InputError(f"moving valve {self.name}, {name}: shape {given}, not {shape}")
        if t < 1 or not (np.isfinite(self.times).all() and np.all(np.diff(self.times) > 0)):
            raise InputError(f"moving valve {self.name}: times {self.times} s do not increase")
