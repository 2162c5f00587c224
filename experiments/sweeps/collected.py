"""A collected sweep: the content of ``sweep.json``, which the runner writes and results keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter, ValidationError

from experiments.common.records.estimates import Paper, SeedRun
from experiments.common.records.findings import Vector
from experiments.common.records.record import Model, Provenance, Status
from mvest.errors import InputError

__all__ = ["SCHEMA", "Cost", "Sweep", "SweepJob", "check_sweep"]

SCHEMA = 2
"""Version of the layout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepJob:
    """One job with one run per seed, without any where it died; vectors are ``(p,)``.

    ``seed`` is the first of so many ``repeats``, None where it is not known which seeds the job
    had; ``P0``, ``Q`` and ``R`` are a variance, variances or a matrix.
    """

    hash: str
    row: str
    factors: Mapping[str, Any]
    seed: int | None = None
    repeats: int = 1
    status: Status
    reason: str
    model: Model | None = None
    initial: Vector | None = None
    truth: Vector | None = None
    P0: Any = None
    Q: Any = None
    R: Any = None
    filter: str | None = None
    runs: tuple[SeedRun, ...]

    @property
    def converged(self) -> bool:
        """Whether the job ended as it should."""
        return self.status == "converged"


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds of a job: of estimating, of all of it, and of neither simulating nor estimating."""

    hash: str
    seconds: float | None
    seconds_total: float | None
    overhead: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Jobs that differ in their factors, with p parameters.

    Attributes
    ----------
    schema : int
    sweep : mapping
        Its name, kind and size, and the grids of its sizes.
    title : str
    parameters : tuple of str
    paper : Paper or None
    truth_hits, truth_misses : int
        Simulated truths that were in the store, and that were not.
    provenance, commits : Provenance and tuple of str
        Of the file, and of the jobs.
    settings : mapping
        Those of the first job, in what a sweep has in common.
    jobs, cost : tuple of SweepJob, and of Cost
    """

    schema: int
    sweep: Mapping[str, Any]
    title: str
    parameters: tuple[str, ...]
    paper: Paper | None = None
    truth_hits: int = 0
    truth_misses: int = 0
    provenance: Provenance
    commits: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    jobs: tuple[SweepJob, ...]
    cost: tuple[Cost, ...]

    @property
    def name(self) -> str:
        """What files call it."""
        return str(self.sweep["name"])

    @property
    def kind(self) -> str:
        """What decides on tables and figures."""
        return str(self.sweep["kind"])


def check_sweep(data: Any, where: str) -> Sweep:
    """A collected sweep from plain data.

    Raises
    ------
    InputError
        Naming ``where`` it comes from and what it lacks.
    """
    if not isinstance(data, Mapping):
        raise InputError(f"{where} is no collected sweep but a {type(data).__name__}")
    if data.get("schema", SCHEMA) != SCHEMA:
        raise InputError(f"{where} has schema {data['schema']}; this version reads {SCHEMA}")
    try:
        sweep = TypeAdapter(Sweep).validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        *place, name = map(str, first["loc"])
        what = " ".join(part.removesuffix("s") for part in place) or "it"
        wrong = f"lacks {name}" if first["type"] == "missing" else f"{name}: {first['msg']}"
        raise InputError(f"{where} is no collected sweep: {what} {wrong}") from error
    if not {"name", "kind"} <= set(sweep.sweep):
        raise InputError(f"{where}: `sweep` must say its name and its kind")
    p = len(sweep.parameters)
    for job in sweep.jobs:
        for run in job.runs:
            for key, values in (("estimate", run.estimate), ("std", run.std), ("bound", run.bound)):
                if values is not None and len(values) != p:
                    raise InputError(
                        f"{where}: job {job.hash}, seed {run.seed}: {key} has {len(values)} "
                        f"values for {p} parameters"
                    )
    return sweep
