"""3D Slicer and ParaView: surfaces over time, segmentations, landmarks as SlicerHeart has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.cases.band import commissures, directed
from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.schema import CASE_FILE
from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.segmentations import segment_name, voxelise_leaflets, write_segmentation
from mvest.exchange.surfaces import Surface, region_arrays, write_surface_series
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import ANNULUS_LABELS, slicerheart_labels
from mvest.imaging.volume import VolumeSequence
from mvest.problem.fields import CaseFields, case_fields
from mvest.reading.npz import read_npz
from mvest.reading.text import refusing
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import principal_stretches

FIELDS = "fields.npz"
REGIONS = ("anterior", "posterior")
"""Of runs, which store numbers of leaflets and no names."""
MARGIN = 3.0
"""mm between the leaflets and the edge of their label map."""
MAX_VOXELS = 5e7
MUSCLES = ("antero-lateral", "postero-medial")
Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, slots=True)
class SlicerOptions:
    """How a case or a run is written for 3D Slicer.

    Attributes
    ----------
    voxel_mm : float
        Of the segmentations; leaflets thinner than a voxel are drawn that thick.
    thickness_mm : float
        Of the leaflets in the segmentations of a run, which stores none.
    """

    voxel_mm: float = 0.5
    thickness_mm: float = 1.3

    def __post_init__(self) -> None:
        for name, low, high in (("voxel_mm", 0.1, 3.0), ("thickness_mm", 0.1, 5.0)):
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name}={getattr(self, name)}, expected {low:g} to {high:g} mm")


def export_slicer(source: Path, target: Path, options: SlicerOptions) -> Path:
    """A case folder, or the folder of a run, as a folder that 3D Slicer and ParaView open.

    ``NAME.pvd`` and ``NAME_0000.vtp``, ... are midsurfaces over time (LPS, mm), ``frames`` as they
    were seen; of a run also ``fitted`` and ``generic``, with displacement, stretches against the
    open valve, and distance from what was seen, as far as the run stored it. Of each frame there
    are ``NAME.seg.nrrd`` with the segments mitral_anterior_leaflet and mitral_posterior_leaflet,
    and ``NAME.mrk.json`` with SlicerHeart's labels, the annulus and the papillary tips. Of a
    closure (``experiment=closure``) it is ``closing``: thick leaflets at every stored time, with
    first principal stress and contact pressure.

    Parameters
    ----------
    source
        With ``case.yaml`` or ``fields.npz``.
    target
        A folder that does not exist yet.
    options

    Raises
    ------
    InputError
        Neither a case nor a run, or a folder that exists or cannot be written.
    """
    if target.exists():
        raise InputError(f"{target}: exists; expected a new folder")
    if (source / CASE_FILE).is_file():
        case = read_case(source)
        return write_atomically(target, lambda part: _write_case(part, case, options))
    if (source / FIELDS).is_file() and "times" in read_npz(source / FIELDS):
        return write_atomically(target, lambda part: _write_closing(part, source / FIELDS))
    if (source / FIELDS).is_file():
        fields = case_fields(source / FIELDS, turned=False)
        return write_atomically(target, lambda part: _write_run(part, fields, options))
    raise InputError(f"{source}: neither a case ({CASE_FILE}) nor a run with shapes ({FIELDS})")


def _write_case(folder: Path, case: ValveCase, options: SlicerOptions) -> None:
    folder.mkdir()
    surface, names = case.surface, case.surface.region_names
    regions = range(len(names))
    mean = np.array([surface.thickness[surface.vertex_region == k].mean() for k in regions])
    order = _ring(case.annulus, surface.triangles, surface.region, names)
    states = []
    for frame in case.frames:
        points, thickness = {}, surface.thickness
        if frame.corresponds:
            points = _against(surface.vertices, frame.vertices, surface.triangles)
        else:
            thickness = np.zeros(len(frame.vertices))
            thickness[frame.triangles.ravel()] = np.repeat(mean[frame.region], 3)
        cells = region_arrays(frame.region, names)
        states.append(Surface(frame.vertices, frame.triangles, points, cells))
        _write_frame(folder, frame, thickness, order, names, options.voxel_mm)
    write_surface_series(folder / "frames.pvd", [frame.time for frame in case.frames], states)


def _write_run(folder: Path, fields: CaseFields, options: SlicerOptions) -> None:
    folder.mkdir()
    count = int(fields.region.max(initial=0)) + 1
    names = REGIONS if count == 2 else tuple(f"leaflet {k + 1}" for k in range(count))
    cells = region_arrays(fields.region, names)
    for name in ("observed", "generic", "fitted"):
        moved = getattr(fields, name)
        if moved is None or not np.isfinite(moved).all():
            continue
        distance = getattr(fields, f"distance_{name}", None)
        states = []
        for k, points in enumerate([fields.rest, *moved]):
            data = _against(fields.rest, points, fields.triangles)
            if distance is not None:
                # The open valve is not compared with anything, but Slicer wants the same arrays.
                data["distance_mm"] = distance[k - 1] if k else np.zeros(len(points))
            states.append(Surface(points, fields.triangles, data, cells))
        write_surface_series(folder / f"{name}.pvd", range(len(states)), states)
    order = _ring(fields.annulus, fields.triangles, fields.region, names)
    thickness = np.full(len(fields.rest), options.thickness_mm)
    for k, stage in enumerate(("open", *fields.frames)):
        x = fields.rest if k == 0 or fields.fitted is None else fields.fitted[k - 1]
        valve = (x, fields.triangles, fields.region, x[fields.annulus], x[fields.free_edge])
        frame = Frame(stage, float(k), Role.HELD_OUT, 0.0, *valve, fields.tips[k], True)
        _write_frame(folder, frame, thickness, order, names, options.voxel_mm)


def _write_closing(folder: Path, file: Path) -> None:
    """The thick leaflets of a closure over time, with stress and contact pressure."""
    folder.mkdir()
    with refusing(file, "fields of a closure"):
        arrays = read_npz(file)
        shapes = np.asarray(arrays["frames"], dtype=np.float64)
        triangles = np.asarray(arrays["triangles"], dtype=np.int64)
        region = np.asarray(arrays["region"], dtype=np.int64)
        cells = region_arrays(region, REGIONS[: int(region.max()) + 1])
        states = []
        for k, points in enumerate(shapes):
            data: Arrays = {"displacement_mm": points - shapes[0]}
            for name in ("stress", "contact_pressure"):
                if name in arrays:
                    data[f"{name}_MPa"] = np.asarray(arrays[name][k], dtype=np.float64)
            states.append(Surface(points, triangles, data, cells))
        write_surface_series(folder / "closing.pvd", arrays["times"].tolist(), states)


def _against(rest: FloatArray, points: FloatArray, triangles: IntArray) -> Arrays:
    """What is seen of a deformed midsurface: displacement and stretches at its vertices."""
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
    """Order of the annulus from where the anterior leaflet begins, and the place where it ends."""
    loop = directed(annulus, triangles)
    pieces = commissures(loop, triangles, region)
    begin, end = pieces[names.index("anterior") if "anterior" in names else min(pieces)]
    place = {int(vertex): k for k, vertex in enumerate(annulus)}
    order = np.array([place[int(vertex)] for vertex in np.roll(loop, -begin)])
    return order, (end - begin) % len(loop)


def _write_frame(
    folder: Path,
    frame: Frame,
    thickness: FloatArray,
    order: tuple[IntArray, int],
    names: Sequence[str],
    voxel_mm: float,
) -> None:
    """Landmarks and a segmentation of a frame, under its name."""
    name = "".join(c if c.isalnum() or c in "-_" else "_" for c in frame.name)
    ring, tips, lists = frame.annulus[order[0]], frame.papillary_tips, {}
    if len(tips):
        marks = slicerheart_labels(ring, order[1], tips.mean(axis=0) - ring.mean(axis=0))
        lists[ANNULUS_LABELS] = PointList(tuple(marks), np.stack(list(marks.values())))
        if len(tips) == len(MUSCLES):
            left = int(np.argmin(np.linalg.norm(tips - marks["ALC"], axis=1)))
            for muscle, tip in zip(MUSCLES, (tips[left], tips[1 - left]), strict=True):
                lists[f"PapillaryMarkup-{muscle}"] = PointList(("muscle tip",), tip[None])
    lists["AnnulusContourMarkup"] = PointList.numbered("annulus", ring, "ClosedCurve")
    write_markups(folder / f"{name}.mrk.json", lists)
    if not np.isfinite(frame.vertices).all():
        return
    low = np.floor((frame.vertices.min(axis=0) - MARGIN) / voxel_mm) * voxel_mm
    size = np.ceil((frame.vertices.max(axis=0) + MARGIN - low) / voxel_mm).astype(int) + 1
    if size.prod() > MAX_VOXELS:
        raise InputError(f"voxel_mm={voxel_mm}: {size.prod():.1g} voxels; expected larger ones")
    empty = np.zeros((1, *size), dtype=np.uint8)
    grid = VolumeSequence(empty, np.full(3, voxel_mm), np.eye(3), low, np.zeros(1))
    labels = voxelise_leaflets(grid, frame.vertices, frame.triangles, frame.region, thickness)
    called = {1 + k: segment_name(region) for k, region in enumerate(names)}
    write_segmentation(folder / f"{name}.seg.nrrd", grid, labels, called)
