"""The template, thickened, as a closed surface for each leaflet, and what no surface says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import LeafletSurface, Valve
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.thickening import thicken
from tests.exchange.surfaces.glb import write_parts


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


def test_a_closed_frame_has_the_leaflets_of_the_open_one(
    whole: Path, options: LeafletsOptions
) -> None:
    both = replace(options, closed=str(whole), pressure_mmHg=100.0, edge_mm=2.5)
    opened, closed = import_leaflets(whole, both).frames
    np.testing.assert_array_equal(closed.region, opened.region)
    np.testing.assert_allclose(closed.vertices, opened.vertices, atol=0.3)
    assert (closed.pressure_mmHg, closed.corresponds) == (100.0, False)


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
        ({"units": "um"}, "give units=mm, cm or m"),
        ({"units": "m"}, r"mm across, .* is units= right"),
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
