"""Filters compared: a table of what each finds and costs, and a figure of their posteriors."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.findings import Vector
from experiments.common.records.record import Model, Record
from experiments.common.records.report import axis_label, write_each
from experiments.studies.filters.findings import Estimated, Findings, Problem
from mvest.reporting.style import BAD, GOOD, SMALL, headline, panels

__all__ = [
    "REFERENCE",
    "filters_answer",
    "filters_figure",
    "filters_table",
    "filters_words",
    "write_filters",
]

REFERENCE = "monte_carlo"
"""The filter with which all others are compared."""

TARGET = 0.1
"""Largest difference of an interval's width from that of Monte Carlo where this is near normal."""

NEAR_NORMAL = 0.25
"""Largest skewness of the draws of a posterior that is near normal."""

LABELS = {
    "paper": "paper's (cycled)",
    "extended": "extended, one update",
    "iterated": "iterated extended",
    "unscented": "unscented, iterated",
    "ensemble": "ensemble, one update",
    "perturbed": "ensemble, perturbed",
    "smoother": "ensemble smoother",
    "importance": "importance sampling",
    REFERENCE: "Monte Carlo",
}


def _label(method: str) -> str:
    return LABELS.get(method, method)


def filters_table(findings: Findings) -> pd.DataFrame:
    """One row for each problem, filter and parameter."""
    rows = []
    for problem in findings.problems:
        reference = problem.filters[REFERENCE]
        assert reference.skewness is not None
        for method, estimated in problem.filters.items():
            repeats, check = problem.repeats[method], estimated.check
            for k, parameter in enumerate(problem.parameters):
                ends, own = (np.log(one.interval(k)) for one in (reference, estimated))
                width = ends[1] - ends[0]
                off = 100 * (own - ends) / width
                rows.append(
                    {
                        "problem": problem.name,
                        "filter": method,
                        "parameter": parameter,
                        "truth": problem.truth[k],
                        "estimate": estimated.estimate[k],
                        "low": estimated.low[k],
                        "high": estimated.high[k],
                        "error_percent": 100 * (estimated.estimate[k] / problem.truth[k] - 1),
                        "width_ratio": (own[1] - own[0]) / width,
                        "lower_end_off_percent": off[0],
                        "upper_end_off_percent": off[1],
                        "shift_in_std": (estimated.log_mean[k] - reference.log_mean[k])
                        / reference.log_std[k],
                        "skewness": reference.skewness[k],
                        "repeats": repeats.runs,
                        "failed": repeats.failed,
                        "coverage": _of(repeats.coverage, k),
                        "rms_error_percent": 100 * _of(repeats.log_rms_error, k),
                        "repeats_width_ratio": _of(repeats.width_ratio, k),
                        "forward_solves": estimated.forward_solves,
                        "cpu_seconds": estimated.seconds,
                        "model_seconds": estimated.model_seconds,
                        "check": None if check is None else check.value,
                        "check_limit": None if check is None else check.limit,
                        "check_runs": None if check is None else check.extra_runs,
                        "ended": estimated.reason,
                        "detail": estimated.detail,
                    }
                )
    return pd.DataFrame(rows)


def _of(values: Vector | None, k: int) -> float:
    return float("nan") if values is None else values[k]


def filters_words(record: Record[Findings]) -> str:
    """Markdown: one table for each problem, and the words around them."""
    table = filters_table(record.findings)
    parts = []
    for problem in record.findings.problems:
        parts += [_problem_text(problem, table[table["problem"] == problem.name]), ""]
    return "\n".join([*parts, _conclusion(table), "", _notes(record.model)])


def _problem_text(problem: Problem, table: pd.DataFrame) -> str:
    parameters, surrogate = problem.parameters, problem.surrogate
    truth = ", ".join(f"{n} {v:g}" for n, v in zip(parameters, problem.truth, strict=True))
    prior = ", ".join(
        f"{n} {v:g} (± {100 * s:.0f} %)"
        for n, v, s in zip(parameters, problem.initial, problem.log_std, strict=True)
    )
    lines = [
        f"## {problem.title}",
        "",
        f"Truth: {truth}. Prior: {prior}. {problem.observations} coordinates of the closed "
        f"valve with errors of {problem.noise_mm:g} mm. {problem.about}".strip(),
        "",
        "| filter | error (%) | width of the 95 % interval over that of Monte Carlo | its ends "
        "against those of Monte Carlo (% of the width) | "
        f"coverage of 95 % intervals, {table['repeats'].iloc[0]} repeats | RMS error of the "
        "repeats (%) | runs of the model | CPU time (s) | its own check, and the limit | ended |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method, rows in table.groupby("filter", sort=False):
        first = rows.iloc[0]
        ended = str(first["ended"]).partition(":")[0]
        if first["failed"]:
            ended += f"; {first['failed']} of {first['repeats']} repeats failed"
        lines.append(
            f"| {_label(str(method))} | {_list(rows['error_percent'], '+.1f')} | "
            f"{_list(rows['width_ratio'], '.2f')} | {_ends(rows)} | "
            f"{_list(100 * rows['coverage'], '.0f')} % | "
            f"{_list(rows['rms_error_percent'], '.1f')} | {first['forward_solves']} | "
            f"{first['cpu_seconds']:.0f} | {_check(first)} | {ended} |"
        )
    reference = table[table["filter"] == REFERENCE]
    lines += [
        "",
        f"Numbers of {', '.join(parameters)}, in this order. Skewness of the posterior: "
        f"{_list(reference['skewness'], '.2f')}. Monte Carlo: "
        f"{reference['detail'].iloc[0]}. Surrogate of the repeats: degree {surrogate.degree}, "
        f"fitted to {surrogate.runs} runs and their derivatives; error of a coordinate over "
        f"{surrogate.held_out} further runs {surrogate.rms_mm:.2g} mm RMS, at most "
        f"{surrogate.largest_mm:.2g} mm.",
    ]
    return "\n".join(lines)


def _check(row: pd.Series) -> str:
    """What a filter found when it compared its posterior with runs of the model."""
    value, limit = row["check"], row["check_limit"]
    if pd.isna(value):
        return "none"
    return f"{value:.2g} of {limit:g}" + ("" if value <= limit else ": **fails**")


def _ends(rows: pd.DataFrame) -> str:
    pairs = zip(rows["lower_end_off_percent"], rows["upper_end_off_percent"], strict=True)
    return ", ".join(f"{low:+.0f} / {high:+.0f}" for low, high in pairs)


def _list(values: pd.Series, form: str) -> str:
    return ", ".join("–" if pd.isna(v) else format(v, form) for v in values)


def _conclusion(table: pd.DataFrame) -> str:
    """Which intervals are within the target of Monte Carlo's, where that is near normal."""
    lines = [
        "## Gaussian intervals against Monte Carlo",
        "",
        f"A posterior counts as near normal where the skewness of its draws is at most "
        f"{NEAR_NORMAL:g}; there a Gaussian interval should be as wide as that of Monte Carlo to "
        f"{100 * TARGET:.0f} %.",
        "",
        "| filter | near normal: within the target | largest difference | elsewhere: within | "
        "largest difference |",
        "|---|---|---|---|---|",
    ]
    others = table[table["filter"] != REFERENCE]
    for method, rows in others.groupby("filter", sort=False):
        near = rows["skewness"].abs() <= NEAR_NORMAL
        cells = [_within(rows[near]["width_ratio"]), _within(rows[~near]["width_ratio"])]
        lines.append(f"| {_label(str(method))} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _within(ratios: pd.Series) -> str:
    if ratios.empty:
        return "– | –"
    off = (ratios - 1).abs()
    return f"{int((off <= TARGET).sum())} of {len(ratios)} | {100 * off.max():.0f} %"


def _notes(model: Model | None) -> str:
    assert model is not None
    return (
        "Simulated. Unknowns are estimated by their logarithms. Errors, widths, runs and CPU time "
        "are of one observation that all filters were given, with the finite-element model itself "
        f"({model.element}, {' x '.join(map(str, model.cells))} cells), "
        "each filter starting from the open valve; every run of the model computes its "
        "derivatives, also for filters that do not read them. Coverage and RMS errors are of "
        "repeats in each of which the truth is drawn from the prior, with a surrogate in the place "
        "of the model; there the Monte Carlo posterior covers 95 % but for chance. The paper's "
        "filter counts the observation in each round and adds process noise, here as large as the "
        "prior: its covariance is not that of a posterior. The own check compares what a filter "
        "took the posterior for with runs of the model (`mvest.estimation.check`); where it fails, "
        "the run says so in its reason, and the filter `importance` is the judge."
    )


def _width_off(problem: Problem, method: str, k: int) -> float:
    """Relative difference of the width of an interval from that of Monte Carlo."""
    own, reference = (np.ptp(np.log(problem.filters[m].interval(k))) for m in (method, REFERENCE))
    return float(own / reference - 1)


def _as_wide(findings: Findings) -> dict[str, tuple[int, int]]:
    """Filter -> unknowns whose interval is as wide as that of Monte Carlo, and all unknowns."""
    counts: dict[str, tuple[int, int]] = {}
    for problem in findings.problems:
        for method in problem.filters:
            off = [_width_off(problem, method, k) for k in range(len(problem.parameters))]
            right, of = counts.get(method, (0, 0))
            counts[method] = right + sum(abs(v) <= TARGET for v in off), of + len(off)
    del counts[REFERENCE]
    return counts


def filters_answer(findings: Findings) -> str:
    """Which filters are as sure as they should be."""
    best = [_label(m) for m, (right, of) in _as_wide(findings).items() if right == of]
    return f"As wide as Monte Carlo everywhere: {' and '.join(best) or 'no filter'}"


def filters_figure(findings: Findings) -> Figure:
    """95 % interval that each filter gives each unknown, on that of Monte Carlo."""
    unknowns = [(p, k) for p in findings.problems for k in range(len(p.parameters))]
    counted = _as_wide(findings)
    methods = list(counted)
    figure, grid = panels(1, len(unknowns), 0.32 * len(methods) + 2.7, sharey=True)
    for axes, (problem, k) in zip(grid[0], unknowns, strict=True):
        by = problem.filters[REFERENCE]
        reference = _in_std(by, by.interval(k), k)
        axes.axvspan(*reference, color="0.88")
        (truth,) = _in_std(by, (problem.truth[k],), k)
        axes.axvline(truth, color="black", linewidth=1.0)
        for row, method in enumerate(methods):
            if method not in problem.filters:
                continue
            low, high = _in_std(by, problem.filters[method].interval(k), k)
            off = _width_off(problem, method, k)
            is_right = abs(off) <= TARGET
            colour = GOOD if is_right else BAD
            axes.plot([low, high], [row, row], color=colour, linewidth=2.2)
            axes.plot((low + high) / 2, row, marker="o", markersize=4, color=colour)
            if not is_right:
                axes.annotate(
                    f"{100 * off:+.0f} %", ((low + high) / 2, row), (0, 4), ha="center",
                    textcoords="offset points", fontsize=SMALL - 1.5, color=colour,
                )  # fmt: skip
        axes.set_xlim(min(-4.2, truth - 0.5), max(4.2, truth + 0.5))
        axes.set_xticks([-2, 0, 2])
        axes.grid(visible=False, axis="y")
        name = problem.parameters[k]
        axes.set_title(textwrap.fill(axis_label(name), 14), fontsize=SMALL)
        axes.set_xlabel(textwrap.fill(problem.title, 14), fontsize=SMALL - 0.5)
    labels = [f"{_label(m)}, {right} of {of}" for m, (right, of) in counted.items()]
    grid[0, 0].set_yticks(range(len(methods)), labels)
    grid[0, 0].set_ylim(len(methods) - 0.4, -0.7)
    headline(
        figure,
        filters_answer(findings),
        f"95 % intervals in standard deviations from the mean of Monte Carlo (grey: its own). "
        f"Blue: width within {100 * TARGET:.0f} %;\norange: not, with the difference. Black: "
        "truth. Names: number of unknowns within. Simulated.",
    )
    return figure


def _in_std(reference: Estimated, values: Sequence[float], k: int) -> list[float]:
    """Logarithms of values of one unknown, in deviations of Monte Carlo from its mean."""
    z = (np.log(values) - reference.log_mean[k]) / reference.log_std[k]
    return [float(value) for value in z]


write_filters = write_each(
    lambda record: filters_table(record.findings),
    filters_words,
    lambda record: filters_figure(record.findings),
)
"""``filters.csv``, ``filters.md`` and the figure."""
