"""Tables and plot of ``make bench``: ``python -m tests.benchmark.report FILE.json ...``.

Writes ``benchmark.csv``, ``.md`` and ``.png`` to ``results/``. Seconds depend on the machine and on
its load. Compare the time over a calibration kernel that ran in the same process, and its ratio to
the stored baseline, ``results/benchmark_baseline.csv`` (copy ``benchmark.csv`` there to set it).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mvest.files import write_atomically
from tests.places import ROOT
from tests.tables import markdown, write_text

KEY = ["what", "element", "size", "parameters", "points", "threads"]
DRAWN = {
    "closure": "o", "guided closure": "P", "tangent": "s", "factorisation": "^", "solve": "D",
    "contact search": "v",
}  # fmt: skip
ABOUT = (
    "Median seconds of the rounds in one process, and the same over a calibration kernel of that "
    "process: seconds of the CPU with one thread, of the clock with two and for batches. A closure "
    "starts from the open valve and ends in equilibrium; `parameters` counts the derivatives that "
    "it carries."
)


def benchmark_table(
    runs: Sequence[Mapping[str, Any]], baseline: pd.DataFrame | None = None
) -> pd.DataFrame:
    """One row for each benchmark of pytest-benchmark's reports, over an earlier table if given."""
    entries = [(entry["stats"], entry["extra_info"]) for run in runs for entry in run["benchmarks"]]
    table = pd.DataFrame(
        {
            **{name: extra.get(name) for name in (*KEY[:3], "nodes", *KEY[3:])},
            "rounds": stats["rounds"],
            "seconds": stats["median"],
            "over calibration": stats["median"] / extra["calibration"],
            "peak memory [MB]": extra.get("peak_mb"),
        }
        for stats, extra in entries
    )
    if baseline is not None:
        old = baseline[[*KEY, "over calibration"]].rename(columns={"over calibration": "old"})
        both = table[KEY].astype(old[KEY].dtypes).merge(old, how="left", on=KEY)
        table["of baseline"] = table["over calibration"] / both["old"].to_numpy()
    return table


def _sized(table: pd.DataFrame) -> Any:
    """Groups of one kernel and element, with two parameters if any, on one thread."""
    alike = table["parameters"].isna() | (table["parameters"] == 2)
    chosen = table[table["nodes"].notna() & (table["threads"] == 1) & alike]
    groups = chosen.sort_values("nodes").groupby(["what", "element"])
    return [(what, element, group) for (what, element), group in groups if len(group) > 1]


def fitted_orders(table: pd.DataFrame) -> pd.DataFrame:
    """Exponent of the nodes in the time, fitted over the sizes, for each kernel and element."""
    return pd.DataFrame(
        {"what": what, "element": element,
         "order": np.polyfit(np.log(group["nodes"]), np.log(group["seconds"]), 1)[0]}
        for what, element, group in _sized(table)
    )  # fmt: skip


def draw(table: pd.DataFrame) -> Any:
    """Time against nodes, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    for what, element, group in _sized(table):
        if what in DRAWN:
            style = {"marker": DRAWN[what], "color": {"hex18": "C0"}.get(element, "C1")}
            axes.loglog(group["nodes"], group["seconds"], label=f"{what}, {element}", **style)
    axes.set(xlabel="nodes", ylabel="seconds, one thread")
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize=7)
    return figure


def shown(rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> str:
    """A table in Markdown, three digits."""
    table = pd.DataFrame(rows).convert_dtypes()
    return markdown(table.map(lambda v: f"{v:.3g}" if isinstance(v, float) else v))


def main(files: Sequence[str], results: Path = ROOT / "results") -> None:
    """Write table and plot of the named reports."""
    contents = [json.loads(Path(file).read_text(encoding="utf-8")) for file in files]
    peers = [row for content in contents for row in content.get("rows", ())]
    stored = results / "benchmark_baseline.csv"
    table = benchmark_table(
        [content for content in contents if "benchmarks" in content],
        pd.read_csv(stored) if stored.is_file() else None,
    )
    parts = ["# Benchmark", ABOUT, shown(table)]
    parts += ["## Order of the time in the number of nodes", shown(fitted_orders(table))]
    parts += ["## The same pressurised sheet elsewhere", shown(peers)] if peers else []
    write_atomically(results / "benchmark.csv", table.to_csv(index=False))
    write_text(results / "benchmark.md", *parts)
    write_atomically(results / "benchmark.png", lambda part: draw(table).savefig(part, dpi=150))


if __name__ == "__main__":
    main(sys.argv[1:])
