"""The record of a run: what ``result.json`` and the kept records in ``results/`` hold.

A study computes its findings; everything else that a record says is stamped once, by the runner.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import Any, Generic, Literal, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from mvest.errors import InputError
from mvest.files import sha256_of
from mvest.provenance import provenance, require_sealed, sealed, write_json
from mvest.reading.json_file import read_mapping

__all__ = [
    "FAILED_GATE",
    "FIELDS",
    "NOT_GATED",
    "PASSED_GATE",
    "SCHEMA",
    "GitState",
    "Mesh",
    "Model",
    "Outcome",
    "Provenance",
    "Record",
    "Status",
    "has_passed",
    "here_and_now",
    "model_of_values",
    "read_record",
    "record_from",
    "require_written",
    "stamp",
    "write_record",
]

SCHEMA = 2
"""Version of the layout of a record."""

FIELDS = "fields.npz"
"""What a run leaves of arrays beside its record."""

HASH_DIGITS = 12
"""Digits of a hash that a line of text shows."""

NOT_GATED, PASSED_GATE, FAILED_GATE = "not gated", "passed", "NOT passed"
"""What the gate has said of an anatomy begins with one of these."""

Status = Literal["converged", "failed"]
F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class GitState:
    """The commit that computed a record; None outside a checkout.

    Attributes
    ----------
    sha : str or None
    dirty : bool or None
        Whether tracked files differed from it.
    """

    sha: str | None
    dirty: bool | None


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a record came from.

    Attributes
    ----------
    git : GitState
    versions : mapping
        Package -> version.
    threads : mapping
        Environment variable that caps threads -> its value.
    python, platform, machine : str
    cpu_count : int or None
    config_hash, mesh_hash : str
        SHA-256; the mesh's is "none" where there is no mesh.
    seed : int
    finished : str
        UTC, ISO 8601.
    """

    git: GitState
    versions: Mapping[str, str | None]
    threads: Mapping[str, str | None]
    python: str
    platform: str
    machine: str
    cpu_count: int | None
    config_hash: str
    mesh_hash: str
    seed: int
    finished: str


@dataclass(frozen=True, slots=True)
class Mesh:
    """The estimator's mesh, and the truth's where there is another.

    Attributes
    ----------
    sha256 : str
    nodes : int
    elements : int or None
    truth_sha256 : str or None
    """

    sha256: str
    nodes: int
    elements: int | None = None
    truth_sha256: str | None = None


@dataclass(frozen=True, slots=True)
class Model:
    """What the estimator computed with, as far as its cost depends on it.

    Attributes
    ----------
    element : str
    cells : tuple of int
        Around the valve, from annulus to free edge, through the thickness.
    source : str
        Of the mesh.
    filter : str
    noise_mm : float
        SD of the errors of an observed coordinate.
    """

    element: str
    cells: tuple[int, ...]
    source: str | None = None
    filter: str | None = None
    noise_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(Generic[F]):
    """What a study gives back.

    Attributes
    ----------
    findings : F
        Everything that its tables and figures need, as plain data in dataclasses.
    status : {"converged", "failed"}
    reason, detail : str
        Why it ended.
    mesh : Mesh or None
    forward_solves : int
    row : str
    parameters : tuple of str
    model : Model or None
        As in `Record`, where the data say them and not the configuration.
    gate : str or None
        As in `Record`.
    """

    findings: F
    status: Status = "converged"
    reason: str = "completed"
    detail: str = ""
    mesh: Mesh | None = None
    forward_solves: int = 0
    row: str = ""
    parameters: tuple[str, ...] = ()
    model: Model | None = None
    gate: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Record(Generic[F]):
    """A finished run.

    Attributes
    ----------
    schema : int
        Version of this layout.
    study, experiment, title, row, table : str
        Its room, its configuration, and what tables call it.
    status, reason, detail : str
        As in `Outcome`.
    parameters : tuple of str
    factors : mapping
        What is varied in this job of a sweep, by name.
    seconds_total : float
        From the start of the job to its record.
    forward_solves : int
    model : Model or None
    mesh : Mesh or None
    provenance : Provenance
    findings : F
        None where the job died before it had any.
    gate : str or None
        What the gate said of the anatomy (see `experiments.common.building.gate`); None where the
        study has none of the configured anatomies.
    """

    schema: int
    study: str
    experiment: str
    title: str
    row: str
    table: str
    status: Status
    reason: str
    detail: str
    parameters: tuple[str, ...]
    factors: Mapping[str, Any]
    seconds_total: float
    forward_solves: int
    model: Model | None
    mesh: Mesh | None
    provenance: Provenance
    findings: F
    gate: str | None = None

    @property
    def converged(self) -> bool:
        """Whether the run ended as it should."""
        return self.status == "converged"

    @property
    def caution(self) -> str:
        """What stands before a result whose anatomy has not passed the gate; else empty."""
        if self.gate == NOT_GATED:
            return (
                "The gate was not asked of this anatomy: whether its closed state is the only one "
                "is not known (experiment=gate; of one's own valve, check=true gate=true)."
            )
        if self.gate is not None and not has_passed(self.gate):
            return (
                f"The anatomy did NOT pass the gate ({self.gate}): its closed state is not the "
                "only one, or jumps while moduli change."
            )
        return ""

    @property
    def line(self) -> str:
        """Commit, configuration, mesh and seed in one line, for tables and figures."""
        source = self.provenance
        gate = "" if self.gate is None else f"; gate of the anatomy: {self.gate}"
        sha = (source.git.sha or "unknown")[:HASH_DIGITS] + ("+changes" if source.git.dirty else "")
        return (
            f"{self.experiment}: mvest {source.versions['mvest']}, commit {sha}, "
            f"configuration {source.config_hash[:HASH_DIGITS]}, "
            f"mesh {source.mesh_hash[:HASH_DIGITS]}, seed {source.seed}{gate}"
        )


def has_passed(gate: str) -> bool | None:
    """Whether the gate was passed; None if it was not asked."""
    return None if gate == NOT_GATED else gate.startswith(PASSED_GATE)


def model_of_values(values: Mapping[str, Any]) -> Model:
    """What a configuration says of the estimator's model."""
    return Model(
        values["mechanics"]["element"],
        tuple(values["mesh"][key] for key in ("columns", "rows", "layers")),
        values["mesh"]["source"],
        values["filter"]["mode"],
        values["observation"]["noise_mm"],
    )


def stamp(
    values: Mapping[str, Any], config_hash: str, outcome: Outcome[F], started: float
) -> Record[F]:
    """The record of an outcome.

    Parameters
    ----------
    values : mapping
        The resolved configuration.
    config_hash : str
    outcome : Outcome
        Its findings are None where a job died.
    started : float
        Seconds since the epoch.
    """
    return Record(
        schema=SCHEMA,
        study=values["study"],
        experiment=values["name"],
        title=values["title"],
        row=outcome.row or values["row"],
        table=values["table"],
        status=outcome.status,
        reason=outcome.reason,
        detail=outcome.detail,
        parameters=outcome.parameters or tuple(values["parameters"]),
        factors=dict(values["factors"]),
        seconds_total=time.time() - started,
        forward_solves=outcome.forward_solves,
        model=outcome.model or model_of_values(values),
        mesh=outcome.mesh,
        provenance=here_and_now(
            config_hash, "none" if outcome.mesh is None else outcome.mesh.sha256, values["seed"]
        ),
        findings=outcome.findings,
        gate=outcome.gate,
    )


def here_and_now(config_hash: str, mesh_hash: str, seed: int) -> Provenance:
    """The provenance of what is written by this process."""
    source = _source()
    return Provenance(
        **{**source, "git": GitState(**source["git"])},
        config_hash=config_hash,
        mesh_hash=mesh_hash,
        seed=seed,
        finished=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    )


@cache
def _source() -> dict[str, Any]:
    """Asked for once: a process computes by what it has imported, whatever is checked out since."""
    return provenance()


def write_record(path: Path, record: Record[Any]) -> None:
    """Write a record as JSON, whole or not at all, with digests of itself and of its arrays.

    Raises
    ------
    InputError
        If it holds something without a JSON form, or cannot be written.
    """
    write_json(path, sealed({ARRAYS: _arrays_digest(path), **asdict(record)}))


ARRAYS = "arrays_sha256"


def _arrays_digest(path: Path) -> str | None:
    """Of the arrays beside a record: those of a run, or those that the results keep."""
    run = path.name == "result.json"
    arrays = path.with_name(FIELDS) if run else path.with_suffix(".npz")
    return sha256_of(arrays) if arrays.is_file() else None


def require_written(data: Mapping[str, Any], path: Path) -> None:
    """Check that the record in a file and the arrays beside it are those that were written.

    Raises
    ------
    InputError
        If they are not, or carry no digest.
    """
    require_sealed(data, str(path))
    if data.get(ARRAYS) != _arrays_digest(path):
        raise InputError(f"{path}: the arrays beside it are not those that it was written with")


@cache
def _adapter(findings: Hashable) -> TypeAdapter[Record[Any]]:
    return TypeAdapter(cast(type[Record[Any]], GenericAlias(Record, (findings,))))


def record_from(data: Any, findings: type[F], where: str) -> Record[F]:
    """A record from plain data; ``where`` names it in an error.

    Raises
    ------
    InputError
        If the data are no record with findings of this type; the message names the first field.
    """
    try:
        return _adapter(cast(Hashable, findings)).validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "it"
        raise InputError(f"{where} is no record of a run: {field}: {first['msg']}") from error


def read_record(path: Path, findings: type[F]) -> Record[F]:
    """The record in a file.

    Raises
    ------
    InputError
        If it cannot be read, is no such record, or is not as it was written.
    """
    data = read_mapping(path)
    record = record_from(data, findings, str(path))
    require_written(data, path)
    return record
