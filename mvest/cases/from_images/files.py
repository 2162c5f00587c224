"""A valve from images as files for other software: ParaView and 3D Slicer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.segmentations import segment_name, voxelise_leaflets, write_segmentation
from mvest.exchange.surfaces import region_arrays, write_surface
from mvest.files import write_atomically
from mvest.imaging.valve_sequence import (
    ANNULUS_LABELS,
    ValveSequence,
    landmarks,
    slicerheart_labels,
)
from mvest.imaging.volume import VolumeSequence


def write_surfaces(folder: Path, sequence: ValveSequence, name: str = "valve") -> Path:
    """Write the valve of every frame for ParaView and 3D Slicer; returns the index.

    ``NAME_0000.vtp``, ... hold the midsurface in LPS mm with ``confidence`` and ``std_mm`` (NaN
    where it was never measured) at its points and ``region`` in its triangles;
    ``NAME.vtp.series`` lists them with their times in s, as ParaView's readers expect it (ParaView
    user's guide, "file series"). It is written last.

    Raises
    ------
    InputError
        A point that is no finite number, or a file that cannot be written.
    """
    layout = sequence.layout
    cells = region_arrays(layout.region, layout.region_names)
    files = []
    for t, time in enumerate(sequence.times):
        points = {"confidence": sequence.vertex_confidence[t], "std_mm": sequence.std_mm}
        file = folder / f"{name}_{t:04d}.vtp"
        write_surface(file, sequence.vertices[t], layout.triangles, points, cells)
        files.append({"name": file.name, "time": float(time)})
    text = json.dumps({"file-series-version": "1.0", "files": files}, indent=1)
    return write_atomically(folder / f"{name}.vtp.series", text + "\n")


def write_landmarks(path: Path, valve: ValveSequence, frame: int) -> Path:
    """Write the named points of one frame as markups of 3D Slicer.

    The lists are ``landmarks`` (see `mvest.imaging.layout`), ``annulus`` and ``free edge`` as
    closed curves, which begin at phi = 0, and SlicerHeart's labels of the annulus.

    Parameters
    ----------
    path
        Ends in ``.mrk.json``.
    valve, frame

    Raises
    ------
    InputError
        No such frame, a point that is no finite number, another extension, or a file that cannot
        be written.
    """
    named = landmarks(valve, frame)
    down = valve.tips[frame].mean(axis=0) - valve.annulus[frame].mean(axis=0)
    half = valve.annulus.shape[1] // 2
    labels = slicerheart_labels(valve.annulus[frame], half, down)
    return write_markups(
        path,
        {
            "landmarks": PointList(tuple(named), np.stack(list(named.values()))),
            "annulus": PointList.numbered("annulus", valve.annulus[frame], "ClosedCurve"),
            "free edge": PointList.numbered("edge", valve.free_edge[frame], "ClosedCurve"),
            ANNULUS_LABELS: PointList(tuple(labels), np.stack(list(labels.values()))),
        },
    )


def write_for_slicer(
    folder: Path,
    volume: VolumeSequence,
    valve: ValveSequence,
    thickness_mm: float,
    frames: Sequence[int],
) -> list[Path]:
    """Write landmarks and a segmentation of chosen frames for 3D Slicer; returns the paths.

    ``valve_0007.mrk.json`` (see `write_landmarks`) and ``valve_0007.seg.nrrd``, on the voxels of
    the volume with a segment for each leaflet, hold frame 7.

    Parameters
    ----------
    folder : Path
        Exists.
    volume, valve
        Frame k of one is frame k of the other.
    thickness_mm : float
        Of the leaflets.
    frames : sequence of int
        From 0 on.

    Raises
    ------
    InputError
        As `write_landmarks`, or a thickness that is no positive number.
    """
    if not (np.isfinite(thickness_mm) and thickness_mm > 0):
        raise InputError(f"thickness_mm = {thickness_mm}, expected a finite number > 0")
    layout = valve.layout
    names = {1 + k: segment_name(region) for k, region in enumerate(layout.region_names)}
    written = []
    for frame in frames:
        base = folder / f"valve_{frame:04d}"
        written.append(write_landmarks(base.with_name(f"{base.name}.mrk.json"), valve, frame))
        labels = voxelise_leaflets(
            volume,
            valve.vertices[frame],
            layout.triangles,
            layout.region,
            np.full(layout.size, thickness_mm),
        )
        target = base.with_name(f"{base.name}.seg.nrrd")
        written.append(write_segmentation(target, volume, labels, names))
    return written
