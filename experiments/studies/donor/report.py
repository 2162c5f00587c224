"""The recorded donor valve: a table of its closures, and pictures of them on one scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from experiments.common.records.record import Record
from experiments.common.records.report import write_drawn
from experiments.studies.donor.findings import Distances, Findings
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reporting.figures import DISTANCE_MAP, VIEWS
from mvest.reporting.markup import MISSING
from mvest.typing import FloatArray, IntArray

__all__ = ["donor_answer", "donor_figure", "donor_table", "donor_words", "write_donor"]

PLAIN = np.array([0.82, 0.80, 0.76])
"""Colour of the recorded valve, which has no distance from itself."""
LIGHT = np.array([0.30, 0.50, 0.81])
WHOLE = ("mean", "median", "rms", "max", "surface")
"""Distances of the whole valve."""


def donor_figure(fields: Path) -> Figure:
    """The closed valve as recorded, with generic moduli and fitted, from two sides.

    Parameters
    ----------
    fields : Path
        An ``.npz`` file with ``triangles (m, 3)``, ``recorded``, ``generic`` and ``fitted``
        ``(n, 3)`` mm, and ``annulus`` and ``free_edge`` vertices in loop order.
    """
    try:
        data = read_npz(fields)
        triangles, loops = data["triangles"], (data["annulus"], data["free_edge"])
        shapes = {k: data[k].astype(float) for k in ("recorded", "generic", "fitted")}
    except (KeyError, ValueError) as error:
        raise InputError(f"{fields}: no fields of a recorded valve ({error})") from error
    distance = {
        name: np.linalg.norm(points - shapes["recorded"], axis=1) for name, points in shapes.items()
    }
    norm = Normalize(0.0, max(float(np.max(list(distance.values()))), 1e-3))
    scale = ScalarMappable(norm, DISTANCE_MAP)
    everything = np.concatenate(list(shapes.values()))
    span = everything.min(axis=0), everything.max(axis=0)
    figure = Figure(figsize=(11.0, 7.2), layout="constrained")
    panels = []
    for row, view in enumerate(VIEWS):
        for column, (name, points) in enumerate(shapes.items()):
            axes = figure.add_subplot(2, 3, 3 * row + column + 1, projection="3d")
            colours = np.tile(PLAIN, (len(triangles), 1))
            if name != "recorded":
                colours = scale.to_rgba(distance[name][triangles].mean(axis=1))[:, :3]
            _draw(axes, points, triangles, colours, loops, span)
            axes.view_init(view.elevation, view.azimuth)
            mean = "" if name == "recorded" else f", mean {distance[name].mean():.2f} mm"
            axes.set_title(f"{name}{mean}\n{view.name}", fontsize=10)
            panels.append(axes)
    bar = figure.colorbar(scale, ax=panels, shrink=0.6, pad=0.02)
    bar.set_label("distance from the recording [mm]")
    figure.suptitle(
        "Human tricuspid valve, closed (midsurfaces: leaflets that touch are a thickness apart)",
        fontsize=11,
    )
    return figure


def _draw(
    axes: Any,
    points: FloatArray,
    triangles: IntArray,
    colours: FloatArray,
    loops: tuple[IntArray, ...],
    span: tuple[FloatArray, FloatArray],
) -> None:
    corner = points[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.45 * np.abs(normal @ LIGHT)
    faces = Poly3DCollection(corner, facecolors=np.clip(colours * shade[:, None], 0, 1))
    faces.set_edgecolor("none")
    faces.set_rasterized(True)
    axes.add_collection3d(faces)
    for loop, colour in zip(loops, ("black", "0.35"), strict=True):
        ring = points[np.append(loop, loop[0])]
        axes.plot(*ring.T, color=colour, linewidth=1.0)
    low, high = span
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.25)
    axes.set_proj_type("ortho")
    axes.set_axis_off()


def donor_table(record: Record[Findings]) -> pd.DataFrame:
    """One row for each closure: the generic one, then the fit from each start."""
    rows = []
    for row in record.findings.rows:
        plain: dict[str, Any] = {"closure": row.closure}
        for key, values in (("start", row.start), ("estimate", row.estimate), ("std", row.std)):
            shown = values or [None] * len(record.parameters)
            plain |= {
                f"{key} {name} [MPa]": value
                for name, value in zip(record.parameters, shown, strict=True)
            }
        distances = _whole(row.distance_mm)
        if row.distance_mm is not None:
            distances |= row.distance_mm.leaflets
        for part in (*WHOLE, *record.findings.regions):
            plain[f"distance {part} [mm]"] = distances.get(part)
        plain |= {
            "iterations": row.iterations,
            "forward solves": row.forward_solves,
            "equilibria": row.equilibria,
            "CPU [s]": row.seconds,
            "reason": row.reason,
        }
        rows.append(plain)
    return pd.DataFrame(rows)


def _whole(distance: Distances | None) -> dict[str, float]:
    """Distances of the whole valve by name; none of a closure that failed."""
    if distance is None:
        return {}
    values = (distance.mean, distance.median, distance.rms, distance.max, distance.surface)
    return dict(zip(WHOLE, values, strict=True))


def donor_answer(record: Record[Findings]) -> str:
    """How near a recorded valve the model comes."""
    generic, fitted = (row.distance_mm for row in record.findings.rows[:2])
    if generic is None or fitted is None:
        return "A recorded donor tricuspid valve: no closed state of the model."
    return (
        f"A recorded donor tricuspid valve: the fitted model closes {fitted.mean:.2f} mm from the "
        f"recording on average, the generic one {generic.mean:.2f} mm."
    )


def donor_words(record: Record[Findings]) -> str:
    """Markdown of the table, with the words that go with it."""
    found = record.findings
    names = [name.partition(".")[2] for name in record.parameters]
    head = [
        "closure",
        *(f"E {name} [MPa]" for name in names),
        *(f"{part} [mm]" for part in WHOLE),
        "forward solves",
        "equilibria",
        "CPU [s]",
        "ended",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in found.rows:
        values = row.estimate or row.start
        std = row.std or [None] * len(names)
        distances = _whole(row.distance_mm)
        cells = [
            row.closure,
            *(
                f"{v:.3g}" if s is None else f"{v:.3g} ± {s:.2g}"
                for v, s in zip(values, std, strict=True)
            ),
            *(f"{distances[part]:.2f}" if part in distances else MISSING for part in WHOLE),
            str(row.forward_solves),
            str(row.equilibria),
            f"{row.seconds:.0f}",
            row.reason.split(":")[0],
        ]
        lines.append("| " + " | ".join(cells) + " |")
    spread = found.starts_differ
    first, fitted = (row.distance_mm for row in found.rows[:2])
    lines += ["", found.claim, "", f"Data: {found.data.citation}."]
    facts = [
        f"Case {found.recording} under {found.pressure_mmHg:.1f} mmHg; mean motion of the leaflets "
        f"between the open and the recorded closed frame: {found.recorded_motion_mm:.2f} mm, "
        f"prescribed motion of the papillary tips: {found.tip_motion_mm:.1f} mm."
    ]
    if spread is not None:
        facts.append(
            f"Largest relative difference between the moduli from the {len(found.rows) - 1} "
            f"starts: {100 * spread:.2g} %."
        )
    if first is not None and fitted is not None:
        closer = 100 * (first.mean - fitted.mean) / first.mean
        verdict = "nearer to" if fitted.mean < first.mean else "NOT nearer to"
        facts.append(
            f"The fitted closure is {verdict} the recording than the generic one: mean distance "
            f"{first.mean:.2f} → {fitted.mean:.2f} mm ({closer:.0f} % less) of the vertices from "
            f"where they were recorded, {first.surface:.2f} → {fitted.surface:.2f} mm of the whole "
            "surface from the recorded one, both ways."
        )
    facts.append(f"{found.seconds:.0f} s of one processor and {found.memory_mb:.0f} MB.")
    if found.identifiability is not None:
        bound = found.identifiability.cramer_rao_std
        alone = ", ".join(MISSING if v is None else f"{v:.2g}" for v in bound)
        facts.append(
            "The ± are the filter's standard deviations, prior included; the data alone would "
            f"leave {alone} MPa: a modulus whose bound is as large as itself rests on the prior as "
            "much as on the recording."
        )
    return "\n".join([*lines, "", " ".join(facts)])


def _note(record: Record[Findings]) -> str:
    found = record.findings
    return f"# {found.claim}\n# data: {found.data.citation}\n# {record.line}\n"


write_donor = write_drawn(
    donor_table, donor_words, lambda record, fields: donor_figure(fields), _note
)
"""The table of each run, and its picture where its surfaces are still there."""
