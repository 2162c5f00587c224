"""3D Slicer and ParaView: surfaces over time, and landmarks with the labels of SlicerHeart."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvest.cases.band import commissures, directed
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.cases.schema import CASE_FILE
from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.surfaces import Data, Surface, region_arrays, write_surface_series
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import ANNULUS_LABELS, slicerheart_labels
from mvest.problem.fields import CaseFields, case_fields
from mvest.reading.npz import read_npz
from mvest.reading.text import refusing
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import principal_stretches

FIELDS = "fields.npz"
MUSCLES = ("antero-lateral", "postero-medial")


@dataclass(frozen=True, slots=True)
class SlicerOptions:
    """The exporter has no options."""


def export_slicer(source: Path, target: Path, options: SlicerOptions) -> Path:
    """Write a case folder, or the folder of a run, as a folder for 3D Slicer and ParaView.

    ``NAME.pvd`` with ``NAME_0000.vtp``, ... are midsurfaces over time (LPS, mm): ``frames`` of a
    case; ``observed``, ``generic`` and ``fitted`` of a run, with displacement and stretches
    relative to the open valve, and the distance from the observed surface if the run stored it.
    ``NAME.mrk.json`` has the annulus, its SlicerHeart landmarks and the papillary tips of each
    frame. A closure (``experiment=closure``) is written as ``closing``: thick leaflets at every
    stored time, with first principal stress and contact pressure.

    InputError if the source is neither a case nor a run; the target exists or cannot be written.

    Parameters
    ----------
    source
        A folder with ``case.yaml`` or ``fields.npz``.
    target
        A new folder.
    options
    """
    if target.exists():
        raise InputError(f"{target}: exists; expected a new folder")
    if (source / CASE_FILE).is_file():
        case = read_case(source)
        return write_atomically(target, lambda part: _write_case(part, case))
    if not (source / FIELDS).is_file():
        raise InputError(f"{source}: neither a case ({CASE_FILE}) nor a run with shapes ({FIELDS})")
    if "times" in read_npz(source / FIELDS):
        return write_atomically(target, lambda part: _write_closing(part, source / FIELDS))
    fields = case_fields(source / FIELDS, turned=False)
    if not fields.leaflets:
        raise InputError(f"{source / FIELDS}: no names of leaflets; run the case again")
    return write_atomically(target, lambda part: _write_run(part, fields))


def _write_case(folder: Path, case: ValveCase) -> None:
    folder.mkdir()
    surface, names = case.surface, case.surface.region_names
    order = _ring(case.annulus, surface.triangles, surface.region, names)
    states = []
    for frame in case.frames:
        data: Data = {}
        if frame.corresponds:
            data = _deformation(surface.vertices, frame.vertices, surface.triangles)
        cells = region_arrays(frame.region, names)
        states.append(Surface(frame.vertices, frame.triangles, data, cells))
        _write_landmarks(folder, frame.name, frame.annulus, order, frame.papillary_tips)
    write_surface_series(folder / "frames.pvd", [frame.time for frame in case.frames], states)


def _write_run(folder: Path, fields: CaseFields) -> None:
    folder.mkdir()
    names = fields.leaflets
    cells = region_arrays(fields.region, names)
    for name in ("observed", "generic", "fitted"):
        moved = getattr(fields, name)
        if moved is None or not np.isfinite(moved).all():
            continue
        distance, states = getattr(fields, f"distance_{name}", None), []
        for k, points in enumerate([fields.rest, *moved]):
            data = _deformation(fields.rest, points, fields.triangles)
            if distance is not None:
                # Slicer needs the same arrays in all states, also in the open valve.
                data["distance_mm"] = distance[k - 1] if k else np.zeros(len(points))
            states.append(Surface(points, fields.triangles, data, cells))
        write_surface_series(folder / f"{name}.pvd", range(len(states)), states)
    order = _ring(fields.annulus, fields.triangles, fields.region, names)
    for k, stage in enumerate(("open", *fields.frames)):
        x = fields.rest if k == 0 or fields.fitted is None else fields.fitted[k - 1]
        _write_landmarks(folder, stage, x[fields.annulus], order, fields.tips[k])


def _write_closing(folder: Path, file: Path) -> None:
    folder.mkdir()
    with refusing(file, "fields of a closure"):
        arrays = read_npz(file)
        shapes = np.asarray(arrays["frames"], dtype=np.float64)
        triangles, region = (np.asarray(arrays[k], np.int64) for k in ("triangles", "region"))
        cells = region_arrays(region, tuple(map(str, arrays["leaflets"])))
        states = []
        for k, points in enumerate(shapes):
            data = {"displacement_mm": points - shapes[0]}
            for name in ("stress", "contact_pressure"):
                if name in arrays:
                    data[f"{name}_MPa"] = np.asarray(arrays[name][k], dtype=np.float64)
            states.append(Surface(points, triangles, data, cells))
        write_surface_series(folder / "closing.pvd", arrays["times"].tolist(), states)


def _deformation(
    rest: FloatArray, points: FloatArray, triangles: IntArray
) -> dict[str, FloatArray]:
    """Displacement and principal stretches of a midsurface at its vertices."""
    first, second = principal_stretches(rest, points, triangles)
    return {
        "displacement_mm": points - rest,
        "stretch_largest": first,
        "stretch_smallest": second,
        "stretch_of_area": first * second,
    }


def _ring(
    annulus: IntArray, triangles: IntArray, region: IntArray, names: Sequence[str]
) -> tuple[IntArray, int]:
    """Order of the annulus from the start of the anterior leaflet, and the index of its end."""
    loop = directed(annulus, triangles)
    pieces = commissures(loop, triangles, region)
    begin, end = pieces[names.index("anterior") if "anterior" in names else min(pieces)]
    index = {int(vertex): k for k, vertex in enumerate(annulus)}
    order = np.array([index[int(vertex)] for vertex in np.roll(loop, -begin)])
    return order, (end - begin) % len(loop)


def _write_landmarks(
    folder: Path, name: str, annulus: FloatArray, order: tuple[IntArray, int], tips: FloatArray
) -> None:
    ring, lists = annulus[order[0]], {}
    if len(tips):
        marks = slicerheart_labels(ring, order[1], tips.mean(axis=0) - ring.mean(axis=0))
        lists[ANNULUS_LABELS] = PointList(tuple(marks), np.stack(list(marks.values())))
        if len(tips) == len(MUSCLES):
            left = int(np.argmin(np.linalg.norm(tips - marks["ALC"], axis=1)))
            for muscle, tip in zip(MUSCLES, (tips[left], tips[1 - left]), strict=True):
                lists[f"PapillaryMarkup-{muscle}"] = PointList(("muscle tip",), tip[None])
    lists["AnnulusContourMarkup"] = PointList.numbered("annulus", ring, "ClosedCurve")
    file = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
    write_markups(folder / f"{file}.mrk.json", lists)
