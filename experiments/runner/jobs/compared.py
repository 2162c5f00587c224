"""What runs of all studies are compared by, whatever else a study computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.common.records.estimates import Data, SeedRun
from experiments.common.records.record import Record, record_from
from experiments.runner.jobs.folder import last_record

__all__ = ["Compared", "compared", "last_compared"]

SINGLE = ("estimate", "std", "relative_error", "distance_mm", "distance_to_truth_mm",
          "iterations", "iterates", "iterate_std")  # fmt: skip
"""Findings of one estimate that are called as in `SeedRun`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Findings that have one name and meaning in every study that has them.

    Attributes
    ----------
    repeats : tuple of SeedRun
        The estimate from each seed; one without numbers where nothing was estimated.
    seconds_computing : float or None
        Of estimating, and of simulating as well.
    truth_store : str or None
    data : Data or None
    measures : mapping
        Name -> number, or what the name means.
    died : bool
        Whether the job ended before it had any findings.
    verdict : str or None
        How far the estimate of a case may be believed (see `mvest.problem.verdict`).
    """

    repeats: tuple[SeedRun, ...]
    seconds_computing: float | None = None
    truth_store: str | None = None
    data: Data | None = None
    measures: Mapping[str, float | str | None] = field(default_factory=dict)
    died: bool = False
    verdict: str | None = None


def compared(data: Mapping[str, Any], where: str) -> Record[Compared]:
    """What is compared of a record of any study.

    Raises
    ------
    InputError
        If the data are no record; ``where`` names it.
    """
    found = data.get("findings") or {}
    innovation, known = (found.get(key) or {} for key in ("innovation", "identifiability"))
    # The findings of a study that estimates once are those of its seed.
    alone = {key: found.get(key) for key in SINGLE} | {
        **{key: data.get(key) for key in ("status", "reason", "detail", "forward_solves")},
        "seed": (data.get("provenance") or {}).get("seed"),
        "bound": known.get("cramer_rao_std"),
        "nis": innovation.get("nis"),
        "nis_band": innovation.get("nis_band"),
        "seconds": found.get("seconds", data.get("seconds_total")),
    }
    verdict = ((found.get("case") or {}).get("verdict") or {}).get("trust")
    findings = {
        **found,
        "repeats": found.get("repeats") or [alone],
        "died": not found,
        "verdict": verdict,
    }
    return record_from({**data, "findings": findings}, Compared, where)


def last_compared(folder: Path, config_hash: str) -> Record[Compared] | None:
    """What the last attempt in a folder ended with; None if it did not get to its end."""
    record = last_record(folder, config_hash)
    return None if record is None else compared(record, str(folder))
