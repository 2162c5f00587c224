"""The valve of one case to be turned by hand: shapes for the script of the page, which draws them.

A shape is triangles, lines and points, each with its positions and colours as bytes in Base64.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from mvest.problem.fields import CaseFields
from mvest.reporting.case.drawing import (
    BLOOD,
    CHORD,
    LINE,
    TIP,
    TISSUE,
    UNSEEN,
    corner_colours,
    distance_top,
    leaflet_colours,
    leak_of,
)
from mvest.reporting.figures import DISTANCE_MAP
from mvest.typing import BoolArray, FloatArray
from mvest.valve.geometry.triangles import surface_edges

PERSONALISED = "closed, personalised"
"""The shape that is shown first, if there is an estimate."""

Part = tuple[FloatArray, FloatArray]
"""Positions ``(k, c, 3)`` mm of primitives with c corners, and colours that fit them."""


def case_view(fields: CaseFields) -> list[dict[str, Any]]:
    """The valve open and closed, as observed and as models have it.

    Returns
    -------
    list of dict
        ``label`` of each shape, whether it is ``pressed`` at first, and ``triangles``, ``lines``
        and ``points``: positions (float32, mm) and colours (uint8) of all corners.
    """
    shapes = shapes_of(fields)
    start = PERSONALISED if PERSONALISED in shapes else next(iter(shapes))
    return [
        {"label": label, "pressed": label == start}
        | {
            kind: _bytes([part for part in parts if part[0].shape[1] == corners])
            for kind, corners in (("triangles", 3), ("lines", 2), ("points", 1))
        }
        for label, parts in shapes.items()
    ]


def shapes_of(fields: CaseFields) -> dict[str, list[Part]]:
    """Parts of each shape by its label."""
    k, frame = fields.closed, fields.closed + 1
    shapes, seen = {"open": _anatomy(fields, fields.rest, 0)}, list[Part]()
    if (cloud := fields.observed_points.get(fields.frames[k])) is not None:
        seen = shapes["closed, observed"] = [(cloud[:, None], UNSEEN)]
    models = {
        "observed": (fields.observed, None),
        "generic": (fields.generic, fields.distance_generic),
        "personalised": (fields.fitted, fields.distance_fitted),
    }
    drawn = {label: (x[k], off) for label, (x, off) in models.items() if x is not None}
    for label, (points, _) in drawn.items():
        shapes[f"closed, {label}"] = _anatomy(fields, points, frame)
    compared = {label: (x, off[k]) for label, (x, off) in drawn.items() if off is not None}
    for label, (points, off) in compared.items():
        top = distance_top(*(each for _, each in compared.values()))
        scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
        colours = corner_colours(scale, off, fields.triangles)
        shapes[f"distance, {label}"] = _surface(fields, points, frame, colours)
    if fields.observed is not None:
        seen = [(fields.observed[k][surface_edges(fields.triangles)], UNSEEN)]
    if fields.fitted is not None and seen:
        model = _anatomy(fields, fields.fitted[k], frame)
        shapes["observed (grey) over personalised"] = [*model, *seen]
    return shapes


def _anatomy(fields: CaseFields, points: FloatArray, frame: int) -> list[Part]:
    """Leaflets in their colours, chordae and papillary tips."""
    return [
        *_surface(fields, points, frame, leaflet_colours(fields.region)),
        (fields.chords(points, frame), CHORD),
        (fields.tips[frame][:, None], TIP),
    ]


def _surface(fields: CaseFields, points: FloatArray, frame: int, colours: FloatArray) -> list[Part]:
    """Leaflets, annulus and free edge; of a closed valve the gap, and the slit of the contact."""
    parts = [(points[fields.triangles], colours)]
    for loop in (fields.annulus, fields.free_edge):
        parts.append((np.stack([points[loop], points[np.roll(loop, -1)]], axis=1), LINE))
    if frame and (leak := leak_of(fields, points, frame)) is not None:
        gap, corners = leak
        parts.append((_cells(corners, gap.slit), np.array(TISSUE)))
        parts.append((_cells(corners, gap.open), np.array(BLOOD)))
    return parts


def _cells(corners: FloatArray, pixels: BoolArray) -> FloatArray:
    """Two triangles ``(k, 3, 3)`` mm for each of some pixels, whose corners are given."""
    a, b = corners[:-1, :-1][pixels], corners[:-1, 1:][pixels]
    c, d = corners[1:, :-1][pixels], corners[1:, 1:][pixels]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])


def _bytes(parts: Sequence[Part]) -> list[str]:
    """Positions and colours of the primitives whose corners were all seen."""
    known = [np.isfinite(corners).all(axis=(1, 2)) for corners, _ in parts]
    places = [corners[seen].reshape(-1, 3) for (corners, _), seen in zip(parts, known, strict=True)]
    colours = [
        np.broadcast_to(colour, corners.shape)[seen].reshape(-1, 3)
        for (corners, colour), seen in zip(parts, known, strict=True)
    ]
    nothing = np.empty((0, 3))
    return [
        base64.b64encode(values.tobytes()).decode("ascii")
        for values in (
            np.concatenate([nothing, *places]).astype("<f4"),
            np.concatenate([nothing, *(255.0 * each for each in colours)]).astype(np.uint8),
        )
    ]
