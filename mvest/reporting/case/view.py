"""The valve of one case to be turned by hand: a plotly scene, its script, and its buttons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from numpy.typing import NDArray

from mvest.problem.fields import CaseFields
from mvest.reporting.case.drawing import BLOOD, TISSUE, gap_corners, gap_of
from mvest.reporting.case.figures import distance_top
from mvest.reporting.figures import LEAFLET_COLOURS
from mvest.reporting.markup import shown_text
from mvest.typing import FloatArray, IntArray

DECIMALS = 2
"""Positions are stored to 0.01 mm, a fiftieth of what is seen of a valve."""
ELEMENT = "valve"
LINE, CHORD, TIP = "#1a1a1a", "#8a817c", "#59382f"
GHOST, UNOBSERVED = "#8c8c8c", "#bfbfbf"
SCALE = "Viridis"

COARSER = 2
"""Of so many pixels of a gap along both directions one is shown."""

PERSONALISED = "closed, personalised"

CAMERAS: Mapping[str, Any] = {
    "obliquely": {"eye": {"x": 0.48, "y": -1.04, "z": 1.25}, "up": {"x": 0, "y": 0, "z": 1}},
    "from the atrium": {"eye": {"x": 0.0, "y": -0.01, "z": 1.75}, "up": {"x": 0, "y": 1, "z": 0}},
    "from the side": {"eye": {"x": 0.85, "y": -1.50, "z": 0.38}, "up": {"x": 0, "y": 0, "z": 1}},
}
"""In perspective: plotly lights no surface from the front in an orthographic scene."""


@dataclass(frozen=True, slots=True)
class CaseView:
    """A scene within a page, and what its buttons show.

    Attributes
    ----------
    markup : Markup
        The scene with plotly's script.
    states : tuple of (str, tuple of bool)
        Label of each button, and which traces of the scene it shows.
    start : int
        The state that is shown first.
    cameras : mapping
        Camera of the scene by label.
    """

    markup: Markup
    states: tuple[tuple[str, tuple[bool, ...]], ...]
    start: int
    cameras: Mapping[str, Any]


def case_view(fields: CaseFields, names: Sequence[str]) -> CaseView:
    """The valve open and closed, as observed and as models have it, one of them shown at a time.

    Parameters
    ----------
    fields : CaseFields
    names : sequence of str
        Of the leaflets, for what is shown under the pointer.
    """
    states = _states(fields, names)
    labels = [label for label, _ in states]
    start = labels.index(PERSONALISED) if PERSONALISED in labels else 0
    owner = np.repeat(np.arange(len(states)), [len(parts) for _, parts in states])
    traces = [trace for _, parts in states for trace in parts]
    for trace, at in zip(traces, owner, strict=True):
        trace.visible = bool(at == start)
    axis = {"visible": False, "showbackground": False}
    scene = go.Figure(traces)
    scene.update_layout(
        template=None,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        paper_bgcolor="white",
        showlegend=False,
        scene={
            "aspectmode": "data",
            "camera": CAMERAS["obliquely"],
            "xaxis": axis,
            "yaxis": axis,
            "zaxis": axis,
        },
    )
    markup = scene.to_html(
        full_html=False,
        include_plotlyjs=True,
        div_id=ELEMENT,
        default_height="100%",
        config={"displaylogo": False, "displayModeBar": False, "responsive": True},
    )
    shown = tuple((label, tuple((owner == k).tolist())) for k, label in enumerate(labels))
    return CaseView(Markup(markup), shown, start, CAMERAS)


def _states(fields: CaseFields, names: Sequence[str]) -> list[tuple[str, list[Any]]]:
    k = fields.closed
    states = [("open", _anatomy(fields, fields.rest, 0, names))]
    if fields.observed is not None:
        states.append(("closed, observed", _anatomy(fields, fields.observed[k], k + 1, names)))
    points = fields.observed_points.get(fields.frames[k])
    if points is not None:
        states.append(("closed, observed", [_cloud(points)]))
    for label, shape in (("generic", fields.generic), ("personalised", fields.fitted)):
        if shape is not None:
            states.append((f"closed, {label}", _anatomy(fields, shape[k], k + 1, names)))
    pairs = (
        ("generic", fields.generic, fields.distance_generic),
        ("personalised", fields.fitted, fields.distance_fitted),
    )
    known = [(label, s[k], d[k]) for label, s, d in pairs if s is not None and d is not None]
    if known:
        top = distance_top(*(distance for _, _, distance in known))
        for label, shape, distance in known:
            states.append((f"distance, {label}", _coloured(fields, shape, k + 1, distance, top)))
    seen = None if points is None else _cloud(points)
    if fields.observed is not None:
        seen = _ghost(fields, fields.observed[k])
    if fields.fitted is not None and seen is not None:
        model = _anatomy(fields, fields.fitted[k], k + 1, names)
        states.append(("observed (grey) over personalised", [*model, seen]))
    return states


def _anatomy(fields: CaseFields, points: FloatArray, frame: int, names: Sequence[str]) -> list[Any]:
    """One mesh for each leaflet, lines, chordae and papillary tips."""
    parts = []
    for r in range(int(fields.region.max()) + 1):
        colour = 255 * LEAFLET_COLOURS[r % len(LEAFLET_COLOURS)]
        mesh = _mesh(points, fields.triangles[fields.region == r])
        mesh.color = f"rgb({','.join(str(round(c)) for c in colour)})"
        name = names[r] if r < len(names) else f"leaflet {r + 1}"
        # plotly reads tags in its texts.
        mesh.update(name=escape(shown_text(str(name))), hoverinfo="name")
        parts.append(mesh)
    return parts + _leak(fields, points, frame) + _lines(fields, points, frame)


def _coloured(
    fields: CaseFields, points: FloatArray, frame: int, distance: FloatArray, top: float
) -> list[Any]:
    known = np.isfinite(distance[fields.triangles]).all(axis=1)
    mesh = _mesh(points, fields.triangles[known], distance)
    mesh.update(
        colorscale=SCALE,
        cmin=0.0,
        cmax=top,
        colorbar={"title": {"text": "mm"}, "len": 0.6, "thickness": 14},
        hovertemplate="%{intensity:.2f} mm<extra></extra>",
    )
    parts = [mesh, *_leak(fields, points, frame), *_rings(fields, points)]
    if not known.all():
        unseen = _mesh(points, fields.triangles[~known])
        unseen.update(color=UNOBSERVED, hoverinfo="skip")
        parts.append(unseen)
    return parts


def _leak(fields: CaseFields, points: FloatArray, frame: int) -> list[Any]:
    """The gap of a closed valve, and the slit where leaflets touch, as high as what is nearest."""
    if not frame or fields.reach_mm is None or not np.isfinite(points).all():
        return []
    gap, plane = gap_of(fields, points, frame, fields.reach_mm)
    corners = gap_corners(gap, plane, COARSER)
    parts = []
    for name, pixels, colour in (("touching", gap.slit, TISSUE), ("gap", gap.open, BLOOD)):
        row, column = np.nonzero(pixels[::COARSER, ::COARSER])
        a = row * corners.shape[1] + column
        b = a + corners.shape[1]
        triangles = np.concatenate(
            [np.stack([a, a + 1, b], axis=1), np.stack([a + 1, b + 1, b], axis=1)]
        )
        if len(triangles):
            mesh = _mesh(corners.reshape(-1, 3), triangles)
            red, green, blue = (round(255 * channel) for channel in colour)
            mesh.update(color=f"rgb({red},{green},{blue})", name=name, hoverinfo="name")
            parts.append(mesh)
    return parts


def _ghost(fields: CaseFields, points: FloatArray) -> Any:
    mesh = _mesh(points, fields.triangles)
    mesh.update(color=GHOST, opacity=0.45, hoverinfo="skip")
    return mesh


def _mesh(points: FloatArray, triangles: IntArray, values: FloatArray | None = None) -> Any:
    """A mesh of the triangles whose corners were all seen, of the vertices that they use."""
    known = np.isfinite(points[triangles]).all(axis=(1, 2))
    used, corner = np.unique(triangles[known], return_inverse=True)
    i, j, k = corner.reshape(-1, 3).T.astype(np.min_scalar_type(len(used)))
    x, y, z = small(points[used]).T
    mesh = go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, flatshading=False)
    if values is not None:
        mesh.intensity = small(values[used])
    mesh.lighting = {"ambient": 0.4, "diffuse": 0.65, "specular": 0.1, "roughness": 0.6}
    mesh.lightposition = {"x": -4e4, "y": -4e4, "z": 1e5}
    return mesh


def _rings(fields: CaseFields, points: FloatArray) -> list[Any]:
    rings = []
    for loop, width in ((fields.annulus, 6), (fields.free_edge, 2)):
        if len(loop):
            x, y, z = small(points[np.append(loop, loop[0])]).T
            rings.append(_line(x, y, z, LINE, width))
    return rings


def _lines(fields: CaseFields, points: FloatArray, frame: int) -> list[Any]:
    lines = _rings(fields, points)
    if len(fields.chord_tip):
        ends = fields.chords(points, frame)
        # A gap after each chord, so that all of them are one line.
        broken = np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1)
        x, y, z = small(broken.reshape(-1, 3)).T
        lines.append(_line(x, y, z, CHORD, 2))
    if fields.tips.shape[1]:
        x, y, z = small(fields.tips[frame]).T
        marker = {"size": 6, "color": TIP}
        lines.append(
            go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, hoverinfo="name",
                         name="papillary tip")
        )  # fmt: skip
    return lines


def _line(x: Any, y: Any, z: Any, colour: str, width: int) -> Any:
    line = {"color": colour, "width": width}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, hoverinfo="skip")


def _cloud(points: FloatArray) -> Any:
    x, y, z = small(points).T
    marker = {"size": 2.2, "color": GHOST}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, hoverinfo="skip")


def small(values: FloatArray) -> NDArray[np.float32]:
    """Values as they are stored in a page: rounded, in single precision."""
    return np.round(values, DECIMALS).astype(np.float32)
