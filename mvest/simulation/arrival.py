"""The geometry of a virtual patient after export and import.

The valve is exported (as surfaces, as a folder of SlicerHeart, as label maps) and imported again.
No reader or writer of this project takes part in the exports: VTK (through PyVista) cuts, refines
and writes surfaces, pandas tables, nibabel label maps. Voxels are those inside closed surfaces,
found by a function that the importer of label maps does not use.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role, ValveCase
from mvest.errors import ConfigurationError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.exchange.importing.slicerheart import SlicerheartOptions, import_slicerheart
from mvest.exchange.importing.written import FoundFrame, case_of_frames
from mvest.problem.registration import displace
from mvest.quantities import Length
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.leaflet_fields import inside_surfaces
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.geometry.thickening import smooth_vertex_normals

KINDS = ("vertices", "surfaces", "slicerheart", "labels")
"""Ways of exporting a geometry, in the order of tables."""

POSE = Rotation.from_euler("xz", [1.0, 0.4]).as_matrix()
SHIFT = np.array([31.0, -12.0, 140.0])
"""From the axes of a simulated valve to LPS mm, so that nothing lies along an axis."""

SCENE = "simulated"
LANDMARKS = {
    "A": (0.0, 1.0), "P": (0.0, -1.0), "AL": (-1.0, 0.0), "PM": (1.0, 0.0), "ALC": (-1.0, 0.25),
    "PMC": (1.0, 0.25),
}  # fmt: skip
"""Direction (x, y) of SlicerHeart's landmarks from the middle of the template's annulus."""

SUBDIVISIONS = 2
"""Times that the edges of leaflets are halved before they are drawn as voxels."""

Shape = Frame | LeafletSurface


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrivalSettings:
    """How the geometry of a virtual patient is exported."""

    kind: Literal["vertices", "surfaces", "slicerheart", "labels"]
    label: str  #: name in tables
    seen_with_errors: bool = False  #: the closed surface has the errors of the patient's case
    voxel_mm: Length | None = None  #: of a label map
    closed: bool = False  #: the closed frame is a label map as well
    std_mm: Length = 0.6  #: of the closed surface, where the case itself does not state it


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """A case, and its true open and closed midsurfaces in the axes of the case."""

    case: ValveCase
    opened: Frame
    closed: Frame


def arrive(
    case: ValveCase,
    positions: FloatArray,
    registration: FloatArray,
    arrival: ArrivalSettings,
    folder: Path,
) -> Arrived:
    """Export the geometry of a virtual patient's case and import it again.

    ``positions (n, 3)`` mm are the true ones of its vertices in the closed frame, ``registration
    (6,)`` their displacement against the annulus and the tips that the case states. Exported and
    imported files are left in the folder, which must be empty. MvestError if the
    importer refuses the export.
    """
    opened, closed = case.frame(Role.REFERENCE), case.frame(Role.CLOSED)
    patient = Arrived(case, opened, replace(closed, vertices=positions))
    drawn = closed.vertices if arrival.seen_with_errors else positions
    closed = replace(closed, vertices=drawn, free_edge=drawn[case.free_edge], corresponds=False)
    if arrival.kind == "vertices":
        return patient
    if arrival.kind == "surfaces":
        return replace(patient, case=replace(case, frames=(opened, closed)))
    # Leaflets, annulus and tips are drawn in one image.
    tips = displace(closed.papillary_tips, registration, closed.annulus.mean(axis=0))
    closed = replace(closed, annulus=drawn[case.annulus], papillary_tips=tips)
    seen = (_in_lps(opened), _in_lps(closed))
    through = _through_slicerheart if arrival.kind == "slicerheart" else _through_labels
    imported = replace(through(patient, seen, arrival, folder), simulated=True)
    return Arrived(imported, _in_lps(opened), _in_lps(patient.closed))


def _through_slicerheart(
    patient: Arrived, frames: tuple[Frame, Frame], arrival: ArrivalSettings, folder: Path
) -> ValveCase:
    """Write the files of ValveBatchExport with -vls, -acc and -lc, and the papillary muscles.

    Frames are midsurfaces (LPS mm; antero-lateral tip first). The atrial side of a leaflet is half
    its thickness away.
    """
    import pandas as pd

    folder, surface = folder / "slicerheart", patient.case.surface
    folder.mkdir()
    annulus = patient.opened.annulus[:, :2] - patient.opened.annulus[:, :2].mean(axis=0)
    contour: list[dict[str, str]] = []
    marks: list[dict[str, str]] = []
    for index, phase, frame in zip(("3", "12"), ("MD", "MS"), frames, strict=True):
        ring, middle = frame.annulus, frame.annulus.mean(axis=0)
        about = {"Filename": SCENE, "Phase": phase, "FrameNumber": index, "Valve": "mitral"}
        for label, name in enumerate(surface.region_names):
            stem = f"{SCENE}_mitral_frame_{index}_{phase}_atrial_mitral_{name}_leaflet"
            _write_atrial_side(folder / f"{stem}.vtk", frame, label, surface.thickness)
        between = 0.5 * (ring + np.roll(ring, -1, axis=0))
        for point in np.stack([ring, between], axis=1).reshape(-1, 3):
            contour.append(about | _in_ras("AnnulusContour", "XYZ", point))
        for name, to in LANDMARKS.items():
            place = _in_ras("Landmark", "RAS", ring[int(np.argmax(annulus @ np.array(to)))])
            marks.append(about | {"LandmarkLabel": name} | place)
        muscles = ("antero-lateral", "postero-medial")
        for muscle, tip in zip(muscles, frame.papillary_tips, strict=True):
            points = (tip + 0.4 * (tip - middle), tip, middle)
            _write_points(folder / f"PapillaryMarkup-{muscle}-{phase}.fcsv", points)
    table_of = pd.DataFrame(contour).assign(AnnulusContourLabel="")
    table_of.to_csv(folder / "AnnulusContourPoints.csv", index=False)
    pd.DataFrame(marks).to_csv(folder / "ValveLandmarkPoints.csv", index=False)
    options = SlicerheartOptions(pressure_mmHg=frames[1].pressure_mmHg, std_mm=arrival.std_mm)
    return import_slicerheart(folder, options)


def _through_labels(
    patient: Arrived, frames: tuple[Frame, Frame], arrival: ArrivalSettings, folder: Path
) -> ValveCase:
    thickness = patient.case.surface.thickness
    if arrival.voxel_mm is None:
        raise ConfigurationError("arrival.voxel_mm is not given; a label map has voxels")
    opened, closed = (folder / f"{frame.name}.nii.gz" for frame in frames)
    tips = [tuple(frame.papillary_tips.ravel().tolist()) for frame in frames]
    options = LeafletsOptions(anterior=1, posterior=2, tips=tips[0], observer_mm=0.0)
    _write_label_map(opened, frames[0], thickness, arrival.voxel_mm)
    if not arrival.closed:
        return _with_closed(import_leaflets(opened, options), frames[1], arrival.std_mm)
    _write_label_map(closed, frames[1], thickness, arrival.voxel_mm)
    pressure = frames[1].pressure_mmHg
    both = replace(options, closed=str(closed), tips_closed=tips[1], pressure_mmHg=pressure)
    return import_leaflets(opened, both)


def _with_closed(case: ValveCase, closed: Frame, std_mm: float) -> ValveCase:
    """Add a closed midsurface to a case of an open frame; chordae are laid out by both frames."""
    of_reference = {name: getattr(case.surface, name) for name in ("fibre", "thickness")}
    frames = [
        FoundFrame(f.name, f.role, f.time, f.pressure_mmHg, f, f.papillary_tips, data)
        for f, data in zip((*case.frames, closed), (of_reference, {}), strict=True)
    ]
    document = {
        "name": case.name,
        "thickness": {"point_data": "thickness"},
        "fibre": "fibre",
        "observation": {"std_mm": std_mm, "correlation_length_mm": 10.0},
        "derived": list(case.derived),
    }
    return case_of_frames(frames, document, mirrored=True)


def _in_lps(frame: Frame) -> Frame:
    """A frame in LPS, the left tip first."""
    tips = frame.papillary_tips[np.argsort(frame.papillary_tips[:, 0])]
    shapes = {"vertices": frame.vertices, "annulus": frame.annulus, "free_edge": frame.free_edge}
    moved = {name: points @ POSE.T + SHIFT for name, points in shapes.items()}
    return replace(frame, papillary_tips=tips @ POSE.T + SHIFT, **moved)


# -- exports --------------------------------------------------------------------------------------
def _in_ras(name: str, axes: str, point: FloatArray) -> dict[str, str]:
    """R, A and S of a point, as in exported tables."""
    values = point * (-1, -1, 1)
    return {f"{name}{axis}": f"{value:.2f}" for axis, value in zip(axes, values, strict=True)}


def _surfaces() -> Any:
    """PyVista's function from vertices and triangles to a surface."""
    try:
        import pyvista
    except ImportError as error:
        raise ConfigurationError("this export needs pip install mvest[viz]") from error
    return pyvista.PolyData.from_regular_faces


def _write_atrial_side(file: Path, frame: Frame, label: int, thickness_mm: FloatArray) -> None:
    """Write one remeshed leaflet, half its thickness ``(n,)`` nearer to the atrium.

    It is a binary legacy file with the header of 3D Slicer, which names its axes.
    """
    surface = _surfaces()
    normals = surface(frame.vertices, frame.triangles).compute_normals(
        cell_normals=False, split_vertices=False, consistent_normals=False
    )
    up = -np.asarray(normals.point_data["Normals"])
    points = frame.vertices + 0.5 * thickness_mm[:, None] * up
    leaflet = surface(points, frame.triangles[frame.region == label]).clean()
    model = leaflet.subdivide(1, subfilter="linear").decimate_pro(0.4, preserve_topology=True)
    model.clear_data()
    model.save(file, binary=True)
    version, _, *rest = file.read_bytes().split(b"\n", 2)
    file.write_bytes(b"\n".join([version, b"3D Slicer output. SPACE=LPS", *rest]))


def _write_points(file: Path, points: Sequence[FloatArray]) -> None:
    rows = [f"{k},{x},{y},{z},0,0,0,1,1,1,0,muscle-{k + 1},," for k, (x, y, z) in enumerate(points)]
    head = (
        "# Markups fiducial file version = 5.0",
        "# CoordinateSystem = LPS",
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    )
    file.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def _write_label_map(file: Path, frame: Shape, thickness_mm: FloatArray, voxel_mm: float) -> None:
    """Write thick leaflets (LPS mm) as a NIfTI of labels: 1 anterior, 2 posterior, 0 elsewhere.

    A voxel has the label of the leaflet in which its centre lies. Both sides of a leaflet are at an
    offset from a smooth surface through the vertices (modified butterfly subdivision: Zorin,
    Schröder and Sweldens, SIGGRAPH 1996), because tissue has no facets: those of 1.5 mm flatten
    bends, as stiffer leaflets would.
    """
    import nibabel

    coarse = _surfaces()(frame.vertices, frame.triangles)
    offset = 0.5 * thickness_mm[:, None] * smooth_vertex_normals(frame.vertices, frame.triangles)
    coarse.point_data["offset"], coarse.cell_data["region"] = offset, frame.region
    fine = coarse.subdivide(SUBDIVISIONS, subfilter="butterfly")
    leaflets = [_thick_leaflet(fine, label) for label in (0, 1)]
    (anterior, posterior), low = inside_surfaces(leaflets, voxel_mm)
    labels = np.where(anterior, 1, np.where(posterior, 2, 0)).astype(np.uint8)
    # Axes of NIfTI are R, A, S.
    turned = np.array([-1.0, -1.0, 1.0])
    affine = np.diag([*(turned * voxel_mm), 1.0])
    affine[:3, 3] = turned * low
    image: Any = nibabel.Nifti1Image  # its constructor has no types
    nibabel.save(image(labels, affine), file)


def _thick_leaflet(surface: Any, label: int) -> tuple[FloatArray, IntArray]:
    """Vertices mm and triangles of one leaflet's closed surface, normals outwards.

    ``surface`` has the point data ``offset``, to the ventricular side, and the cell data
    ``region``. Leaflets in contact may pass through each other by the tolerance of contact, so each
    is closed on its own, as `mvest.valve.geometry.thickening.thicken` does with both.
    """
    triangles = np.asarray(surface.regular_faces, dtype=np.int64)
    own, numbers = np.unique(triangles[surface.cell_data["region"] == label], return_inverse=True)
    triangles, n = numbers.reshape(-1, 3), len(own)
    sides = [triangles, triangles[:, ::-1] + n]
    for a in boundary_loops(triangles):
        b = np.roll(a, -1)
        sides += [np.column_stack([b, a, a + n]), np.column_stack([b, a + n, b + n])]
    middle, offset = surface.points[own], surface.point_data["offset"][own]
    return np.concatenate([middle + offset, middle - offset]), np.concatenate(sides)
