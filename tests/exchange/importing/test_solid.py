"""A small valve, thickened, as closed surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.thickening import thicken
from tests.exchange.importing.voxelised import small_valve
from tests.exchange.surfaces.glb import write_parts

TIPS = (-8.0, 0.0, -20.0, 8.0, 0.0, -20.0)
OPTIONS = LeafletsOptions(units="mm", tips=TIPS, edge_mm=0.8)
VALVE = small_valve(closed=False, taller=0.4)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    solid = thicken(VALVE)
    path = tmp_path_factory.mktemp("solid") / "valve.stl"
    meshio.Mesh(solid.vertices, [("triangle", solid.triangles)]).write(path)
    return path


def test_one_surface_for_each_leaflet(tmp_path: Path) -> None:
    parts = {}
    for number, name in enumerate(("a", "p")):
        used, inverse = np.unique(VALVE.triangles[VALVE.region == number], return_inverse=True)
        faces = inverse.reshape(-1, 3)
        part = replace(
            VALVE,
            vertices=VALVE.vertices[used],
            triangles=faces,
            region=np.zeros(len(faces), dtype=np.int64),
            region_names=(VALVE.region_names[number],),
            fibre=VALVE.fibre[used],
            thickness=VALVE.thickness[used],
        )
        solid = thicken(part)
        parts[name] = solid.vertices, solid.triangles
    path = write_parts(tmp_path / "valve.glb", parts)
    found = import_leaflets(path, replace(OPTIONS, anterior="a", posterior="p")).surface
    nearest = closest_points(found.vertices, VALVE.vertices, VALVE.triangles)
    assert np.sqrt(np.mean(nearest.distance**2)) < 0.15
    centres = found.vertices[found.triangles].mean(axis=1)
    own = closest_points(centres, VALVE.vertices, VALVE.triangles)
    assert (VALVE.region[own.triangle] == found.region).mean() > 0.95


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"units": "um"}, "give units=mm, cm or m"),
        ({"units": "m"}, r"mm across, .* is units= right"),
    ],
)
def test_missing_or_wrong_options_are_named(
    whole: Path, change: dict[str, object], words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        import_leaflets(whole, replace(OPTIONS, **change))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert str(whole) in str(caught.value)
