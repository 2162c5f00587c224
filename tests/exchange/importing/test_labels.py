"""Label maps of a small known valve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK

from mvest.cases.case import Role, ValveCase
from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, _frames, import_leaflets
from mvest.typing import IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.segmented import segmentation_std
from tests.exchange.importing.voxelised import small_valve, voxelised, write_slicer

TIPS = (-8.0, 0.0, -20.0, 8.0, 0.0, -20.0)
OPTIONS = LeafletsOptions(tips=TIPS, observer_mm=0.0)
TRUE = small_valve(closed=False, taller=0.4)


@pytest.fixture(scope="module")
def image() -> SimpleITK.Image:
    return voxelised(TRUE, 0.8)


@pytest.fixture(scope="module")
def slicer(image: SimpleITK.Image, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "valve.seg.nrrd"
    write_slicer(SimpleITK.Image(image), path)
    return path


@pytest.fixture(scope="module")
def case(slicer: Path) -> ValveCase:
    return import_leaflets(slicer, OPTIONS)


def check(path: Path, **given: Any) -> ValveCase:
    """A map of the valve, imported and compared with it."""
    found = import_leaflets(path, replace(OPTIONS, **given))
    surface = found.surface
    away = closest_points(surface.vertices, TRUE.vertices, TRUE.triangles)
    assert np.sqrt(np.mean(away.distance**2)) < 0.25
    centres = surface.vertices[surface.triangles].mean(axis=1)
    nearest = closest_points(centres, TRUE.vertices, TRUE.triangles)
    # Each commissure is found within one column of vertices.
    wrong = (TRUE.region[nearest.triangle] != surface.region).mean()
    assert wrong < 2.01 / len(found.annulus)
    return found


def test_midsurface_thickness_and_stated_error(case: ValveCase) -> None:
    own = case.surface
    there = closest_points(own.vertices, TRUE.vertices, TRUE.triangles)
    back = closest_points(TRUE.vertices, own.vertices, own.triangles)
    thickness = own.thickness - there.interpolate(TRUE.thickness, TRUE.triangles)
    rms = np.sqrt([np.mean(error**2) for error in (there.distance, back.distance, thickness)])
    assert (rms < [0.15, 0.25, 0.25]).all()
    # A distance to a surface has one component.
    assert rms[0] < 1.2 * case.uncertainty.typical_mm
    assert case.uncertainty.typical_mm == pytest.approx(segmentation_std(0.8, 0.4, 0.0))
    assert any("posterior: mitral_posterior_leaflet (2)" in line for line in case.derived)
    # 0.8 / sqrt(24) = 0.1633, 0.4^2 / 6 = 0.0267; 0.1633^2 + 0.0267^2 + 0.3^2 = 0.1174 = 0.3426^2
    assert segmentation_std(0.8, 0.4, 0.3) == pytest.approx(0.3426, abs=1e-4)


def _written(
    image: SimpleITK.Image, path: Path, convention: Callable[[IntArray], IntArray]
) -> Path:
    """The map with labels, z first, of another convention."""
    labels = convention(SimpleITK.GetArrayFromImage(image).astype(np.int64)).astype(np.uint8)
    other = SimpleITK.GetImageFromArray(labels, isVector=False)
    if labels.ndim == 3:
        other.CopyInformation(image)
    else:
        other.SetSpacing([*image.GetSpacing(), 0.04])
        other.SetOrigin([*image.GetOrigin(), 0.0])
        direction = np.eye(4)
        direction[:3, :3] = np.reshape(image.GetDirection(), (3, 3))
        other.SetDirection(direction.ravel().tolist())
    SimpleITK.WriteImage(other, str(path))
    return path


def _scallops(labels: IntArray) -> IntArray:
    """2, 3 and 4 in place of the posterior leaflet."""
    third = labels.shape[2] // 3
    return np.where(labels == 2, 2 + np.clip(np.arange(labels.shape[2]) // third, 0, 2), labels)


@pytest.mark.parametrize(
    ("convention", "given", "words"),
    [
        (
            lambda labels: np.choose(labels, [0, 2, 1]),
            {},
            "label 2 taken as the anterior and label 1 as the posterior",
        ),
        (lambda labels: (labels > 0).astype(np.int64), {}, "anterior leaflet: the taller one"),
        (_scallops, {"anterior": 1, "posterior": [2, 3, 4]}, "posterior: 2, 3, 4"),
    ],
)
def test_labels_of_all_conventions_are_the_same_valve(
    image: SimpleITK.Image,
    tmp_path: Path,
    convention: Callable[[IntArray], IntArray],
    given: dict[str, Any],
    words: str,
) -> None:
    path = _written(image, tmp_path / "valve.nii.gz", convention)
    assert any(words in line for line in check(path, **given).derived)


def test_names_of_leaflets_are_recognised(image: SimpleITK.Image, tmp_path: Path) -> None:
    path = tmp_path / "valve.seg.nrrd"
    write_slicer(SimpleITK.Image(image), path, ("AML", "Posterior"), tags=False)
    assert "anterior: AML (1); posterior: Posterior (2)" in check(path).derived


def test_a_file_for_each_leaflet(image: SimpleITK.Image, tmp_path: Path) -> None:
    for label, name in ((1, "a_anterior_leaflet.nrrd"), (2, "a_posterior_leaflet.nrrd")):
        _written(image, tmp_path / name, lambda labels, own=label: labels == own)
    check(tmp_path / "a_posterior_leaflet.nrrd")


def test_two_labelled_frames_are_the_open_and_the_closed_one(
    image: SimpleITK.Image, tmp_path: Path
) -> None:
    path, derived = tmp_path / "valve.nii.gz", list[str]()
    _written(image, path, lambda labels: np.stack([0 * labels, labels, 0 * labels, labels]))
    with pytest.raises(InputError, match=r"frames \[1, 3\] hold labels: give pressure_mmHg="):
        import_leaflets(path, OPTIONS)
    found = _frames(path, replace(OPTIONS, pressure_mmHg=100.0), derived)
    assert [(one.role, one.frame) for one in found] == [(Role.REFERENCE, 1), (Role.CLOSED, 3)]
    assert "1 is taken as the open one and 3 as the closed one" in derived[0]


def test_labels_other_than_two_leaflets_are_refused(image: SimpleITK.Image, tmp_path: Path) -> None:
    def annulus(labels: IntArray) -> IntArray:
        """1 where the leaflets begin, 2 and 3 the leaflets."""
        top = np.flatnonzero((labels > 0).any(axis=(1, 2))).max()
        ring = (np.arange(len(labels)) > top - 2)[:, None, None] & (labels > 0)
        return np.where(ring, 1, np.where(labels > 0, labels + 1, 0))

    with pytest.raises(InputError, match="not recognised among 1, 2, 3: give anterior=N and post"):
        check(_written(image, tmp_path / "valve.nii.gz", annulus))


def test_exchanged_tips_are_refused(slicer: Path) -> None:
    with pytest.raises(InputError, match=r"papillary tip lies as in a mirror: .* exchanged"):
        import_leaflets(slicer, replace(OPTIONS, tips=(*TIPS[3:], *TIPS[:3])))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tips": None}, r"give tips=\[x,y,z,x,y,z\] in LPS"),
        ({"closed": "1"}, "give pressure_mmHg="),
        ({"open": 3}, r"frame 3 holds no labels, expected one of \[0\]"),
        ({"units": "cm"}, "a label map is in mm"),
        ({"tips": (0.0, 0.0, 500.0, 9.0, 9.0, 500.0)}, "mm from the leaflets"),
    ],
)
def test_missing_options_are_requested_by_name(
    slicer: Path, change: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        import_leaflets(slicer, replace(OPTIONS, **change))
    assert "\n" not in str(caught.value)
    assert str(slicer) in str(caught.value)
