"""The frames of a case as they were given, before anything is simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mvest.reporting.case.fields import CaseFields
from mvest.reporting.case.figures import views_figure
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops

__all__ = ["frame_fields", "frames_figure"]


def frame_fields(
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    annulus: FloatArray,
    tips: FloatArray,
    chord_tip: IntArray | None = None,
    chord_insertion: FloatArray | None = None,
    reach_mm: float | None = None,
) -> CaseFields:
    """One frame by itself.

    Parameters
    ----------
    vertices, triangles, region : (n, 3) mm, (m, 3), (m,)
    annulus : (k, 3) mm
        Tells which border is the annulus.
    tips : (t, 3) mm
    chord_tip, chord_insertion : (c,), (c, 3) mm, optional
    reach_mm : float, optional
        Of a closed frame, the distance of midsurfaces within which leaflets touch.
    """
    loops = sorted(boundary_loops(triangles), key=lambda loop: _gap(vertices[loop], annulus))
    if chord_tip is None or chord_insertion is None:
        chord_tip, insertion = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    else:
        gaps = np.linalg.norm(chord_insertion[:, None] - vertices[None], axis=2)
        insertion = gaps.argmin(axis=1)
    return CaseFields(
        triangles,
        region,
        vertices,
        loops[0],
        loops[-1],
        ("frame",),
        np.array([True]),
        np.stack([tips, tips]),
        chord_tip,
        insertion,
        {},
        reach_mm=reach_mm,
    )


def _gap(points: FloatArray, curve: FloatArray) -> float:
    return float(np.linalg.norm(points[:, None] - curve[None], axis=2).min(axis=1).mean())


def frames_figure(frames: Mapping[str, CaseFields], names: Sequence[str]) -> Figure:
    """Every frame from two sides.

    Parameters
    ----------
    frames : mapping
        Title -> frame.
    names : sequence of str
        Of the leaflets.
    """
    # Of a closed one the leak is drawn, as of a frame that is not the reference.
    shapes = [(t, one, one.rest, 0 if one.reach_mm is None else 1) for t, one in frames.items()]
    return views_figure(shapes, names)
