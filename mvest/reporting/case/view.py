"""A turnable 3D view of the valve of one case: a plotly scene and its buttons."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from mvest.problem.fields import CaseFields
from mvest.reporting.case.drawing import BLOOD, TISSUE, leak_of
from mvest.reporting.figures import LEAFLET_COLOURS
from mvest.reporting.markup import shown_text
from mvest.typing import FloatArray, IntArray

DECIMALS = 2
"""Positions are stored to 0.01 mm."""
LINE, CHORD, TIP = "#1a1a1a", "#8a817c", "#59382f"
GHOST = "#8c8c8c"

PERSONALISED = "closed, personalised"
"""The state that is shown first, if there is an estimate."""
CAMERAS: Mapping[str, Any] = {
    "obliquely": {"eye": {"x": 0.48, "y": -1.04, "z": 1.25}, "up": {"x": 0, "y": 0, "z": 1}},
    "from the atrium": {"eye": {"x": 0.0, "y": -0.01, "z": 1.75}, "up": {"x": 0, "y": 1, "z": 0}},
    "from the side": {"eye": {"x": 0.85, "y": -1.50, "z": 0.38}, "up": {"x": 0, "y": 0, "z": 1}},
}
"""Perspective ones: plotly does not light surfaces from the front in an orthographic scene."""


def case_view(fields: CaseFields, names: Sequence[str]) -> tuple[Markup, list[dict[str, Any]]]:
    """The open and closed valve, observed and modelled; one state is shown at a time.

    Parameters
    ----------
    fields : CaseFields
    names : sequence of str
        Of the leaflets, shown under the pointer.

    Returns
    -------
    markup, buttons : Markup, list of mapping
        The scene with plotly's script; and for each button its ``label``, whether it ``shows`` each
        trace of the scene, and whether it is ``pressed`` at first.
    """
    states = states_of(fields, names)
    start = PERSONALISED if PERSONALISED in states else next(iter(states))
    traces = [
        trace.update(visible=label == start) for label, parts in states.items() for trace in parts
    ]
    owner = np.array([label for label, parts in states.items() for _ in parts])
    scene = go.Figure(traces)
    axis = {"visible": False, "showbackground": False}
    scene.update_layout(
        template=None,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        paper_bgcolor="white",
        showlegend=False,
        scene={"aspectmode": "data", "camera": CAMERAS["obliquely"]}
        | {f"{name}axis": axis for name in "xyz"},
    )
    markup = scene.to_html(
        full_html=False,
        include_plotlyjs=True,
        div_id="valve",
        default_height="100%",
        config={"displaylogo": False, "displayModeBar": False, "responsive": True},
    )
    buttons = [
        {"label": label, "shows": (owner == label).tolist(), "pressed": label == start}
        for label in states
    ]
    return Markup(markup), buttons


def states_of(fields: CaseFields, names: Sequence[str]) -> dict[str, list[Any]]:
    """Traces of the scene by the label of the state that they belong to."""
    k, frame = fields.closed, fields.closed + 1
    states = {"open": _anatomy(fields, fields.rest, 0, names)}
    seen = []
    if (cloud := fields.observed_points.get(fields.frames[k])) is not None:
        seen = states["closed, observed"] = [_dots(cloud, GHOST, 2.2, hoverinfo="skip")]
    if fields.observed is not None:
        ghost = _mesh(fields.observed[k], fields.triangles, color=GHOST, hoverinfo="skip")
        seen = [ghost.update(opacity=0.45)]
        states["closed, observed"] = _anatomy(fields, fields.observed[k], frame, names)
    for label, shape in (("generic", fields.generic), ("personalised", fields.fitted)):
        if shape is not None:
            states[f"closed, {label}"] = _anatomy(fields, shape[k], frame, names)
    if fields.fitted is not None and seen:
        model = _anatomy(fields, fields.fitted[k], frame, names)
        states["observed (grey) over personalised"] = [*model, *seen]
    return states


def _anatomy(fields: CaseFields, points: FloatArray, frame: int, names: Sequence[str]) -> list[Any]:
    """One mesh for each leaflet, lines, chordae and papillary tips."""
    parts = []
    for r, name in enumerate(names):
        triangles = fields.triangles[fields.region == r]
        colour = to_hex(LEAFLET_COLOURS[r % len(LEAFLET_COLOURS)])
        text = escape(shown_text(str(name)))  # plotly interprets tags
        parts.append(_mesh(points, triangles, color=colour, name=text, hoverinfo="name"))
    parts += [*_leak(fields, points, frame), *_rings(fields, points)]
    if len(fields.chord_tip):
        ends = fields.chords(points, frame)
        # All chordae are one line, interrupted after each.
        broken = np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1)
        parts.append(_line(broken.reshape(-1, 3), CHORD, 2))
    if fields.tips.shape[1]:
        parts.append(_dots(fields.tips[frame], TIP, 6, hoverinfo="name", name="papillary tip"))
    return parts


def _leak(fields: CaseFields, points: FloatArray, frame: int) -> list[Any]:
    """The gap of a closed valve and the slit between touching leaflets, every second pixel."""
    if not frame or (leak := leak_of(fields, points, frame)) is None:
        return []
    gap, corners = leak[0], leak[1][::2, ::2]
    parts = []
    for name, pixels, colour in (("touching", gap.slit, TISSUE), ("gap", gap.open, BLOOD)):
        row, column = np.nonzero(pixels[:-1:2, :-1:2])
        a = row * corners.shape[1] + column
        b = a + corners.shape[1]
        halves = [np.stack([a, a + 1, b], axis=1), np.stack([a + 1, b + 1, b], axis=1)]
        if len(a):
            mesh = _mesh(corners.reshape(-1, 3), np.concatenate(halves), color=to_hex(colour))
            parts.append(mesh.update(name=name, hoverinfo="name"))
    return parts


def _mesh(points: FloatArray, triangles: IntArray, **style: Any) -> Any:
    """A mesh of the triangles without a NaN, and of the vertices that they use."""
    known = np.isfinite(points[triangles]).all(axis=(1, 2))
    used, corner = np.unique(triangles[known], return_inverse=True)
    i, j, k = corner.reshape(-1, 3).T.astype(np.min_scalar_type(len(used)))
    x, y, z = small(points[used]).T
    return go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k,
        flatshading=False,
        lighting={"ambient": 0.4, "diffuse": 0.65, "specular": 0.1, "roughness": 0.6},
        lightposition={"x": -4e4, "y": -4e4, "z": 1e5},
        **style,
    )  # fmt: skip


def _rings(fields: CaseFields, points: FloatArray) -> list[Any]:
    loops = ((fields.annulus, 6), (fields.free_edge, 2))
    return [_line(points[[*loop, loop[0]]], LINE, width) for loop, width in loops if len(loop)]


def _line(points: FloatArray, colour: str, width: int) -> Any:
    x, y, z = small(points).T
    line = {"color": colour, "width": width}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=line, hoverinfo="skip")


def _dots(points: FloatArray, colour: str, size: float, **style: Any) -> Any:
    x, y, z = small(points).T
    marker = {"size": size, "color": colour}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, **style)


def small(values: FloatArray) -> NDArray[np.float32]:
    """Values as stored in a page: rounded, in single precision."""
    return np.round(values, DECIMALS).astype(np.float32)
