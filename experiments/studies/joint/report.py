"""Chordal length and moduli from a whole cycle: the table, the words and the figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mvest.estimation.information.consistency import chi_square_band
from mvest.reporting.figures import COLOURS, MARKERS, write_study

__all__ = ["joint_figure", "joint_text", "parameter_label", "write_joint"]

Record = Mapping[str, Any]

EXACT_LIMIT = 0.01
"""Relative error to be reached without noise."""
NOISE_LIMIT = 1.5
"""Root mean square error over the Cramér-Rao bound to be reached with noise."""

LABELS = {
    "E_f.anterior": "anterior modulus",
    "E_f.posterior": "posterior modulus",
    "chord_rest_length": "chordal length",
}


def parameter_label(name: str) -> str:
    """What a reader calls a parameter."""
    return LABELS.get(name, name)


def _percent(value: float | None, form: str = ".2f") -> str:
    return "not determined" if value is None else f"{100 * value:{form}} %"


def _table(record: Record) -> pd.DataFrame:
    """One row per estimate and parameter."""
    cases = [("no noise", record["exact"])]
    cases += [(f"noise, seed {entry['seed']}", entry) for entry in record["seeds"]]
    cases.append(("noise, truth on a finer mesh", record["finer"]))
    if record["told"]["status"] == "converged":
        cases.append(("the same, with the mesh's error", record["told"]))
    bound = record["bounds"][-1]["std"]
    rows = []
    for case, entry in cases:
        for k, name in enumerate(record["parameters"]):
            rows.append(
                {
                    "case": case,
                    "parameter": name,
                    "truth": record["truth"][k],
                    "start": record["start"][k],
                    "estimate": entry["estimate"][k],
                    "relative_error": entry["error"][k],
                    "relative_std": entry["std"][k],
                    "relative_bound": bound[k],
                    "model_runs": entry["runs"],
                    "residual_mm": entry["residual_mm"],
                    "status": entry["status"],
                }
            )
    return pd.DataFrame(rows)


def _words(record: Record) -> str:
    names = [parameter_label(name) for name in record["parameters"]]
    two, whole = record["bounds"]
    exact, ratio = record["exact"], record["rms_over_bound"]
    finer, told = record["finer"], record["told"]
    worst = max(abs(e) for e in exact["error"])
    start = [s / t - 1 for s, t in zip(record["start"], record["truth"], strict=True)]
    lines = [
        f"| | {' | '.join(names)} |",
        "|---|" + "---|" * len(names),
        f"| start | {' | '.join(_percent(v, '+.0f') for v in start)} |",
        f"| error, whole cycle without noise | "
        f"{' | '.join(_percent(v, '+.3f') for v in exact['error'])} |",
        f"| smallest possible std, open and closed frame | "
        f"{' | '.join(_percent(v) for v in two['std'])} |",
        f"| smallest possible std, whole cycle | {' | '.join(_percent(v) for v in whole['std'])} |",
        f"| RMS error over that bound, {len(record['seeds'])} seeds | "
        f"{' | '.join(f'{v:.2f}' for v in ratio)} |",
        f"| error, truth on {finer['cells'][0]} x {finer['cells'][1]} cells and half the time step "
        f"| {' | '.join(_percent(v, '+.2f') for v in finer['error'])} |",
        f"| std that the filter told of it | {' | '.join(_percent(v) for v in finer['std'])} |",
        *_mesh_rows(told),
        "",
        f"{len(record['times'])} frames of {record['vertices']} vertices; noise of "
        f"{record['noise_mm']:g} mm per coordinate. Everything is simulated.",
        f"Without noise: largest error {100 * worst:.3f} %, target {100 * EXACT_LIMIT:g} %: "
        f"{'met' if worst <= EXACT_LIMIT else 'missed'}. "
        f"With noise: largest ratio to the bound {max(ratio):.2f}, target {NOISE_LIMIT:g}: "
        f"{'met' if max(ratio) <= NOISE_LIMIT else 'missed'}. {_band_words(record)}",
        _two_frames(record),
        _first_pass(record),
        _other_mesh(record),
    ]
    return "\n".join(lines)


def _mesh_rows(told: Record) -> list[str]:
    if told["status"] != "converged":
        return []
    return [
        f"| shift by its own mesh, from one run on a third mesh | "
        f"{' | '.join(_percent(v, '+.2f') for v in told['shift'])} |",
        f"| std with that shift | {' | '.join(_percent(v) for v in told['std'])} |",
    ]


def _other_mesh(record: Record) -> str:
    finer, told = record["finer"], record["told"]
    apart = (
        f"Where the truth comes from another mesh, the frames of the two meshes are "
        f"{finer['distance_mm']:.2f} mm apart (mean) at the same parameters, and the first "
        f"standard deviations know nothing of it"
    )
    if told["status"] != "converged":
        return f"{apart}; what the estimator's own mesh may shift is not known ({told['reason']})."
    with_it, without = (", ".join(f"{v:+.1f}" for v in _in_std(entry)) for entry in (told, finer))
    return (
        f"{apart}. The second do: the estimator runs its own estimate once on a third mesh, finer "
        f"than the truth's ({told['cells'][0]} x {told['cells'][1]} cells, half the time step, "
        f"{told['distance_mm']:.2f} mm apart), and by how much that would shift each parameter is "
        f"taken for one more error of it. Errors over these standard deviations: {with_it}, "
        f"normalised squared error {told['nees']:.1f} for {len(told['std'])} parameters (without: "
        f"{without}, {finer['nees']:.0f})."
    )


def _in_std(entry: Mapping[str, Any]) -> list[float]:
    return [e / s for e, s in zip(entry["error"], entry["std"], strict=True)]


def _band_words(record: Record) -> str:
    """Where ratios to the bound lie if errors are normal with just that size."""
    n = len(record["seeds"])
    low, high = np.sqrt(np.array(chi_square_band(n)) / n)
    return f"With {n} seeds a ratio lies between {low:.2f} and {high:.2f} in 95 % of cases."


def _first_pass(record: Record) -> str:
    last, names = record["first"][-1], record["parameters"]
    parts = [
        f"{parameter_label(name)} {_percent(last['error'][k], '+.1f')} "
        f"(told std {_percent(last['std'][k])})"
        for k, name in enumerate(names)
    ]
    worst = max(abs(e) / s for e, s in zip(last["error"], last["std"], strict=True))
    return (
        f"The first pass over the frames, an extended Kalman filter, ends at errors of "
        f"{', '.join(parts)}: up to {worst:.1f} of its standard deviations. "
        f"{len(record['passes'])} further passes, each linearised anew and counting every frame "
        f"once, end at the mode of the batch."
    )


def _two_frames(record: Record) -> str:
    two, whole = record["bounds"]
    names = [parameter_label(name) for name in record["parameters"]]
    pairs = [
        (abs(two["correlation"][i][j]), i, j)
        for i in range(len(names))
        for j in range(i)
        if two["correlation"][i][j] is not None
    ]
    if not pairs or None in two["std"] or None in whole["std"]:
        return "Open and closed frame alone do not determine all parameters."
    _, i, j = max(pairs)
    factor = [a / b for a, b in zip(two["std"], whole["std"], strict=True)]
    return (
        f"Open and closed frame alone leave {names[j]} and {names[i]} correlated by "
        f"{two['correlation'][i][j]:+.3f} (whole cycle: {whole['correlation'][i][j]:+.3f}); their "
        f"bounds are {min(factor):.1f} to {max(factor):.1f} times those of the whole cycle. The "
        f"closed frame {whole['count'] - 1} times over would make it "
        f"{np.sqrt(whole['count'] - 1):.1f}."
    )


def joint_text(record: Record) -> str:
    """The summary for the terminal."""
    return _words(record)


def joint_figure(record: Record) -> Figure:
    """Estimates as frames come in, errors over the bound, and the bounds of both sets of frames."""
    names = record["parameters"]
    figure = Figure(figsize=(12.5, 4.0), layout="constrained")
    left, passes, middle, right = figure.subplots(1, 4, width_ratios=[1.3, 1.0, 1.0, 1.0])
    _draw_path(left, record["times"], record["first"], names)
    left.set(xlabel="time of the last frame seen (s)", ylabel="error (% of the truth)")
    left.set_title("first pass, frame by frame", fontsize=10)
    numbers = list(range(1, len(record["passes"]) + 1))
    _draw_path(passes, numbers, record["passes"], names)
    passes.set(xlabel="pass over the whole cycle", ylim=left.get_ylim())
    passes.set_title("passes that follow", fontsize=10)
    passes.legend(fontsize=8, frameon=False, loc="upper right")
    bound = np.array(record["bounds"][-1]["std"], dtype=float)
    errors = np.array([entry["error"] for entry in record["seeds"]]) / bound
    for k in range(len(names)):
        x = k + np.linspace(-0.2, 0.2, len(errors))
        middle.plot(x, errors[:, k], ls="", marker=MARKERS[k], ms=4, color=COLOURS[k])
        rms = record["rms_over_bound"][k]
        middle.text(k, 3.4, f"RMS {rms:.2f}", ha="center", fontsize=8)
    middle.axhspan(-2, 2, color="0.9", zorder=0)
    middle.axhline(0.0, color="black", lw=0.8)
    middle.set(ylim=(-4, 4), ylabel="error / Cramér-Rao bound")
    middle.set_title(f"{len(errors)} seeds, {record['noise_mm']:g} mm noise", fontsize=10)
    width = 0.38
    for j, entry in enumerate(record["bounds"]):
        values = [np.nan if v is None else 100 * v for v in entry["std"]]
        places = np.arange(len(names)) + (j - 0.5) * width
        right.bar(places, values, width, color=("0.65", "0.25")[j], label=entry["frames"])
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
    axes: Axes, at: Sequence[float], rows: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> None:
    """Errors with bands of two standard deviations, in percent."""
    for k, name in enumerate(names):
        error, std = (100 * np.array([row[key][k] for row in rows]) for key in ("error", "std"))
        axes.fill_between(at, error - 2 * std, error + 2 * std, color=COLOURS[k], alpha=0.15, lw=0)
        label = parameter_label(name)
        axes.plot(at, error, color=COLOURS[k], marker=MARKERS[k], ms=4, label=label)
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set_yscale("symlog", linthresh=5.0)
    ticks = (-100, -50, -20, -5, 0, 5, 20, 50, 100)
    axes.set_yticks(ticks, labels=[str(tick) for tick in ticks])
    axes.set_ylim(-150, 250)


def write_joint(folder: Path, record: Record) -> list[Path]:
    """Table, words and figure, named after the experiment."""
    return write_study(folder, record, _table(record), _words(record), joint_figure(record))
