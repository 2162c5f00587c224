"""Studies whose findings are plain dictionaries."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.common.record import Mesh, Outcome, Record
from experiments.common.study import Job

__all__ = ["Plain", "each", "flat", "plain_run"]

Plain = dict[str, Any]

STAMPED = {
    "schema", "experiment", "title", "row", "table", "status", "reason", "detail", "factors",
    "seconds_total", "forward_solves", "model", "mesh", "provenance",
}  # fmt: skip


def flat(record: Record[Any] | Mapping[str, Any]) -> Plain:
    """Header and findings of a record in one mapping."""
    whole = asdict(record) if isinstance(record, Record) else dict(record)
    return {**whole, **(whole.pop("findings") or {})}


def plain_run(
    run: Callable[[Mapping[str, Any], str, Path, float], tuple[Plain, list[Path]]],
) -> Callable[[Job[Any]], Outcome[Plain]]:
    """A run that gives a whole record as a dictionary."""

    def outcome(job: Job[Any]) -> Outcome[Plain]:
        record, _ = run(job.values, job.config_hash, job.folder, time.time())
        mesh = record.get("mesh") or {}
        return Outcome(
            findings={key: value for key, value in record.items() if key not in STAMPED},
            status=record["status"],
            reason=record["reason"],
            detail=record["detail"],
            mesh=Mesh(mesh["sha256"], mesh["nodes"], mesh.get("elements"), mesh.get("truth_sha256"))
            if "sha256" in mesh
            else None,
            forward_solves=record["forward_solves"],
        )

    return outcome


def each(
    write: Callable[[Path, Plain], list[Path]],
) -> Callable[[Path, Mapping[str, Record[Plain]], Mapping[str, Path]], list[Path]]:
    """Tables and figures of every record by itself."""

    def write_each(
        folder: Path, records: Mapping[str, Record[Plain]], _arrays: Mapping[str, Path]
    ) -> list[Path]:
        return [path for record in records.values() for path in write(folder, flat(record))]

    return write_each
