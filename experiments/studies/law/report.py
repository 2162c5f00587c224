"""Two material laws on the same data: a table of both fits, and what each says of the tissue."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.studies.law.findings import Findings
from mvest.reporting.figures import COLOURS

__all__ = ["biaxial_figure", "curves_figure", "law_answer", "law_table", "law_text", "law_words"]

DIRECTIONS = ("along the fibres", "across the fibres")
TRUTH, EXPONENTIAL, LINEAR = "black", COLOURS[0], COLOURS[1]
LAST_STRESS = 0.8
"""MPa; beyond it nothing is drawn."""


def curves_figure(record: Record[Findings]) -> Figure | None:
    """Stress against stretch of each leaflet, true and as estimated with either law."""
    findings = record.findings
    if not findings.curves:
        return None
    figure = Figure(figsize=(8.6, 3.4 * len(findings.curves)), layout="constrained")
    grid = figure.subplots(len(findings.curves), 2, squeeze=False, sharey=True)
    for axes_of_region, (region, curves) in zip(grid, findings.curves.items(), strict=True):
        seen, stretch, law = (
            findings.stretches[region],
            np.array(curves.stretch),
            curves.exponential,
        )
        for k, (axes, direction) in enumerate(zip(axes_of_region, DIRECTIONS, strict=True)):
            low, _, high = seen.across if k else seen.along
            axes.axvspan(low, high, color="0.9", label="stretches in the closed valve (90 %)")
            band = [np.array(side)[:, k] for side in (law.low, law.high)]
            axes.fill_between(stretch, *band, color=EXPONENTIAL, alpha=0.25, linewidth=0)
            for values, colour, style, label in (
                (curves.truth, TRUTH, "-", "truth"),
                (law.estimate, EXPONENTIAL, "--", "exponential law, estimated (95 % band)"),
                (curves.linear, LINEAR, "-.", "linear law, estimated"),
            ):
                axes.plot(stretch, np.array(values)[:, k], style, color=colour, label=label)
            axes.set(xlim=(stretch[0], stretch[-1]), ylim=(0, LAST_STRESS))
            _label(axes, f"{region} leaflet, {direction}")
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


def _label(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("stretch in both directions")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def biaxial_figure(record: Record[Findings]) -> Figure:
    """The law with the coefficients of excised leaflets, under equibiaxial stretch."""
    excised = record.findings.excised
    figure = Figure(figsize=(4.2 * len(excised), 3.6), layout="constrained")
    grid = figure.subplots(1, len(excised), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (region, curves) in zip(grid, excised.items(), strict=True):
        stress = np.array(curves.stress)
        for k, (name, style) in enumerate((("circumferential", "-"), ("radial", "--"))):
            axes.plot(curves.stretch, 1e3 * stress[:, k], style, color=COLOURS[k], label=name)
        axes.set(ylim=(0, 150), xlim=(1.0, 1.3))  # kPa
        _label(axes, f"{region} leaflet")
    grid[0].set_ylabel("nominal stress [kPa]")
    grid[0].legend(frameon=False, fontsize=8)
    figure.suptitle("The law with coefficients of excised leaflets", fontsize=11)
    return figure


def law_table(record: Record[Findings]) -> pd.DataFrame:
    """One row for each parameter of each fit."""
    rows = []
    for fit in record.findings.fits:
        distance = fit.distance_mm
        for parameter in fit.parameters:
            own = asdict(parameter)
            rows.append(
                {
                    "law": fit.law,
                    "parameter": own.pop("name"),
                    **own,
                    "distance_mean_mm": None if distance is None else distance.mean,
                    "distance_max_mm": None if distance is None else distance.max,
                    "residual_rms_mm": fit.residual_rms_mm,
                    "chi_square_per_number": fit.chi_square,
                    "iterations": fit.iterations,
                    "seconds": fit.seconds,
                    "reason": fit.reason,
                }
            )
    return pd.DataFrame(rows)


def law_text(record: Record[Findings]) -> str:
    """The tables of both fits and of what other errors make of the exponential law."""
    findings = record.findings
    lines = [
        "| law | parameter | truth | start | estimate | SD | Cramér-Rao |",
        "|---|---|---|---|---|---|---|",
    ]
    for fit in findings.fits:
        for p in fit.parameters:
            numbers = (p.truth, p.start, p.estimate, p.std, p.bound)
            cells = ["–" if v is None else f"{v:.3g}" for v in numbers]
            name = f"{p.name} ({p.unit})" if p.unit else p.name
            lines.append(f"| {fit.law} | {name} | {' | '.join(cells)} |")
    lines += [
        "",
        "| law | distance from the true closed valve, mean / max (mm) | χ² per coordinate | "
        "iterations | time (s) |",
        "|---|---|---|---|---|",
    ]
    for fit in findings.fits:
        d = fit.distance_mm
        cell = "–" if d is None else f"{d.mean:.3f} / {d.max:.2f}"
        chi = "–" if fit.chi_square is None else f"{fit.chi_square:.3f}"
        ended = "" if fit.converged else f" ({fit.reason})"
        lines.append(
            f"| {fit.law}{ended} | {cell} | {chi} | {fit.iterations} | {fit.seconds:.0f} |"
        )
    if findings.chi_square_band is None:
        return "\n".join(lines)
    low, high = findings.chi_square_band
    lines += [
        "",
        f"Data: one closed frame of a simulated valve of the exponential law, with independent "
        f"errors of {findings.noise_mm:g} mm of each coordinate. χ² of a right model lies between "
        f"{low:.3f} and {high:.3f} per coordinate (95 %).",
        "",
        "| leaflet | stretch along the fibres (5th, 50th, 95th percentile) | across |",
        "|---|---|---|",
    ]
    for region, seen in findings.stretches.items():
        cells = [", ".join(f"{v:.2f}" for v in values) for values in (seen.along, seen.across)]
        lines.append(f"| {region} | {cells[0]} | {cells[1]} |")
    return "\n".join([*lines, *_scatter(record)])


def _scatter(record: Record[Findings]) -> list[str]:
    """How the estimates with the exponential law scatter about the truth, in lines of Markdown."""
    findings = record.findings
    done = [sample for sample in findings.samples if sample.converged]
    if not done:
        return []
    truth = np.array(findings.truth)
    estimates, low, high = (
        np.array(rows) for rows in zip(*((s.estimate, s.low, s.high) for s in done), strict=True)
    )
    inside = ((low <= truth) & (truth <= high)).sum(axis=0)
    lines = [
        "",
        f"The exponential law from {len(findings.samples)} samples of the errors, of which "
        f"{len(done)} gave an estimate:",
        "",
        "| parameter | truth | median | smallest to largest | 95 % interval holds the truth |",
        "|---|---|---|---|---|",
    ]
    for k, name in enumerate(record.parameters):
        own = estimates[:, k]
        lines.append(
            f"| {name} | {truth[k]:.3g} | {np.median(own):.3g} | {own.min():.3g} to "
            f"{own.max():.3g} | {inside[k]} of {len(done)} |"
        )
    return lines


def law_answer(record: Record[Findings]) -> str:
    """What is known of the exponential law, and whether the data tell the laws apart."""
    found = record.findings
    misfits = ", ".join(
        f"{fit.law} {fit.chi_square:.2f}" for fit in found.fits if fit.chi_square is not None
    )
    held = [
        low <= truth <= high
        for sample in found.samples
        for low, truth, high in zip(sample.low, found.truth, sample.high, strict=True)
    ]
    low, high = found.chi_square_band or (float("nan"),) * 2
    return (
        f"One simulated closed frame fitted by two laws: χ² per coordinate {misfits} (a right "
        f"model: {low:.2f} to {high:.2f}); {sum(held)} of {len(held)} intervals of the "
        "exponential law hold the truth."
    )


def law_words(record: Record[Findings]) -> str:
    """The tables, and what excised leaflets' coefficients give beside measurements of others."""
    lines = [
        law_text(record),
        "",
        "## Coefficients of excised leaflets",
        "",
        "| leaflet | slope along the fibres at rest (MPa) | at 0.1 MPa | stretch at which 0.1 MPa "
        "is reached along / across the fibres |",
        "|---|---|---|---|",
    ]
    for region, curves in record.findings.excised.items():
        reached = " / ".join("–" if v is None else f"{v:.2f}" for v in curves.reached)
        slope = "–" if curves.slope is None else f"{curves.slope:.2g}"
        lines.append(f"| {region} | {curves.slope_at_rest:.2g} | {slope} | {reached} |")
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
