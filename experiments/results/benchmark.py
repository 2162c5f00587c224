"""Table and plot of a benchmark: ``python -m experiments.results.benchmark REPORT.json ...``.

Reads what ``make bench`` has measured (kernels and closures, other libraries, the profile of a
closure) and writes ``benchmark.csv``, ``.md`` and ``.png`` to
``results/``. Seconds depend on the machine and on what else it does; the column to compare is the
time over a calibration kernel that ran in the same process, and its ratio to the stored baseline,
``results/benchmark_baseline.csv`` (copy ``benchmark.csv`` there to set a new one).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from mvest.errors import InputError, MvestError
from mvest.files import write_atomically
from mvest.reading.json_file import read_mapping

__all__ = ["benchmark_figure", "benchmark_table", "fitted_orders", "main"]

KEY = ["what", "element", "size", "parameters", "points", "threads"]
COLOURS = {"hex18": "#0072B2", "tet4": "#D55E00"}
DRAWN = {
    "closure": "o",
    "guided closure": "P",
    "tangent": "s",
    "factorisation": "^",
    "solve": "D",
    "contact search": "v",
}


def benchmark_table(
    runs: Sequence[Mapping[str, Any]], baseline: pd.DataFrame | None
) -> pd.DataFrame:
    """One row for each benchmark of the given pytest-benchmark reports.

    Parameters
    ----------
    runs : sequence of mapping
        Contents of the reports.
    baseline : DataFrame or None
        An earlier table; its calibrated times are what ``of baseline`` divides by.
    """
    rows = []
    for run in runs:
        for entry in run["benchmarks"]:
            extra = entry["extra_info"]
            name = entry["name"].partition("[")[0].removeprefix("test_").replace("_", " ")
            median = entry["stats"]["median"]
            rows.append(
                {
                    "what": name,
                    "element": extra.get("element", ""),
                    "size": extra.get("size", ""),
                    "nodes": extra.get("nodes"),
                    "parameters": extra.get("parameters"),
                    "points": extra.get("points"),
                    "threads": extra["threads"],
                    "rounds": entry["stats"]["rounds"],
                    "seconds": median,
                    "over calibration": median / extra["calibration"],
                    "peak memory [MB]": extra.get("peak_mb"),
                }
            )
    table = pd.DataFrame(rows)
    if baseline is not None:
        old = baseline.set_index(_keys(baseline))["over calibration"]
        new = table.set_index(_keys(table))["over calibration"]
        table["of baseline"] = (new / old.reindex(new.index)).to_numpy()
    return table


def _keys(table: pd.DataFrame) -> pd.Series[str]:
    """One text for each row that says what was measured, the same after a journey through CSV."""

    def text(value: object) -> str:
        if value is None or value != value:
            return ""
        return f"{value:g}" if isinstance(value, int | float) else str(value)

    return table[KEY].map(text).agg("/".join, axis=1)


def fitted_orders(table: pd.DataFrame) -> pd.DataFrame:
    """Exponent of the nodes in the time, fitted over the sizes, for each kernel and element."""
    rows = []
    sized = table[table["nodes"].notna() & (table["threads"] == 1)]
    for (what, element), group in sized.groupby(["what", "element"]):
        group = group[group["parameters"].isna() | (group["parameters"] == 2)]
        if group["nodes"].nunique() > 1:
            slope = np.polyfit(np.log(group["nodes"]), np.log(group["seconds"]), 1)[0]
            rows.append({"what": what, "element": element, "order": float(slope)})
    return pd.DataFrame(rows)


def benchmark_figure(table: pd.DataFrame) -> Figure:
    """Time against nodes, both logarithmic, with the fitted order."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    for what, element, order in fitted_orders(table).itertuples(index=False, name=None):
        if what not in DRAWN:
            continue
        group = table[(table["what"] == what) & (table["element"] == element)]
        group = group[(group["parameters"].isna() | (group["parameters"] == 2))]
        group = group[group["threads"] == 1].sort_values("nodes")
        axes.loglog(
            group["nodes"],
            group["seconds"],
            color=COLOURS.get(element, "#009E73"),
            marker=DRAWN[what],
            label=f"{what}, {element}: order {order:.2f}",
        )
    axes.set_xlabel("nodes")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("seconds, one thread")
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize=7)
    return figure


def _readable(table: pd.DataFrame) -> str:
    """Markdown of a table, three digits, empty where there is no value."""

    def text(value: object) -> str:
        if value is None or value == "" or (isinstance(value, float) and np.isnan(value)):
            return ""
        if isinstance(value, float):
            return f"{value:.0f}" if value.is_integer() and abs(value) < 1e6 else f"{value:.3g}"
        return str(value)

    lines = ["| " + " | ".join(table.columns) + " |", "|" + " --- |" * len(table.columns)]
    lines += [
        "| " + " | ".join(text(v) for v in row) + " |"
        for row in table.itertuples(index=False, name=None)
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None, results: Path = Path("results")) -> int:
    """Write table and plot of the named reports; returns the exit status."""
    given = [Path(a) for a in (sys.argv[1:] if arguments is None else arguments)]
    if not given:
        print("usage: python -m experiments.results.benchmark RUN.json ...", file=sys.stderr)
        return 2
    try:
        contents = [read_mapping(path) for path in given]
        runs = [c for c in contents if "benchmarks" in c]
        peers = [row for c in contents if "rows" in c for row in c["rows"]]
        if not runs:
            raise InputError("none of the files is a report of pytest-benchmark")
        stored = results / "benchmark_baseline.csv"
        table = benchmark_table(runs, pd.read_csv(stored) if stored.is_file() else None)
        parts = [
            "# Benchmark",
            "Median seconds of the rounds in one process, and the same over a calibration kernel "
            "of that process: seconds of the CPU with one thread, of the clock with two and for "
            "batches. A closure starts from the open valve and ends in equilibrium; `parameters` "
            "counts the derivatives that it carries.",
            _readable(table),
            "## Order of the time in the number of nodes",
            _readable(fitted_orders(table)),
        ]
        starts = [row for c in contents for row in c.get("startup", [])]
        if starts:
            parts += [
                "## Until something begins",
                "Least CPU seconds of some processes, with warm caches.",
                _readable(pd.DataFrame(starts)),
            ]
        parts += [_profile(entry) for c in contents for entry in c.get("profile", [])]
        if peers:
            parts += ["## The same pressurised sheet elsewhere", _readable(pd.DataFrame(peers))]
        written = [
            write_atomically(results / "benchmark.csv", lambda p: table.to_csv(p, index=False)),
            write_atomically(results / "benchmark.md", "\n\n".join(parts) + "\n"),
            write_atomically(
                results / "benchmark.png", lambda p: benchmark_figure(table).savefig(p, dpi=150)
            ),
        ]
        for path in written:
            print(path)
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _profile(entry: Mapping[str, Any]) -> str:
    """Where the time of a closure went, and what its largest parts reached of the machine."""
    total = entry["seconds"]
    parts = pd.DataFrame(
        [
            {"part": name, "seconds": seconds, "share [%]": 100.0 * seconds / total}
            for name, seconds in sorted(entry["parts"].items(), key=lambda item: -item[1])
        ]
    )
    bounds = pd.DataFrame(
        [
            {
                "what": row["what"],
                "reached": row["reached"],
                "of what this machine can do": row["machine"],
                "unit": row["bound by"],
            }
            for row in entry["bounds"]
        ]
    )
    return "\n\n".join(
        [
            f"## Where the time of a {entry['closure']} closure goes: {entry['nodes']} nodes",
            f"{total:.1f} s of the CPU with two derivatives, guides included; "
            f"{entry['iterations on the finest mesh']} Newton iterations on the finest mesh, "
            f"{entry['factorisations']} factorisations and {entry['evaluations']} evaluations.",
            _readable(parts),
            "What bounds its parts, one thread (dense products for arithmetic, a long vector sum "
            "for memory):",
            _readable(bounds),
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
