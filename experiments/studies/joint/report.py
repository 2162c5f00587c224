"""Chordal length and moduli from a whole cycle: the table, the words and the figure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.common.records.report import parameter_label, percent
from experiments.studies.joint.findings import Findings, Fit, Frame, MeshError, Pass
from mvest.estimation.information.consistency import chi_square_band
from mvest.reporting.figures import COLOURS, MARKERS

__all__ = ["joint_answer", "joint_figure", "joint_table", "joint_words"]

EXACT_LIMIT = 0.01
"""Relative error to be reached without noise."""
NOISE_LIMIT = 1.5
"""Root mean square error over the Cramér-Rao bound to be reached with noise."""


def _percent(value: float | None, form: str = ".2f") -> str:
    return percent(value, form, "not determined")


def joint_table(record: Record[Findings]) -> pd.DataFrame:
    """One row per estimate and parameter."""
    found, seed = record.findings, record.provenance.seed
    cases = [("no noise", found.exact, found.exact.std)]
    cases += [(f"noise, seed {seed + k}", fit, fit.std) for k, fit in enumerate(found.seeds)]
    other = found.finer.fit
    cases.append(("noise, truth on a finer mesh", other, other.std))
    if isinstance(found.mesh_error, MeshError):
        cases.append(("the same, with the mesh's error", other, found.mesh_error.std))
    return pd.DataFrame(
        [
            {
                "case": case,
                "parameter": name,
                "truth": found.truth[k],
                "start": found.start[k],
                "estimate": fit.estimate[k],
                "relative_error": fit.error[k],
                "relative_std": std[k],
                "relative_bound": found.bounds[-1].std[k],
                "model_runs": fit.runs,
                "residual_mm": fit.residual_mm,
                "status": fit.status,
            }
            for case, fit, std in cases
            for k, name in enumerate(record.parameters)
        ]
    )


def joint_words(record: Record[Findings]) -> str:
    """The table for readers, and what it says."""
    found = record.findings
    names = [parameter_label(name) for name in record.parameters]
    two, whole = found.bounds
    exact, ratio, finer = found.exact, found.rms_over_bound, found.finer
    worst = max(abs(e) for e in exact.error)
    start = [s / t - 1 for s, t in zip(found.start, found.truth, strict=True)]
    lines = [
        f"| | {' | '.join(names)} |",
        "|---|" + "---|" * len(names),
        f"| start | {' | '.join(_percent(v, '+.0f') for v in start)} |",
        f"| error, whole cycle without noise | "
        f"{' | '.join(_percent(v, '+.3f') for v in exact.error)} |",
        f"| smallest possible std, open and closed frame | "
        f"{' | '.join(_percent(v) for v in two.std)} |",
        f"| smallest possible std, whole cycle | {' | '.join(_percent(v) for v in whole.std)} |",
        f"| RMS error over that bound, {len(found.seeds)} seeds | "
        f"{' | '.join(f'{v:.2f}' for v in ratio)} |",
        f"| error, truth on {finer.cells[0]} x {finer.cells[1]} cells and half the time step "
        f"| {' | '.join(_percent(v, '+.2f') for v in finer.fit.error)} |",
        f"| std that the filter states | {' | '.join(_percent(v) for v in finer.fit.std)} |",
        *_mesh_rows(found.mesh_error),
        "",
        f"{len(found.times)} frames of {found.vertices} vertices; noise of "
        f"{found.noise_mm:g} mm per coordinate. Everything is simulated.",
        f"Without noise: largest error {100 * worst:.3f} %, target {100 * EXACT_LIMIT:g} %: "
        f"{'met' if worst <= EXACT_LIMIT else 'missed'}. "
        f"With noise: largest ratio to the bound {max(ratio):.2f}, target {NOISE_LIMIT:g}: "
        f"{'met' if max(ratio) <= NOISE_LIMIT else 'missed'}. {_band_words(len(found.seeds))}",
        _two_frames(found, names),
        _first_pass(found, names),
        _other_mesh(found),
    ]
    return "\n".join(lines)


def joint_answer(record: Record[Findings]) -> str:
    """How far all parameters are off together, by the estimator's mesh and by another."""
    found = record.findings
    count = len(found.truth)
    own = max(abs(error) for error in found.exact.error)
    other = found.finer.fit
    beside = (
        ""
        if isinstance(found.mesh_error, str)
        else f", {_worst_in_std(other, found.mesh_error.std):.1f} with the mesh's own error added"
    )
    return (
        f"Errors of {count} parameters from a whole simulated cycle: up to {100 * own:.2g} % "
        "without noise; where the truth comes from another mesh up to "
        f"{100 * max(abs(error) for error in other.error):.2g} %, "
        f"{_worst_in_std(other, other.std):.1f} stated standard deviations{beside}."
    )


def _mesh_rows(error: MeshError | str) -> list[str]:
    if isinstance(error, str):
        return []
    return [
        f"| shift by its own mesh, from one run on a third mesh | "
        f"{' | '.join(_percent(v, '+.2f') for v in error.shift)} |",
        f"| std with that shift | {' | '.join(_percent(v) for v in error.std)} |",
    ]


def _other_mesh(found: Findings) -> str:
    finer, error = found.finer, found.mesh_error
    apart = (
        f"Where the truth comes from another mesh, the frames of the two meshes are "
        f"{finer.distance_mm:.2f} mm apart (mean) at the same parameters, and the first "
        f"standard deviations know nothing of it"
    )
    if isinstance(error, str):
        return f"{apart}; what the estimator's own mesh may shift is not known ({error})."
    with_it, without = (_in_std(finer.fit, std) for std in (error.std, finer.fit.std))
    return (
        f"{apart}. The second do: the estimator runs its own estimate once on a third mesh, finer "
        f"than the truth's ({error.cells[0]} x {error.cells[1]} cells, half the time step, "
        f"{error.distance_mm:.2f} mm apart), and by how much that would shift each parameter is "
        f"taken for one more error of it. Errors over these standard deviations: {with_it}, "
        f"normalised squared error {error.nees:.1f} for {len(error.std)} parameters (without: "
        f"{without}, {finer.fit.nees:.0f})."
    )


def _in_std(fit: Fit, std: Sequence[float]) -> str:
    return ", ".join(f"{e / s:+.1f}" for e, s in zip(fit.error, std, strict=True))


def _worst_in_std(fit: Fit, std: Sequence[float]) -> float:
    return max(abs(e) / s for e, s in zip(fit.error, std, strict=True))


def _band_words(n: int) -> str:
    """Where ratios to the bound lie if errors are normal with just that size."""
    low, high = np.sqrt(np.array(chi_square_band(n)) / n)
    return f"With {n} seeds a ratio lies between {low:.2f} and {high:.2f} in 95 % of cases."


def _first_pass(found: Findings, names: list[str]) -> str:
    last = found.first[-1]
    parts = [
        f"{name} {_percent(last.error[k], '+.1f')} (stated std {_percent(last.std[k])})"
        for k, name in enumerate(names)
    ]
    worst = max(abs(e) / s for e, s in zip(last.error, last.std, strict=True))
    return (
        f"The first pass over the frames, an extended Kalman filter, ends at errors of "
        f"{', '.join(parts)}: up to {worst:.1f} of its standard deviations. "
        f"{len(found.passes)} further passes, each linearised anew and counting every frame "
        f"once, end at the mode of the batch."
    )


def _two_frames(found: Findings, names: list[str]) -> str:
    two, whole = found.bounds
    pairs = [
        (value, i, j)
        for i in range(len(names))
        for j in range(i)
        if (value := two.correlation[i][j]) is not None
    ]
    factor = [
        a / b for a, b in zip(two.std, whole.std, strict=True) if a is not None and b is not None
    ]
    if not pairs or len(factor) < len(names):
        return "Open and closed frame alone do not determine all parameters."
    value, i, j = max(pairs, key=lambda pair: abs(pair[0]))
    return (
        f"Open and closed frame alone leave {names[j]} and {names[i]} correlated by "
        f"{value:+.3f} (whole cycle: {whole.correlation[i][j]:+.3f}); their "
        f"bounds are {min(factor):.1f} to {max(factor):.1f} times those of the whole cycle. The "
        f"closed frame {whole.count - 1} times over would make it "
        f"{np.sqrt(whole.count - 1):.1f}."
    )


def joint_figure(record: Record[Findings]) -> Figure:
    """Estimates as frames come in, errors over the bound, and the bounds of both sets of frames."""
    found, names = record.findings, record.parameters
    figure = Figure(figsize=(12.5, 4.0), layout="constrained")
    left, passes, middle, right = figure.subplots(1, 4, width_ratios=[1.3, 1.0, 1.0, 1.0])
    _draw_path(left, found.times, found.first, names)
    left.set(xlabel="time of the last frame seen (s)", ylabel="error (% of the truth)")
    left.set_title("first pass, frame by frame", fontsize=10)
    numbers = list(range(1, len(found.passes) + 1))
    _draw_path(passes, numbers, found.passes, names)
    passes.set(xlabel="pass over the whole cycle", ylim=left.get_ylim())
    passes.set_title("passes that follow", fontsize=10)
    passes.legend(fontsize=8, frameon=False, loc="upper right")
    bound = np.array(found.bounds[-1].std, dtype=float)
    errors = np.array([fit.error for fit in found.seeds]) / bound
    for k in range(len(names)):
        x = k + np.linspace(-0.2, 0.2, len(errors))
        middle.plot(x, errors[:, k], ls="", marker=MARKERS[k], ms=4, color=COLOURS[k])
        rms = found.rms_over_bound[k]
        middle.text(k, 3.4, f"RMS {rms:.2f}", ha="center", fontsize=8)
    middle.axhspan(-2, 2, color="0.9", zorder=0)
    middle.axhline(0.0, color="black", lw=0.8)
    middle.set(ylim=(-4, 4), ylabel="error / Cramér-Rao bound")
    middle.set_title(f"{len(errors)} seeds, {found.noise_mm:g} mm noise", fontsize=10)
    width = 0.38
    for j, entry in enumerate(found.bounds):
        values = 100 * np.array(entry.std, dtype=float)
        places = np.arange(len(names)) + (j - 0.5) * width
        right.bar(places, values, width, color=("0.65", "0.25")[j], label=entry.frames)
    right.set_yscale("log")
    right.set(ylabel="smallest possible std (%)", ylim=(None, 4 * right.get_ylim()[1]))
    right.set_title("two frames and the whole cycle", fontsize=10)
    right.legend(fontsize=8, frameon=False)
    for axes in (middle, right):
        axes.set_xticks(range(len(names)))
        axes.set_xticklabels(
            [parameter_label(name).replace(" ", "\n") for name in names], fontsize=8
        )
    return figure


def _draw_path(
    axes: Axes, at: Sequence[float], rows: Sequence[Frame | Pass], names: Sequence[str]
) -> None:
    """Errors with bands of two standard deviations, in percent."""
    errors, stds = (100 * np.array(v) for v in ([r.error for r in rows], [r.std for r in rows]))
    for k, name in enumerate(names):
        error, std = errors[:, k], stds[:, k]
        axes.fill_between(at, error - 2 * std, error + 2 * std, color=COLOURS[k], alpha=0.15, lw=0)
        label = parameter_label(name)
        axes.plot(at, error, color=COLOURS[k], marker=MARKERS[k], ms=4, label=label)
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set_yscale("symlog", linthresh=5.0)
    ticks = (-100, -50, -20, -5, 0, 5, 20, 50, 100)
    axes.set_yticks(ticks, labels=[str(tick) for tick in ticks])
    axes.set_ylim(-150, 250)
