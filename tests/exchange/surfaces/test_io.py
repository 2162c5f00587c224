"""Surfaces that are written, and read again."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.surfaces import (
    Surface,
    read_mesh,
    read_surface,
    write_surface,
    write_surface_series,
)
from tests.valve.conftest import shapes

__all__ = ["shapes"]


def test_a_surface_comes_back_exactly(shapes, tmp_path):
    vertices, triangles = shapes.sphere(2.0, 4)  # several compressed blocks
    rng = np.random.default_rng(0)
    points = {
        "vector": rng.normal(size=(len(vertices), 3)),
        "single": rng.normal(size=len(vertices)).astype(np.float32),
        "unknown": np.r_[np.nan, np.inf, np.zeros(len(vertices) - 2)],
    }
    cells = {"label": rng.integers(-5, 5, len(triangles)), "flag": rng.random(len(triangles)) > 0.5}
    back = read_surface(write_surface(tmp_path / "s.vtp", vertices, triangles, points, cells))
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.triangles, triangles)
    assert [p.name for p in tmp_path.iterdir()] == ["s.vtp"]
    for name, values in points.items():
        np.testing.assert_array_equal(back.point_data[name], values)
        assert back.point_data[name].dtype == values.dtype
    for name, values in cells.items():
        np.testing.assert_array_equal(back.cell_data[name], values)


def test_a_series_is_an_index_of_files_that_name_their_axes(shapes, tmp_path):
    vertices, triangles = shapes.box()
    states = [Surface(vertices + k, triangles, {"x": vertices[:, 0]}) for k in range(3)]
    index = write_surface_series(tmp_path / "valve.pvd", [0.0, 0.5, 1.0], states)
    assert index.read_text().count("DataSet ") == 3
    assert 'timestep="0.5" file="valve_0001.vtp"' in index.read_text()
    mesh = read_mesh(tmp_path / "valve_0001.vtp")
    assert mesh.space == "LPS"
    np.testing.assert_array_equal(mesh.vertices, vertices + 1)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("a.off", {}, "extension"),
        ("no/where/a.vtp", {}, "cannot write"),
        ("a.vtp", {"vertices": np.full((8, 3), np.nan)}, "not finite"),
    ],
)
def test_bad_output_is_one_clear_error_and_leaves_nothing(shapes, tmp_path, name, change, message):
    vertices, triangles = shapes.box()
    box = {"vertices": vertices, "triangles": triangles}
    with pytest.raises(InputError, match=message):
        write_surface(tmp_path / name, **box | change)
    assert list(tmp_path.iterdir()) == []
