"""Two material laws on the same data: a table of both fits, and what each says of the tissue."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mvest.files import write_atomically
from mvest.reporting.figures import COLOURS, save_figure
from mvest.reporting.files import provenance_line

__all__ = ["biaxial_figure", "curves_figure", "law_text", "write_law_tables"]

Record = Mapping[str, Any]

DIRECTIONS = ("along the fibres", "across the fibres")
TRUTH, EXPONENTIAL, LINEAR = "black", COLOURS[0], COLOURS[1]
LAST_STRESS = 0.8
"""MPa; beyond it nothing is drawn."""


def curves_figure(record: Record) -> Figure:
    """Stress against stretch of each leaflet, true and as estimated with either law."""
    regions = list(record["curves"])
    figure = Figure(figsize=(8.6, 3.4 * len(regions)), layout="constrained")
    grid = figure.subplots(len(regions), 2, squeeze=False, sharey=True)
    for axes_of_region, region in zip(grid, regions, strict=True):
        curves, seen = record["curves"][region], record["stretches"][region]
        stretch = np.array(curves["stretch"])
        for k, (axes, direction) in enumerate(zip(axes_of_region, DIRECTIONS, strict=True)):
            low, _, high = seen["along" if k == 0 else "across"]
            axes.axvspan(low, high, color="0.9", label="stretches in the closed valve (90 %)")
            band = [np.array(curves["exponential"][side])[:, k] for side in ("low", "high")]
            axes.fill_between(stretch, *band, color=EXPONENTIAL, alpha=0.25, linewidth=0)
            for name, colour, style, label in (
                ("truth", TRUTH, "-", "truth"),
                ("exponential", EXPONENTIAL, "--", "exponential law, estimated (95 % band)"),
                ("linear", LINEAR, "-.", "linear law, estimated"),
            ):
                values = curves[name]["estimate"] if name == "exponential" else curves[name]
                axes.plot(stretch, np.array(values)[:, k], style, color=colour, label=label)
            axes.set(xlim=(stretch[0], stretch[-1]), ylim=(0, LAST_STRESS))
            axes.set_title(f"{region} leaflet, {direction}", fontsize=10)
            axes.set_xlabel("stretch in both directions")
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
        axes_of_region[0].set_ylabel("nominal stress [MPa]")
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(),
        title="Simulated leaflets: stress under equibiaxial stretch",
        frameon=False,
        fontsize=8,
        loc="outside upper center",
        ncols=2,
    )
    return figure


def biaxial_figure(record: Record) -> Figure:
    """The law with the coefficients of excised leaflets, under equibiaxial stretch."""
    excised = record["excised"]
    figure = Figure(figsize=(4.2 * len(excised), 3.6), layout="constrained")
    grid = figure.subplots(1, len(excised), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (region, curves) in zip(grid, excised.items(), strict=True):
        stress = np.array(curves["stress"])
        for k, (name, style) in enumerate((("circumferential", "-"), ("radial", "--"))):
            axes.plot(curves["stretch"], 1e3 * stress[:, k], style, color=COLOURS[k], label=name)
        axes.set(ylim=(0, 150), xlim=(1.0, 1.3))  # kPa
        axes.set_title(f"{region} leaflet", fontsize=10)
        axes.set_xlabel("stretch in both directions")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("nominal stress [kPa]")
    grid[0].legend(frameon=False, fontsize=8)
    figure.suptitle("The law with coefficients of excised leaflets", fontsize=11)
    return figure


def _frame(record: Record) -> pd.DataFrame:
    """One row for each parameter of each fit."""
    return pd.DataFrame(
        [
            {
                "law": fit["law"],
                "parameter": parameter["name"],
                **{key: value for key, value in parameter.items() if key != "name"},
                "distance_mean_mm": fit["distance_mm"]["mean"],
                "distance_max_mm": fit["distance_mm"]["max"],
                "residual_rms_mm": fit["residual_rms_mm"],
                "chi_square_per_number": fit["chi_square"],
                "iterations": fit["iterations"],
                "seconds": fit["seconds"],
                "reason": fit["reason"],
            }
            for fit in record["fits"]
            for parameter in fit["parameters"]
        ]
    )


def _readable(record: Record) -> str:
    lines = [
        "| law | parameter | truth | start | estimate | SD | Cramér-Rao |",
        "|---|---|---|---|---|---|---|",
    ]
    for fit in record["fits"]:
        for p in fit["parameters"]:
            numbers = (p["truth"], p["start"], p["estimate"], p["std"], p["bound"])
            cells = ["–" if v is None else f"{v:.3g}" for v in numbers]
            name = f"{p['name']} ({p['unit']})" if p["unit"] else p["name"]
            lines.append(f"| {fit['law']} | {name} | {' | '.join(cells)} |")
    lines += [
        "",
        "| law | distance from the true closed valve, mean / max (mm) | χ² per coordinate | "
        "iterations | time (s) |",
        "|---|---|---|---|---|",
    ]
    for fit in record["fits"]:
        distance = fit["distance_mm"]
        cell = "–"
        if distance["mean"] is not None:
            cell = f"{distance['mean']:.3f} / {distance['max']:.2f}"
        chi = "–" if fit["chi_square"] is None else f"{fit['chi_square']:.3f}"
        ended = "" if fit["converged"] else f" ({fit['reason']})"
        lines.append(
            f"| {fit['law']}{ended} | {cell} | {chi} | {fit['iterations']} | {fit['seconds']:.0f} |"
        )
    band = record["chi_square_band"]
    if band is None:
        return "\n".join(lines)
    lines += [
        "",
        f"Data: one closed frame of a simulated valve of the exponential law, with independent "
        f"errors of {record['noise_mm']:g} mm of each coordinate. χ² of a right model lies between "
        f"{band[0]:.3f} and {band[1]:.3f} per coordinate (95 %).",
        "",
        "| leaflet | stretch along the fibres (5th, 50th, 95th percentile) | across |",
        "|---|---|---|",
    ]
    for region, seen in record["stretches"].items():
        cells = [", ".join(f"{v:.2f}" for v in seen[k]) for k in ("along", "across")]
        lines.append(f"| {region} | {cells[0]} | {cells[1]} |")
    lines += _repeats(record)
    return "\n".join(lines)


def _repeats(record: Record) -> list[str]:
    """How the estimates with the exponential law scatter about the truth, in lines of Markdown."""
    done = [r for r in record["repeats"] if r["converged"]]
    if not done:
        return []
    truth = np.array(record["truth"])
    estimates, low, high = (np.array([r[k] for r in done]) for k in ("estimate", "low", "high"))
    inside = ((low <= truth) & (truth <= high)).sum(axis=0)
    lines = [
        "",
        f"The exponential law from {len(record['repeats'])} samples of the errors, of which "
        f"{len(done)} gave an estimate:",
        "",
        "| parameter | truth | median | smallest to largest | 95 % interval holds the truth |",
        "|---|---|---|---|---|",
    ]
    for k, name in enumerate(record["parameters"]):
        own = estimates[:, k]
        lines.append(
            f"| {name} | {truth[k]:.3g} | {np.median(own):.3g} | {own.min():.3g} to "
            f"{own.max():.3g} | {inside[k]} of {len(done)} |"
        )
    return lines


def _excised(record: Record) -> str:
    """What the coefficients of excised leaflets give, beside what was measured in others."""
    lines = [
        "## Coefficients of excised leaflets",
        "",
        "| leaflet | slope along the fibres at rest (MPa) | at 0.1 MPa | stretch at which 0.1 MPa "
        "is reached along / across the fibres |",
        "|---|---|---|---|",
    ]
    for region, curves in record["excised"].items():
        reached = " / ".join("–" if v is None else f"{v:.2f}" for v in curves["reached"])
        lines.append(
            f"| {region} | {curves['slope_at_rest']:.2g} | {curves['slope']:.2g} | {reached} |"
        )
    return "\n".join(
        [
            *lines,
            "",
            "All under equibiaxial stretch; uniaxially, the slope at rest is half as large (3 μ). "
            "Excised anterior leaflets have been measured with 0.06 to 0.09 MPa before and 2 to 9 "
            "MPa after they stiffen (Krishnamurthy et al. 2009). The curves show what is known "
            "from biaxial tests: flat at first, then steep, earlier along the fibres than across "
            "them and earlier in the anterior leaflet. The coefficients are those usually quoted "
            "from May-Newman and Yin (1998); the original was not at hand to compare.",
        ]
    )


def law_text(record: Record) -> str:
    """The tables for the terminal."""
    return _readable(record)


def write_law_tables(folder: Path, record: Record) -> list[Path]:
    """``law.csv``, ``law.md`` and both figures in ``folder``."""
    table = _frame(record)
    parts = [f"# {record['title']}", _readable(record), _excised(record), provenance_line(record)]
    return [
        write_atomically(folder / "law.csv", lambda path: table.to_csv(path, index=False)),
        write_atomically(folder / "law.md", "\n\n".join(parts) + "\n"),
        *(save_figure(folder / "law", curves_figure(record), record) if record["curves"] else []),
        *save_figure(folder / "law_biaxial", biaxial_figure(record), record),
    ]
