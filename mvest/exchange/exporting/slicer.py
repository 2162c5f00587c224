"""3D Slicer and ParaView: surfaces over time, segmentations, landmarks as SlicerHeart has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.rims import commissures, directed
from mvest.cases.schema import CASE_FILE
from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.segmentations import segment_name, voxelise_leaflets, write_segmentation
from mvest.exchange.surfaces import SurfaceFile, region_arrays, write_surface_series
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import ANNULUS_LABELS, slicerheart_labels
from mvest.imaging.volume import VolumeSequence
from mvest.problem.fields import CaseFields, read_case_fields
from mvest.reading.bounded import refusing
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import principal_stretches

FIELDS = "fields.npz"
REGIONS = ("anterior", "posterior")
"""Of runs, which store numbers of leaflets and no names."""
MARGIN = 3.0
"""mm between the leaflets and the edge of their label map."""
MAX_VOXELS = 5e7
MUSCLES = ("antero-lateral", "postero-medial")


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
        fields = read_case_fields(source / FIELDS, turned=False)
        return write_atomically(target, lambda part: _write_run(part, fields, options))
    raise InputError(f"{source}: neither a case ({CASE_FILE}) nor a run with shapes ({FIELDS})")


def _write_case(folder: Path, case: ValveCase, options: SlicerOptions) -> None:
    folder.mkdir()
    surface = case.surface
    ring, end = _ring(case.annulus, surface.triangles, surface.region, surface.region_names)
    order = np.array([np.flatnonzero(case.annulus == vertex)[0] for vertex in ring])
    thick = [
        float(surface.thickness[surface.vertex_region == k].mean())
        for k in range(len(surface.region_names))
    ]
    states = []
    rest = case.frame(Role.REFERENCE)
    for frame in case.frames:
        cells = region_arrays(frame.region, surface.region_names)
        points: dict[str, NDArray[np.generic]] = {}
        if frame.corresponds:
            points = _against(rest.vertices, frame.vertices, surface.triangles)
        states.append(SurfaceFile(frame.vertices, frame.triangles, points, cells))
        stem = folder / _file_name(frame.name)
        _write_marks(stem, frame.annulus[order], end, frame.papillary_tips)
        thickness = surface.thickness if frame.corresponds else _of_vertices(frame, thick)
        _write_voxels(
            stem,
            frame.vertices,
            frame.triangles,
            frame.region,
            thickness,
            surface.region_names,
            options.voxel_mm,
        )
    write_surface_series(folder / "frames.pvd", [frame.time for frame in case.frames], states)


def _of_vertices(frame: Frame, thickness: Sequence[float]) -> FloatArray:
    label = np.zeros(len(frame.vertices), dtype=np.int64)
    label[frame.triangles.ravel()] = np.repeat(frame.region, 3)
    return np.array(thickness)[label]


def _write_run(folder: Path, fields: CaseFields, options: SlicerOptions) -> None:
    folder.mkdir()
    count = int(fields.region.max(initial=0)) + 1
    names = REGIONS if count == 2 else tuple(f"leaflet {k + 1}" for k in range(count))
    ring, end = _ring(fields.annulus, fields.triangles, fields.region, names)
    cells = region_arrays(fields.region, names)
    for name in ("observed", "generic", "fitted"):
        shapes = getattr(fields, name)
        if shapes is None or not np.isfinite(shapes).all():
            continue
        distance = getattr(fields, f"distance_{name}", None)
        states = []
        for k, points in enumerate([fields.rest, *shapes]):
            data = _against(fields.rest, points, fields.triangles)
            if distance is not None:
                # The open valve is not compared with anything, but Slicer wants the same arrays.
                data["distance_mm"] = distance[k - 1] if k else np.zeros(len(points))
            states.append(SurfaceFile(points, fields.triangles, data, cells))
        write_surface_series(folder / f"{name}.pvd", range(len(states)), states)
    thickness = np.full(len(fields.rest), options.thickness_mm)
    for k, stage in enumerate(("open", *fields.frames)):
        shape = fields.rest if k == 0 or fields.fitted is None else fields.fitted[k - 1]
        stem = folder / _file_name(stage)
        _write_marks(stem, shape[ring], end, fields.tips[k])
        _write_voxels(
            stem, shape, fields.triangles, fields.region, thickness, names, options.voxel_mm
        )


def _write_closing(folder: Path, file: Path) -> None:
    """The thick leaflets of a closure over time, with stress and contact pressure."""
    folder.mkdir()
    with refusing(file, "fields of a closure"):
        arrays = read_npz(file)
        shapes = np.asarray(arrays["frames"], dtype=np.float64)
        triangles = np.asarray(arrays["triangles"], dtype=np.int64)
        region = np.asarray(arrays["region"], dtype=np.int64)
        states = []
        for k, points in enumerate(shapes):
            data = {"displacement_mm": points - shapes[0]}
            for name in ("stress", "contact_pressure"):
                if name in arrays:
                    data[f"{name}_MPa"] = np.asarray(arrays[name][k], dtype=np.float64)
            cells = region_arrays(region, REGIONS[: int(region.max()) + 1])
            states.append(SurfaceFile(points, triangles, dict(data), cells))
        write_surface_series(folder / "closing.pvd", arrays["times"].tolist(), states)


def _against(
    rest: FloatArray, points: FloatArray, triangles: IntArray
) -> dict[str, NDArray[np.generic]]:
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
    """Annulus from where the anterior leaflet begins, and the position where that ends."""
    loop = directed(annulus, triangles)
    pieces = commissures(loop, triangles, region)
    begin, end = pieces[names.index("anterior") if "anterior" in names else min(pieces)]
    return np.roll(loop, -begin), (end - begin) % len(loop)


def _write_marks(stem: Path, ring: FloatArray, end: int, tips: FloatArray) -> None:
    lists = {}
    if len(tips):
        labels = slicerheart_labels(ring, end, tips.mean(axis=0) - ring.mean(axis=0))
        lists[ANNULUS_LABELS] = PointList(tuple(labels), np.stack(list(labels.values())))
        if len(tips) == len(MUSCLES):
            left = int(np.argmin(np.linalg.norm(tips - labels["ALC"], axis=1)))
            for muscle, tip in zip(MUSCLES, (tips[left], tips[1 - left]), strict=True):
                lists[f"PapillaryMarkup-{muscle}"] = PointList(("muscle tip",), tip[None])
    lists["AnnulusContourMarkup"] = PointList.numbered("annulus", ring, "ClosedCurve")
    write_markups(stem.with_name(f"{stem.name}.mrk.json"), lists)


def _write_voxels(
    stem: Path,
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    thickness: FloatArray,
    names: Sequence[str],
    voxel_mm: float,
) -> None:
    if not np.isfinite(vertices).all():
        return
    low = np.floor((vertices.min(axis=0) - MARGIN) / voxel_mm) * voxel_mm
    shape = np.ceil((vertices.max(axis=0) + MARGIN - low) / voxel_mm).astype(int) + 1
    if shape.prod() > MAX_VOXELS:
        raise InputError(f"voxel_mm={voxel_mm}: {shape.prod():.1g} voxels; expected larger ones")
    grid = VolumeSequence(
        np.zeros((1, *shape), dtype=np.uint8), np.full(3, voxel_mm), np.eye(3), low, np.zeros(1)
    )
    labels = voxelise_leaflets(grid, vertices, triangles, region, thickness)
    called = {1 + k: segment_name(name) for k, name in enumerate(names)}
    write_segmentation(stem.with_name(f"{stem.name}.seg.nrrd"), grid, labels, called)


def _file_name(name: str) -> str:
    """The name of a frame as part of a file's name."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
