"""How far moduli may be believed, by where the valve comes from, with the targets that are missed.

Errors and intervals are those of estimates that may be stated. The bias is that of all estimates,
so that a verdict cannot hide it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.records.record import Record
from experiments.results.published import records_of
from experiments.results.renewal import chosen, status_of
from mvest.problem.record import EstimateRecord
from mvest.problem.verdict import TRUSTWORTHY
from mvest.reporting.skill import GENERIC, log_width, skill, stated, trust_of
from mvest.reporting.tables import Column, Table, table

REFERENCE = "reference"  # scenario without a wrong assumption
LEAFLETS = ("anterior", "posterior")
FEWEST = 20  # trusted intervals by which their share and width are judged


@dataclass(frozen=True, slots=True)
class Mode:
    """A way of use, and the published runs that show how good it is."""

    name: str
    study: str  # of which they are, as `mvest results` names it
    takes: Callable[[Record], bool] = lambda record: True

    def runs(self, results: Path) -> list[tuple[Record, EstimateRecord]]:
        """Its records and estimates."""
        (one,) = (one for one in chosen([self.study]) if one.name == self.study)
        kept = records_of(results, one.table)
        found = [run for run in kept.estimates if run[0].experiment == one.values["name"]]
        return [run for run in found if self.takes(run[0])]

    def is_stale(self, results: Path) -> bool:
        """Whether a record that it is judged by is not of today."""
        return any(status_of(one, results).stale for one in chosen([self.study]))


MODES = (
    Mode("known geometry", "population"),
    Mode("volume", "volumes"),
    Mode("surfaces", "surfaces", lambda one: one.numbers["kind"] == "surfaces"),
    Mode("SlicerHeart", "surfaces", lambda one: one.numbers["kind"] == "slicerheart"),
    Mode("label maps", "surfaces", lambda one: one.numbers["kind"] == "labels"),
    Mode("wrong assumptions", "calibration", lambda one: one.numbers["scenario"] != REFERENCE),
    Mode("five patients", "patients"),
    Mode("Table 1", "table1_independent"),
)
"""All valves are simulated; the geometry of the last three is known."""


@dataclass(frozen=True, slots=True)
class Target:
    """A range that a column of `believed` has to lie in."""

    column: str
    low: float
    high: float
    text: str  # of a value that does not

    def misses(self, row: dict[str, Any]) -> str:
        """What is said of a row that misses it; empty if it is met or cannot be judged."""
        value = row[self.column]
        met = value is None or self.low <= value <= self.high
        return "" if met else self.text.format(value, **row)


TARGETS = (
    Target("error over guess", 0, 0.5, "median error {0:.2f} of the guess's (at most 0.5)"),
    *(
        Target(
            f"{leaflet} in SE",
            -2,
            2,
            f"{leaflet} moduli off by {{{leaflet} off:+.0f}} ± {{{leaflet} off SE:.0f}} % "
            "on average (within two standard errors)",
        )
        for leaflet in LEAFLETS
    ),
    Target("judged coverage", 90, 98, "{0:.0f} % of trusted intervals hold (90 to 98 %)"),
    Target("judged square", 0.8, 1.25, "mean square of trusted errors {0:.2f} (0.8 to 1.25)"),
    Target("lost", 0, 4 / 60, "{without} of {n} without an estimate (at most 4 of 60)"),
)
"""What is wanted of every mode."""


@cache
def believed(results: Path) -> Table:
    """A row for each mode of use, the one that misses most targets first."""
    rows = [row for mode in MODES if (row := _row(mode.name, mode.runs(results)))]
    rows.sort(key=lambda row: (-len(missed(row)), -(row["error over guess"] or 0.0)))
    whole, hidden = Column("%", ".0f"), Column(hidden=True)
    about = {
        "mode": Column(label="from"),
        "patients": Column(),
        "n": Column(label="estimates"),
        "median error": Column("%", ".0f", label="error"),
        "guess": whole,
        "ratio": Column("%", ".0f", label="ratio's error"),
        "ratio's guess": whole,
        **{
            f"bias {leaflet}": Column(digits=".2f", std=f"SE {leaflet}", label=f"{leaflet} bias")
            for leaflet in LEAFLETS
        },
        "coverage": Column("%", ".0f", "", "coverage low", "coverage high", label="inside"),
        "mean square": Column(digits=".2f"),
        "trusted": whole,
        "without": Column(label="none"),
        "minutes": Column("min", ".1f", label="CPU"),
    }
    others = {name for row in rows for name in row} - set(about)
    return table(rows, **about, **dict.fromkeys(sorted(others), hidden))


def missed(row: dict[str, Any]) -> list[str]:
    """The targets that a row misses, each in words."""
    return [text for target in TARGETS if (text := target.misses(row))]


def _row(mode: str, runs: Sequence[tuple[Record, EstimateRecord]]) -> dict[str, Any]:
    estimates = [estimate for _, estimate in runs]
    moduli = [own for one in estimates for own in stated(one) if own.is_modulus]
    if not moduli:
        return {}
    trusted = [one for one in estimates if trust_of(one) == TRUSTWORTHY]
    every = skill(moduli)
    good = skill(found) if (found := [own for one in trusted for own in one.moduli]) else {}
    seconds = [one.seconds or run.numbers.get("cpu_s") or run.seconds_total for run, one in runs]
    guess, median = every[GENERIC], every["median error"]
    judged = good.get("n", 0) >= FEWEST
    widths = [width for own in moduli if np.isfinite(width := log_width(own))]
    lost = sum(not one.is_stated for one in estimates)
    ratios = [_ratio_errors(one) for one in estimates if one.is_stated]
    error, guessed = np.median(ratios, axis=0) if ratios else (None, None)
    row = {
        "mode": mode,
        "patients": len({run.provenance.seed for run, _ in runs}),
        "n": len(estimates),
        "median error": median,
        "guess": guess,
        "error over guess": None if median is None else median / guess,
        "ratio": error,
        "ratio's guess": guessed,
        **{key: good.get(key) for key in ("coverage", "coverage low", "coverage high")},
        "mean square": good.get("mean square"),
        "judged coverage": good["coverage"] if judged else None,
        "judged square": good["mean square"] if judged else None,
        "intervals": good.get("n", 0),
        "inside": good.get("inside", 0),
        "factor": float(np.exp(np.median(widths) / 2)) if widths else None,
        "trusted": 100.0 * len(trusted) / len(estimates) if _is_judged(estimates) else None,
        "without": lost,
        "lost": lost / len(estimates),
        "minutes": float(np.median(np.array(seconds, dtype=float))) / 60.0,
    }
    for leaflet in LEAFLETS:
        bias, error = _bias(runs, f"E_f.{leaflet}")
        row |= {f"bias {leaflet}": bias, f"SE {leaflet}": error}
        row[f"{leaflet} in SE"] = bias / error if bias is not None and error else None
        row[f"{leaflet} off"] = None if bias is None else 100.0 * float(np.expm1(bias))
        row[f"{leaflet} off SE"] = None if error is None else 100.0 * error
    return row


def _is_judged(estimates: Sequence[EstimateRecord]) -> bool:
    return any(one.verdict is not None for one in estimates)


def _ratio_errors(estimate: EstimateRecord) -> tuple[float, float]:
    """Errors (%) of the ratio of both moduli, and of the generic guess's ratio."""
    one, other = (estimate.unknown(f"E_f.{leaflet}") for leaflet in LEAFLETS)
    pairs = [(one.estimate, other.estimate), (one.prior_mean, other.prior_mean)]
    ratios = np.array([[*pair] for pair in [*pairs, (one.truth, other.truth)]], dtype=float)
    found = ratios[:, 0] / ratios[:, 1]
    errors = 100.0 * np.abs(found[:2] / found[2] - 1.0)
    return float(errors[0]), float(errors[1])


def _bias(
    runs: Sequence[tuple[Record, EstimateRecord]], name: str
) -> tuple[float | None, float | None]:
    """Mean error of a modulus's logarithm and its standard error.

    The runs of one patient are averaged first, because their errors are not independent.
    """
    errors: dict[int, list[float]] = {}
    for run, estimate in runs:
        own = {one.name: one for one in estimate.moduli}.get(name)
        if own is not None and own.estimate is not None and own.truth:
            log = float(np.log(own.estimate / own.truth))
            errors.setdefault(run.provenance.seed, []).append(log)
    means = np.array([np.mean(each) for each in errors.values()])
    if not means.size:
        return None, None
    spread = float(means.std(ddof=1) / np.sqrt(means.size)) if means.size > 1 else None
    return float(means.mean()), spread
