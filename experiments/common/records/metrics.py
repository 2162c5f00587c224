"""The numbers that every run is compared by, and whether it is to be compared at all."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, stdev

from experiments.common.records.record import Record

LARGEST_ERROR = 1.0
"""Relative error of a modulus beyond which an estimate is no answer."""


def short_names(names: Sequence[str]) -> list[str]:
    """Names of parameters without a common beginning: ``E_f.anterior`` becomes ``anterior``."""
    together = len({name.split(".")[0] for name in names}) == 1 and all("." in n for n in names)
    return [name.split(".", 1)[1] if together else name for name in names]


def metrics(record: Record) -> dict[int, dict[str, float]]:
    """Step -> name -> number; step 0 has all but the iterates, with the mean error (%) first.

    Of a job that repeats over seeds these are means over the estimates that converged, and
    ``spread`` is their standard deviation.
    """
    runs, short = (
        record.estimates,
        dict(zip(record.parameters, short_names(record.parameters), strict=True)),
    )
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
    found = {0: {key: fmean(values) for key, values in series.items() if values}}
    for name in short.values():
        if len(values := series.get(f"estimate.{name}", [])) > 1:
            found[0][f"spread.{name}"] = stdev(values)
    numbers = {"forward_solves": record.forward_solves, **record.numbers}
    if runs:
        numbers["failed"] = sum(not run.converged for run in runs)
        numbers["seconds"] = sum(run.seconds or 0.0 for run in runs)
    found[0] |= {k: float(v) for k, v in numbers.items() if isinstance(v, int | float)}
    for step, iterate in enumerate(runs[0].iterates if runs else ()):
        for one, value in zip(runs[0].parameters, iterate, strict=False):
            if value is not None:
                found.setdefault(step, {})[f"iterate.{short.get(one.name, one.name)}"] = value
    return found


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
