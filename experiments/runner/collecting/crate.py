"""Provenance of a folder of results as an RO-Crate: one JSON-LD file that says what made what.

The format is RO-Crate 1.1 (https://w3id.org/ro/crate/1.1): a folder, its files with their SHA-256,
and for each record an action that made it, with the software, its commit, the configuration and the
data that it was computed from. It is a page of JSON, so it is written here; ``rocrate``, which
writes it too, brings five packages for that.
"""

from __future__ import annotations

import mimetypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from experiments.common.records.record import HASH_DIGITS, Record, require_written
from experiments.runner.jobs.compared import Compared, compared
from mvest.errors import InputError
from mvest.files import sha256_of
from mvest.provenance import write_json
from mvest.reading.json_file import read_mapping

__all__ = ["CRATE", "write_crate"]

CRATE = "ro-crate-metadata.json"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
LEFT_OUT = {"log.txt", "plan.json", "done", "tracked.json", CRATE}
"""Files that keep what was typed, names of files included; marks of the runner; the crate."""
MAX_FILES = 10_000
UNSTATED = "not stated"
RECORD, CONFIG, RECORDS = "result.json", "config.json", "records/*/*.json"

Entity = dict[str, Any]


def write_crate(folder: Path) -> Path:
    """Describe a run's folder, or a folder of published results, in ``ro-crate-metadata.json``.

    Raises
    ------
    InputError
        If it holds no record, a record is not as it was written, or the file cannot be written.
    """
    single = folder / RECORD
    paths = [single] if single.is_file() else sorted(folder.glob(RECORDS))
    if not paths:
        raise InputError(f"{folder}: no {RECORD} of a run, and no records of published results")
    datas = [read_mapping(path) for path in paths]
    for data, path in zip(datas, paths, strict=True):
        require_written(data, path)
    records = [compared(data, str(path)) for data, path in zip(datas, paths, strict=True)]
    files = [_file(path, folder) for path in _files(folder)]
    graph = [*_root(records, datas, files), *files]
    for path, record in zip(paths, records, strict=True):
        graph += _action(quote(path.relative_to(folder).as_posix()), record, files)
    unique = {str(entity["@id"]): entity for entity in graph}
    content = {"@context": f"{SPECIFICATION}/context", "@graph": list(unique.values())}
    write_json(folder / CRATE, content)
    return folder / CRATE


def _files(folder: Path) -> list[Path]:
    found = [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.name not in LEFT_OUT
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    if len(found) > MAX_FILES:
        raise InputError(f"{folder}: {len(found)} files, expected at most {MAX_FILES}")
    return found


def _file(path: Path, folder: Path) -> Entity:
    kind, _ = mimetypes.guess_type(path.name)
    return {
        "@id": quote(path.relative_to(folder).as_posix()),
        "@type": "File",
        "name": path.name,
        "encodingFormat": kind or "application/octet-stream",
        "contentSize": str(path.stat().st_size),
        "sha256": sha256_of(path),
    }


def _root(
    records: Sequence[Record[Compared]],
    datas: Sequence[Mapping[str, Any]],
    files: Sequence[Entity],
) -> list[Entity]:
    """The file itself, and the folder that it is about."""
    alone = records[0] if len(records) == 1 else None
    cases = [(data.get("findings") or {}).get("case") or {} for data in datas]
    licences = {(case.get("about") or {}).get("licence") or UNSTATED for case in cases}
    return [
        {
            "@id": CRATE,
            "@type": "CreativeWork",
            "about": {"@id": "./"},
            "conformsTo": {"@id": SPECIFICATION},
        },
        {
            "@id": "./",
            "@type": "Dataset",
            "name": alone.title if alone else "Results of mvest",
            "description": (
                f"{alone.row}: {alone.status}, {alone.reason}"
                if alone
                else f"{len(records)} records with their tables and figures"
            ),
            "datePublished": max(record.provenance.finished for record in records),
            "license": ", ".join(sorted(licences)),
            "hasPart": [_at(entity) for entity in files],
            "mentions": [{"@id": _name(record)} for record in records],
        },
    ]


def _action(place: str, record: Record[Compared], files: Sequence[Entity]) -> list[Entity]:
    """What made a record, with what, and from what."""
    source = record.provenance
    version = source.versions.get("mvest") or "unknown"
    commit = f"{source.git.sha or 'unknown'}{'+changes' if source.git.dirty else ''}"
    software = {
        "@id": f"#mvest-{commit}",
        "@type": "SoftwareApplication",
        "name": "mvest",
        "softwareVersion": version,
        "version": commit,
        "softwareRequirements": ", ".join(
            f"{name} {found}" for name, found in sorted(source.versions.items()) if found
        ),
    }
    inputs = [
        {
            "@id": f"#configuration-{source.config_hash}",
            "@type": "PropertyValue",
            "name": "SHA-256 of the configuration",
            "value": source.config_hash,
        }
    ]
    data = record.findings.data
    if data is not None:
        inputs.append(
            {
                "@id": f"#data-{data.sha256}",
                "@type": "CreativeWork",
                "name": data.citation or "data",
                "sha256": data.sha256,
            }
        )
    of_config = [entity for entity in files if entity["@id"] == CONFIG]
    made = [
        entity for entity in files if _made_with(entity, place, record) and entity not in of_config
    ]
    action = {
        "@id": _name(record),
        "@type": "CreateAction",
        "name": f"{record.experiment}: {record.row}",
        "instrument": _at(software),
        "object": [_at(entity) for entity in (*of_config, *inputs)],
        "result": [_at(entity) for entity in made],
        "endTime": source.finished,
        "actionStatus": {
            "@id": f"http://schema.org/{'Completed' if record.converged else 'Failed'}ActionStatus"
        },
    }
    return [software, *inputs, action | ({} if record.converged else {"error": record.reason})]


def _made_with(entity: Entity, place: str, record: Record[Compared]) -> bool:
    """Whether a file belongs to a record: all of a run's folder, or what is called after it."""
    name = str(entity["@id"])
    return place == RECORD or name == place or name.partition(".")[0] == quote(record.experiment)


def _name(record: Record[Compared]) -> str:
    key = f"{record.provenance.config_hash[:HASH_DIGITS]}-{record.provenance.seed}"
    return f"#{quote(record.experiment)}-{key}"


def _at(entity: Entity) -> dict[str, str]:
    return {"@id": str(entity["@id"])}
