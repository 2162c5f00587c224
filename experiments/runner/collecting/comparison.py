"""What a run is compared by: short names of its settings and of its numbers, as MLflow shows them.

Everything here reads a job's record and resolved configuration; MLflow itself is not needed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from experiments.common.records.findings import Vector
from experiments.common.records.record import Record
from experiments.runner.jobs.compared import Compared
from mvest.provenance import config_hash

__all__ = ["inputs", "metrics", "parameters", "short_names"]

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
    "filter.initial": "initial", "filter.P0": "P0", "filter.Q": "Q", "filter.R": "R",
    "truth.values": "truth",
}  # fmt: skip
"""Names of settings that hold one value for each estimated parameter, or one for all."""

DIGEST_LENGTH = 36
"""Most characters of a digest that MLflow takes."""


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


def metrics(record: Record[Compared]) -> list[tuple[str, float, int]]:
    """Name, value and step of every number worth comparing between runs.

    A job that repeats over seeds is one run: its numbers are means over the seeds that converged
    (``error`` in percent of the truth, without sign), ``spread`` is the standard deviation of the
    estimates over the seeds, and ``repeat.*`` holds the seeds one by one, with the seed as the
    step. So there is one line for each setting in a comparison, whatever the number of seeds, and
    the seeds cost nothing but a few values in the same call.
    """
    runs = record.findings.repeats
    done = [run for run in runs if run.converged]
    found: list[tuple[str, float | None, int]] = []
    errors: list[float] = []
    for k, name in enumerate(short_names(record.parameters)):
        estimates = _column([run.estimate for run in done], k)
        error = [100.0 * abs(value) for value in _column([run.relative_error for run in done], k)]
        errors += error
        found += [
            (f"error.{name}", _mean(error), 0),
            (f"estimate.{name}", _mean(estimates), 0),
            (f"std.{name}", _mean(_column([run.std for run in done], k)), 0),
        ]
        if len(runs) > 1:
            found.append((f"spread.{name}", _deviation(estimates), 0))
            found += [
                (f"repeat.{what}.{name}", values[k], run.seed or 0)
                for run in done
                for what, values in (
                    ("estimate", run.estimate),
                    ("relative_error", run.relative_error),
                )
                if values is not None
            ]
        found += [
            (f"iterate.{name}", iterate[k], step)
            for step, iterate in enumerate(runs[0].iterates or ())
        ]
    # MLflow's own comparison begins with the metric that was logged first.
    found.insert(0, ("error.mean", _mean(errors), 0))
    for name, distances in (
        ("distance", [run.distance_mm for run in done]),
        ("distance_truth", [run.distance_to_truth_mm for run in done]),
    ):
        known = [distance for distance in distances if distance is not None]
        found.append((f"{name}.mean", _mean([distance.mean for distance in known]), 0))
        found.append((f"{name}.max", _mean([distance.max for distance in known]), 0))
    found += [
        ("nis", _mean([run.nis for run in done if run.nis is not None]), 0),
        ("failed", len(runs) - len(done), 0),
        ("iterations", _mean([run.iterations or 0 for run in runs]), 0),
        ("forward_solves", math.fsum(run.forward_solves or 0 for run in runs), 0),
        ("seconds", math.fsum(run.seconds or 0.0 for run in runs), 0),
    ]
    found += [
        (name, value, 0)
        for name, value in record.findings.measures.items()
        if not isinstance(value, str)  # what a measure means
    ]
    return [(name, float(value), step) for name, value, step in found if value is not None]


def inputs(config: Values, record: Record[Compared]) -> list[dict[str, str]]:
    """What a run was computed from, as MLflow's data sets: the observation and the mesh.

    Returns
    -------
    list of dict
        ``context``, ``name``, ``digest``, ``source_type``, ``source`` and ``profile`` (JSON). An
        observation's digest is that of the recording where there is one, and otherwise of the
        settings that it is simulated from: valve, mechanics, truth, frames, noise and seed.
    """
    mesh, model, recording = record.mesh, record.model, record.findings.data
    found = []
    if mesh is not None and model is not None:
        sizes = {k: v for k, v in asdict(mesh).items() if not k.endswith("sha256")}
        found.append(
            {
                "context": "mesh",
                "name": f"mesh {model.element} {' x '.join(map(str, model.cells))}",
                "digest": mesh.sha256[:DIGEST_LENGTH],
                "source_type": "mesh",
                "source": json.dumps({**config["mesh"], "element": model.element}),
                "profile": json.dumps(sizes),
            }
        )
    frames = config["observation"]["frames"]
    if recording is not None:
        found.append(
            {
                "context": "observation",
                "name": "recording",
                "digest": recording.sha256[:DIGEST_LENGTH],
                "source_type": "file",
                "source": json.dumps({"citation": recording.citation}),
                "profile": json.dumps({"frames": frames}),
            }
        )
    elif config["study"] == "twin":
        repeats = int(config.get("repeats") or 1)
        source = {
            key: config[key] for key in ("valve", "mechanics", "truth", "observation", "seed")
        } | {"repeats": repeats, "mesh": mesh and (mesh.truth_sha256 or mesh.sha256)}
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


def _column(rows: Sequence[Vector | None], k: int) -> list[float]:
    return [row[k] for row in rows if row is not None]


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None


def _deviation(values: Sequence[float]) -> float | None:
    if len(values) < 2:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))
