"""Label maps of a valve that is known, drawn by SimpleITK at 0.5 and 0.8 mm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK

from mvest.cases.case import Role, ValveCase
from mvest.cases.folder import read_case, write_case
from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.segmented import segmentation_std
from mvest.valve.geometry.thickening import thicken
from tests.exchange.importing.voxelised import small_valve, voxelised, write_slicer


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
    return import_leaflets(slicer, LeafletsOptions(tips=tips, observer_mm=0.0))


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
    # 0.8 / sqrt(24) = 0.1633, 0.4^2 / 6 = 0.0267; 0.1633^2 + 0.0267^2 + 0.3^2 = 0.1174 = 0.3426^2
    assert segmentation_std(0.8, 0.4, 0.3) == pytest.approx(0.3426, abs=1e-4)


def test_regions_come_from_the_terminology(case: ValveCase, valve: Valve) -> None:
    centres = case.surface.vertices[case.surface.triangles].mean(axis=1)
    nearest = closest_points(centres, valve.surface.vertices, valve.surface.triangles)
    assert (valve.surface.region[nearest.triangle] == case.surface.region).mean() > 0.98
    assert any("posterior: mitral_posterior_leaflet (2)" in line for line in case.derived)


def _written(
    image: SimpleITK.Image, path: Path, convention: Callable[[IntArray], IntArray]
) -> Path:
    """The map with its labels, z first, as someone else has them."""
    labels = convention(SimpleITK.GetArrayFromImage(image).astype(np.int64)).astype(np.uint8)
    other = SimpleITK.GetImageFromArray(labels, isVector=False)
    if labels.ndim == 3:
        other.CopyInformation(image)
    else:
        other.SetSpacing([*image.GetSpacing(), 0.04])
        other.SetOrigin([*image.GetOrigin(), 0.0])
    SimpleITK.WriteImage(other, str(path))
    return path


def _scallops(labels: IntArray) -> IntArray:
    """2, 3 and 4 in place of the posterior leaflet."""
    third = labels.shape[2] // 3
    return np.where(labels == 2, 2 + np.clip(np.arange(labels.shape[2]) // third, 0, 2), labels)


def _annulus(labels: IntArray) -> IntArray:
    """1 where the leaflets begin, 2 and 3 the leaflets."""
    top = np.flatnonzero((labels > 0).any(axis=(1, 2))).max()
    ring = (np.arange(len(labels)) > top - 2)[:, None, None] & (labels > 0)
    return np.where(ring, 1, np.where(labels > 0, labels + 1, 0))


def _sparse(labels: IntArray) -> IntArray:
    """Six frames, of which two are segmented."""
    return np.stack([(frame in (1, 4)) * labels for frame in range(6)])


SMALL_TIPS = (-8.0, 0.0, -20.0, 8.0, 0.0, -20.0)


@pytest.fixture(scope="module")
def small() -> SimpleITK.Image:
    return voxelised(small_valve(closed=False, taller=0.4), 0.8)


@pytest.mark.parametrize(
    ("convention", "given", "said"),
    [
        (lambda labels: labels, {}, "label 1 taken as the anterior and label 2 as the posterior"),
        (
            lambda labels: np.choose(labels, [0, 2, 1]),
            {},
            "label 2 taken as the anterior and label 1 as the posterior",
        ),
        (lambda labels: (labels > 0).astype(np.int64), {}, "anterior leaflet: the taller one"),
        (_scallops, {"anterior": 1, "posterior": [2, 3, 4]}, "posterior: 2, 3, 4"),
        (_annulus, {"anterior": 2, "posterior": 3}, "anterior: 2; posterior: 3; not used: 1"),
        (_sparse, {"open": 4}, "[1, 4], 4 is taken as the open one"),
    ],
)
def test_labels_of_all_conventions_are_the_same_valve(
    small: SimpleITK.Image,
    tmp_path: Path,
    convention: Callable[[IntArray], IntArray],
    given: dict[str, Any],
    said: str,
) -> None:
    path = _written(small, tmp_path / "valve.nii.gz", convention)
    assert any(said in line for line in _small(path, **given).derived)


def _small(path: Path, **given: Any) -> ValveCase:
    """A map of the small valve, imported and compared with it."""
    found = import_leaflets(path, LeafletsOptions(tips=SMALL_TIPS, observer_mm=0.0, **given))
    surface, true = found.surface, small_valve(closed=False, taller=0.4)
    away = closest_points(surface.vertices, true.vertices, true.triangles)
    assert np.sqrt(np.mean(away.distance**2)) < 0.25
    centres = surface.vertices[surface.triangles].mean(axis=1)
    nearest = closest_points(centres, true.vertices, true.triangles)
    assert (true.region[nearest.triangle] == surface.region).mean() > 0.95
    return found


def test_a_file_for_each_leaflet(small: SimpleITK.Image, tmp_path: Path) -> None:
    for label, name in ((1, "a_anterior_leaflet.nrrd"), (2, "a_posterior_leaflet.nrrd")):
        _written(small, tmp_path / name, lambda labels, own=label: labels == own)
    path = tmp_path / "a_posterior_leaflet.nrrd"
    _small(path)
    other = path.rename(tmp_path / "b.nrrd")
    _small(tmp_path / "a_anterior_leaflet.nrrd", posterior=str(other))


def test_two_labelled_frames_are_the_open_and_the_closed_one(
    small: SimpleITK.Image, tmp_path: Path
) -> None:
    path = _written(small, tmp_path / "valve.nii.gz", _sparse)
    with pytest.raises(InputError, match=r"frames \[1, 4\] hold labels: give pressure_mmHg="):
        _small(path)
    both = _small(path, pressure_mmHg=100.0)
    assert [frame.role for frame in both.frames] == [Role.REFERENCE, Role.CLOSED]
    assert any("1 is taken as the open one and 4 as the closed" in line for line in both.derived)


@pytest.mark.parametrize(
    ("convention", "words"),
    [
        (_annulus, "not recognised among 1, 2, 3: give anterior=N and posterior=N"),
        (lambda labels: np.minimum(_annulus(labels), 2), "give anterior= and posterior=, or leaf"),
    ],
)
def test_labels_that_are_no_two_leaflets_are_asked_for(
    small: SimpleITK.Image, tmp_path: Path, convention: Callable[[IntArray], IntArray], words: str
) -> None:
    path = _written(small, tmp_path / "valve.nii.gz", convention)
    with pytest.raises(InputError, match=words):
        _small(path)


def test_exchanged_leaflets_are_called_so(slicer: Path, tips: tuple[float, ...]) -> None:
    swapped = LeafletsOptions(
        anterior="mitral_posterior_leaflet", posterior="1", tips=tips, mirrored=True
    )
    turned = import_leaflets(slicer, swapped)
    assert any("anterior: mitral_posterior_leaflet (2)" in line for line in turned.derived)
    with pytest.raises(InputError, match="as in a mirror: exchange the leaflets"):
        import_leaflets(slicer, replace(swapped, mirrored=False))
    with pytest.raises(InputError, match="as in a mirror: give the antero-lateral tip first"):
        import_leaflets(slicer, LeafletsOptions(tips=(*tips[3:], *tips[:3])))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tips": None}, r"give tips=\[x,y,z,x,y,z\] in LPS"),
        ({"closed": "1"}, "give pressure_mmHg="),
        ({"anterior": 7}, "0 parts of the name or number 7, expected one of mitral_anterior"),
        ({"anterior": "front"}, "0 parts of the name or number front"),
        ({"anterior": 2}, "give anterior=N and posterior=N"),
        ({"open": 3}, r"frame 3 holds no labels, expected one of \[0\]"),
        ({"units": "cm"}, "a label map is in mm"),
        ({"tips": (0.0, 0.0, 500.0, 9.0, 9.0, 500.0)}, "mm from the leaflets"),
    ],
)
def test_what_is_missing_is_asked_for_by_name(
    slicer: Path, tips: tuple[float, ...], change: dict[str, object], words: str
) -> None:
    options = replace(LeafletsOptions(tips=tips), **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=words) as caught:
        import_leaflets(slicer, options)
    assert "\n" not in str(caught.value)
    assert str(slicer) in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [{"edge_mm": 9.0}, {"observer_mm": -1.0}, {"smoothing_mm": 20.0}, {"tips": (1.0, 2.0)}],
)
def test_options_that_are_none_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        LeafletsOptions(**options)


@pytest.mark.parametrize("names", [("AML", "PML"), ("Anterior", "Posterior"), ("A2", "P2")])
def test_names_of_leaflets_are_recognised(
    small: SimpleITK.Image, tmp_path: Path, names: tuple[str, str]
) -> None:
    path = tmp_path / "valve.seg.nrrd"
    write_slicer(SimpleITK.Image(small), path, names, tags=False)
    said = f"anterior: {names[0]} (1); posterior: {names[1]} (2)"
    assert said in _small(path).derived


@pytest.mark.slow
@pytest.mark.parametrize("voxel_mm", [0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8])
def test_whatever_is_imported_can_be_thickened(
    valve: Valve, tips: tuple[float, ...], tmp_path: Path, voxel_mm: float
) -> None:
    path = tmp_path / "valve.nrrd"
    SimpleITK.WriteImage(voxelised(valve.surface, voxel_mm), str(path))
    imported = import_leaflets(path, LeafletsOptions(tips=tips, observer_mm=0.0))
    thicken(imported.surface)
    repaired = [line for line in imported.derived if "passes through itself" in line]
    assert len(repaired) == (voxel_mm == 0.6)
    write_case(tmp_path / "case", imported)
    again = read_case(tmp_path / "case")
    assert np.sqrt(np.mean(_distances(again, valve)[0] ** 2)) < 0.15


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
        import_leaflets(path, LeafletsOptions(tips=tips))
