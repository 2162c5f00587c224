"""Folders as SlicerHeart's export modules write them, by VTK and pandas alone.

No writer of this project takes part. The valve is a simulated one, of which each leaflet is cut out
by itself, moved to its atrial side and given other triangles; surfaces go through VTK's own writer
with the header of 3D Slicer, tables through pandas with SlicerHeart's columns.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mvest.cases.case import Role

vtk = pytest.importorskip("vtk", reason="needs VTK, which comes with the extra viz")
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy  # noqa: E402

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
    result = vtk.vtkPolyData()
    places = vtk.vtkPoints()
    places.SetDataTypeToDouble()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=1))
    result.SetPoints(places)
    cells = vtk.vtkCellArray()
    packed = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(packed.astype(np.int64), deep=1))
    result.SetPolys(cells)
    return result


def run(source, *steps):
    for step in steps:
        step.SetInputData(source)
        step.Update()
        source = step.GetOutput()
    return source


def atrial_leaflet(frame, label, thickness):
    """One leaflet of a frame: its atrial side, with triangles of its own."""
    normals = vtk.vtkPolyDataNormals()
    normals.SplittingOff()
    normals.ConsistencyOff()
    whole = run(polydata(frame.vertices, frame.triangles), normals)
    outward = vtk_to_numpy(whole.GetPointData().GetNormals())
    points = frame.vertices - 0.5 * thickness * outward
    finer = vtk.vtkLinearSubdivisionFilter()
    finer.SetNumberOfSubdivisions(1)
    fewer = vtk.vtkDecimatePro()
    fewer.SetTargetReduction(0.4)
    fewer.PreserveTopologyOn()
    leaflet = polydata(in_lps(points), frame.triangles[frame.region == label])
    return run(leaflet, vtk.vtkCleanPolyData(), finer, fewer)


def write_model(path, model, *, binary=True, version=42, space="LPS"):
    """As vtkMRMLModelStorageNode does: version 4.2, binary if compression is asked for."""
    writer = vtk.vtkPolyDataWriter()
    writer.SetFileVersion(version)
    writer.SetFileType(vtk.VTK_BINARY if binary else vtk.VTK_ASCII)
    writer.SetHeader("3D Slicer output." + (f" SPACE={space}" if space else ""))
    writer.SetInputData(model)
    writer.SetFileName(str(path))
    assert writer.Write()


def landmarks_of(case, frame):
    """SlicerHeart's labels by position ``(3,)`` LPS; the antero-lateral side is at -x here."""
    ring = frame.annulus
    return {
        label: in_lps(ring[np.argmax(ring[:, :2] @ towards)])
        for label, towards in {
            "A": (0, 1),
            "P": (0, -1),
            "AL": (-1, 0),
            "PM": (1, 0),
            "ALC": (-1, 0.25),
            "PMC": (1, 0.25),
        }.items()
    }


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


def batch_export(folder: Path, case, scene="P001", **how) -> Path:
    """What ValveBatchExport writes of a case with the flags -vls, -acc and -lc."""
    folder.mkdir(parents=True)
    contour, marks = [], []
    seen = [frame for frame in case.frames if frame.role in (Role.REFERENCE, Role.CLOSED)]
    for number, frame in enumerate(seen):
        phase, index = PHASES[frame.name], str(3 + 9 * number)
        stem = f"{scene}_mitral_frame_{index}_{phase}"
        for label, name in enumerate(case.surface.region_names):
            model = atrial_leaflet(frame, label, THICKNESS[name])
            write_model(folder / f"{stem}_atrial_mitral_{name}_leaflet.vtk", model, **how)
        ring = in_lps(frame.annulus)
        points = np.concatenate([ring + (np.roll(ring, -1, axis=0) - ring) * t for t in (0, 0.5)])
        points = points.reshape(2, -1, 3).transpose(1, 0, 2).reshape(-1, 3)
        for x, y, z in points:
            contour.append(
                [scene, phase, index, "mitral", f"{-x:.2f}", f"{-y:.2f}", f"{z:.2f}", ""]
            )
        for label, (x, y, z) in landmarks_of(case, frame).items():
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


def fem_export(folder: Path, frame, chordae, *, branched=False) -> Path:
    """What ValveFemExport writes of one frame: shells, the tube of the annulus, bundles of chords.

    A bundle is a model of lines with two points each. Branched chords part 3.5 mm before they end.
    """
    folder.mkdir(parents=True)
    for label, (name, thickness) in enumerate(THICKNESS.items()):
        model = atrial_leaflet(frame, label, thickness)
        file = folder / f"mitral_{name}_leaflet_SurfaceModel-fit.vtk"
        write_model(file, model, binary=False)
    ring = in_lps(np.vstack([frame.annulus, frame.annulus[:1]]))
    tube = vtk.vtkTubeFilter()
    tube.SetRadius(0.5)
    tube.SetNumberOfSides(20)
    tube.CappingOff()
    path = run(polyline(ring), tube, vtk.vtkTriangleFilter())
    write_model(folder / "AnnulusContourModel.vtk", path, binary=False)
    for half, bundle in ((chordae.tip == 0, "primary"), (chordae.tip == 1, "secondary")):
        segments = []
        for tip, end in zip(chordae.tip[half], chordae.insertion[half], strict=True):
            start, end = in_lps(frame.papillary_tips[tip]), in_lps(end)
            fork = end - 3.5 * (end - start) / np.linalg.norm(end - start)
            segments += [(start, fork), (fork, end)] if branched else [(start, end)]
        lines = vtk.vtkAppendPolyData()
        for segment in segments:
            lines.AddInputData(polyline(np.array(segment)))
        lines.Update()
        file = folder / f"Chords_mesh_-_mitral_anterior_leaflet-{bundle}.vtk"
        write_model(file, lines.GetOutput(), binary=False)
    return folder


def polyline(points):
    places, cells = vtk.vtkPoints(), vtk.vtkCellArray()
    places.SetDataTypeToDouble()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=1))
    cells.InsertNextCell(len(points))
    for k in range(len(points)):
        cells.InsertCellPoint(k)
    result = vtk.vtkPolyData()
    result.SetPoints(places)
    result.SetLines(cells)
    return result
