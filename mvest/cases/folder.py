"""Reading and writing a case as a folder: ``case.yaml`` and the files that it names.

``README.md`` in this package explains the fields. Every error begins with its file and field. Joint
errors of all frames are one file of named arrays, NumPy's ``.npz``.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mvest.cases.band import check_closing_pressure
from mvest.cases.case import (
    Arrival,
    ErrorSamples,
    Frame,
    Role,
    Uncertainty,
    ValveCase,
    check_different,
    check_frames,
)
from mvest.cases.frames import LOOPS, SeenFrame, place_frame, read_frame, reference_band
from mvest.cases.schema import CASE_FILE, VERSION, CaseFolder, PointData
from mvest.cases.tissue import point_data, read_chordae, read_leaflets, write_chordae
from mvest.errors import InputError
from mvest.exchange.surfaces import Surface, write_surface
from mvest.files import write_atomically
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line, write_columns
from mvest.typing import FloatArray
from mvest.units import kpa_to_mpa, mpa_to_mmhg


def read_error_samples(file: Path, frames: Sequence[str]) -> ErrorSamples:
    """Read the error samples of a case with frames of these names, in this order.

    The arrays are ``frames``, names ``(f,)``, ``vertices (K, f, n, 3)`` and ``tips (K, f, t, 3)``
    as in `ErrorSamples`, mm, and optionally ``source (K,)``, integers. InputError if the file is
    not a ``.npz`` of these, or belongs to other frames.
    """
    if file.suffix.lower() != ".npz":
        raise InputError(f"{file.name}: extension {file.suffix!r}, expected .npz")
    arrays = "frames", "vertices", "tips"
    stored = read_npz(file, arrays, exact=True, optional=("source",), where=file.name)
    names = stored.pop("frames")
    if names.ndim != 1 or names.dtype.kind != "U" or names.tolist() != list(frames):
        text = names.dtype.kind == "U"
        shown = one_line(names.tolist(), 80) if text else f"an array of {names.dtype}"
        raise InputError(f"{file.name}: frames {shown}, expected {one_line(list(frames), 120)}")
    return ErrorSamples(**stored)


def write_error_samples(file: Path, samples: ErrorSamples, frames: Sequence[str]) -> None:
    """Write error samples to a ``.npz`` file."""
    arrays: dict[str, Any] = {"vertices": samples.vertices, "tips": samples.tips}
    if samples.source is not None:
        arrays["source"] = samples.source
    np.savez_compressed(file, frames=np.array(list(frames)), **arrays)


TEXTS = ("name", "description", "source", "licence", "simulated")
"""Fields of both a case and its file."""

GENERIC_UNCERTAINTY = Uncertainty(1.0, 10.0)
"""Leaflets tracked in echocardiography have smooth errors of about 1 mm."""


def read_case(path: Path | str) -> ValveCase:
    """Read a case folder (the folder with ``case.yaml``).

    InputError or GeometryError for anything missing, unknown, inadmissible or contradictory: one
    error with file, field, numbers, and what would be right.
    """
    folder = CaseFolder(Path(path))
    if not folder.root.is_dir():
        raise InputError(f"{folder.root}: no such folder; expected a folder with {CASE_FILE}")
    if not folder.case.is_file():
        raise InputError(f"{folder.root}: no {CASE_FILE} in this folder")
    document = folder.document
    check_different("regions", document.region_names, folder.wrong)
    check_frames(document.frames, folder.wrong)
    seen = [read_frame(folder, number) for number in range(len(document.frames))]
    first = next(s for s in seen if s.entry.role == Role.REFERENCE)
    reference = reference_band(folder, first)
    pressures = _pressures(folder)
    placed = [place_frame(folder, reference, s, p) for s, p in zip(seen, pressures, strict=True)]
    surface = read_leaflets(folder, reference)
    chordae = read_chordae(folder, reference, placed)
    uncertainty, samples = _observation(folder, first)
    entry, arrival = document.chordae, document.arrival
    case = ValveCase(
        **{name: getattr(document, name) for name in TEXTS},
        surface=surface,
        annulus=reference.annulus,
        free_edge=reference.free_edge,
        frames=tuple(frame for frame, _ in placed),
        chordae=chordae,
        uncertainty=uncertainty,
        derived=tuple(dict.fromkeys(folder.derived)),
        sha256=folder.sha256(),
        error_samples=samples,
        chordae_follow=entry is None or entry.follow,
        arrival=None if arrival is None else Arrival(arrival.way, arrival.made_by),
    )
    if entry is not None:
        with folder.at("chordae"):
            _ = case.valve  # checks that its chordae connect tips and leaflets
    return case


def _observation(
    folder: CaseFolder, reference: SeenFrame
) -> tuple[Uncertainty, ErrorSamples | None]:
    """Errors of the vertices, and the joint errors of all frames."""
    given = folder.document.observation
    if given is None:
        folder.derived.append(
            f"observation: standard deviation {GENERIC_UNCERTAINTY.std_mm:g} mm and correlation "
            f"length {GENERIC_UNCERTAINTY.correlation_length_mm:g} mm assumed"
        )
        return GENERIC_UNCERTAINTY, None
    with folder.at("observation.std_mm"):
        std: float | FloatArray
        if isinstance(given.std_mm, PointData):
            std = point_data(reference, given.std_mm.point_data, 1)[:, 0]
        else:
            std = given.std_mm
        uncertainty = Uncertainty(std, given.correlation_length_mm)
    if given.error_samples is None:
        return uncertainty, None
    file = folder.file(given.error_samples, "observation.error_samples")
    with folder.at("observation.error_samples"):
        names = [frame.name for frame in folder.document.frames]
        return uncertainty, read_error_samples(file, names)


def _pressures(folder: CaseFolder) -> list[float]:
    """Transmitral pressure (mmHg) of every frame."""
    unit = folder.document.units.pressure
    to_mmhg = 1.0 if unit == "mmHg" else mpa_to_mmhg(kpa_to_mpa(1.0))
    pressures = [to_mmhg * frame.pressure for frame in folder.document.frames]
    for number, frame in enumerate(folder.document.frames):
        if frame.role != Role.REFERENCE:
            with folder.at(f"frames.{number}.pressure"):
                check_closing_pressure(pressures[number], unit)
    return pressures


def write_case(folder: Path | str, case: ValveCase) -> Path:
    """Write a case: ``case.yaml``, one ``.vtp`` per frame, loops and chordae as ``.csv``.

    Everything is stated explicitly, in mm, s and mmHg, so that nothing is derived on reading. The
    folder must be new or empty, and appears only when it is complete. It is returned. InputError if
    it is not empty or cannot be written.
    """
    target = require_new(folder)
    return write_atomically(target, lambda part: _write_files(part, case))


def require_new(folder: Path | str) -> Path:
    """The folder to write a case to; InputError if it has any content."""
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target}: exists and is not an empty folder; expected a new one")
    return target


def _write_files(folder: Path, case: ValveCase) -> None:
    folder.mkdir()
    chordae, std = case.chordae, case.uncertainty.std_mm
    observation: dict[str, Any] = {
        "std_mm": {"point_data": "std_mm"} if isinstance(std, np.ndarray) else float(std),
        "correlation_length_mm": float(case.uncertainty.correlation_length_mm),
    }
    if case.error_samples is not None:
        observation["error_samples"] = "errors.npz"
        names = [frame.name for frame in case.frames]
        write_error_samples(folder / "errors.npz", case.error_samples, names)
    document: dict[str, Any] = {
        "version": VERSION,
        **{name: getattr(case, name) for name in TEXTS},
        "units": {"length": "mm", "pressure": "mmHg", "time": "s"},
        "regions": list(case.surface.region_names),
        "thickness": {"point_data": "thickness"},
        "fibre": "fibre",
        "frames": [_write_frame(folder, case, k, own) for k, own in enumerate(case.frames)],
        "chordae": {
            "file": "chordae.csv",
            "toe_strain": float(chordae.toe_strain),
            "families": list(chordae.family_names),
            **({"follow": True} if case.chordae_follow else {}),
        },
        "observation": observation,
        **({"arrival": asdict(case.arrival)} if case.arrival else {}),
        "derived": list(case.derived),
    }
    write_chordae(folder / "chordae.csv", chordae)
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)
    (folder / CASE_FILE).write_text(text, encoding="utf-8")


def _write_frame(folder: Path, case: ValveCase, number: int, frame: Frame) -> dict[str, Any]:
    stem = f"frame_{number:02d}"
    point_data = {}
    if frame.role is Role.REFERENCE:
        point_data = {"fibre": case.surface.fibre, "thickness": case.surface.thickness}
        if isinstance(case.uncertainty.std_mm, np.ndarray):
            point_data["std_mm"] = case.uncertainty.std_mm
    cell_data = {"region": np.asarray(frame.region)}
    surface = Surface(frame.vertices, frame.triangles, point_data, cell_data)
    write_surface(folder / f"{stem}.vtp", surface)
    for name in LOOPS:
        file = folder / f"{stem}_{name}.csv"
        if frame.role is Role.REFERENCE:
            write_columns(file, ("vertex",), ([v] for v in getattr(case, name).tolist()))
        else:
            write_columns(file, ("x", "y", "z"), getattr(frame, name).tolist())
    return {
        "name": frame.name,
        "time": float(frame.time),
        "role": frame.role.value,
        "surface": f"{stem}.vtp",
        **{name: f"{stem}_{name}.csv" for name in LOOPS},
        "papillary_tips": np.asarray(frame.papillary_tips, dtype=np.float64).tolist(),
        "pressure": float(frame.pressure_mmHg),
        **({} if frame.role is Role.REFERENCE else {"corresponds": bool(frame.corresponds)}),
    }
