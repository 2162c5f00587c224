"""What runs are compared by: the numbers of a record, and the settings that tell jobs apart."""

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
    """Why a run is not to be compared with others; empty if it is.

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


def typed(overrides: Iterable[str]) -> list[str]:
    """Names of settings that were typed (``NAME=VALUE``), each once."""
    names = (word.lstrip("+~").partition("=")[0].replace("/", ".") for word in overrides)
    return list(dict.fromkeys(name for name in names if name != "name"))


def columns(config: Values, words: Iterable[str]) -> dict[str, Any]:
    """The settings of a run that were typed, and the handful: a column for each value.

    Parameters
    ----------
    config : mapping
        As it lies beside the result: without a name of a file, which must not reach a store.
    words : iterable of str
        Dotted names; of one that has settings below it all are meant.
    """
    chosen = tuple(f"{word}." for word in (*words, *HANDFUL))
    return {
        name: value
        for name, value in leaves(config, config["parameters"]).items()
        if f"{name}.".startswith(chosen) and is_hashed(name, config["study"])
    }


def leaves(value: Any, parameters: Sequence[str], name: str = "") -> dict[str, Any]:
    """Single values by dotted names; of a list by its parameters, of a matrix the diagonal."""
    if isinstance(value, list):
        names = short_names(parameters) if len(value) == len(parameters) else range(len(value))
        square = all(isinstance(item, list) and len(item) == len(value) for item in value)
        value = [row[k] for k, row in enumerate(value)] if square else value
        value = dict(zip(names, value, strict=True))
    if not isinstance(value, Mapping):
        return {} if value in (None, "") else {name: value}
    found: dict[str, Any] = {}
    for key, item in value.items():
        found |= leaves(item, parameters, f"{name}.{key}" if name else str(key))
    return found


def varied(rows: Sequence[Values], factors: Sequence[Values]) -> list[dict[str, Any]]:
    """Of the columns of jobs those that differ, and the handful; factors that no column repeats."""
    kept: dict[str, list[Any]] = {}
    for source in (rows, factors):
        for name in dict.fromkeys(name for row in source for name in row):
            values = [row.get(name) for row in source]
            shown = name in HANDFUL or len(rows) == 1 or len(set(map(repr, values))) > 1
            if shown and (source is rows or values not in kept.values()):
                kept[name] = values
    return [{name: values[k] for name, values in kept.items()} for k in range(len(rows))]


def together(rows: Sequence[Values], words: Iterable[str]) -> dict[str, str]:
    """The values that typed settings have in a sweep, as they are typed: ``[5,3],[4,2]``."""
    found: dict[str, dict[str, None]] = {}
    for row in rows:
        for word in (*words, *HANDFUL):
            own = [
                text_of(value) for name, value in row.items() if f"{name}.".startswith(f"{word}.")
            ]
            if own:
                whole = own[0] if word in row else f"[{','.join(own)}]"
                found.setdefault(word, {})[whole] = None
    return {word: ",".join(texts) for word, texts in found.items()}


def text_of(value: Any) -> str:
    """A value as it is typed."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)
