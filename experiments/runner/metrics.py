"""Numbers and settings by which runs are compared, in MLflow and by optimising sweepers."""

from collections.abc import Iterable, Mapping
from statistics import fmean, stdev
from typing import Any

from experiments.common.config import is_hashed
from experiments.common.records.record import Record
from experiments.common.schema import Values
from experiments.sweeps.collected import short_names

ALWAYS = (
    "study", "valve.folder_sha256", "mesh.source", "mechanics.element", "filter.mode",
    "truth.label", "observation.noise_mm", "seed",
)  # fmt: skip
"""Settings that every run shows, overridden or not."""

LARGEST_ERROR = 1.0  # relative error of a modulus beyond which an estimate is implausible


def metrics(record: Record) -> dict[str, float]:
    """Name -> number, the mean error (%) first.

    For a job that repeats over seeds these are means over the converged estimates, and ``spread``
    is their standard deviation.
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
    """Why a run is left out of comparisons; empty if it is plausible.

    It failed, its verdict is that there is no estimate, or the error exceeds `LARGEST_ERROR`.
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


def settings_of(config: Values, overrides: Iterable[str], factors: Values) -> dict[str, Any]:
    """Overridden settings of a run as they were typed, those of `ALWAYS`, and its factors.

    ``config`` is the one next to the result, with the content of files in place of their names,
    which must not reach a store. A factor is left out if a setting has the same value.
    """
    words = (word.lstrip("+~").partition("=") for word in overrides)
    typed = {name.replace("/", "."): text for name, _, text in words if name != "name"}
    found: dict[str, Any] = {}
    for name in (*typed, *ALWAYS):
        value: Any = config
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, Mapping | list) and "sha256" not in str(value):
            value = typed[name]
        if value not in (None, "") and is_hashed(name, config["study"]):
            found[name] = value
    known = list(found.values())
    return found | {name: value for name, value in factors.items() if value not in known}
