"""The geometry of a virtual patient as it arrives: a case, and where the valve truly was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from experiments.studies.surfaces.exports import (
    landmarks_on,
    write_label_map,
    write_slicerheart,
)
from experiments.studies.surfaces.settings import DoorSettings
from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.importing.labels import LabelsOptions, import_labels
from mvest.cases.importing.slicerheart import SlicerheartOptions, import_slicerheart
from mvest.cases.paths import CASE_FILE
from mvest.cases.writer import write_case
from mvest.errors import ConfigurationError
from mvest.problem.registration import displace
from mvest.typing import FloatArray
from mvest.valve.geometry.thickening import smooth_vertex_normals
from mvest.valve.io.leaflet_surfaces import write_surface

__all__ = ["DOORS", "Arrived", "arrive"]

POSE = Rotation.from_euler("xz", [1.0, 0.4]).as_matrix()
SHIFT = np.array([31.0, -12.0, 140.0])
"""From the axes of a simulated valve to LPS mm: so that nothing lies along an axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """A case, and where its open and closed midsurfaces truly were, in the axes of the case."""

    case: ValveCase
    opened: Frame
    closed: Frame


def arrive(
    case: ValveCase,
    positions: FloatArray,
    registration: FloatArray,
    door: DoorSettings,
    folder: Path,
) -> Arrived:
    """What becomes of a virtual patient's geometry on its way through a door.

    Parameters
    ----------
    case : ValveCase
        Of the patient, whose vertices correspond.
    positions : ndarray
        ``(n, 3)`` mm, where these truly were in the closed frame.
    registration : ndarray
        ``(6,)`` by which they are displaced against the annulus and the tips that the case states.
    door : DoorSettings
    folder : Path
        Empty; what is exported and imported is left there.

    Raises
    ------
    MvestError
        If there is no such door, or what was exported is refused.
    """
    if door.kind not in DOORS:
        raise ConfigurationError(f"door.kind = {door.kind!r}, expected one of {', '.join(DOORS)}")
    opened, closed = case.frame(Role.REFERENCE), case.frame(Role.CLOSED)
    drawn = closed.vertices if door.seen_with_errors else positions
    true = replace(closed, vertices=positions)
    closed = replace(closed, vertices=drawn, free_edge=drawn[case.free_edge], corresponds=False)
    if door.kind in IMPORTED:
        # Leaflets, annulus and tips are drawn in one image.
        tips = displace(closed.papillary_tips, registration, closed.annulus.mean(axis=0))
        closed = replace(closed, annulus=drawn[case.annulus], papillary_tips=tips)
    return DOORS[door.kind](Arrived(case, opened, true), closed, door, folder)


def _vertices(patient: Arrived, _closed: Frame, _door: DoorSettings, _folder: Path) -> Arrived:
    return patient


def _surfaces(patient: Arrived, closed: Frame, _door: DoorSettings, _folder: Path) -> Arrived:
    return replace(patient, case=replace(patient.case, frames=(patient.opened, closed)))


def _slicerheart(patient: Arrived, closed: Frame, door: DoorSettings, folder: Path) -> Arrived:
    case, export = patient.case, folder / "slicerheart"
    surface = case.surface
    thickness = [
        float(surface.thickness[surface.vertex_region == k].mean())
        for k in range(len(surface.region_names))
    ]
    frames = [("MD", _in_lps(patient.opened)), ("MS", _in_lps(closed))]
    landmarks = landmarks_on(patient.opened.annulus)
    write_slicerheart(export, frames, surface.region_names, thickness, landmarks)
    options = SlicerheartOptions(pressure_mmHg=closed.pressure_mmHg, std_mm=door.std_mm)
    return _posed(patient, import_slicerheart(export, options))


def _labels(patient: Arrived, closed: Frame, door: DoorSettings, folder: Path) -> Arrived:
    if door.voxel_mm is None:
        raise ConfigurationError("door.voxel_mm is not given; a label map has voxels")
    opened, closed = (_in_lps(frame) for frame in (patient.opened, closed))
    thickness = patient.case.surface.thickness
    files = []
    for frame in (opened, closed) if door.closed else (opened,):
        files.append(folder / f"{frame.name}.nii.gz")
        normals = smooth_vertex_normals(frame.vertices, frame.triangles)
        write_label_map(files[-1], frame, normals, thickness, door.voxel_mm)
    options = LabelsOptions(tips=_numbers(opened.papillary_tips), observer_mm=0.0)
    if not door.closed:
        imported = import_labels(files[0], options)
        return _posed(patient, _with_closed(imported, closed, door.std_mm, folder / "by_hand"))
    options = replace(
        options,
        closed=str(files[1]),
        tips_closed=_numbers(closed.papillary_tips),
        pressure_mmHg=closed.pressure_mmHg,
    )
    return _posed(patient, import_labels(files[0], options))


def _numbers(points: FloatArray) -> tuple[float, ...]:
    return tuple(points.ravel().tolist())


def _with_closed(case: ValveCase, closed: Frame, std_mm: float, folder: Path) -> ValveCase:
    """A case of an open frame with a closed one added by hand, as midsurface.

    Its chordae are laid out again, by both frames.
    """
    write_case(folder, case)
    document = yaml.safe_load((folder / CASE_FILE).read_text(encoding="utf-8"))
    region = {"region": np.asarray(closed.region)}
    write_surface(folder / "closed.vtp", closed.vertices, closed.triangles, {}, region)
    document["frames"].append(
        {
            "name": closed.name,
            "time": closed.time,
            "role": closed.role.value,
            "surface": "closed.vtp",
            "papillary_tips": closed.papillary_tips.tolist(),
            "pressure": closed.pressure_mmHg,
            "corresponds": False,
        }
    )
    document["observation"] = {"std_mm": std_mm, "correlation_length_mm": 10.0}
    del document["chordae"]
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    (folder / CASE_FILE).write_text(text, encoding="utf-8")
    return read_case(folder)


def _in_lps(frame: Frame) -> Frame:
    """A frame in the axes of an image, LPS, the left tip first."""
    tips = frame.papillary_tips[np.argsort(frame.papillary_tips[:, 0])]
    return replace(
        frame,
        vertices=_moved(frame.vertices),
        annulus=_moved(frame.annulus),
        free_edge=_moved(frame.free_edge),
        papillary_tips=_moved(tips),
    )


def _moved(points: FloatArray) -> FloatArray:
    return np.asarray(points @ POSE.T + SHIFT)


def _posed(patient: Arrived, case: ValveCase) -> Arrived:
    true = (_in_lps(frame) for frame in (patient.opened, patient.closed))
    return Arrived(replace(case, simulated=True), *true)


IMPORTED = ("slicerheart", "labels")
"""Kinds whose geometry is drawn in images."""
DOORS: dict[str, Callable[[Arrived, Frame, DoorSettings, Path], Arrived]] = {
    "vertices": _vertices,
    "surfaces": _surfaces,
    "slicerheart": _slicerheart,
    "labels": _labels,
}
"""Kind of a door -> what it makes of a patient, whose closed frame was drawn so."""
