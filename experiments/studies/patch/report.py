"""A stiff patch of a leaflet: how well it was found, as a table, in words and as maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from experiments.common.records.record import Record
from experiments.studies.patch.findings import Findings

__all__ = ["patch_answer", "patch_figure", "patch_table", "patch_words"]

STIFFNESS_LIMIT = 0.2
"""Relative error of the peak that is to be met."""
PLACE_LIMIT = 0.5
"""Distance of the peak from the patch's centre, over the patch's radius, that is to be met."""


def patch_table(record: Record[Findings]) -> pd.DataFrame:
    """One row for each point of the leaflet and each truth."""
    places = record.findings.map
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "truth": label,
                    "along_mm": places.along_mm,
                    "down_mm": places.down_mm,
                    "true_MPa": fit.compared.truth,
                    "estimate_MPa": fit.compared.modulus,
                    "log_std": fit.compared.log_std,
                }
            )
            for label, fit in record.findings.results.items()
        ]
    ).round(5)


def _verdict(found: Findings) -> str:
    entry, radius = found.results["patch"].compared, found.patch.radius_mm
    error = entry.peak / entry.true_at_centre - 1
    stiff = abs(error) <= STIFFNESS_LIMIT
    place = entry.peak_distance_mm <= PLACE_LIMIT * radius
    return (
        f"Stiffness of the peak {100 * error:+.0f} % off, target {100 * STIFFNESS_LIMIT:g} %: "
        f"{'met' if stiff else 'missed'}. Place {entry.peak_distance_mm:.1f} mm off, target "
        f"{PLACE_LIMIT * radius:g} mm (half the patch's radius): {'met' if place else 'missed'}."
    )


def patch_answer(record: Record[Findings]) -> str:
    """Whether the patch is seen."""
    entry = record.findings.results["patch"].compared
    return (
        f"A simulated stiff patch of the anterior leaflet: peak "
        f"{100 * (entry.peak / entry.true_at_centre - 1):+.0f} % off, "
        f"{entry.peak_distance_mm:.1f} mm from its place; {100 * entry.within_two_std:.0f} % of "
        "the leaflet within two stated standard deviations (95 % expected)."
    )


def patch_words(record: Record[Findings]) -> str:
    """The table for readers, and what it says."""
    found = record.findings
    results, field = found.results, found.field
    compared = [fit.compared for fit in results.values()]
    rows: list[tuple[str, Sequence[float | None], str]] = [
        ("true modulus at the centre (MPa)", [c.true_at_centre for c in compared], ".2f"),
        ("estimated modulus there (MPa)", [c.at_centre for c in compared], ".2f"),
        (
            "its standard deviation (of the logarithm)",
            [c.log_std_at_centre for c in compared],
            ".2f",
        ),
        ("highest estimated modulus (MPa)", [c.peak for c in compared], ".2f"),
        ("its distance from the centre (mm)", [c.peak_distance_mm for c in compared], ".1f"),
        ("estimated modulus outside the patch (MPa)", [c.outside for c in compared], ".2f"),
        ("RMS error of log E over the leaflet", [c.rms_log_error for c in compared], ".2f"),
        (
            "share of the leaflet within two standard deviations",
            [c.within_two_std for c in compared],
            ".2f",
        ),
        (
            "RMS shift of log E by the estimator's mesh, from one run on a third",
            [c.shift_rms for c in compared],
            ".2f",
        ),
        (
            "share within two standard deviations and shifts",
            [c.within_two_with_shift for c in compared],
            ".2f",
        ),
        ("residual (mm)", [fit.residual_mm for fit in results.values()], ".3f"),
    ]
    titles = {"patch": "with the patch", "no patch": "without a patch"}
    lines = ["| | " + " | ".join(titles[label] for label in results) + " |"]
    lines.append("|---" * (1 + len(results)) + "|")
    for words, values, form in rows:
        cells = " | ".join("not known" if v is None else f"{v:{form}}" for v in values)
        lines.append(f"| {words} | {cells} |")
    around, along = found.cells_of_truth
    assert record.model is not None
    own = record.model.cells
    lines += [
        "",
        _verdict(found),
        f"Truth: {found.truth[0]:g} MPa, in the patch up to {found.patch.factor:g} "
        f"times as much, radius {found.patch.radius_mm:g} mm; {around} x {along} "
        f"cells. Estimator: {own[0]} x {own[1]} cells, a smooth field with a correlation length "
        f"of {field.correlation_length_mm:g} mm and a prior standard deviation of "
        f"{field.std_log:g} of log E, {field.modes} modes "
        f"({100 * found.share:.0f} % of its variance), together with both moduli.",
        f"{len(found.times)} frames of a cycle, {found.vertices} vertices, noise of "
        f"{found.noise_mm:g} mm per coordinate. What is estimated beside the true modulus comes "
        "from the noise, the other mesh and the field's smoothness. The shift by the estimator's "
        "mesh is to first order. Everything is simulated.",
        *(
            f"{titles[label]}: what the mesh may shift is not known ({fit.shift_unknown})."
            for label, fit in results.items()
            if fit.shift_unknown
        ),
    ]
    return "\n".join(lines)


def patch_figure(record: Record[Findings]) -> Figure:
    """Maps of the unrolled leaflet: true modulus, estimated modulus, standard deviation."""
    places = record.findings.map
    results = {label: fit.compared for label, fit in record.findings.results.items()}
    mesh = Triangulation(places.along_mm, places.down_mm, places.triangles)
    moduli = np.concatenate([m for entry in results.values() for m in (entry.truth, entry.modulus)])
    levels = np.geomspace(0.999 * moduli.min(), 1.001 * moduli.max(), 25)
    modulus = (levels, LogNorm(), "viridis")
    largest = max(max(entry.log_std) for entry in results.values())
    spread = (np.linspace(0.0, 1.001 * largest, 13), Normalize(), "Greys")
    figure = Figure(figsize=(11.5, 1.9 * len(results) + 0.9), layout="constrained")
    grid = figure.subplots(len(results), 3, sharex=True, sharey=True, squeeze=False)
    drawn = {}
    for row, (label, entry) in zip(grid, results.items(), strict=True):
        maps = {"truth": entry.truth, "modulus": entry.modulus, "log_std": entry.log_std}
        for axes, (key, values) in zip(row, maps.items(), strict=True):
            levels, norm, colours = spread if key == "log_std" else modulus
            drawn[key] = axes.tricontourf(mesh, values, levels, norm=norm, cmap=colours)
            axes.set_aspect("equal")
            if label == "patch":
                _outline(axes, mesh, entry.truth, "black" if key == "log_std" else "white")
        top = int(np.argmax(entry.modulus))
        row[1].plot(places.along_mm[top], places.down_mm[top], "x", color="red", ms=8)
        row[0].set_ylabel(f"{label}\nfrom the annulus (mm)")
    bar = figure.colorbar(drawn["modulus"], ax=list(grid[:, :2].ravel()), label="E_f (MPa)")
    ticks = [t for t in (2, 3, 4, 5, 6, 8, 10, 12, 15) if moduli.min() <= t <= moduli.max()]
    bar.set_ticks(ticks, labels=[str(t) for t in ticks])
    bar.minorticks_off()
    figure.colorbar(drawn["log_std"], ax=list(grid[:, 2]), format="%.2f",
                    label="standard deviation of log E_f")  # fmt: skip
    titles = ("true modulus", "estimated modulus (x: highest)", "its standard deviation")
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title)
    grid[0, 0].invert_yaxis()
    for axes in grid[-1]:
        axes.set_xlabel("along the annulus (mm)")
    figure.suptitle(
        f"Unrolled {record.findings.patch.region} leaflet; dashed: where the true stiffness is "
        "half-way up the patch (simulated)"
    )
    return figure


def _outline(axes: Axes, mesh: Triangulation, truth: tuple[float, ...], colour: str) -> None:
    """Where the true modulus is half-way up the patch, on the logarithmic scale."""
    level = float(np.sqrt(min(truth) * max(truth)))
    axes.tricontour(mesh, truth, levels=[level], colors=colour, linewidths=1.2, linestyles="--")
