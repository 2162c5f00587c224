"""What the image step returns: one valve in every frame, with how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.typing import FloatArray

MIN_CONFIDENCE = 0.7
"""Confidence from which on a frame shows a valve, wherever that is decided or drawn.

A volume is accepted if its best frame reaches it; frames of a case are chosen among those that do.
Set on simulated volumes of valves of their own: chamber walls alone reached 0.64, and of 25 valves
that were detected rightly one stayed below 0.8.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ValveSequence:
    """A valve in every frame of a sequence; all positions LPS in mm.

    Attributes
    ----------
    layout : ValveLayout
        Vertex i is the same point of the tissue in all frames.
    times : (T,) s
        Increasing.
    vertices : (T, n, 3)
        Midsurface of the leaflets.
    tips : (T, 2, 3)
        Papillary tips, the first that at phi = 0.
    frame_confidence : (T,)
        0 (no valve) to 1.
    vertex_confidence : (T, n)
        0 (not seen) to 1.
    std_mm : (n,)
        Standard deviation of each coordinate of each vertex; NaN where it was never measured.
    correlation_length_mm : float
        Over which errors of neighbouring vertices are alike along the leaflets.
    """

    layout: ValveLayout
    times: FloatArray
    vertices: FloatArray
    tips: FloatArray
    frame_confidence: FloatArray
    vertex_confidence: FloatArray
    std_mm: FloatArray
    correlation_length_mm: float

    def __post_init__(self) -> None:
        t, n = len(self.times), self.layout.size
        for name, shape in (
            ("vertices", (t, n, 3)),
            ("tips", (t, 2, 3)),
            ("frame_confidence", (t,)),
            ("vertex_confidence", (t, n)),
            ("std_mm", (n,)),
        ):
            given = np.shape(getattr(self, name))
            if given != shape:
                raise InputError(f"valve sequence {name}: shape {given}, expected {shape}")
        if t < 1 or not (np.isfinite(self.times).all() and np.all(np.diff(self.times) > 0)):
            raise InputError(f"valve sequence times {self.times} s, expected increasing ones")

    @property
    def confidence(self) -> float:
        """Of the volume: the median of its frames."""
        return float(np.median(self.frame_confidence))

    @property
    def annulus(self) -> FloatArray:
        """``(T, columns, 3)`` mm."""
        return self.vertices[:, self.layout.annulus]

    @property
    def free_edge(self) -> FloatArray:
        """``(T, columns, 3)`` mm."""
        return self.vertices[:, self.layout.free_edge]
