"""A collected sweep: ``sweep.json`` of the runner, ``results/sweeps/NAME.json`` when published.

A job is its record, without tables, and what the runner knows of it besides. In the file, what all
jobs have alike stands once (``common``), and each job adds what is its own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from experiments.common.records.record import Frozen, Provenance, Record
from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.problem.record import EstimateRecord, Unknown
from mvest.provenance import require_sealed, sealed
from mvest.reading.documents import read_mapping
from mvest.reading.text import one_line

SWEEPS = "sweeps"
"""Folder of the published sweeps within the results."""

PATHS = {"iterates", "iterate_std"}

NOT_KEPT: dict[str, Any] = {
    "detail": "", "correlation": (), "frames": (), "condition_number": None, "flat": (),
    "confounded": (), "objective": (), "details": {}, "distance_to_truth_mm": None,
}  # fmt: skip
"""Parts of an estimate that no table or figure of a sweep shows; the job's own record has them."""


class SweptJob(Frozen):
    """One job of a sweep.

    Attributes
    ----------
    hash : str
        First digits of the hash of its configuration.
    seed, repeats : int
        It runs with the seeds ``seed``, ``seed + 1``, ..., so many in all.
    record : Record
        Its head, see `head_of`.
    """

    hash: str
    seed: int
    repeats: int = 1
    record: Record

    @property
    def runs(self) -> tuple[EstimateRecord, ...]:
        """A run for each planned seed; one that left no estimate failed for the job's reason."""
        known = {one.seed for one in self.record.estimates}
        lost = [
            EstimateRecord(seed=seed, status="failed", reason=self.record.reason)
            for seed in range(self.seed, self.seed + self.repeats)
            if seed not in known
        ]
        return (*self.record.estimates, *lost)


class Sweep(Frozen):
    """Jobs that differ in their factors.

    Attributes
    ----------
    version : int
        Of this layout.
    name, size, title : str
    parameters : tuple of str, (p,)
    paper : mapping or None
        What the paper reports of the same experiment: ``table``, ``estimate``, ``error_percent``.
    provenance : Provenance
        Of the process that collected the jobs; its configuration hash is that of all jobs.
    commits : tuple of str
        Those that computed the jobs.
    settings : mapping
        The configuration of the first job, without factors and what belongs to a machine.
    jobs : tuple of SweptJob
        At least one.
    """

    version: Literal[4] = 4
    name: str
    size: str | None = None
    title: str
    parameters: tuple[str, ...]
    paper: Mapping[str, Any] | None = None
    provenance: Provenance
    commits: tuple[str, ...] = ()
    settings: Mapping[str, Any] = {}
    jobs: tuple[SweptJob, ...] = Field(min_length=1)

    @property
    def factors(self) -> list[str]:
        """Names of everything varied, in the order in which the jobs bring them up."""
        return list(dict.fromkeys(name for job in self.jobs for name in job.record.factors))

    @property
    def records(self) -> list[Record]:
        """Those of all jobs."""
        return [job.record for job in self.jobs]

    @property
    def has_starts(self) -> bool:
        """Whether its runs begin at several initial guesses."""
        runs = (run for record in self.records for run in record.estimates)
        return len({tuple(one.prior_mean for one in run.unknowns) for run in runs}) > 1

    def plain(self) -> dict[str, Any]:
        """Plain data for JSON, sealed; `Sweep.of_plain` reads them."""
        # Of the paths from several starts, one a job.
        first = 1 if self.has_starts else 0
        jobs = []
        for job in self.jobs:
            unshown = dict.fromkeys(range(first, len(job.record.estimates)), PATHS)
            left_out: Any = {"record": {"estimates": unshown}}
            jobs.append(job.model_dump(mode="json", exclude_defaults=True, exclude=left_out))
        common = _common(jobs)
        header = self.model_dump(mode="json", exclude={"jobs"})
        return sealed({**header, "common": common, "jobs": [_beyond(job, common) for job in jobs]})

    @classmethod
    def of_plain(cls, data: Any, where: str) -> Sweep:
        """A sweep from plain data; ``where`` names them in an error.

        Raises
        ------
        InputError
            If the data are no collected sweep of this version, or not as they were written.
        """
        if not isinstance(data, Mapping):
            raise InputError(f"{where} is no collected sweep but a {type(data).__name__}")
        try:
            common = data["common"]
            jobs = [_joined(common, job) for job in data["jobs"]]
            rest = {k: v for k, v in data.items() if k not in ("sha256", "common")}
            sweep = cls.model_validate({**rest, "jobs": jobs})
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{where} is no collected sweep: {error}") from error
        except ValidationError as error:
            first = error.errors()[0]
            place = one_line(".".join(map(str, first["loc"])), 80)
            raise InputError(f"{where} is no collected sweep: {place}: {first['msg']}") from error
        require_sealed(data, where)
        return sweep


def head_of(record: Record) -> Record:
    """What a sweep keeps of a job's record: no tables, and of estimates what sweeps show."""
    estimates = tuple(
        one.model_copy(
            update={**NOT_KEPT, "unknowns": tuple(u for u in one.unknowns if u.kind != "derived")}
        )
        for one in record.estimates
    )
    head = record.model_copy(update={"tables": {}, "estimates": estimates})
    _forget_given(head)
    return head


def _forget_given(part: Any) -> None:
    """Forget which fields of a record were given: a third of the memory of ten thousand heads."""
    if isinstance(part, Frozen | EstimateRecord | Unknown):
        object.__setattr__(part, "__pydantic_fields_set__", set())
        for value in vars(part).values():
            _forget_given(value)
    elif isinstance(part, tuple):
        for value in part:
            _forget_given(value)


def write_sweep_file(path: Path, sweep: Sweep) -> None:
    """Write a collected sweep, whole or not at all.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    text = json.dumps(sweep.plain(), ensure_ascii=False, separators=(",", ":"))
    write_atomically(path, text + "\n", sync=True)


def read_sweep(path: Path) -> Sweep:
    """The collected sweep in a file.

    Raises
    ------
    InputError
        If it cannot be read, is no collected sweep, or is not as it was written.
    """
    return Sweep.of_plain(read_mapping(path), str(path))


def read_sweeps(results: Path) -> list[Sweep]:
    """Every published sweep in the order of file names."""
    return [read_sweep(path) for path in sorted((results / SWEEPS).glob("*.json"))]


def _common(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Entries that all of several nested mappings have alike."""
    found: dict[str, Any] = {}
    for key, value in parts[0].items():
        others = [part[key] for part in parts if key in part]
        if len(others) < len(parts):
            continue
        if all(isinstance(other, dict) for other in others):
            found[key] = _common(others)
        elif all(other == value and type(other) is type(value) for other in others):
            found[key] = value
    return found


def _beyond(part: Mapping[str, Any], common: Mapping[str, Any]) -> dict[str, Any]:
    """What a mapping says beyond the common entries."""
    found = {}
    for key, value in part.items():
        if key not in common:
            found[key] = value
        elif isinstance(value, dict) and (own := _beyond(value, common[key])):
            found[key] = own
    return found


def _joined(common: Mapping[str, Any], part: Mapping[str, Any]) -> dict[str, Any]:
    """The mapping of which `_beyond` gave a part."""
    own = {
        key: _joined(common[key], value) if isinstance(common.get(key), dict) else value
        for key, value in part.items()
    }
    return {**common, **own}
