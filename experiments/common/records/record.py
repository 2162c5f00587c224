"""The record of a run: the content of ``result.json`` and of the records in ``results/``.

A study returns a `Result`; the runner adds the rest of the record once.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from pydantic import BeforeValidator, Field

from mvest.errors import InputError
from mvest.files import PREFIX, sha256_of, write_atomically
from mvest.problem.record import EstimateRecord, Frozen
from mvest.provenance import provenance, require_sealed, sealed, write_json
from mvest.reading.documents import read_mapping, validated
from mvest.reporting.tables import Table

if TYPE_CHECKING:
    from mvest.valve.mesh.solid_mesh import SolidMesh

VERSION = 3  # of the layout of a record
FIELDS = "fields.npz"  # file of a run's arrays, next to its record
HASH_DIGITS = 12  # digits of a hash that a line of text shows
# A verdict of the gate on an anatomy begins with one of these.
NOT_GATED, PASSED_GATE, FAILED_GATE = "not gated", "passed", "NOT passed"

Status = Literal["converged", "failed"]
Number: TypeAlias = float | int | str | bool | None


class GitState(Frozen):
    """The commit of a record, and whether tracked files differed; None outside a checkout."""

    sha: str | None
    dirty: bool | None


class Provenance(Frozen):
    """Where a record came from. Hashes are SHA-256."""

    git: GitState
    versions: Mapping[str, str | None]
    threads: Mapping[str, str | None]  # environment variables that cap threads, and their values
    # Kind of golden run -> generation of the numbers; a kind without an entry is of generation 0.
    numbers: Mapping[str, int] = {}
    python: str
    platform: str
    machine: str
    cpu_count: int | None
    config_hash: str
    mesh_hash: str  # "none" without a mesh
    seed: int
    finished: str  # UTC, ISO 8601


class Mesh(Frozen):
    """The estimator's mesh, and the truth's if it has another one."""

    sha256: str
    nodes: int
    elements: int | None = None
    truth_sha256: str | None = None

    @classmethod
    def of(cls, mesh: SolidMesh, truth: SolidMesh | None = None) -> Mesh:
        """The record of a mesh, and of the truth's mesh."""
        return cls(
            sha256=mesh.sha256,
            nodes=len(mesh.nodes),
            elements=len(mesh.elements),
            truth_sha256=None if truth is None else truth.sha256,
        )


class Model(Frozen):
    """The estimator's model, as far as its cost depends on it."""

    element: str
    cells: tuple[int, ...]  # around the valve, from annulus to free edge, through the thickness
    source: str | None = None  # of the mesh
    filter: str | None = None
    noise_mm: float | None = None  # SD of the errors of an observed coordinate


def _plain(tables: Mapping[str, Any]) -> dict[str, Any]:
    return {k: one.plain() if isinstance(one, Table) else one for k, one in tables.items()}


class Result(Frozen):
    """What a study returns: everything that its tables and figures show."""

    # Tidy tables by name, stored as plain data (see `table_of`); "" is the main one.
    tables: Annotated[Mapping[str, Any], BeforeValidator(_plain)] = {}
    # Single values; a name ends with its unit. MLflow gets the numeric ones.
    numbers: Mapping[str, Number] = {}
    estimates: tuple[EstimateRecord, ...] = ()
    # Stored next to the record, for figures; not part of it.
    arrays: Annotated[Mapping[str, Any], Field(exclude=True)] = {}
    status: Status = "converged"
    reason: str = "completed"  # why the run ended
    detail: str = ""
    mesh: Mesh | None = None
    forward_solves: int = 0
    row: str = ""  # what tables call this run; empty: the configuration's ``row``
    parameters: tuple[str, ...] = ()  # empty: those of the configuration
    model: Model | None = None  # None: that of the configuration
    # Verdict of the gate on the configured anatomy (`experiments.common.building.gate`), if any.
    gate: str | None = None

    def changed(self, **values: Any) -> Self:
        """The same with other values, checked like the first ones."""
        known = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**known, **values})

    def table_of(self, name: str = "") -> Table:
        """One of its tables; raises a `KeyError` if it has none of this name."""
        return Table.of_plain(self.tables[name], f"table {name!r}")

    @property
    def converged(self) -> bool:
        """Whether the run ended as it should."""
        return self.status == "converged"


class Record(Result):
    """A finished run: the content of ``result.json`` and of the records in ``results/``."""

    version: int  # of this layout
    study: str
    experiment: str  # name of the configuration
    title: str  # of its table
    table: str  # file name of its table
    factors: Mapping[str, Any]  # what is varied in this job of a sweep, by name
    seconds_total: float  # from the start of the job to its record
    provenance: Provenance

    @property
    def caution(self) -> str:
        """A warning where the anatomy has not passed the gate; else empty."""
        if self.gate == NOT_GATED:
            return (
                "Uniqueness of the closed state was not tested for this anatomy (experiment=gate; "
                "for your own valve check=true gate=true)."
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
    """Whether the gate was passed; None if it was not run."""
    return None if gate == NOT_GATED else gate.startswith(PASSED_GATE)


def model_of_values(values: Mapping[str, Any]) -> Model:
    """The estimator's model that a configuration describes."""
    return Model(
        element=values["mechanics"]["element"],
        cells=tuple(values["mesh"][key] for key in ("columns", "rows", "layers")),
        source=values["mesh"]["source"],
        filter=values["filter"]["mode"],
        noise_mm=values["observation"]["noise_mm"],
    )


def stamp(values: Mapping[str, Any], config_hash: str, result: Result, started: float) -> Record:
    """The record of a result; the job ``started`` so many seconds after the epoch."""
    found = {name: getattr(result, name) for name in Result.model_fields if name != "arrays"}
    found["row"] = result.row or values["row"]
    found["parameters"] = result.parameters or tuple(values["parameters"])
    found["model"] = result.model or model_of_values(values)
    mesh_hash = "none" if result.mesh is None else result.mesh.sha256
    return Record(
        **found,
        version=VERSION,
        study=values["study"],
        experiment=values["name"],
        title=values["title"],
        table=values["table"],
        factors=values["factors"],
        seconds_total=time.time() - started,
        provenance=here_and_now(config_hash, mesh_hash, values["seed"]),
    )


_source = cache(provenance)  # read once: a later checkout does not change what was imported


def here_and_now(config_hash: str, mesh_hash: str, seed: int) -> Provenance:
    """The provenance of what this process writes now."""
    finished = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return Provenance(
        **_source(), config_hash=config_hash, mesh_hash=mesh_hash, seed=seed, finished=finished
    )


ARRAYS = "arrays_sha256"  # in a record's file, the digest of its arrays
NEW_FIELDS = f"{PREFIX}{FIELDS}"  # arrays of a record that is about to be written


def write_record(path: Path, record: Record, arrays: Mapping[str, Any] | None = None) -> None:
    """Write a record as JSON and its arrays next to it, with digests of both.

    A former record and its arrays are replaced only when the new ones are on disk.

    Raises an `InputError` if they cannot be written; the former ones are then still there.
    """
    new = path.with_name(NEW_FIELDS)
    new.unlink(missing_ok=True)
    if arrays:
        write_atomically(new, partial(np.savez_compressed, **arrays))
    write_json(path, sealed_record(record, new))
    adopt_arrays(path)


def adopt_arrays(path: Path) -> None:
    """Rename the new arrays of a record to `FIELDS`; also repairs a write that was killed."""
    new, fields = path.with_name(NEW_FIELDS), path.with_name(FIELDS)
    with suppress(InputError, KeyError):
        digest = read_mapping(path)[ARRAYS]
        if digest is None:
            fields.unlink(missing_ok=True)
        elif new.is_file() and sha256_of(new) == digest:
            new.replace(fields)


def sealed_record(record: Record, arrays: Path) -> dict[str, Any]:
    """Plain data of a record with digests of itself and of its file of arrays, if any."""
    digest = sha256_of(arrays) if arrays.is_file() else None
    return sealed({ARRAYS: digest, **record.model_dump(mode="json")})


def record_from(data: Mapping[str, Any], where: str, arrays: Path | None = None) -> Record:
    """A record from plain data; ``where`` names them in an error.

    ``arrays`` is the file of its arrays, if it has one; None: do not check it. Raises an
    `InputError` if the data are no record of this version, or they or the arrays were changed.
    """
    known = {key: value for key, value in data.items() if key not in ("sha256", ARRAYS)}
    if known.get("version") != VERSION:
        raise InputError(f"{where} is no record of this version ({VERSION})")
    record = validated(Record, known, where)
    require_sealed(data, where)
    if arrays is not None and data.get(ARRAYS) != (sha256_of(arrays) if arrays.is_file() else None):
        raise InputError(f"{where}: its file of arrays is not the one it was written with")
    return record


def read_record(path: Path) -> Record:
    """The record in a file; raises an `InputError` if it is none or was changed."""
    return record_from(read_mapping(path), str(path), path.with_name(FIELDS))
