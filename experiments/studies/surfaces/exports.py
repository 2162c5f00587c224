"""Surfaces as others write them: a folder of SlicerHeart, and a label map.

No reader or writer of this project takes part: surfaces are cut, moved to their atrial side, given
other triangles and written by VTK (through PyVista), tables by pandas, label maps by nibabel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from mvest.cases.case import Frame
from mvest.errors import ConfigurationError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface

__all__ = ["drawn_leaflets", "landmarks_on", "write_label_map", "write_slicerheart"]

SCENE = "simulated"
FINE_MM = 0.2
"""Of the grid on which leaflets are drawn before they are sampled at voxels."""
MARGIN_MM = 6.0
TOWARDS = {
    "A": (0.0, 1.0),
    "P": (0.0, -1.0),
    "AL": (-1.0, 0.0),
    "PM": (1.0, 0.0),
    "ALC": (-1.0, 0.25),
    "PMC": (1.0, 0.25),
}
"""Direction (x, y) of SlicerHeart's landmarks from the middle of the template's annulus."""


def landmarks_on(annulus: FloatArray) -> IntArray:
    """Which points of the template's annulus ``(k, 3)`` are SlicerHeart's landmarks."""
    centred = annulus[:, :2] - annulus[:, :2].mean(axis=0)
    return np.array([np.argmax(centred @ np.array(way)) for way in TOWARDS.values()])


def write_slicerheart(
    folder: Path,
    frames: Sequence[tuple[str, Frame]],
    regions: Sequence[str],
    thickness_mm: Sequence[float],
    landmarks: IntArray,
) -> None:
    """Write what ValveBatchExport writes with -vls, -acc and -lc, and the papillary muscles.

    Parameters
    ----------
    folder : Path
        Which does not exist.
    frames : sequence of (str, Frame)
        Phase (MD, MS, ...) and midsurface, LPS mm; tips antero-lateral first.
    regions : sequence of str
        Names of the leaflets.
    thickness_mm : sequence of float
        Of each leaflet: its atrial side lies half of it from the midsurface.
    landmarks : ndarray
        Of the annulus, see `landmarks_on`.

    Raises
    ------
    ConfigurationError
        If PyVista is not installed.
    """
    folder.mkdir()
    contour: list[list[str]] = []
    marks: list[list[str]] = []
    for number, (phase, frame) in enumerate(frames):
        index = str(3 + 9 * number)
        stem = f"{SCENE}_mitral_frame_{index}_{phase}"
        for label, (name, thick) in enumerate(zip(regions, thickness_mm, strict=True)):
            file = folder / f"{stem}_atrial_mitral_{name}_leaflet.vtk"
            _write_model(file, _atrial_side(frame, label, thick))
        ring = frame.annulus
        between = 0.5 * (ring + np.roll(ring, -1, axis=0))
        for point in np.stack([ring, between], axis=1).reshape(-1, 3):
            contour.append([SCENE, phase, index, "mitral", *_in_ras(point), ""])
        for label_of, point in zip(TOWARDS, ring[landmarks], strict=True):
            marks.append([SCENE, phase, "mitral", index, label_of, *_in_ras(point)])
        muscles = ("antero-lateral", "postero-medial")
        for muscle, tip in zip(muscles, frame.papillary_tips, strict=True):
            base = tip + 0.4 * (tip - ring.mean(axis=0))
            file = folder / f"PapillaryMarkup-{muscle}-{phase}.fcsv"
            _write_points(file, {"muscle-1": base, "muscle-2": tip, "muscle-3": ring.mean(axis=0)})
    columns = [f"AnnulusContour{axis}" for axis in ("X", "Y", "Z", "Label")]
    first = ["Filename", "Phase", "FrameNumber", "Valve"]
    table = pd.DataFrame(contour, columns=[*first, *columns])
    table.to_csv(folder / "AnnulusContourPoints.csv", index=False)
    columns = ["LandmarkLabel", "LandmarkR", "LandmarkA", "LandmarkS"]
    first = ["Filename", "Phase", "Valve", "FrameNumber"]
    table = pd.DataFrame(marks, columns=[*first, *columns])
    table.to_csv(folder / "ValveLandmarkPoints.csv", index=False)


def _in_ras(point: FloatArray) -> list[str]:
    """R, A, S of a point, as exported tables have them."""
    return [f"{value:.2f}" for value in point * (-1, -1, 1)]


def _atrial_side(frame: Frame, label: int, thickness_mm: float) -> Any:
    """One leaflet with triangles of its own, moved to the atrium by half its thickness."""
    try:
        import pyvista
    except ImportError as error:
        raise ConfigurationError(
            "folders of SlicerHeart are written by VTK: pip install mvest[viz]"
        ) from error

    def surface(points: FloatArray, triangles: IntArray) -> Any:
        return pyvista.PolyData.from_regular_faces(points, triangles)

    normals = surface(frame.vertices, frame.triangles).compute_normals(
        cell_normals=False, split_vertices=False, consistent_normals=False
    )
    points = frame.vertices - 0.5 * thickness_mm * np.asarray(normals.point_data["Normals"])
    leaflet = surface(points, frame.triangles[frame.region == label]).clean()
    return leaflet.subdivide(1, subfilter="linear").decimate_pro(0.4, preserve_topology=True)


def _write_model(file: Path, model: Any) -> None:
    """A binary legacy model with the header of 3D Slicer, which names its axes."""
    model.clear_data()
    model.save(file, binary=True)
    version, _, *rest = file.read_bytes().split(b"\n", 2)
    file.write_bytes(b"\n".join([version, b"3D Slicer output. SPACE=LPS", *rest]))


def _write_points(file: Path, points: dict[str, FloatArray]) -> None:
    rows = [
        f"{number},{x},{y},{z},0,0,0,1,1,1,0,{label},,"
        for number, (label, (x, y, z)) in enumerate(points.items())
    ]
    head = (
        "# Markups fiducial file version = 5.0",
        "# CoordinateSystem = LPS",
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    )
    file.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def write_label_map(
    file: Path, frame: Frame, normals: FloatArray, thickness_mm: FloatArray, voxel_mm: float
) -> None:
    """Write thick leaflets as a NIfTI of labels: 1 anterior, 2 posterior, 0 elsewhere.

    A voxel belongs to the leaflets if more than half of it does, to the larger part of the two.

    Parameters
    ----------
    file : Path
    frame : Frame
        Midsurface, LPS mm; its regions are anterior and posterior.
    normals : ndarray
        ``(n, 3)`` of the vertices.
    thickness_mm : ndarray
        ``(n,)``
    voxel_mm : float
    """
    drawn, low = drawn_leaflets(frame, normals, thickness_mm)
    shape = [int(np.ceil(n * FINE_MM / voxel_mm)) for n in drawn.shape]
    # Voxels lie anywhere against the leaflets.
    start = 0.37 * voxel_mm
    at = np.indices(shape).reshape(3, -1) * voxel_mm / FINE_MM + start / FINE_MM
    share = []
    for label in (1, 2):
        # The mean over a voxel, as far as a normal distribution of its variance is one.
        blurred = gaussian_filter((drawn == label).astype(np.float32), voxel_mm / FINE_MM / 12**0.5)
        share.append(map_coordinates(blurred, at, order=1).reshape(shape))
    anterior, posterior = share
    labels = np.where(anterior + posterior > 0.5, 1 + (posterior > anterior), 0)
    # Axes of NIfTI are R, A, S.
    turned = np.array([-1.0, -1.0, 1.0])
    affine = np.diag([*(turned * voxel_mm), 1.0])
    affine[:3, 3] = turned * (low + start)
    image: Any = nibabel.Nifti1Image  # its constructor has no types
    nibabel.save(image(labels.astype(np.uint8), affine), file)


def drawn_leaflets(
    frame: Frame | LeafletSurface, normals: FloatArray, thickness_mm: FloatArray
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Labels on a fine grid, and where its first point is (LPS mm)."""
    vertices, triangles = frame.vertices, frame.triangles
    corner = vertices[triangles]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max()
    k = int(np.ceil(longest / (0.8 * FINE_MM)))
    i, j = np.meshgrid(np.arange(k + 1), np.arange(k + 1))
    inside = i + j <= k
    weights = np.column_stack([i[inside], j[inside], k - i[inside] - j[inside]]) / k
    points = np.einsum("ka,tai->tki", weights, corner).reshape(-1, 3)
    along = np.einsum("ka,tai->tki", weights, normals[triangles]).reshape(-1, 3)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Points are drawn as cells of the fine grid, half of one beyond where they are.
    reach = np.einsum("ka,ta->tk", weights, thickness_mm[triangles]).ravel() - FINE_MM
    leaflet = np.repeat(frame.region + 1, len(weights)).astype(np.uint8)
    low = vertices.min(axis=0) - MARGIN_MM
    shape = np.ceil((np.ptp(vertices, axis=0) + 2 * MARGIN_MM) / FINE_MM).astype(int) + 1
    drawn: NDArray[np.uint8] = np.zeros(shape, dtype=np.uint8)
    for zeta in np.linspace(-0.5, 0.5, int(np.ceil(thickness_mm.max() / (0.8 * FINE_MM))) + 1):
        cell = np.round((points + zeta * reach[:, None] * along - low) / FINE_MM).astype(int)
        drawn[tuple(cell.T)] = leaflet
    return drawn, low
