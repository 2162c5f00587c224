"""What a run is compared by: short names of its settings and of its numbers, as MLflow shows them.

Everything here reads a job's record and resolved configuration; MLflow itself is not needed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mvest.provenance import config_hash

__all__ = ["inputs", "metrics", "parameters", "short_names"]

Values = Mapping[str, Any]

NOT_COMPARED = (
    "hydra", "paths", "tracking", "sweep", "factors", "paper", "name", "title", "table", "row",
    "publish", "force", "dry_run", "time_limit_s", "figures", "isolate",
)  # fmt: skip
"""Parts of a configuration that say nothing about a run beside another one."""

SHORT = {"observation.noise_mm": "noise", "filter.mode": "filter"}
"""Names of single settings."""

BY_PARAMETER = {
    "filter.initial": "initial", "filter.P0": "P0", "filter.Q": "Q", "filter.R": "R",
    "truth.values": "truth",
}  # fmt: skip
"""Names of settings that hold one value for each estimated parameter, or one for all."""

DIGEST_LENGTH = 36
"""Most characters of a digest that MLflow takes."""


def parameters(config: Values, record: Values) -> dict[str, str]:
    """Settings of a run by short dotted names; numbers are texts that read as numbers.

    A list gets one name for each of its values: the parameter's where there is one value for each
    (``initial.anterior``), a count from 0 otherwise. Of a matrix the diagonal is named. What is
    varied in a sweep (``factors``) keeps the short names given to it there.

    Parameters
    ----------
    config : mapping
        The resolved configuration.
    record : mapping
        The contents of ``result.json``.
    """
    names = short_names(record["parameters"])
    others = {"donor", "imaging"} - {config["study"]}
    left_out = {*NOT_COMPARED, *others}
    found: dict[str, Any] = {}
    for name, value in _leaves({k: v for k, v in config.items() if k not in left_out}):
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


def metrics(record: Values) -> list[tuple[str, float, int]]:
    """Name, value and step of every number worth comparing between runs.

    A job that repeats over seeds is one run: its numbers are means over the seeds that converged
    (``error`` in percent of the truth, without sign), ``spread`` is the standard deviation of the
    estimates over the seeds, and ``repeat.*`` holds the seeds one by one, with the seed as the
    step. So there is one line for each setting in a comparison, whatever the number of seeds, and
    the seeds cost nothing but a few values in the same call.
    """
    runs = record.get("repeats") or [record]
    done = [run for run in runs if run.get("status") == "converged"]
    found: list[tuple[str, float | None, int]] = []
    errors: list[float] = []
    for k, name in enumerate(short_names(record["parameters"])):
        estimates = _column(done, "estimate", k)
        error = [100.0 * abs(value) for value in _column(done, "relative_error", k)]
        errors += error
        found += [
            (f"error.{name}", _mean(error), 0),
            (f"estimate.{name}", _mean(estimates), 0),
            (f"std.{name}", _mean(_column(done, "std", k)), 0),
        ]
        if len(runs) > 1:
            found.append((f"spread.{name}", _deviation(estimates), 0))
            found += [
                (f"repeat.{key}.{name}", run[source][k], int(run["seed"]))
                for run in done
                for key, source in (("estimate", "estimate"), ("relative_error", "relative_error"))
                if run.get(source) is not None
            ]
        found += [
            (f"iterate.{name}", iterate[k], step)
            for step, iterate in enumerate(record.get("iterates") or [])
        ]
    # MLflow's own comparison begins with the metric that was logged first.
    found.insert(0, ("error.mean", _mean(errors), 0))
    for key, name in (("distance_mm", "distance"), ("distance_to_truth_mm", "distance_truth")):
        spreads = [run[key] for run in done if run.get(key) is not None]
        found += [
            (f"{name}.{part}", _mean([spread[part] for spread in spreads]), 0)
            for part in ("mean", "max")
            if all(part in spread for spread in spreads)
        ]
    found.append(("nis", _mean([run["nis"] for run in done if run.get("nis") is not None]), 0))
    found.append(("failed", len(runs) - len(done), 0))
    found.append(("iterations", _mean([run.get("iterations") or 0 for run in runs]), 0))
    found.append(("forward_solves", math.fsum(run.get("forward_solves") or 0 for run in runs), 0))
    # Studies that do more than one estimate have no time but their own.
    seconds = math.fsum(run.get("seconds", record["seconds_total"]) or 0 for run in runs)
    found.append(("seconds", seconds, 0))
    found += [
        (name, value, 0)
        for name, value in (record.get("measures") or {}).items()
        if not isinstance(value, str)  # what a measure means
    ]
    return [(name, float(value), step) for name, value, step in found if value is not None]


def inputs(config: Values, record: Values) -> list[dict[str, str]]:
    """What a run was computed from, as MLflow's data sets: the observation and the mesh.

    Returns
    -------
    list of dict
        ``context``, ``name``, ``digest``, ``source_type``, ``source`` and ``profile`` (JSON). An
        observation's digest is that of the recording where there is one, and otherwise of the
        settings that it is simulated from: valve, mechanics, truth, frames, noise and seed.
    """
    mesh, model = record["mesh"] or {}, record.get("model")
    found = []
    if "sha256" in mesh and model is not None:
        cells = " x ".join(str(count) for count in model["cells"])
        found.append(
            {
                "context": "mesh",
                "name": f"mesh {model['element']} {cells}",
                "digest": str(mesh["sha256"])[:DIGEST_LENGTH],
                "source_type": "mesh",
                "source": json.dumps({**config["mesh"], "element": model["element"]}),
                "profile": json.dumps({k: v for k, v in mesh.items() if not k.endswith("sha256")}),
            }
        )
    frames = config["observation"]["frames"]
    if record.get("data"):
        found.append(
            {
                "context": "observation",
                "name": "recording",
                "digest": str(record["data"]["sha256"])[:DIGEST_LENGTH],
                "source_type": "file",
                "source": json.dumps({"citation": record["data"].get("citation")}),
                "profile": json.dumps({"frames": frames}),
            }
        )
    elif config["study"] == "twin":
        repeats = int(config.get("repeats") or 1)
        source = {
            key: config[key] for key in ("valve", "mechanics", "truth", "observation", "seed")
        } | {"repeats": repeats, "mesh": mesh.get("truth_sha256", mesh.get("sha256"))}
        noise = config["observation"]["noise_mm"]
        found.append(
            {
                "context": "observation",
                "name": "simulated observation",
                "digest": config_hash(source)[:DIGEST_LENGTH],
                "source_type": "simulation",
                "source": json.dumps(
                    {"truth": config["truth"], "noise_mm": noise, "seed": config["seed"]}
                ),
                "profile": json.dumps({"frames": frames, "repeats": repeats}),
            }
        )
    return found


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


def _column(runs: Iterable[Values], key: str, k: int) -> list[float]:
    return [run[key][k] for run in runs if run.get(key) is not None and run[key][k] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None


def _deviation(values: Sequence[float]) -> float | None:
    if len(values) < 2:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))
