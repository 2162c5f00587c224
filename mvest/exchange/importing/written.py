"""A case from frames that an importer found: written as a folder and read by the usual rules."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.schema import CASE_FILE
from mvest.cases.tissue import CHORD_COLUMNS, FAMILIES
from mvest.errors import InputError, MvestError
from mvest.exchange.surfaces import Surface, write_surface
from mvest.reading.text import write_columns
from mvest.typing import FloatArray
from mvest.valve.geometry.midsurface import Midsurface


def check_options(
    options: object, counts: Mapping[str, int], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Check the options that are lists of so many entries, or numbers within limits.

    Raises
    ------
    InputError
        One has another length, a number that is not finite, or is beyond its limits.
    """
    for name, count in counts.items():
        given = getattr(options, name)
        if given is None:
            continue
        finite = all(isinstance(one, str) or np.isfinite(one) for one in given)
        if len(given) != count or not finite:
            raise InputError(f"{name}={list(given)}, expected {count} of them")
    for name, (low, high) in limits.items():
        if not low <= (value := getattr(options, name)) <= high:
            raise InputError(f"{name}={value}, expected {low:g} to {high:g}")


@dataclass(frozen=True, slots=True, eq=False)
class FoundFrame:
    """A frame, in mm, mmHg and s; see ``frames`` of a case for what its fields mean."""

    name: str
    role: Role
    time: float
    pressure: float
    surface: Midsurface | Surface
    tips: FloatArray
    thickness: FloatArray | None = None


def case_of_frames(
    frames: Sequence[FoundFrame],
    document: Mapping[str, Any],
    chordae: Sequence[Sequence[object]] = (),
) -> ValveCase:
    """The case of frames without common vertices, with the checks and rules of every case.

    Parameters
    ----------
    frames
        The reference and others.
    document
        Further fields of ``case.yaml``.
    chordae
        Rows of a table with `CHORD_COLUMNS`; without any, chordae are laid out.

    Raises
    ------
    InputError, GeometryError
        As `mvest.cases.folder.read_case`, without the name of a folder.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder, entries = Path(temporary), []
        for number, one in enumerate(frames):
            data = {} if one.thickness is None else {"thickness": one.thickness}
            surface, labels = one.surface, {"region": np.asarray(one.surface.region)}
            write_surface(
                folder / f"{number}.vtp", surface.vertices, surface.triangles, data, labels
            )
            entry = {"name": one.name, "role": one.role.value, "time": float(one.time)}
            entry |= {"surface": f"{number}.vtp", "papillary_tips": one.tips.tolist()}
            apart = {} if one.role is Role.REFERENCE else {"corresponds": False}
            entries.append(entry | {"pressure": float(one.pressure)} | apart)
        if chordae:
            write_columns(folder / "chordae.csv", CHORD_COLUMNS, chordae)
            table = {"file": "chordae.csv", "families": list(FAMILIES)}
            document = {**document, "chordae": table}
        units = {"length": "mm", "pressure": "mmHg", "time": "s"}
        whole = {"version": 1, "units": units, **document, "frames": entries}
        text = yaml.safe_dump(whole, sort_keys=False, allow_unicode=True)
        (folder / CASE_FILE).write_text(text, encoding="utf-8")
        try:
            return replace(read_case(folder), sha256="")
        except MvestError as fault:
            said = str(fault).replace(f"{folder / CASE_FILE}: ", "").replace(f"{folder}/", "")
            raise type(fault)(said) from fault
