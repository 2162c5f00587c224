"""Triangles with all corners on one edge of a band, as decimation leaves them."""

import numpy as np

from mvest.cases.ears import without_ears
from mvest.cases.folder import read_case
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.surface_coordinates import boundary_loops
from tests.cases.folders import closing, plain_folder, save, save_surface


def with_an_ear(triangles, rim):
    """Turn the edges about the vertex rim[1] so that it is left in a single triangle, with rim[0]
    and rim[2]; returns the triangles and the number of that one."""
    triangles = triangles.tolist()
    while len(at := [t for t, corners in enumerate(triangles) if rim[1] in corners]) > 1:
        first = next(t for t in at if rim[0] in triangles[t])
        (inner,) = set(triangles[first]) - {rim[0], rim[1]}
        second = next(t for t in at if t != first and inner in triangles[t])
        (far,) = set(triangles[second]) - {inner, rim[1]}
        swap = {rim[1]: far}
        triangles[first] = [swap.get(v, v) for v in triangles[first]]
        swap = {inner: rim[0]}
        triangles[second] = [swap.get(v, v) for v in triangles[second]]
    return np.array(triangles), at[0]


def loops(triangles):
    return {frozenset(loop.tolist()) for loop in boundary_loops(triangles)}


def test_an_ear_gets_a_corner_elsewhere_and_the_edges_stay():
    valve = Template().valve(24, 8)
    bad, ear = with_an_ear(valve.surface.triangles, valve.annulus[4:7])
    assert np.isin(bad[ear], valve.annulus).all()
    good, cured = without_ears(bad)
    assert cured.tolist() == [ear]
    for rim in (valve.annulus, valve.free_edge):
        assert not np.isin(good, rim).all(axis=1).any()
    # boundary_loops refuses what is no manifold, or not oriented alike.
    assert loops(good) == loops(bad)
    assert len(good) == len(bad)


def test_a_surface_without_ears_is_left_alone():
    triangles = Template().valve(24, 8).surface.triangles
    same, cured = without_ears(triangles)
    assert np.array_equal(same, triangles)
    assert not len(cured)


def test_a_case_with_an_ear_is_read_and_says_so(tmp_path):
    document = plain_folder(tmp_path / "case")
    valve = Template().valve(24, 8)
    surface = valve.surface
    bad, ear = with_an_ear(surface.triangles, valve.annulus[4:7])
    for name, x in (("open", surface.vertices), ("closed", closing(surface.vertices))):
        save_surface(tmp_path / "case" / f"{name}.vtp", x, bad, surface.region)
    case = read_case(save(tmp_path / "case", document))
    assert any(f"inner edge turned of triangles [{ear}]" in text for text in case.derived)
    assert case.frames[1].corresponds
