"""A collected sweep: ``sweep.json`` of a run, ``results/sweeps/NAME.json`` when published."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from experiments.common.records.record import Provenance, Record
from mvest.files import write_atomically
from mvest.problem.record import EstimateRecord, Frozen, Unknown
from mvest.problem.registration import unit_of
from mvest.provenance import require_sealed, sealed
from mvest.reading.documents import read_mapping, validated

SWEEPS = "sweeps"  # folder of the published sweeps within the results

NOT_KEPT: dict[str, Any] = {
    "detail": "", "frames": (), "condition_number": None, "distance_to_truth_mm": None,
}  # fmt: skip
"""Parts of an estimate that only the job's own record has."""


class SweptJob(Frozen):
    """One job of a sweep, with the seeds ``seed``, ..., ``seed + repeats - 1``."""

    hash: str  # first digits of the hash of its configuration
    seed: int
    repeats: int = 1
    record: Record  # its head, see `head_of`

    @property
    def runs(self) -> tuple[EstimateRecord, ...]:
        """An estimate for each planned seed; a missing one has failed for the job's reason."""
        record, known = self.record, {one.seed for one in self.record.estimates}
        unknowns = tuple(Unknown(name=name, unit=unit_of(name)) for name in record.parameters)
        lost = [
            EstimateRecord(seed=seed, status="failed", reason=record.reason, unknowns=unknowns)
            for seed in range(self.seed, self.seed + self.repeats)
            if seed not in known
        ]
        return (*record.estimates, *lost)


class Sweep(Frozen):
    """Jobs that differ in their factors."""

    version: Literal[4] = 4  # of this layout
    name: str
    size: str | None = None
    title: str
    parameters: tuple[str, ...]
    paper: Mapping[str, Any] | None = None  # its ``table``, ``estimate`` and ``error_percent``
    provenance: Provenance  # of the process that collected the jobs, with the hash of all jobs
    commits: tuple[str, ...] = ()  # those that computed the jobs
    settings: Mapping[str, Any] = {}  # of the first job, without factors and paths
    jobs: tuple[SweptJob, ...] = Field(min_length=1)

    @property
    def factors(self) -> list[str]:
        """Names of everything varied, in the order of the jobs."""
        return list(dict.fromkeys(name for job in self.jobs for name in job.record.factors))

    @property
    def records(self) -> list[Record]:
        """Those of all jobs."""
        return [job.record for job in self.jobs]


def head_of(record: Record) -> Record:
    """The part of a job's record that a sweep needs: no tables, no details of estimates."""
    estimates = tuple(
        one.without_details().model_copy(
            update={**NOT_KEPT, "unknowns": tuple(u for u in one.unknowns if u.kind != "derived")}
        )
        for one in record.estimates
    )
    return record.model_copy(update={"tables": {}, "estimates": estimates})


def write_sweep_file(path: Path, sweep: Sweep) -> None:
    """Write a sweep with a digest of its content; raises an `InputError` if it cannot."""
    jobs = [job.model_dump(mode="json", exclude_defaults=True) for job in sweep.jobs]
    content = sealed({**sweep.model_dump(mode="json", exclude={"jobs"}), "jobs": jobs})
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    write_atomically(path, text + "\n", sync=True)


def read_sweep(path: Path) -> Sweep:
    """The sweep in a file; raises an `InputError` if it is none or was changed."""
    data = read_mapping(path)
    sweep = validated(Sweep, {k: v for k, v in data.items() if k != "sha256"}, str(path))
    require_sealed(data, str(path))
    return sweep


def read_sweeps(results: Path) -> list[Sweep]:
    """Every published sweep in the order of file names."""
    return [read_sweep(path) for path in sorted((results / SWEEPS).glob("*.json"))]


def short_names(names: Sequence[str]) -> list[str]:
    """Names of parameters without a common beginning: ``E_f.anterior`` becomes ``anterior``."""
    together = len({name.split(".")[0] for name in names}) == 1 and all("." in n for n in names)
    return [name.split(".", 1)[1] if together else name for name in names]
