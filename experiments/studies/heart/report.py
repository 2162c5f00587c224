"""The valve of a reference heart: its sizes, its closure, the gate, and twins on it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.common.records.report import parameter_label, write_drawn
from experiments.studies.heart.findings import Findings
from mvest.errors import InputError
from mvest.reading.npz import read_npz
from mvest.reporting.case.drawing import (
    ATRIUM,
    View,
    draw_valve,
    leaflet_colours,
    name_leaflets,
    paint_leak,
    same_scale,
)
from mvest.reporting.case.fields import CaseFields
from mvest.reporting.case.figures import corner_colours
from mvest.reporting.markup import MISSING

__all__ = ["heart_answer", "heart_figure", "heart_table", "heart_words", "write_heart"]

POSTERIOR = View("seen from the posterior side", 8.0, -90.0)


def heart_figure(fields: Path) -> Figure:
    """The open valve with its leaflets and with its thickness, and the closed one, twice each."""
    try:
        arrays = read_npz(fields)
        shapes = np.concatenate([arrays["frames"], arrays["chord_end"]], axis=1).astype(float)
        count = len(arrays["chord_tip"])
        valve = CaseFields(
            triangles=arrays["triangles"].astype(np.int64),
            region=arrays["region"].astype(np.int64),
            rest=shapes[0],
            annulus=arrays["annulus"].astype(np.int64),
            free_edge=arrays["free_edge"].astype(np.int64),
            frames=("closed",),
            seen=np.ones(1, dtype=bool),
            tips=arrays["tips"].astype(float),
            chord_tip=arrays["chord_tip"].astype(np.int64),
            chord_insertion=shapes.shape[1] - count + np.arange(count),
            observed_points={},
            reach_mm=float(arrays["reach_mm"]),
        )
        thickness = arrays["thickness"].astype(float)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{fields}: no fields of a closing valve ({error})") from error
    scale = ScalarMappable(Normalize(0.0, float(np.ceil(2 * thickness.max()) / 2)), "viridis")
    plain = leaflet_colours(valve.region)
    panels = (
        ("open, as modelled", 0, plain),
        ("its thickness", 0, corner_colours(scale, thickness, valve.triangles)),
        ("closed, 120 mmHg (simulated)", 1, plain),
    )
    figure = Figure(figsize=(10.5, 7.4), layout="constrained")
    grid = figure.subplots(2, 3, height_ratios=[1.0, 0.9])
    for row, view in enumerate((ATRIUM, POSTERIOR)):
        for axes, (title, k, colours) in zip(grid[row], panels, strict=True):
            draw_valve(axes, valve, shapes[k], colours, view, k, chords=view is POSTERIOR)
            if view is ATRIUM:
                axes.set_title(title, fontsize=10, pad=10)
                if k:
                    paint_leak(axes, valve, shapes[k], k)
        shown = [shapes[0], shapes[1], *valve.tips] if view is POSTERIOR else [shapes[0]]
        same_scale(list(grid[row]), shown, view)
    name_leaflets(grid[0, 0], valve, ("anterior", "posterior"))
    bar = figure.colorbar(scale, ax=list(grid[:, 2]), shrink=0.5, pad=0.02)
    bar.set_label("thickness (mm)")
    figure.suptitle(
        "Mitral valve of the HRA reference heart (male, v1.2): only its shape is real\n"
        "Browne et al. 2022, doi 10.48539/HBM373.VSTV.568, CC BY 4.0; adapted",
        fontsize=10,
    )
    return figure


def heart_table(record: Record[Findings]) -> pd.DataFrame:
    """Everything in rows of part, name, value and unit."""
    found = record.findings
    rows = [("shape", one.name, one.value, one.unit) for one in found.measures]
    for mesh in found.meshes:
        rows += [
            (f"mesh {mesh.name}", name, value, unit)
            for name, value, unit in (
                ("nodes", float(mesh.nodes), ""),
                (f"elements ({mesh.element})", float(mesh.elements), ""),
                ("volume", mesh.volume_mm3, "mm³"),
            )
        ]
    for one in found.closures:
        for state, step in (("open", one.opened), ("closed", one.closed)):
            part = f"{one.name}, {state}"
            rows += [(part, name, float(value), "") for name, value in asdict(step).items()]
    for asked in found.gate:
        value = np.nan if asked.max_mm is None else asked.max_mm
        rows.append(
            ("gate", asked.name, value, f"mm, {'passed' if asked.passed else 'NOT passed'}")
        )
    for twin in found.twins:
        for k, name in enumerate(record.parameters):
            estimate = np.nan if twin.estimate is None else twin.estimate[k]
            rows.append((f"twin, {twin.truth}", name, estimate, "MPa"))
            error = np.nan if twin.error_percent is None else twin.error_percent[k]
            rows.append((f"twin, {twin.truth}", f"error of {name}", error, "%"))
    return pd.DataFrame(rows, columns=["part", "name", "value", "unit"])


def heart_answer(record: Record[Findings]) -> str:
    """What comes back of the moduli that were put in."""
    errors = "; ".join(
        f"{twin.truth} {max(map(abs, twin.error_percent)):.2g} %"
        if twin.error_percent
        else f"{twin.truth} none"
        for twin in record.findings.twins
    )
    closed = record.findings.closures[0].closed
    return (
        "A human valve's shape (reference heart), closed with assumed chordae: "
        f"{closed.orifice_mm2:.2g} mm² stay open; largest error of a modulus of twins on it: "
        f"{errors}."
    )


def heart_words(record: Record[Findings]) -> str:
    """Markdown of all tables, with what they rest on."""
    found = record.findings
    lines = [f"**{found.claim}**", "", "| the open valve | |", "|---|---|"]
    lines += [f"| {one.name} | {one.value:.4g} {one.unit} |" for one in found.measures]
    lines += ["", "| mesh | element | nodes | elements | volume (mm³) |", "|---|---|---|---|---|"]
    lines += [
        f"| {mesh.name} | {mesh.element} | {mesh.nodes} | {mesh.elements} | {mesh.volume_mm3:.0f} |"
        for mesh in found.meshes
    ]
    lines += [
        "",
        *_closures(found),
        "",
    ]
    lines += [
        f"Gate **{'passed' if found.passed else 'NOT passed'}**"
        + (f"; not asked: {', '.join(found.left_out)}." if found.left_out else "."),
        "",
        "| gate | mean / max (mm) | |",
        "|---|---|---|",
    ]
    for asked in found.gate:
        distance = MISSING
        if asked.mean_mm is not None and asked.max_mm is not None:
            distance = f"{asked.mean_mm:.2g} / {asked.max_mm:.2g}"
        verdict = "passed" if asked.passed else "**NOT passed**"
        lines.append(f"| {asked.name} | {distance} | {verdict}: {asked.reason} |")
    names = [parameter_label(name) for name in record.parameters]
    head = ["truth", *names, *(f"error of {name}" for name in names), "distance (mm)", "ended"]
    lines += ["", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for twin in found.twins:
        estimates, errors = [MISSING] * len(names), [MISSING] * len(names)
        if twin.estimate is not None and twin.std is not None and twin.error_percent is not None:
            estimates = [
                f"{v:.3g} ± {s:.1g} MPa (true {t:g})"
                for v, s, t in zip(twin.estimate, twin.std, twin.values, strict=True)
            ]
            errors = [f"{e:+.2g} %" for e in twin.error_percent]
        distance = MISSING if twin.distance_mm is None else f"{twin.distance_mm:.2g}"
        lines.append(
            "| " + " | ".join([twin.truth, *estimates, *errors, distance, twin.reason]) + " |"
        )
    lines += ["", "What follows from the source, and what is assumed:", ""]
    lines += [f"* {sentence}" for sentence in found.derived]
    lines += ["", f"Data: {found.data.citation}."]
    return "\n".join(lines)


def _closures(found: Findings) -> list[str]:
    pressure = found.closures[0].closed.pressure_mmhg
    lines = [
        f"| closed under {pressure:.0f} mmHg | annulus shortens by "
        "| edges' depth, closed over open | orifice (mm²) | largest ball that passes (mm) "
        "| coaptation in the middle (mm) "
        "| largest strain of a chord | smallest determinant of F |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in found.closures:
        before, after = one.opened, one.closed
        lines.append(
            f"| {one.name} | {100 * one.annulus_contraction:.0f} % | {one.closed_depth:g} "
            f"| {before.orifice_mm2:.0f} → {after.orifice_mm2:.1f} "
            f"| {before.passing_ball_mm:.1f} → {after.passing_ball_mm:.1f} "
            f"| {after.coaptation_mm:.1f} | {100 * after.chord_strain:.0f} % "
            f"| {after.smallest_jacobian:.2f} |"
        )
    return lines


write_heart = write_drawn(heart_table, heart_words, lambda record, fields: heart_figure(fields))
"""Tables of each run, and its picture where its surfaces are still there."""
