"""The template, thickened, as one closed surface and as one for each leaflet."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.exchange.surfaces import read_surface
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import LeafletSurface, Valve
from mvest.valve.geometry.midsurface import midsurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.thickening import thicken
from tests.exchange.surfaces.glb import write_parts

HRA = Path(os.environ.get("MVEST_HRA", "../shared/data/hra_mitral"))
"""Folder with the mitral valve of the HRA reference heart, three PLY files in mm."""


@pytest.fixture(scope="module")
def valve() -> Valve:
    return Template(TemplateParameters()).valve(64, 20)


@pytest.fixture(scope="module")
def options(valve: Valve) -> LeafletsOptions:
    left = valve.papillary_tips[np.argsort(valve.papillary_tips[:, 0])]
    return LeafletsOptions(units="mm", tips=tuple(left.ravel().tolist()))


@pytest.fixture(scope="module")
def whole(valve: Valve, tmp_path_factory: pytest.TempPathFactory) -> Path:
    solid = thicken(valve.surface)
    path = tmp_path_factory.mktemp("solid") / "valve.stl"
    meshio.Mesh(solid.vertices, [("triangle", solid.triangles)]).write(path)
    return path


def test_one_surface_for_all(valve: Valve, whole: Path, options: LeafletsOptions) -> None:
    case = import_leaflets(whole, options)
    surface = valve.surface
    nearest = closest_points(case.surface.vertices, surface.vertices, surface.triangles)
    assert nearest.distance.mean() < 0.04
    thickness = nearest.interpolate(surface.thickness, surface.triangles)
    assert np.abs(case.surface.thickness - thickness).mean() < 0.02
    assert any("shortest on the side of each tip" in line for line in case.derived)
    assert any("1 mm by voxels, smoothing and observer_mm=1" in line for line in case.derived)


def test_a_closed_frame_has_the_leaflets_of_the_open_one(
    whole: Path, options: LeafletsOptions
) -> None:
    both = replace(options, closed=str(whole), pressure_mmHg=100.0, edge_mm=2.5)
    opened, closed = import_leaflets(whole, both).frames
    np.testing.assert_array_equal(closed.region, opened.region)
    np.testing.assert_allclose(closed.vertices, opened.vertices, atol=0.3)
    assert (closed.pressure_mmHg, closed.corresponds) == (100.0, False)


def test_lengths_in_metres(whole: Path, options: LeafletsOptions, tmp_path: Path) -> None:
    surface = read_surface(whole)
    path = tmp_path / "valve.ply"
    mesh = meshio.Mesh(1e-3 * surface.vertices, [("triangle", surface.triangles.astype(np.int32))])
    mesh.write(path)
    assert options.tips is not None
    metres = replace(options, units="m", tips=tuple(1e-3 * x for x in options.tips))
    one, other = import_leaflets(path, metres), import_leaflets(whole, options)
    away = closest_points(one.surface.vertices, other.surface.vertices, other.surface.triangles)
    assert away.distance.max() < 0.01
    with pytest.raises(InputError, match=r"0.0.* mm across, .* is units= right"):
        import_leaflets(path, options)


@pytest.mark.parametrize("together", [False, True])
def test_one_surface_for_each_leaflet(
    valve: Valve, options: LeafletsOptions, tmp_path: Path, together: bool
) -> None:
    surface, parts = valve.surface, {}
    for number, name in enumerate(("a", "p")):
        used, inverse = np.unique(surface.triangles[surface.region == number], return_inverse=True)
        faces = inverse.reshape(-1, 3)
        part = LeafletSurface(
            surface.vertices[used],
            faces,
            np.zeros(len(faces), dtype=np.int64),
            (surface.region_names[number],),
            surface.fibre[used],
            surface.thickness[used],
        )
        solid = thicken(part)
        meshio.Mesh(solid.vertices, [("triangle", solid.triangles)]).write(tmp_path / f"{name}.stl")
        parts[name] = solid.vertices, solid.triangles
    if together:
        path = write_parts(tmp_path / "valve.glb", parts)
        given = replace(options, anterior="a", posterior="p")
    else:
        path, given = tmp_path / "a.stl", replace(options, posterior=str(tmp_path / "p.stl"))
    case = import_leaflets(path, given)
    nearest = closest_points(case.surface.vertices, surface.vertices, surface.triangles)
    assert np.sqrt(np.mean(nearest.distance**2)) < 0.15
    centres = case.surface.vertices[case.surface.triangles].mean(axis=1)
    own = closest_points(centres, surface.vertices, surface.triangles)
    assert (surface.region[own.triangle] == case.surface.region).mean() > 0.97


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"units": None}, "give units=mm, cm or m"),
        ({"tips": None}, r"give tips=\[x,y,z,x,y,z\] in LPS"),
        ({"closed": "closed.stl"}, "give pressure_mmHg="),
        ({"thickness_mm": (9.0, 9.0)}, "thickness of 9.0 mm, expected at most 5 mm"),
    ],
)
def test_what_is_missing_is_asked_for_by_name(
    whole: Path, options: LeafletsOptions, change: dict[str, object], words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        import_leaflets(whole, replace(options, **change))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert str(whole) in str(caught.value)


@pytest.mark.skipif(not HRA.is_dir(), reason="no HRA valve; MVEST_HRA names its folder")
def test_a_real_anatomy() -> None:
    valve = read_surface(HRA / "mitral_valve.ply")
    tips = []
    for name in ("anterolateral", "posteromedial"):
        muscle = read_surface(HRA / f"papillary_muscle_{name}.ply").vertices
        away = closest_points(muscle, valve.vertices, valve.triangles).distance
        tips.append(muscle[away.argmin()])
    middle = midsurface(valve.vertices, valve.triangles, tips=np.array(tips))
    check_surface(middle.vertices, middle.triangles)
    # The README of the data: a median thickness of about 1.8 mm.
    assert 1.4 < np.median(middle.thickness) < 2.0
    # Every vertex lies within the tissue, as far from the one wall as from the other.
    away = closest_points(middle.vertices, valve.vertices, valve.triangles).distance
    assert np.abs(2 * away - middle.thickness)[len(middle.annulus) * 3 :].mean() < 0.3
