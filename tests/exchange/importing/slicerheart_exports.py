"""Folders as SlicerHeart's export modules write them, by VTK and pandas alone.

No writer of this project takes part. The valve is a simulated one, of which each leaflet is cut out
by itself, moved to its atrial side and given other triangles; surfaces go through VTK's own writer
with the header of 3D Slicer, tables through pandas with SlicerHeart's columns.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from mvest.cases.case import Role

pyvista = pytest.importorskip("pyvista", reason="needs PyVista, which comes with the extra viz")
import vtk  # noqa: E402

ANGLE = 0.4
POSE = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0.0], [np.sin(ANGLE), np.cos(ANGLE), 0.0], [0.0, 0.0, 1.0]]
) @ np.array([[1.0, 0, 0], [0, np.cos(1.0), -np.sin(1.0)], [0, np.sin(1.0), np.cos(1.0)]])
SHIFT = np.array([31.0, -12.0, 140.0])
"""From the axes of the simulated valve to LPS: a rotation, so that nothing lies along an axis."""
THICKNESS = {"anterior": 1.32, "posterior": 1.26}
PHASES = {"open": "MD", "closed": "MS"}


def in_lps(points):
    return points @ POSE.T + SHIFT


def polydata(points, triangles):
    return pyvista.PolyData.from_regular_faces(points, triangles)


def run(source, *steps):
    for step in steps:
        step.SetInputData(source)
        step.Update()
        source = step.GetOutput()
    return source


def atrial_leaflet(frame, label, thickness):
    """One leaflet of a frame: its atrial side, with triangles of its own."""
    whole = polydata(frame.vertices, frame.triangles).compute_normals(
        cell_normals=False, split_vertices=False, consistent_normals=False
    )
    points = frame.vertices - 0.5 * thickness * whole.point_data["Normals"]
    leaflet = polydata(in_lps(points), frame.triangles[frame.region == label]).clean()
    finer = leaflet.subdivide(1, subfilter="linear").decimate_pro(0.4, preserve_topology=True)
    finer.clear_data()
    return finer


def write_model(path, model, *, binary=True, version=42, space="LPS"):
    """As vtkMRMLModelStorageNode does: version 4.2, binary if compression is asked for."""
    writer = vtk.vtkPolyDataWriter()
    writer.SetFileVersion(version)
    writer.SetFileType(vtk.VTK_BINARY if binary else vtk.VTK_ASCII)
    writer.SetHeader("3D Slicer output." + (f" SPACE={space}" if space else ""))
    writer.SetInputData(model)
    writer.SetFileName(str(path))
    assert writer.Write()


LANDMARKS = {
    "A": (0, 1), "P": (0, -1), "AL": (-1, 0), "PM": (1, 0), "ALC": (-1, 0.25), "PMC": (1, 0.25)
}  # fmt: skip
"""Directions from the middle of the annulus; the antero-lateral side is at -x here."""


def write_fcsv(path, points, axes="LPS"):
    sign = {"LPS": 1, "RAS": -1}[axes]
    rows = [
        f"{k},{sign * x},{sign * y},{z},0,0,0,1,1,1,0,{label},,"
        for k, (label, (x, y, z)) in enumerate(points.items())
    ]
    head = (
        "# Markups fiducial file version = 5.0",
        f"# CoordinateSystem = {axes}",
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    )
    path.write_text("\n".join([*head, *rows]) + "\n")


def segmented_leaflets(frame, voxel_mm):
    """Both leaflets as SlicerHeart's LeafletModel makes them.

    Labels of voxels, their smoothed closed surface, a loop of 30 points round the leaflet, and the
    side of it that is nearer to the atrium.
    """
    points = in_lps(frame.vertices)
    low = points.min(axis=0) - 4
    size = np.ceil((points.max(axis=0) + 4 - low) / voxel_mm).astype(int) + 1
    centres = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1)
    centres = low + voxel_mm * centres.reshape(-1, 3)
    share = np.array([(i, j) for i in range(9) for j in range(9 - i)]) / 8
    depth = []
    for label, thickness in enumerate(THICKNESS.values()):
        a, b, c = points[frame.triangles[frame.region == label]].transpose(1, 0, 2)
        dense = np.concatenate([a + (b - a) * u + (c - a) * v for u, v in share])
        reach = cKDTree(dense).query(centres, distance_upper_bound=3)[0]
        depth.append(reach / (thickness / 2))
    labels = np.where(np.min(depth, axis=0) <= 1, 1 + np.argmin(depth, axis=0), 0)
    image = pyvista.ImageData(dimensions=size, spacing=[voxel_mm] * 3, origin=low)
    image["labels"] = labels.reshape(size).ravel(order="F").astype(np.int16)
    above = in_lps(frame.annulus).mean(axis=0)
    above = above + 30 * (above - in_lps(frame.papillary_tips).mean(axis=0)) / 25
    return [atrial_side(image, label, frame, points, above) for label in range(2)]


def atrial_side(image, label, frame, points, above):
    faces = vtk.vtkDiscreteFlyingEdges3D()
    faces.GenerateValues(1, label + 1, label + 1)
    smooth = vtk.vtkWindowedSincPolyDataFilter()
    smooth.SetPassBand(0.01)
    smooth.BoundarySmoothingOff()
    smooth.NonManifoldSmoothingOn()
    smooth.NormalizeCoordinatesOn()
    largest = vtk.vtkPolyDataConnectivityFilter()
    largest.SetExtractionModeToLargestRegion()
    rim = polydata(points, frame.triangles[frame.region == label]).extract_feature_edges(
        boundary_edges=True, feature_edges=False, manifold_edges=False, non_manifold_edges=False
    )
    rim = rim.strip()
    curve = rim.points[rim.lines[1:]]
    length = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(curve, axis=0), axis=1)])
    at = np.linspace(0, length[-1], 30, endpoint=False)
    marks = vtk.vtkPoints()
    for mark in np.stack([np.interp(at, length, axis) for axis in curve.T], axis=1):
        marks.InsertNextPoint(*mark)
    loop = vtk.vtkSelectPolyData()
    loop.SetLoop(marks)
    loop.GenerateSelectionScalarsOn()
    loop.SetSelectionModeToLargestRegion()
    # SlicerHeart takes the greedy search, which ends at an error message on some loops.
    loop.SetEdgeSearchModeToDijkstra()
    clip = vtk.vtkClipPolyData()
    clip.InsideOutOn()
    clip.GenerateClippedOutputOn()
    run(image, faces, smooth, largest, loop, clip)
    sides = [pyvista.wrap(side).clean() for side in (clip.GetOutput(), clip.GetClippedOutput())]
    return min(sides, key=lambda side: np.linalg.norm(side.points - above, axis=1).mean())


def batch_export(folder: Path, case, scene="P001", *, voxel_mm=None, **how) -> Path:
    """What ValveBatchExport writes of a case with the flags -vls, -acc and -lc.

    With ``voxel_mm`` leaflets are cut out of a segmentation, see `segmented_leaflets`.
    """
    folder.mkdir(parents=True)
    contour, marks = [], []
    seen = [frame for frame in case.frames if frame.role in (Role.REFERENCE, Role.CLOSED)]
    for number, frame in enumerate(seen):
        phase, index = PHASES[frame.name], str(3 + 9 * number)
        stem = f"{scene}_mitral_frame_{index}_{phase}"
        whole = None if voxel_mm is None else segmented_leaflets(frame, voxel_mm)
        for label, name in enumerate(case.surface.region_names):
            model = whole[label] if whole else atrial_leaflet(frame, label, THICKNESS[name])
            write_model(folder / f"{stem}_atrial_mitral_{name}_leaflet.vtk", model, **how)
        ring = in_lps(frame.annulus)
        points = np.concatenate([ring + (np.roll(ring, -1, axis=0) - ring) * t for t in (0, 0.5)])
        points = points.reshape(2, -1, 3).transpose(1, 0, 2).reshape(-1, 3)
        for x, y, z in points:
            contour.append(
                [scene, phase, index, "mitral", f"{-x:.2f}", f"{-y:.2f}", f"{z:.2f}", ""]
            )
        for label, towards in LANDMARKS.items():
            x, y, z = in_lps(frame.annulus[np.argmax(frame.annulus[:, :2] @ towards)])
            marks.append(
                [scene, phase, "mitral", index, label, f"{-x:.2f}", f"{-y:.2f}", f"{z:.2f}"]
            )
        tips = in_lps(frame.papillary_tips[np.argsort(frame.papillary_tips[:, 0])])
        for muscle, tip in zip(("antero-lateral", "postero-medial"), tips, strict=True):
            triple = {"muscle-1": tip - 10 * POSE[:, 2], "muscle-2": tip, "muscle-3": ring.mean(0)}
            write_fcsv(folder / f"PapillaryMarkup-{muscle}-{phase}.fcsv", triple)
    columns = ["AnnulusContourX", "AnnulusContourY", "AnnulusContourZ", "AnnulusContourLabel"]
    pd.DataFrame(contour, columns=["Filename", "Phase", "FrameNumber", "Valve", *columns]).to_csv(
        folder / "AnnulusContourPoints.csv", index=False
    )
    columns = ["LandmarkLabel", "LandmarkR", "LandmarkA", "LandmarkS"]
    pd.DataFrame(marks, columns=["Filename", "Phase", "Valve", "FrameNumber", *columns]).to_csv(
        folder / "ValveLandmarkPoints.csv", index=False
    )
    return folder


def fem_export(folder: Path, frame, chordae=None) -> Path:
    """What ValveFemExport writes of one frame: shells, the tube of the annulus, bundles of chords.

    A bundle is a model of lines; every second chord parts 3.5 mm before it ends, where a second
    line begins.
    """
    folder.mkdir(parents=True)
    for label, (name, thickness) in enumerate(THICKNESS.items()):
        model = atrial_leaflet(frame, label, thickness)
        file = folder / f"mitral_{name}_leaflet_SurfaceModel-fit.vtk"
        write_model(file, model, binary=False)
    ring = in_lps(np.vstack([frame.annulus, frame.annulus[:1]]))
    tube = polyline(ring).tube(radius=0.5, n_sides=20, capping=False).triangulate()
    write_model(folder / "AnnulusContourModel.vtk", tube, binary=False)
    for tip, bundle in enumerate(("primary", "secondary") if chordae else ()):
        lines, start = [], in_lps(frame.papillary_tips[tip])
        for k, end in enumerate(in_lps(chordae.insertion[chordae.tip == tip])):
            fork = end - 3.5 * (end - start) / np.linalg.norm(end - start)
            lines += [(start, fork), (fork, end)] if k % 2 else [(start, fork, end)]
        write_lines(folder / f"Chords_mesh_-_mitral_anterior_leaflet-{bundle}.vtk", lines)
    return folder


def write_lines(file: Path, lines) -> None:
    """A model of lines, each with points of its own."""
    first, *others = map(polyline, lines)
    write_model(file, first.append_polydata(*others), binary=False)


def polyline(points):
    points = np.array(points)
    return pyvista.PolyData(points, lines=[len(points), *range(len(points))])
