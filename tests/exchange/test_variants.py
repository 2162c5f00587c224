"""What other programs' libraries write is read as it was written."""

from pathlib import Path

import numpy as np
import pytest

from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_regions
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.exchange import markup_variants, surface_variants, volume_variants
from tests.exchange.variant import Variant
from tests.exchange.variants import LABELS, MARKUPS, PAGE, SURFACES, VOLUMES, page

CORNERS = surface_variants.POINTS[surface_variants.TRIANGLES]


def made(variant: Variant, folder: Path) -> Path:
    variant.write(folder / variant.file)
    return folder / variant.file


def area(corners: np.ndarray) -> np.ndarray:
    """Vector area ``(3,)`` of triangles, whichever diagonal of a quad they take."""
    a, b, c = corners.transpose(1, 0, 2)
    return np.cross(b - a, c - a).sum(axis=0) / 2


@pytest.mark.parametrize("variant", SURFACES, ids=str)
def test_a_surface(variant: Variant, tmp_path: Path) -> None:
    path = made(variant, tmp_path)
    regions = {1: "anterior", 2: "posterior"} if variant.labels else {0: "all"}
    found = read_regions(path, regions)
    wanted = surface_variants.LABELS - 1 if variant.labels else np.zeros(3, dtype=int)
    if "quads" in variant.options and variant.labels:
        wanted = np.array([0, 0, 1])
    assert len(found.vertices) == len(surface_variants.POINTS)
    if "quads" not in variant.options:
        corners = (found.vertices[found.triangles], CORNERS)
        middles = [np.sort(c.mean(axis=1), axis=0) for c in corners]
        np.testing.assert_allclose(*middles, rtol=0, atol=1e-3)
    for label in np.unique(wanted):
        own = found.vertices[found.triangles[found.region == label]]
        np.testing.assert_allclose(area(own), area(CORNERS[wanted == label]), rtol=1e-6)
    if path.suffix in (".vtp", ".vtu", ".vtk"):
        np.testing.assert_array_equal(found.point_data["thickness"].ravel(), surface_variants.WALL)


@pytest.mark.parametrize("variant", VOLUMES, ids=str)
def test_a_volume(variant: Variant, tmp_path: Path) -> None:
    path = made(variant, tmp_path)
    modality = None if path.suffix == ".dcm" else Modality.MR
    found = read_volume(path, modality=modality, **variant.given)
    count = 1 if "3D" in variant.options else 3
    wanted = volume_variants.frames()[:count]
    # Floats that are stored as scaled integers of 16 bits.
    np.testing.assert_allclose(found.frames, wanted, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.times, volume_variants.TIMES[:count], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.spacing, volume_variants.SPACING, rtol=1e-6)
    if path.suffix == ".dcm":
        return  # its axes are a convention: `test_volumes`
    np.testing.assert_allclose(found.direction, volume_variants.DIRECTION, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.origin, volume_variants.ORIGIN, rtol=0, atol=1e-4)


@pytest.mark.parametrize("variant", LABELS, ids=str)
def test_labels(variant: Variant, tmp_path: Path) -> None:
    found = read_labels(made(variant, tmp_path))
    for label, name in ((1, "mitral_anterior_leaflet"), (2, "mitral_posterior_leaflet")):
        wanted, value, layer = volume_variants.label_map() == label, label, 0
        if "overlapping layers" in variant.options and label == 1:
            wanted = np.roll(wanted, 2, axis=0)
        if variant.options[0].startswith("4D"):
            layer = 1
        if variant.format == "Slicer segmentation":
            (segment,) = (segment for segment in found.segments if segment.name == name)
            value, layer = segment.label, segment.layer
        np.testing.assert_array_equal(found.frames[layer] == value, wanted)
    np.testing.assert_allclose(found.direction * found.spacing, volume_variants.AFFINE[:3, :3])
    np.testing.assert_allclose(found.origin, volume_variants.ORIGIN)


@pytest.mark.parametrize("variant", MARKUPS, ids=str)
def test_points(variant: Variant, tmp_path: Path) -> None:
    path = made(variant, tmp_path)
    (found,) = (points for points in read_markups(path).values() if len(points.labels) > 2)
    assert found.labels == markup_variants.LABELS
    np.testing.assert_array_equal(found.points, markup_variants.POSITIONS)


def test_the_page_of_formats_is_made_of_these() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m tests.exchange.variants"
