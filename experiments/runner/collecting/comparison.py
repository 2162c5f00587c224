"""What a run is compared by: short names of its settings and of its numbers, as MLflow shows them.

Everything here reads a job's record and resolved configuration; MLflow itself is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import stdev
from typing import Any

from experiments.common.records.record import Record

Values = Mapping[str, Any]

NOT_COMPARED = (
    "hydra", "paths", "tracking", "sweep", "factors", "paper", "name", "title", "table", "row",
    "publish", "force", "dry_run", "detach", "time_limit_s", "memory_limit_gb", "figures",
    "isolate",
)  # fmt: skip
"""Parts of a configuration that say nothing about a run beside another one."""

SHORT = {"observation.noise_mm": "noise", "filter.mode": "filter"}
"""Names of single settings."""

BY_PARAMETER = {
    "filter.initial": "initial", "filter.P0": "P0", "filter.method.Q": "Q", "filter.R": "R",
    "truth.values": "truth",
}  # fmt: skip
"""Names of settings that hold one value for each estimated parameter, or one for all."""


def parameters(config: Values, names: Sequence[str]) -> dict[str, str]:
    """Settings of a run by short dotted names; numbers are texts that read as numbers.

    A list gets one name for each of its values: the parameter's where there is one value for each
    (``initial.anterior``), a count from 0 otherwise. Of a matrix the diagonal is named. What is
    varied in a sweep (``factors``) keeps the short names given to it there.

    Parameters
    ----------
    config : mapping
        The resolved configuration.
    names : sequence of str
        Of the parameters.
    """
    names = short_names(names)
    found: dict[str, Any] = {}
    for name, value in _leaves({k: v for k, v in config.items() if k not in NOT_COMPARED}):
        if name in BY_PARAMETER:
            found |= _by_parameter(BY_PARAMETER[name], value, names)
        elif isinstance(value, list):
            found[name] = ", ".join(str(item) for item in value)
        else:
            found[SHORT.get(name, name)] = value
    factors = dict(_leaves(config.get("factors") or {}))
    found |= {name: value for name, value in factors.items() if name not in found}
    return {name: _text(value) for name, value in found.items() if value not in (None, "")}


def short_names(names: Sequence[str]) -> list[str]:
    """Names of parameters without what all of them begin with: ``E_f.anterior`` -> ``anterior``.

    MLflow's charts cut long names off.
    """
    stems = {name.split(".")[0] for name in names}
    together = len(stems) == 1 and all("." in name for name in names)
    return [name.split(".", 1)[1] if together else name for name in names]


def metrics(record: Record) -> list[tuple[str, float, int]]:
    """Name, value and step of every number worth comparing between runs.

    A job that repeats over seeds is one run: its numbers are means over the estimates that
    converged (``error`` in percent of the truth, without sign), ``spread`` is their standard
    deviation, and ``repeat.*`` holds them one by one, with the seed as the step.
    """
    runs = record.estimates
    done = [run for run in runs if run.converged]
    found: list[tuple[str, float | None, int]] = []
    errors: list[float] = []
    for name, short in zip(record.parameters, short_names(record.parameters), strict=True):
        own = [(run.seed, one) for run in done for one in run.unknowns if one.name == name]
        estimates = [one.estimate for _, one in own]
        error = [
            100.0 * abs(one.relative_error) for _, one in own if one.relative_error is not None
        ]
        errors += error
        found += [
            (f"error.{short}", _mean(error), 0),
            (f"estimate.{short}", _mean(estimates), 0),
            (f"std.{short}", _mean([one.std for _, one in own]), 0),
        ]
        if len(runs) > 1:
            found.append((f"spread.{short}", _deviation(estimates), 0))
            for seed, one in own:
                found.append((f"repeat.estimate.{short}", one.estimate, seed or 0))
                found.append((f"repeat.relative_error.{short}", one.relative_error, seed or 0))
        if runs:
            position = [one.name for one in runs[0].unknowns].index(name) if own else 0
            found += [
                (f"iterate.{short}", iterate[position], step)
                for step, iterate in enumerate(runs[0].iterates)
                if position < len(iterate)
            ]
    # MLflow's own comparison begins with the metric that was logged first.
    found.insert(0, ("error.mean", _mean(errors), 0))
    for key, distances in (
        ("distance", [run.distance_mm for run in done]),
        ("distance_truth", [run.distance_to_truth_mm for run in done]),
    ):
        known = [distance for distance in distances if distance is not None]
        found.append((f"{key}.mean", _mean([distance.mean for distance in known]), 0))
        found.append((f"{key}.max", _mean([distance.max for distance in known]), 0))
    if runs:
        found += [
            ("nis", _mean([run.innovation.nis if run.innovation else None for run in done]), 0),
            ("failed", len(runs) - len(done), 0),
            ("iterations", _mean([run.iterations or 0 for run in runs]), 0),
            ("seconds", math.fsum(run.seconds or 0.0 for run in runs), 0),
        ]
    found.append(("forward_solves", record.forward_solves, 0))
    found += [
        (name, float(value), 0)
        for name, value in record.numbers.items()
        if isinstance(value, int | float)
    ]
    return [(name, float(value), step) for name, value, step in found if value is not None]


def _leaves(values: Values, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            found += _leaves(value, f"{prefix}{key}.")
        else:
            found.append((f"{prefix}{key}", value))
    return found


def _by_parameter(short: str, value: Any, names: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, list):
        return {short: value}
    if value and isinstance(value[0], list):
        value = [row[k] for k, row in enumerate(value)]
    labels = names if len(value) == len(names) else [str(k) for k in range(len(value))]
    found = {f"{short}.{label}": item for label, item in zip(labels, value, strict=True)}
    if short in ("P0", "Q", "R") and len(set(value)) == 1:
        return {short: value[0], **found}
    return found


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _deviation(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return stdev(known) if len(known) > 1 else None
