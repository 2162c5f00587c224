"""Surfaces that are written, and read again."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.surfaces import Surface, read_surface, write_surface
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
    written = Surface(vertices, triangles, points, cells, space="LPS")
    back = read_surface(write_surface(tmp_path / "s.vtp", written))
    assert back.space == "LPS"
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.triangles, triangles)
    assert [p.name for p in tmp_path.iterdir()] == ["s.vtp"]
    for name, values in points.items():
        np.testing.assert_array_equal(back.point_data[name], values)
        assert back.point_data[name].dtype == values.dtype
    for name, values in cells.items():
        np.testing.assert_array_equal(back.cell_data[name], values)


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
        write_surface(tmp_path / name, Surface(**box | change))
    assert list(tmp_path.iterdir()) == []
