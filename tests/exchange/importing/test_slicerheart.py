"""Folders of SlicerHeart, written by VTK and pandas (`mvest.simulation.arrival`), become cases."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mvest.cases.case import Role
from mvest.errors import GeometryError, InputError
from mvest.exchange.importing.joining import _curled, _without_chords
from mvest.exchange.importing.slicerheart import MARGINAL_MM, SlicerheartOptions, import_slicerheart
from mvest.simulation.arrival import POSE, SHIFT, ArrivalSettings, arrive
from mvest.valve.anatomy.valve import band_grid
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import surface_coordinates
from mvest.valve.geometry.triangles import areas, directed_edges
from tests.cases.folders import template_case, tree_case

pyvista = pytest.importorskip("pyvista", reason="needs PyVista, which comes with the extra viz")

OPTIONS = SlicerheartOptions(pressure_mmHg=120.0)
TRUTH = template_case(64, 16)
TREES = tree_case(64, 16)
SPHERE = pyvista.Sphere(radius=10.0)


def in_lps(points):
    return points @ POSE.T + SHIFT


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    settings = ArrivalSettings(kind="slicerheart", label="")
    arrive(TRUTH, TRUTH.frame(Role.CLOSED).vertices, np.zeros(6), settings, folder)
    return folder / "slicerheart"


@pytest.fixture
def folder(exported, tmp_path):
    """A copy to change."""
    return shutil.copytree(exported, tmp_path / "scene")


@pytest.fixture(scope="module")
def case(exported):
    return import_slicerheart(exported, OPTIONS)


def rms_to(frame, vertices, triangles):
    """Rms distance (mm) of the vertices of a frame from a surface."""
    distance = closest_points(frame.vertices, vertices, triangles).distance
    return np.sqrt(np.mean(distance**2))


def test_both_phases_are_the_true_midsurfaces(case):
    truth = {frame.role: frame for frame in TRUTH.frames}
    assert [frame.name for frame in case.frames] == ["mid-diastole", "mid-systole"]
    for frame in case.frames:
        true = truth[frame.role]
        place = closest_points(frame.vertices, in_lps(true.vertices), true.triangles)
        # Half a thickness is 0.6 mm: without it, or to the other side, this would fail.
        inside = cKDTree(frame.free_edge).query(frame.vertices)[0] > 1e-9
        assert np.sqrt(np.mean(place.distance[inside] ** 2)) < 0.05
        # The rim that is cut off rounds the indentations of the free edge.
        assert place.distance.max() < 0.5
    assert not case.frame(Role.CLOSED).corresponds
    assert case.frame(Role.CLOSED).pressure_mmHg == 120.0
    tips = truth[Role.REFERENCE].papillary_tips
    expected = in_lps(tips[np.argsort(tips[:, 0])])
    assert case.frame(Role.REFERENCE).papillary_tips == pytest.approx(expected, abs=1e-6)
    own, true = (
        np.bincount(s.region, areas(s.vertices, s.triangles)) for s in (case.surface, TRUTH.surface)
    )
    assert own == pytest.approx(true, rel=0.03)


def test_edges_that_curl_round_a_rim_are_cut_off():
    # A straight wall of 8 mm ends in quarter circles of radius 0.6 mm.
    angle, radius = np.linspace(0, np.pi / 2, 20), 0.6
    arc = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    wall = np.stack([np.linspace(0, -8, 80)[1:-1], np.zeros(78)], axis=1)
    curve = np.vstack([arc[::-1], wall, arc * [-1, 1] - [8, 0]])
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    even = np.linspace(0, along[-1], 81)
    curve = np.stack([np.interp(even, along, axis) for axis in curve.T], axis=1)
    rows = np.zeros((81, 6, 3))
    rows[:, :, 2], rows[:, :, 0] = curve[:, :1], curve[:, 1:]
    shares = _curled(rows, np.full((2, 6), radius))
    assert shares * along[-1] == pytest.approx(np.full((2, 6), radius * np.pi / 2), abs=0.02)
    assert not _curled(rows[10:70], np.full((2, 6), radius)).any()


def test_a_lobe_beyond_an_edge_between_two_vertices_of_the_rim_has_coordinates():
    grid, lobe = band_grid(12, 4), np.arange(48, 51)
    turn = np.radians(grid.phi)
    tube = np.stack([10 * np.cos(turn), 10 * np.sin(turn), -6 * grid.s], axis=1)
    # Two vertices of the free edge, two below them, and one in the middle of the four.
    first, second = tube[36], tube[37]
    below = np.stack([first, second]) - [0, 0, 3.0]
    points = np.concatenate([tube, below, [np.mean([first, second, *below], axis=0)]])
    added = [[36, 37, 50], [37, 49, 50], [49, 48, 50], [48, 36, 50]]
    inwards = [36, 37] in directed_edges(grid.triangles).tolist()
    triangles = np.concatenate([grid.triangles, np.array(added)[:, :: -1 if inwards else 1]])
    loops = np.arange(12), np.r_[36, lobe[:2], np.arange(37, 48)]
    with pytest.raises(GeometryError, match="fold over at 4 triangles"):
        surface_coordinates(points, triangles, *loops)
    more, faces, region = _without_chords(points, triangles, np.zeros(len(triangles)), loops)
    found = surface_coordinates(more, faces, *loops)
    assert found.s[50] < 1.0 - 1e-3
    assert (len(more), len(faces), len(region)) == (52, len(triangles) + 2, len(triangles) + 2)
    assert areas(more, faces).sum() == pytest.approx(areas(points, triangles).sum())


def test_the_annulus_alone_gives_the_commissures(folder, case):
    (folder / "ValveLandmarkPoints.csv").unlink()
    found = import_slicerheart(folder, OPTIONS)
    assert any("commissures where the leaflet nearer" in line for line in found.derived)
    for frame, expected in zip(found.frames, case.frames, strict=True):
        assert rms_to(frame, expected.vertices, expected.triangles) < 0.1


def test_models_in_r_a_s_are_the_same_valve(folder, case):
    for file in folder.glob("*_MD_atrial_*"):
        model = pyvista.read(file)
        model.points = model.points * [-1, -1, 1]
        model.save(file)
    found = import_slicerheart(folder, OPTIONS)
    assert found.surface.vertices == pytest.approx(case.surface.vertices, abs=1e-3)
    assert any("names no axes in its header, so R, A, S" in line for line in found.derived)


NAMES = {
    "April to August 2026": lambda name: name.replace("_atrial", ""),
    "by hand": lambda name: re.sub(r".*_(M.)_atrial_mitral_(.).*", r"\2ml-\1.vtk", name).upper(),
    "in words": lambda name: re.sub(r".*_(M.)_atrial_mitral_(\w+)_leaflet", r"\1 \2 Leaflet", name),
}


@pytest.mark.parametrize("names", NAMES)
def test_surfaces_of_other_names_are_the_same_valve(folder, case, names):
    for file in folder.glob("*_atrial_*"):
        file.rename(file.with_name(NAMES[names](file.name).replace(".VTK", ".vtk")))
    found = import_slicerheart(folder, OPTIONS)
    for frame, expected in zip(found.frames, case.frames, strict=True):
        assert np.array_equal(frame.vertices, expected.vertices)


def test_folders_without_phases_are_the_open_and_the_closed_frame(folder, case, tmp_path):
    for phase in ("MD", "MS"):
        (tmp_path / phase).mkdir()
        for file in folder.glob(f"*_{phase}_atrial_*"):
            leaflet = "anterior" if "anterior" in file.name else "posterior"
            shutil.copy(file, tmp_path / phase / f"{leaflet}_SurfaceModel-fit.vtk")
        table = (folder / "ValveLandmarkPoints.csv").read_text().splitlines(keepends=True)
        rows = [row for row in table[1:] if f",{phase}," in row]
        (tmp_path / phase / "ValveLandmarkPoints.csv").write_text("".join([table[0], *rows]))
    tips = tuple(case.frame(Role.REFERENCE).papillary_tips.ravel())
    options = SlicerheartOptions(tips=tips, closed=str(tmp_path / "MS"), pressure_mmHg=120.0)
    found = import_slicerheart(tmp_path / "MD", options)
    for frame, expected in zip(found.frames, case.frames, strict=True):
        assert rms_to(frame, expected.vertices, expected.triangles) < 0.1
    options = replace(options, closed=str(tmp_path / "MD"))
    refused(tmp_path / "MS", "are the frames exchanged?", options=options)


def in_scallops(folder, gap_mm):
    """Cut the posterior leaflets into scallops at their indentations, with gaps.

    The scallops have triangles of their own.
    """
    for file in folder.glob("*_atrial_mitral_posterior_leaflet.vtk"):
        whole = pyvista.read(file)
        seen = in_lps(TRUTH.frame(Role.REFERENCE if "_MD_" in file.name else Role.CLOSED).vertices)
        before, middle, after = (seen.reshape(16, 64, 3)[:, column] for column in (43, 48, 53))
        first, last = (beyond(border, middle, whole.points) for border in (before, after))
        sides = first, np.maximum(-first, -last), last
        name = file.name.replace("posterior_leaflet", "posterior_leaflet_P{}")
        for number, side in enumerate(sides, 1):
            whole.point_data["side"] = side
            part = whole.clip_scalar(scalars="side", value=-gap_mm / 2).triangulate().clean()
            if number == 2:
                part = part.subdivide(1, "linear").flip_faces()
            write_model(part, folder / name.format(number))
        file.unlink()


def beyond(border, inside, points):
    """Distance of points from the plane of a border, positive on the side of other points."""
    normal = np.linalg.svd(border - border.mean(axis=0))[2][2]
    normal *= np.sign((inside.mean(axis=0) - border.mean(axis=0)) @ normal)
    return (points - border.mean(axis=0)) @ normal


def write_model(model, file):
    model.clear_data()
    model.save(file)
    file.write_bytes(
        re.sub(rb"\n[^\n]*\n", b"\n3D Slicer. SPACE=LPS\n", file.read_bytes(), count=1)
    )


def test_scallops_of_the_posterior_leaflet_are_joined(folder, case):
    in_scallops(folder, 0.6)
    found = import_slicerheart(folder, OPTIONS)
    for frame, expected in zip(found.frames, case.frames, strict=True):
        assert rms_to(frame, expected.vertices, expected.triangles) < 0.1
    own, true = (
        np.bincount(s.region, areas(s.vertices, s.triangles)) for s in (found.surface, case.surface)
    )
    assert own == pytest.approx(true, rel=0.01)
    assert "MD: posterior leaflet: P1, P2, P3" in found.derived
    file = next(folder.glob("*_MD_*_P2.vtk"))
    shutil.copy(file, file.with_stem(f"{file.stem}_again"))
    refused(folder, "4 surfaces of the posterior .*, or one of each scallop")


def test_scallops_far_apart_are_refused(folder):
    in_scallops(folder, 4.0)
    refused(folder, "MD: posterior leaflet: segments of a leaflet, 4.* mm apart", GeometryError)


def test_the_atrial_side_is_taken_before_closed_segments(folder, case):
    for file in folder.glob("*_atrial_*"):
        SPHERE.save(file.with_name(file.name.replace("_atrial", "")))
    found = import_slicerheart(folder, OPTIONS)
    assert np.array_equal(found.surface.vertices, case.surface.vertices)
    for file in folder.glob("*_atrial_*"):
        file.unlink()
    refused(folder, "anterior leaflet: a closed surface, expected one side", GeometryError)


def refused(folder, words, kind=InputError, options=OPTIONS):
    with pytest.raises(kind, match=words) as caught:
        import_slicerheart(folder, options)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(folder))


@pytest.fixture
def fem(exported, tmp_path):
    """A folder of ValveFemExport with branching chords: shells, and lines with their own points."""
    folder = tmp_path / "fem"
    folder.mkdir()
    for file in exported.glob("*_MD_atrial_*"):
        name = re.sub(r".*(mitral_\w+_leaflet)", r"\1_SurfaceModel-fit", file.name)
        shutil.copy(file, folder / name)
    table = (exported / "ValveLandmarkPoints.csv").read_text().splitlines(keepends=True)
    rows = [row for row in table[1:] if ",MD," in row]
    (folder / "ValveLandmarkPoints.csv").write_text("".join([table[0], *rows]))
    lines = in_lps(TREES.chordae.ends(TREES.frames[0].papillary_tips))
    for number, own in enumerate((lines[::2], lines[1::2])):
        write_lines(own, folder / f"Chords_mesh_-_Region_{number}.vtk")
    return folder


def write_lines(segments, file):
    cells = np.column_stack(
        [np.full(len(segments), 2), np.arange(2 * len(segments)).reshape(-1, 2)]
    )
    write_model(pyvista.PolyData(segments.reshape(-1, 3), lines=cells), file)


def test_branching_chords_of_a_fem_export(fem):
    found, truth = import_slicerheart(fem, SlicerheartOptions()), TREES.chordae
    tips, own = found.frames[0].papillary_tips, found.chordae
    true_tips = in_lps(TREES.frames[0].papillary_tips)
    assert tips == pytest.approx(true_tips[::-1], abs=1e-3)
    c, ends = len(truth.insertion), truth.ends(TREES.frames[0].papillary_tips)
    j = len(truth.junction)
    assert (len(own.insertion), len(own.junction)) == (c, j)
    # Each segment is the true one with the same ends, and as long as drawn.
    away, number = cKDTree(in_lps(ends).reshape(-1, 6)).query(own.ends(tips).reshape(-1, 6))
    assert away.max() < 1e-3
    assert sorted(number) == list(range(c + j))
    length = np.linalg.norm(np.diff(ends, axis=1)[:, 0], axis=1)
    assert own.rest_length == pytest.approx(length[number], abs=1e-4)
    # By the distance from the free edge, which the shift to the midsurface moves a little.
    edge = cKDTree(TREES.surface.vertices[TREES.free_edge])
    inwards = edge.query(truth.insertion[number[:c]])[0]
    clear = np.abs(inwards - MARGINAL_MM) > 0.5
    assert (own.family[:c] == (inwards > MARGINAL_MM))[clear].all()
    assert clear.sum() > 40
    # A trunk is as stiff as its branches, and all trunks as the template's.
    for junction in range(j):
        branches = own.axial_stiffness[own.parent == junction].sum()
        assert own.axial_stiffness[c + junction] == pytest.approx(branches)
    total = TRUTH.chordae.axial_stiffness[TRUTH.chordae.parent < 0].sum()
    assert own.axial_stiffness[own.parent < 0].sum() == pytest.approx(total)
    assert any(f"chordae: {c} leaflet ends and {j} branching points" in s for s in found.derived)


def test_chords_that_start_elsewhere_or_meet_are_refused(fem):
    tips = in_lps(TREES.frames[0].papillary_tips)[::-1]
    moved = SlicerheartOptions(tips=tuple((tips + np.array([3.0, 4.0, 0.0])).ravel()))
    refused(fem, "chords begin up to 5.0 mm from the papillary tips", options=moved)
    file, ends = fem / "Chords_mesh_-_Region_0.vtk", TREES.chordae.junction[[0, 2]]
    write_lines(in_lps(np.stack([ends, TREES.chordae.junction[[1, 1]]], axis=1)), file)
    refused(fem, r"\d chords meet at .*, where others begin; expected one", options=OPTIONS)
    for one in fem.glob("Chords*"):
        one.unlink()
    ends = TREES.chordae.insertion
    upwards = np.stack(
        [ends, np.broadcast_to(TREES.frames[0].papillary_tips[0], ends.shape)], axis=1
    )
    write_lines(in_lps(upwards), file)
    given = SlicerheartOptions(tips=tuple(tips.ravel()))
    refused(fem, r"chords begin up to \d\d\.\d mm", options=given)


def test_a_mirrored_valve_is_refused_unless_accepted(folder, case):
    tips = tuple(case.frame(Role.REFERENCE).papillary_tips[::-1].ravel())
    swapped = replace(OPTIONS, tips=tips)
    refused(folder, "mid-diastole: the antero-lateral .* tip lies as in a mirror", options=swapped)
    import_slicerheart(folder, replace(swapped, mirrored=True))
    file = folder / "ValveLandmarkPoints.csv"
    names = {"ALC": "PMC", "PMC": "ALC", "AL": "PM", "PM": "AL"}
    text = re.sub(r"\b(ALC|PMC|AL|PM)\b", lambda found: names[found[0]], file.read_text())
    file.write_text(text)
    refused(folder, "landmark ALC lies as in a mirror: on the right.*mirrored=true")


def test_missing_tips_are_requested_by_name(folder, case):
    tips = case.frame(Role.REFERENCE).papillary_tips
    for file in folder.glob("Papillary*"):
        file.unlink()
    refused(folder, r"MD: no papillary tips .*; give tips=\[x,y,z,x,y,z\] in LPS mm")
    given = import_slicerheart(folder, SlicerheartOptions(tips=tuple(tips.ravel())))
    assert given.frame(Role.REFERENCE).papillary_tips == pytest.approx(tips)
    assert "MS: papillary tips of mid-diastole" in given.derived


def test_other_valves_scenes_and_phases_are_refused(folder):
    no_phase = SlicerheartOptions(closed="ES")
    refused(folder, "closed=ES: no such phase, there are MD, MS", options=no_phase)
    refused(folder, "of scene 'P002'", options=SlicerheartOptions(scene="P002"))
    for file in folder.glob("*_MS_atrial_*"):
        shutil.copy(file, file.with_name(file.name.replace("simulated", "P002")))
    refused(folder, r"2 scenes \(P002, simulated\); give scene=NAME")
    for file in folder.glob("*_atrial_*"):
        file.rename(file.with_name(file.name.replace("mitral_frame", "tricuspid_frame")))
    words = "no surfaces of mitral leaflets.*; found P002_tricuspid_frame"
    refused(folder, words, options=SlicerheartOptions(scene="simulated"))


def removed(folder):
    for name in ("ValveLandmarkPoints.csv", "AnnulusContourPoints.csv"):
        (folder / name).unlink()


def in_ras(folder):
    for file in folder.glob("*_MD_atrial_*"):
        file.write_bytes(file.read_bytes().replace(b"SPACE=LPS", b"SPACE=RAS"))


def cut_off(folder):
    file = next(folder.glob("*_MD_atrial_mitral_anterior*"))
    file.write_bytes(file.read_bytes()[:2000])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (removed, "neither the landmarks ALC and PMC nor the annulus; export"),
        (in_ras, "MD: the annulus lies .* mm from the leaflets.*x and y turned .* 0"),
        (cut_off, "anterior_leaflet.vtk: damaged"),
    ],
)
def test_missing_or_contradicting_files_are_refused(folder, change, words):
    change(folder)
    refused(folder, words)
