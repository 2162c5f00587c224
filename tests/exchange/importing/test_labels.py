"""Label maps of a valve that is known, drawn by SimpleITK at 0.5 and 0.8 mm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.writer import write_case
from mvest.errors import InputError
from mvest.exchange.importing.segmented import LabelsOptions, import_labels, segmentation_std
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.proximity import closest_points
from tests.exchange.importing.voxelised import voxelised, write_slicer


@pytest.fixture(scope="module")
def valve() -> Valve:
    return Template(TemplateParameters()).valve(64, 20)


@pytest.fixture(scope="module")
def tips(valve: Valve) -> tuple[float, ...]:
    # Seen from the atrium the antero-lateral tip is on the left of the anterior leaflet.
    left = valve.papillary_tips[np.argsort(valve.papillary_tips[:, 0])]
    return tuple(left.ravel().tolist())


@pytest.fixture(scope="module")
def image(valve: Valve) -> SimpleITK.Image:
    return voxelised(valve.surface, voxel_mm=0.8)


@pytest.fixture(scope="module")
def slicer(image: SimpleITK.Image, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "valve.seg.nrrd"
    write_slicer(SimpleITK.Image(image), path)
    return path


@pytest.fixture(scope="module")
def case(slicer: Path, tips: tuple[float, ...]) -> ValveCase:
    return import_labels(slicer, LabelsOptions(tips=tips, observer_mm=0.0))


def _distances(case: ValveCase, valve: Valve) -> tuple[FloatArray, FloatArray, FloatArray]:
    """From the case to the truth, back, and the error of the thickness."""
    own, true = case.surface, valve.surface
    there = closest_points(own.vertices, true.vertices, true.triangles)
    back = closest_points(true.vertices, own.vertices, own.triangles)
    thickness = own.thickness - there.interpolate(true.thickness, true.triangles)
    return there.distance, back.distance, thickness


def test_midsurface_and_thickness_are_those_of_the_valve(case: ValveCase, valve: Valve) -> None:
    there, back, thickness = _distances(case, valve)
    assert np.sqrt(np.mean(there**2)) < 0.15
    assert np.sqrt(np.mean(back**2)) < 0.25
    assert abs(thickness.mean()) < 0.15
    assert np.sqrt(np.mean(thickness**2)) < 0.25


def test_the_stated_error_covers_the_one_that_is_made(case: ValveCase, valve: Valve) -> None:
    there, _, _ = _distances(case, valve)
    # A distance to a surface has one component.
    assert np.sqrt(np.mean(there**2)) < 1.2 * case.uncertainty.typical_mm
    assert case.uncertainty.typical_mm == pytest.approx(segmentation_std(0.8, 0.4, 0.0))


def test_voxels_smoothing_and_observer_add_up() -> None:
    # 0.8 / sqrt(24) = 0.1633, 0.4^2 / 6 = 0.0267; 0.1633^2 + 0.0267^2 + 0.3^2 = 0.1174 = 0.3426^2
    assert segmentation_std(0.8, 0.4, 0.3) == pytest.approx(0.3426, abs=1e-4)


def test_regions_come_from_the_terminology(case: ValveCase, valve: Valve) -> None:
    centres = case.surface.vertices[case.surface.triangles].mean(axis=1)
    nearest = closest_points(centres, valve.surface.vertices, valve.surface.triangles)
    assert (valve.surface.region[nearest.triangle] == case.surface.region).mean() > 0.98
    assert any("mitral_posterior_leaflet, label 2" in line for line in case.derived)


def test_the_case_is_written_and_read(case: ValveCase, tmp_path: Path) -> None:
    write_case(tmp_path / "case", case)
    again = read_case(tmp_path / "case")
    np.testing.assert_allclose(again.surface.thickness, case.surface.thickness, atol=1e-6)
    assert [frame.role for frame in again.frames] == [Role.REFERENCE]


def test_nifti_with_plain_labels_gives_the_same(
    case: ValveCase, image: SimpleITK.Image, tips: tuple[float, ...], tmp_path: Path
) -> None:
    path = tmp_path / "valve.nii.gz"
    SimpleITK.WriteImage(image, str(path))
    other = import_labels(path, LabelsOptions(tips=tips, observer_mm=0.0))
    away = closest_points(other.surface.vertices, case.surface.vertices, case.surface.triangles)
    assert away.distance.max() < 0.05
    assert any("label 1, as the file names none" in line for line in other.derived)


def test_segments_are_told_apart_by_names_or_numbers(slicer: Path, tips: tuple[float, ...]) -> None:
    swapped = LabelsOptions(
        anterior="mitral_posterior_leaflet", posterior="1", tips=tips, mirrored=True
    )
    turned = import_labels(slicer, swapped)
    assert any("anterior leaflet: segment mitral_posterior_leaflet" in s for s in turned.derived)
    with pytest.raises(InputError, match="as in a mirror"):
        import_labels(slicer, replace(swapped, mirrored=False))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tips": None}, r"give tips=\[x,y,z,x,y,z\] in LPS mm"),
        ({"closed": "1"}, "give pressure_mmHg="),
        ({"anterior": "7"}, r"no voxel has the label 7 .* give anterior=LABEL"),
        ({"anterior": "front"}, "0 segments of the anterior leaflet .* give anterior=NAME"),
        ({"open": 3}, "frame 3, expected one of 1 from 0 on"),
        ({"tips": (0.0, 0.0, 500.0, 9.0, 9.0, 500.0)}, "mm from the leaflets"),
    ],
)
def test_what_is_missing_is_asked_for_by_name(
    slicer: Path, tips: tuple[float, ...], change: dict[str, object], words: str
) -> None:
    options = replace(LabelsOptions(tips=tips), **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=words) as caught:
        import_labels(slicer, options)
    assert "\n" not in str(caught.value)
    assert str(slicer) in str(caught.value)


def test_leaflets_that_do_not_meet_are_refused(
    image: SimpleITK.Image, tips: tuple[float, ...], tmp_path: Path
) -> None:
    path = tmp_path / "apart.nrrd"
    labels = SimpleITK.GetArrayFromImage(image)
    posterior = np.roll(labels == 2, -7, axis=1)
    labels[labels == 2] = 0
    labels[posterior] = 2
    apart = SimpleITK.GetImageFromArray(labels)
    apart.CopyInformation(image)
    SimpleITK.WriteImage(apart, str(path))
    with pytest.raises(InputError, match="the leaflets meet nowhere"):
        import_labels(path, LabelsOptions(tips=tips))
