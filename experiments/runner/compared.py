"""What runs are compared by: the numbers of a record, and the settings that differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from experiments.common.config import is_hashed
from experiments.common.records.record import Record
from experiments.sweeps.collected import short_names

Values = Mapping[str, Any]

HANDFUL = (
    "study", "valve.folder_sha256", "mesh.source", "mechanics.element", "filter.mode",
    "truth.label", "observation.noise_mm", "seed",
)  # fmt: skip
"""Settings that every run shows, typed or not."""

LARGEST_ERROR = 1.0
"""Relative error of a modulus beyond which an estimate is no answer."""


def metrics(record: Record) -> dict[str, float]:
    """Name -> number, the mean error (%) first.

    Of a job that repeats over seeds these are means over the estimates that converged, and
    ``spread`` is their standard deviation.
    """
    runs = record.estimates
    short = dict(zip(record.parameters, short_names(record.parameters), strict=True))
    pairs: list[tuple[str, float | None]] = []
    for run in (run for run in runs if run.converged):
        for one in (one for one in run.unknowns if one.name in short):
            name, error = short[one.name], one.relative_error
            percent = None if error is None else 100.0 * abs(error)
            pairs += [("error.mean", percent), (f"error.{name}", percent)]
            pairs += [(f"estimate.{name}", one.estimate), (f"std.{name}", one.std)]
        for key, far in ("distance", run.distance_mm), ("distance_truth", run.distance_to_truth_mm):
            pairs += [(f"{key}.mean", far.mean), (f"{key}.max", far.max)] if far else []
        pairs += [("nis", run.innovation.nis)] if run.innovation else []
    pairs += [("iterations", run.iterations or 0) for run in runs]
    series: dict[str, list[float]] = {}
    for key, value in pairs:
        series.setdefault(key, []).extend([] if value is None else [value])
    found = {key: fmean(values) for key, values in series.items() if values}
    for name in short.values():
        if len(values := series.get(f"estimate.{name}", [])) > 1:
            found[f"spread.{name}"] = stdev(values)
    numbers = {"forward_solves": record.forward_solves, **record.numbers}
    if runs:
        numbers["failed"] = sum(not run.converged for run in runs)
        numbers["seconds"] = sum(run.seconds or 0.0 for run in runs)
    return found | {k: float(v) for k, v in numbers.items() if isinstance(v, int | float)}


def implausible(record: Record) -> str:
    """Why a run is left out of comparisons; empty if it is not.

    It failed, its verdict is that there is no estimate, or a modulus is wrong by more than its
    truth, where that is known.
    """
    if not record.converged:
        return "failed"
    for one in (one for one in record.estimates if one.converged):
        if not one.is_stated:
            return "the verdict is that there is no estimate"
        for unknown in one.moduli:
            if (error := abs(unknown.relative_error or 0.0)) > LARGEST_ERROR:
                return f"{unknown.name} is wrong by {error:.0%} of the truth"
    return ""


def settings_of(config: Values, overrides: Iterable[str]) -> dict[str, Any]:
    """The settings of a run that were typed, as they were typed, and the handful.

    Parameters
    ----------
    config : mapping
        As it lies beside the result: the content of a file instead of its name, which must not
        reach a store.
    overrides : iterable of str
        ``NAME=VALUE``.
    """
    words = (word.lstrip("+~").partition("=") for word in overrides)
    typed = {name.replace("/", "."): text for name, _, text in words if name != "name"}
    found: dict[str, Any] = {}
    for name in (*typed, *HANDFUL):
        value: Any = config
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, Mapping | list) and "sha256" not in str(value):
            value = typed[name]
        if value not in (None, "") and is_hashed(name, config["study"]):
            found[name] = value
    return found


def varied(rows: Sequence[Values], factors: Sequence[Values]) -> list[dict[str, Any]]:
    """Of the columns of jobs those that differ, and the handful; factors that no column repeats."""
    shown: dict[str, list[Any]] = {}
    for source in (rows, factors):
        for name in dict.fromkeys(name for row in source for name in row):
            values = [row.get(name) for row in source]
            differs = name in HANDFUL or len(rows) == 1 or len(set(map(repr, values))) > 1
            if differs and (source is rows or values not in shown.values()):
                shown[name] = values
    return [{name: values[k] for name, values in shown.items()} for k in range(len(rows))]


def together(rows: Sequence[Values]) -> dict[str, str]:
    """The values that settings have in a sweep: ``[5,3],[4,2]``."""
    names = dict.fromkeys(name for row in rows for name in row)
    each = {name: [text_of(row[name]) for row in rows if name in row] for name in names}
    return {name: ",".join(dict.fromkeys(texts)) for name, texts in each.items()}


def text_of(value: Any) -> str:
    """A value as it is typed."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)
