"""What the gate has said of an anatomy, from the kept records."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from experiments.common.places import GATE_RECORDS
from experiments.common.records.record import FAILED_GATE, NOT_GATED, PASSED_GATE
from experiments.common.schema import build
from mvest.closure.anchors import content_digest
from mvest.errors import InputError
from mvest.reading.json_file import read_mapping
from mvest.valve.anatomy.template import TemplateParameters

__all__ = ["anatomy_digest", "gate_of"]


def anatomy_digest(values: Mapping[str, Any]) -> str:
    """SHA-256 of the configured anatomy, whatever its file is called."""
    given = values["valve"]
    if given.get("folder") is not None:
        return content_digest(given["folder_sha256"] or "", given["annulus_contraction"])
    return content_digest(build(TemplateParameters, values["valve"]))


def gate_of(values: Mapping[str, Any], records: Path = GATE_RECORDS) -> str:
    """The verdict on the configured anatomy and the mesh it was reached on, or `NOT_GATED`.

    Parameters
    ----------
    values : mapping
        The resolved configuration.
    records : Path
        Folder of the gate's kept records.
    """
    return _verdicts(records).get(anatomy_digest(values), NOT_GATED)


@cache
def _verdicts(records: Path) -> dict[str, str]:
    """Digest of an anatomy -> what the gate said of it; a damaged record says nothing."""
    found: dict[str, str] = {}
    for path in sorted(records.glob("*.json")):
        try:
            record = read_mapping(path)
            cells, element = record["model"]["cells"], record["model"]["element"]
            passed = PASSED_GATE if record["findings"]["passed"] is True else FAILED_GATE
            found[str(record["findings"]["anatomy"])] = (
                f"{passed} on {cells[0]} x {cells[1]} {element}"
            )
        except (InputError, KeyError, TypeError, IndexError):
            continue
    return found
