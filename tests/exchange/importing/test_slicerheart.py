"""Folders of SlicerHeart, written by VTK and pandas, become cases."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.errors import GeometryError, InputError
from mvest.exchange.importing.slicerheart import SlicerheartOptions, import_slicerheart
from mvest.exchange.markups import PointList, write_markups
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.thickening import thicken
from mvest.valve.geometry.triangles import areas
from mvest.valve.mesh.given import GivenValve
from tests.cases.folders import template_case
from tests.exchange.importing.slicerheart_exports import (
    atrial_leaflet,
    batch_export,
    fem_export,
    in_lps,
    pyvista,
    write_lines,
    write_model,
)

OPTIONS = SlicerheartOptions(pressure_mmHg=120.0)
TRUTH = template_case(64, 16)
SPHERE = pyvista.Sphere(radius=10.0)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return batch_export(tmp_path_factory.mktemp("slicerheart") / "P001", TRUTH)


@pytest.fixture
def folder(exported, tmp_path):
    """A copy to change."""
    return shutil.copytree(exported, tmp_path / "P001")


def away(frame, truth):
    """mm of each vertex of a frame from the true midsurface."""
    return closest_points(frame.vertices, in_lps(truth.vertices), truth.triangles).distance


@pytest.fixture(scope="module")
def case(exported):
    return import_slicerheart(exported, OPTIONS)


def test_both_phases_are_the_true_midsurfaces(case):
    truth = {frame.role: frame for frame in TRUTH.frames}
    assert [frame.name for frame in case.frames] == ["mid-diastole", "mid-systole"]
    for frame in case.frames:
        distance = away(frame, truth[frame.role])
        # Half a thickness is 0.6 mm: without it, or to the other side, this would fail.
        assert np.sqrt(np.mean(distance**2)) < 0.05
    assert not case.frame(Role.CLOSED).corresponds
    assert case.frame(Role.CLOSED).pressure_mmHg == 120.0
    tips = truth[Role.REFERENCE].papillary_tips
    assert case.frame(Role.REFERENCE).papillary_tips == pytest.approx(
        in_lps(tips[np.argsort(tips[:, 0])]), abs=1e-6
    )


def test_the_valve_can_be_thickened_wherever_it_is_sampled(case):
    # Where the free edges part a kink would make the thick leaflets pass through themselves.
    given = GivenValve(case.valve)
    thicken(given.valve(80, 21).surface, given.normals(80, 21))


def test_leaflets_keep_their_names_and_areas(case):
    surface, reference = case.surface, TRUTH.surface
    assert surface.region_names == ("anterior", "posterior")
    own, true = (
        np.bincount(s.region, areas(s.vertices, s.triangles)) for s in (surface, reference)
    )
    assert own == pytest.approx(true, rel=0.03)


def test_what_was_not_given_is_said(case, exported):
    said = " | ".join(case.derived)
    for words in ("thickness: 1.32 mm", "half the thickness", "joined at the commissures", "times"):
        assert words in said
    assert "110 mmHg" not in said
    assert "110 mmHg" in " | ".join(import_slicerheart(exported, SlicerheartOptions()).derived)


@pytest.mark.slow
def test_leaflets_cut_out_of_a_segmentation_come_within_half_a_voxel(tmp_path):
    # Quads where triangles were clipped, slivers and rims that curl, as SlicerHeart's have.
    folder = batch_export(tmp_path / "P001", TRUTH, voxel_mm=0.5)
    found = import_slicerheart(folder, OPTIONS)
    truth = {frame.role: frame for frame in TRUTH.frames}
    for frame in found.frames:
        true = truth[frame.role]
        back = closest_points(in_lps(true.vertices), frame.vertices, frame.triangles).distance
        assert np.sqrt(np.mean(back**2)) < 0.25
        assert np.quantile(away(frame, true), 0.9) < 0.5
        # Half of each rim is on the side that was cut out, and would add a twelfth.
        area = [areas(f.vertices, f.triangles).sum() for f in (frame, true)]
        assert area[0] == pytest.approx(area[1], rel=0.05)


def test_one_phase_is_an_anatomy(folder):
    for file in folder.glob("*_MS_*"):
        file.unlink()
    alone = import_slicerheart(folder, OPTIONS)
    assert [frame.role for frame in alone.frames] == [Role.REFERENCE]


@pytest.mark.parametrize("as_model", [False, True])
def test_the_annulus_alone_tells_the_commissures(folder, case, tmp_path, as_model):
    (folder / "ValveLandmarkPoints.csv").unlink()
    if as_model:
        (folder / "AnnulusContourPoints.csv").unlink()
        for role, stem in ((Role.REFERENCE, "frame_3_MD"), (Role.CLOSED, "frame_12_MS")):
            fem = fem_export(tmp_path / stem, TRUTH.frame(role))
            (fem / "AnnulusContourModel.vtk").rename(folder / f"P001_mitral_{stem}_annulus.vtk")
    found = import_slicerheart(folder, OPTIONS)
    assert "commissures where the leaflet nearer to the annulus changes" in " | ".join(
        found.derived
    )
    for frame, expected in zip(found.frames, case.frames, strict=True):
        distance = closest_points(frame.vertices, expected.vertices, expected.triangles).distance
        assert np.sqrt(np.mean(distance**2)) < 0.1


def test_models_in_r_a_s_are_the_same_valve(folder, case):
    frame = TRUTH.frame(Role.REFERENCE)
    for label, name in enumerate(("anterior", "posterior")):
        model = atrial_leaflet(frame, label, {"anterior": 1.32, "posterior": 1.26}[name])
        points = model.GetPoints()
        for k in range(points.GetNumberOfPoints()):
            x, y, z = points.GetPoint(k)
            points.SetPoint(k, -x, -y, z)
        file = folder / f"P001_mitral_frame_3_MD_atrial_mitral_{name}_leaflet.vtk"
        write_model(file, model, space="RAS", binary=False, version=51)
    found = import_slicerheart(folder, OPTIONS)
    assert found.surface.vertices == pytest.approx(case.surface.vertices, abs=1e-3)
    for file in folder.glob("*_MD_atrial_*"):
        file.write_bytes(file.read_bytes().replace(b"SPACE=RAS", b"no axes at"))
    found = import_slicerheart(folder, OPTIONS)
    assert found.surface.vertices == pytest.approx(case.surface.vertices, abs=1e-3)
    assert "names no axes in its header, so R, A, S are assumed" in " | ".join(found.derived)


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


def test_the_atrial_side_is_taken_before_closed_segments(folder, case):
    for file in folder.glob("*_atrial_*"):
        write_model(file.with_name(file.name.replace("_atrial", "")), SPHERE)
    assert np.array_equal(
        import_slicerheart(folder, OPTIONS).surface.vertices, case.surface.vertices
    )
    for file in folder.glob("*_atrial_*"):
        file.unlink()
    refused(folder, "anterior leaflet: a closed surface, expected one side", GeometryError)


def test_of_several_surfaces_of_a_leaflet_one_word_chooses(folder, case):
    for file in folder.glob("*_atrial_*"):
        shutil.copy(file, file.with_name(file.name.replace("_atrial", "_atrial_smooth")))
    refused(folder, r"2 surfaces of the anterior leaflet \(P001.*\), expected one; only=WORD takes")
    found = import_slicerheart(folder, replace(OPTIONS, only="smooth"))
    assert np.array_equal(found.surface.vertices, case.surface.vertices)


def test_points_that_are_not_used_are_said(folder, case):
    lists = {"mine": PointList(("chord 1",), np.zeros((1, 3)))}
    write_markups(folder / "MD.mrk.json", lists)
    text = (folder / "MD.mrk.json").read_text().replace('"Fiducial"', '"Line"', 1)
    (folder / "unplaced_MS.mrk.json").write_text(text.replace('"defined"', '"undefined"'))
    with (folder / "ValveLandmarkPoints.csv").open("a") as table:
        table.write("P001,MS,mitral,12,apex,1,2,3\n")
    found = import_slicerheart(folder, OPTIONS)
    assert np.array_equal(found.surface.vertices, case.surface.vertices)
    assert "MD: Fiducial of 1 points (chord 1) not used" in found.derived
    assert "MS: points chord 1 not placed, so not used" in found.derived
    assert "MS: landmarks APEX not used" in found.derived


def refused(folder, words, kind=InputError, **options):
    with pytest.raises(kind, match=words) as caught:
        import_slicerheart(folder, SlicerheartOptions(**options))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(folder))


def test_a_mirrored_valve_is_refused_unless_it_is_said(folder, case):
    file = folder / "ValveLandmarkPoints.csv"
    swapped = {"ALC": "PMC", "PMC": "ALC", "AL": "PM", "PM": "AL"}
    lines = [line.split(",") for line in file.read_text().splitlines()]
    lines = [[swapped.get(cell, cell) for cell in line] for line in lines]
    file.write_text("\n".join(map(",".join, lines)) + "\n")
    refused(folder, "lie as in a mirror: from the atrium ALC is on the right.*mirrored=true")
    taken = import_slicerheart(folder, SlicerheartOptions(pressure_mmHg=120.0, mirrored=True))
    assert len(taken.surface.vertices) == len(case.surface.vertices)


def test_missing_tips_are_asked_for_by_name(folder):
    tips = import_slicerheart(folder, OPTIONS).frame(Role.REFERENCE).papillary_tips
    for file in folder.glob("Papillary*"):
        file.unlink()
    refused(folder, r"MD: no papillary tips .*; give tips=\[x,y,z,x,y,z\] in LPS mm")
    given = import_slicerheart(folder, SlicerheartOptions(tips=tuple(tips.ravel())))
    assert given.frame(Role.REFERENCE).papillary_tips == pytest.approx(tips)
    assert "MS: papillary tips where they are in mid-diastole" in " | ".join(given.derived)


def test_other_valves_scenes_and_phases_are_refused(folder):
    refused(folder, "closed=ES: no such phase, there are MD, MS", closed="ES")
    refused(folder, "of scene 'P002'", scene="P002")
    for file in folder.glob("*_MS_atrial_*"):
        shutil.copy(file, file.with_name(file.name.replace("P001", "P002")))
    refused(folder, r"2 scenes \(P001, P002\); give scene=NAME")
    for file in folder.glob("*_atrial_*"):
        file.rename(file.with_name(file.name.replace("mitral_frame", "tricuspid_frame")))
    refused(folder, "no surfaces of mitral leaflets.*; found P001_tricuspid_frame", scene="P001")


def removed(folder):
    for name in ("ValveLandmarkPoints.csv", "AnnulusContourPoints.csv"):
        (folder / name).unlink()


def in_ras(folder):
    for file in folder.glob("*_MD_atrial_*"):
        file.write_bytes(file.read_bytes().replace(b"SPACE=LPS", b"SPACE=RAS"))


def cut_off(folder):
    file = next(folder.glob("*_MD_atrial_mitral_anterior*"))
    file.write_bytes(file.read_bytes()[:2000])


def closed(folder):
    write_model(next(folder.glob("*_MD_atrial_mitral_anterior*")), SPHERE)


@pytest.mark.parametrize(
    ("change", "words", "kind"),
    [
        (removed, "neither the landmarks ALC and PMC nor the annulus; export", InputError),
        (in_ras, "MD: the annulus lies .* mm from the leaflets.*x and y turned .* 0", InputError),
        (cut_off, "anterior_leaflet.vtk: damaged", InputError),
        (closed, "anterior leaflet: a closed surface, expected one side", GeometryError),
    ],
)
def test_what_contradicts_or_is_missing_is_refused(folder, change, words, kind):
    change(folder)
    refused(folder, words, kind)


@pytest.fixture(scope="module")
def fem(tmp_path_factory):
    return fem_export(
        tmp_path_factory.mktemp("fem") / "open", TRUTH.frame(Role.REFERENCE), TRUTH.chordae
    )


def test_a_folder_of_valve_fem_export_brings_its_chords(fem):
    case, truth = import_slicerheart(fem, SlicerheartOptions()), TRUTH.chordae
    reference, found = TRUTH.frame(Role.REFERENCE), case.chordae
    assert np.sqrt(np.mean(away(case.frame(Role.REFERENCE), reference) ** 2)) < 0.05
    # Files of text have six digits.
    nearest = np.linalg.norm(in_lps(truth.insertion)[:, None] - found.insertion, axis=2)
    assert nearest.min(axis=1).max() < 1e-2
    same = nearest.argmin(axis=1)
    assert sorted(same) == list(range(len(found)))
    tips = case.frame(Role.REFERENCE).papillary_tips
    begins = in_lps(reference.papillary_tips)
    assert tips[found.tip[same]] == pytest.approx(begins[truth.tip], abs=1e-2)
    assert tips[0, 0] > tips[1, 0]
    lengths = np.linalg.norm(truth.insertion - reference.papillary_tips[truth.tip], axis=1)
    assert found.rest_length[same] == pytest.approx(lengths, abs=1e-2)
    named = [np.array(chordae.family_names)[chordae.family] for chordae in (found, truth)]
    assert np.array_equal(named[0][same], named[1])
    assert found.axial_stiffness.sum() == pytest.approx(truth.axial_stiffness.sum())
    assert f"chordae: {len(truth)} of the export" in " | ".join(case.derived)


def test_chords_of_three_heads_whose_fans_meet(fem, tmp_path):
    folder = shutil.copytree(fem, tmp_path / "fem")
    frame = TRUTH.frame(Role.REFERENCE)
    heads = np.vstack([frame.papillary_tips, frame.papillary_tips[1] + [0.0, 3.0, 2.0]])
    end = TRUTH.chordae.insertion[TRUTH.chordae.tip == 1][0]
    forks = [0.8 * end + 0.2 * heads[2] + move for move in ([1.0, 0, 0], [-1.0, 0, 0])]
    lines = [line for f in forks for line in ([heads[2], f], [f, end], [f, end])]
    write_lines(folder / "Chords_mesh_-_third.vtk", in_lps(np.array(lines)))
    case = import_slicerheart(folder, SlicerheartOptions())
    found, tips = case.chordae, case.frame(Role.REFERENCE).papillary_tips
    assert len(tips) == 3
    third = np.linalg.norm(tips - in_lps(heads[2]), axis=1).argmin()
    own = found.tip == third
    assert len(found) == len(TRUTH.chordae) + own.sum()
    assert found.insertion[own] == pytest.approx(in_lps(np.array([end, end])), abs=1e-2)
    lengths = [np.linalg.norm(f - heads[2]) + np.linalg.norm(end - f) for f in forks]
    assert np.sort(found.rest_length[own]) == pytest.approx(np.sort(lengths), abs=1e-2)


def test_chords_that_begin_elsewhere_than_at_the_tips_are_refused(fem):
    tips = import_slicerheart(fem, SlicerheartOptions()).frame(Role.REFERENCE).papillary_tips
    moved = tuple((tips + 5.0 * np.eye(3)[2]).ravel())
    refused(fem, "chords begin up to 5.0 mm from the papillary tips, expected 3 mm", tips=moved)


def test_chords_that_end_at_the_tips_are_refused(fem, tmp_path):
    folder, chordae = shutil.copytree(fem, tmp_path / "fem"), TRUTH.chordae
    for file in folder.glob("Chords*"):
        file.unlink()
    tips = in_lps(TRUTH.frame(Role.REFERENCE).papillary_tips)[chordae.tip]
    lines = np.stack([in_lps(chordae.insertion), tips], axis=1)
    write_lines(folder / "chords.vtk", lines)
    refused(folder, "no papillary tips")
    tips = tuple(np.unique(tips, axis=0).ravel())
    refused(folder, r"chords begin up to \d\d\.\d mm from the papillary tips", tips=tips)


def test_a_second_folder_of_valve_fem_export_is_the_closed_frame(fem, tmp_path):
    frame = TRUTH.frame(Role.CLOSED)
    closed = fem_export(tmp_path / "closed", frame, TRUTH.chordae)
    case = import_slicerheart(fem, SlicerheartOptions(closed=str(closed), pressure_mmHg=100.0))
    assert np.sqrt(np.mean(away(case.frame(Role.CLOSED), frame) ** 2)) < 0.05
    order = np.argsort(-in_lps(TRUTH.frame(Role.REFERENCE).papillary_tips)[:, 0])
    for role in (Role.REFERENCE, Role.CLOSED):
        expected = in_lps(TRUTH.frame(role).papillary_tips)[order]
        assert case.frame(role).papillary_tips == pytest.approx(expected, abs=1e-2)
