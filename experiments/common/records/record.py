"""The record of a run: what ``result.json`` and the kept records in ``results/`` hold.

A study returns a `Result`; everything else that a record says is stamped once, by the runner. The
numbers that runs are compared by are taken from it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, ValidationError

from mvest.errors import InputError
from mvest.files import sha256_of
from mvest.problem.record import EstimateRecord
from mvest.provenance import provenance, require_sealed, sealed, write_json
from mvest.reading.documents import read_mapping
from mvest.reporting.tables import Table

if TYPE_CHECKING:
    from experiments.common.study import Result
    from mvest.valve.mesh.solid_mesh import SolidMesh
from collections.abc import Sequence
from statistics import fmean, stdev

VERSION = 3
"""Of the layout of a record."""

FIELDS = "fields.npz"
"""What a run leaves of arrays beside its record."""

HASH_DIGITS = 12
"""Digits of a hash that a line of text shows."""

NOT_GATED, PASSED_GATE, FAILED_GATE = "not gated", "passed", "NOT passed"
"""What the gate has said of an anatomy begins with one of these."""

Status = Literal["converged", "failed"]
Number: TypeAlias = float | int | str | bool | None


class Frozen(BaseModel):
    """A part of a record: immutable, and without fields that it does not name."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class GitState(Frozen):
    """The commit that computed a record; None outside a checkout.

    Attributes
    ----------
    sha : str or None
    dirty : bool or None
        Whether tracked files differed from it.
    """

    sha: str | None
    dirty: bool | None


class Provenance(Frozen):
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


class Mesh(Frozen):
    """The estimator's mesh, and the truth's where there is another."""

    sha256: str
    nodes: int
    elements: int | None = None
    truth_sha256: str | None = None

    @classmethod
    def of(cls, mesh: SolidMesh, truth: SolidMesh | None = None) -> Mesh:
        """What a record says of a mesh, and of that of the truth."""
        return cls(
            sha256=mesh.sha256,
            nodes=len(mesh.nodes),
            elements=len(mesh.elements),
            truth_sha256=None if truth is None else truth.sha256,
        )


class Model(Frozen):
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


class Record(Frozen):
    """A finished run: what ``result.json`` and the kept records in ``results/`` hold.

    Attributes
    ----------
    version : int
        Of this layout.
    study, experiment, title, row, table : str
        Its study, its configuration, and what tables call it.
    status : {"converged", "failed"}
    reason, detail : str
        Why the run ended.
    parameters : tuple of str
    factors : mapping
        What is varied in this job of a sweep, by name.
    seconds_total : float
        From the start of the job to its record.
    forward_solves : int
    model : Model or None
    mesh : Mesh or None
    provenance : Provenance
    estimates : tuple of EstimateRecord
    numbers : mapping
        Single values by name, with the unit at the end of the name.
    tables : mapping
        Name -> plain data of a `mvest.reporting.tables.Table`.
    gate : str or None
        What the gate said of the anatomy (see `experiments.common.building.gate`); None where the
        study uses none of the configured anatomies.
    """

    version: int
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
    estimates: tuple[EstimateRecord, ...] = ()
    numbers: Mapping[str, Number] = {}
    tables: Mapping[str, Mapping[str, Any]] = {}
    gate: str | None = None

    def table_of(self, name: str = "") -> Table:
        """One of its tables.

        Raises
        ------
        KeyError
            If it has none of this name.
        """
        return Table.of_plain(self.tables[name], f"table {name!r} of {self.experiment}")

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
        element=values["mechanics"]["element"],
        cells=tuple(values["mesh"][key] for key in ("columns", "rows", "layers")),
        source=values["mesh"]["source"],
        filter=values["filter"]["mode"],
        noise_mm=values["observation"]["noise_mm"],
    )


def stamp(values: Mapping[str, Any], config_hash: str, result: Result, started: float) -> Record:
    """The record of what a study returned.

    Parameters
    ----------
    values : mapping
        The resolved configuration.
    config_hash : str
    result : Result
    started : float
        Seconds since the epoch.
    """
    mesh = result.mesh
    return Record(
        version=VERSION,
        study=values["study"],
        experiment=values["name"],
        title=values["title"],
        row=result.row or values["row"],
        table=values["table"],
        status=result.status,
        reason=result.reason,
        detail=result.detail,
        parameters=result.parameters or tuple(values["parameters"]),
        factors=dict(values["factors"]),
        seconds_total=time.time() - started,
        forward_solves=result.forward_solves,
        model=result.model or model_of_values(values),
        mesh=mesh,
        provenance=here_and_now(
            config_hash, "none" if mesh is None else mesh.sha256, values["seed"]
        ),
        estimates=result.estimates,
        numbers=result.numbers,
        tables={name: table.plain() for name, table in result.tables.items()},
        gate=result.gate,
    )


def here_and_now(config_hash: str, mesh_hash: str, seed: int) -> Provenance:
    """The provenance of what is written by this process."""
    source = _source()
    return Provenance(
        **source,
        config_hash=config_hash,
        mesh_hash=mesh_hash,
        seed=seed,
        finished=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    )


@cache
def _source() -> dict[str, Any]:
    """Asked for once: a process computes by what it has imported, whatever is checked out since."""
    return provenance()


def write_record(path: Path, record: Record, arrays: Path | None = None) -> None:
    """Write a record as JSON, whole or not at all, with digests of itself and of its arrays.

    The arrays are those beside it if not given.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    write_json(path, sealed_record(record, arrays or path.with_name(FIELDS)))


ARRAYS = "arrays_sha256"
"""In a record's file, the digest of its arrays."""


def sealed_record(record: Record, arrays: Path) -> dict[str, Any]:
    """Plain data of a record with digests of itself and of its file of arrays, if it has one."""
    digest = sha256_of(arrays) if arrays.is_file() else None
    return sealed({ARRAYS: digest, **record.model_dump(mode="json")})


def record_from(data: Mapping[str, Any], where: str, arrays: Path | None = None) -> Record:
    """A record from plain data, which must be as they were written.

    Parameters
    ----------
    data : mapping
    where : str
        Names the data in an error.
    arrays : Path, optional
        Where the file of its arrays lies, if it has one; not checked if not given.

    Raises
    ------
    InputError
        If the data are no record of this version, or they or the arrays were changed since.
    """
    known = {key: value for key, value in data.items() if key not in ("sha256", ARRAYS)}
    if known.get("version") != VERSION:
        raise InputError(f"{where} is no record of this version ({VERSION})")
    try:
        record = Record.model_validate(known)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "it"
        raise InputError(f"{where} is no record of a run: {field}: {first['msg']}") from error
    require_sealed(data, where)
    if arrays is not None and data.get(ARRAYS) != (sha256_of(arrays) if arrays.is_file() else None):
        raise InputError(f"{where}: the arrays beside it are not those that it was written with")
    return record


def read_record(path: Path) -> Record:
    """The record in a file of a run's folder.

    Raises
    ------
    InputError
        If it cannot be read, is no such record, or is not as it was written.
    """
    return record_from(read_mapping(path), str(path), path.with_name(FIELDS))


LARGEST_ERROR = 1.0
"""Relative error of a modulus beyond which an estimate is no answer."""


def short_names(names: Sequence[str]) -> list[str]:
    """Names of parameters without a common beginning: ``E_f.anterior`` becomes ``anterior``."""
    together = len({name.split(".")[0] for name in names}) == 1 and all("." in n for n in names)
    return [name.split(".", 1)[1] if together else name for name in names]


def metrics(record: Record) -> dict[int, dict[str, float]]:
    """Step -> name -> number; step 0 has all but the iterates, with the mean error (%) first.

    Of a job that repeats over seeds these are means over the estimates that converged, and
    ``spread`` is their standard deviation.
    """
    runs, short = (
        record.estimates,
        dict(zip(record.parameters, short_names(record.parameters), strict=True)),
    )
    pairs: list[tuple[str, float | None]] = []
    for run in (run for run in runs if run.converged):
        for one in (one for one in run.unknowns if one.name in short):
            name, error = short[one.name], one.relative_error
            percent = None if error is None else 100.0 * abs(error)
            pairs += [("error.mean", percent), (f"error.{name}", percent)]
            pairs += [(f"estimate.{name}", one.estimate), (f"std.{name}", one.std)]
        for key, far in ("distance", run.distance_mm), ("distance_truth", run.distance_to_truth_mm):
            pairs += [(f"{key}.mean", far.mean), (f"{key}.max", far.max)] if far else []
        pairs += [("nis", run.innovation.nis)] if run.innovation else []
    pairs += [("iterations", run.iterations or 0) for run in runs]
    series: dict[str, list[float]] = {}
    for key, value in pairs:
        series.setdefault(key, []).extend([] if value is None else [value])
    found = {0: {key: fmean(values) for key, values in series.items() if values}}
    for name in short.values():
        if len(values := series.get(f"estimate.{name}", [])) > 1:
            found[0][f"spread.{name}"] = stdev(values)
    numbers = {"forward_solves": record.forward_solves, **record.numbers}
    if runs:
        numbers["failed"] = sum(not run.converged for run in runs)
        numbers["seconds"] = sum(run.seconds or 0.0 for run in runs)
    found[0] |= {k: float(v) for k, v in numbers.items() if isinstance(v, int | float)}
    for step, iterate in enumerate(runs[0].iterates if runs else ()):
        for one, value in zip(runs[0].parameters, iterate, strict=False):
            if value is not None:
                found.setdefault(step, {})[f"iterate.{short.get(one.name, one.name)}"] = value
    return found


def implausible(record: Record) -> str:
    """Why a run is not to be compared with others; empty if it is.

    It failed, its verdict is that there is no estimate, or a modulus is wrong by more than its
    truth, where that is known.
    """
    if not record.converged:
        return "failed"
    for one in (one for one in record.estimates if one.converged):
        if not one.is_stated:
            return "the verdict is that there is no estimate"
        for unknown in one.moduli:
            if (error := abs(unknown.relative_error or 0.0)) > LARGEST_ERROR:
                return f"{unknown.name} is wrong by {error:.0%} of the truth"
    return ""
