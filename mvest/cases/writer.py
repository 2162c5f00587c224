"""Writing a case as a folder that `mvest.cases.folder.read_case` reads back unchanged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import write_error_samples
from mvest.cases.schema import CASE_FILE, VERSION
from mvest.cases.tissue import CHORD_COLUMNS
from mvest.errors import InputError
from mvest.exchange.surfaces import write_surface
from mvest.files import write_atomically
from mvest.reading.text import write_columns


def write_case(folder: Path | str, case: ValveCase) -> Path:
    """Write a case: ``case.yaml``, one ``.vtp`` per frame, loops and chordae as ``.csv``.

    Everything is given explicitly, in mm, s and mmHg, so that nothing is derived anew on reading.
    The folder appears under its name only once it is complete.

    Parameters
    ----------
    folder
        A folder that does not exist yet (or is empty), in one that does.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The folder is not empty or cannot be written, or the reference frame is not the surface of
        the case.
    """
    target = require_new(folder)
    _check_reference(case)
    return write_atomically(target, lambda part: _write_files(part, case))


def require_new(folder: Path | str) -> Path:
    """The folder, where a case may be written.

    Raises
    ------
    InputError
        There is something.
    """
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target}: exists and is not an empty folder; expected a new one")
    return target


def _check_reference(case: ValveCase) -> None:
    frame, surface = case.frame(Role.REFERENCE), case.surface
    own = {name: getattr(surface, name) for name in ("vertices", "triangles", "region")}
    own |= {name: surface.vertices[getattr(case, name)] for name in ("annulus", "free_edge")}
    for name, wanted in own.items():
        if not np.array_equal(getattr(frame, name), wanted):
            raise InputError(
                f"case {case.name}: {name} of the reference frame {frame.name!r} is not as the "
                "surface has it"
            )


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
        "name": case.name,
        "description": case.description,
        "source": case.source,
        "licence": case.licence,
        "simulated": case.simulated,
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
        "derived": list(case.derived),
    }
    families = [chordae.family_names[k] for k in chordae.family]
    write_columns(
        folder / "chordae.csv",
        CHORD_COLUMNS,
        zip(
            chordae.tip.tolist(),
            *chordae.insertion.T.tolist(),
            families,
            chordae.rest_length.tolist(),
            chordae.axial_stiffness.tolist(),
            strict=True,
        ),
    )
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)
    (folder / CASE_FILE).write_text(text, encoding="utf-8")


def _write_frame(folder: Path, case: ValveCase, number: int, frame: Frame) -> dict[str, Any]:
    stem = f"frame_{number:02d}"
    point_data = {}
    if frame.role is Role.REFERENCE:
        point_data = {"fibre": case.surface.fibre, "thickness": case.surface.thickness}
        if isinstance(case.uncertainty.std_mm, np.ndarray):
            point_data["std_mm"] = case.uncertainty.std_mm
    write_surface(
        folder / f"{stem}.vtp",
        frame.vertices,
        frame.triangles,
        point_data,
        {"region": np.asarray(frame.region)},
    )
    for name in ("annulus", "free_edge"):
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
        "annulus": f"{stem}_annulus.csv",
        "free_edge": f"{stem}_free_edge.csv",
        "papillary_tips": np.asarray(frame.papillary_tips, dtype=np.float64).tolist(),
        "pressure": float(frame.pressure_mmHg),
        **({} if frame.role is Role.REFERENCE else {"corresponds": bool(frame.corresponds)}),
    }
