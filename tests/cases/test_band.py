"""Triangles with all corners on one edge of a band, as decimation leaves them."""

import numpy as np
import pytest

from mvest.cases.band import commissures, directed, find_loops, match_annulus, without_ears
from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.surface_coordinates import boundary_loops
from tests.cases.folders import TIPS


def parts(valve):
    surface = valve.surface
    return surface.vertices, surface.triangles, surface.region


def renumbered(vertices, triangles, region, seed=0):
    """The same surface with vertices and triangles in another order."""
    rng = np.random.default_rng(seed)
    order, rows = rng.permutation(len(vertices)), rng.permutation(len(triangles))
    place = np.argsort(order)
    turn = rng.integers(0, 3, len(triangles))
    columns = (np.arange(3) + turn[:, None]) % 3
    moved = np.take_along_axis(place[triangles], columns, axis=1)
    return vertices[order], moved[rows], region[rows]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_loops_are_named_whatever_the_numbering(seed):
    valve = Template().valve(24, 8)
    x, t, _ = renumbered(*parts(valve), seed)
    loops_ = find_loops(x, t, np.array(TIPS))
    for name in ("annulus", "free_edge"):
        ours, theirs = x[getattr(loops_, name)], valve.surface.vertices[getattr(valve, name)]
        assert set(map(tuple, ours)) == set(map(tuple, theirs))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_annulus_of_another_mesh_is_matched_from_commissure_to_commissure(reverse, seed):
    ours, other = Template().valve(40, 8), Template().valve(72, 9)
    annulus = np.roll(ours.annulus[::-1] if reverse else ours.annulus, 7)
    x, t, r = renumbered(*parts(other), seed)
    shift = np.array([1.0, -2.0, 3.0])
    seen = find_loops(x, t, np.array(TIPS)).annulus
    found = match_annulus(parts(ours), annulus, (x + shift, t, r), np.roll(seen, 5)) - shift
    # Both polygons are inscribed in one curve of circumference C = 101 mm, whose radius of
    # curvature R is 11 mm at least: chords of h = C / 40 leave it by h^2 / 8 R < 0.08 mm. An
    # annulus turned by one vertex would be off by h = 2.5 mm, a mirrored one by centimetres.
    exact = ours.surface.vertices[annulus]
    gap = np.linalg.norm(found - exact, axis=1)
    assert gap.max() < 0.08
    commissure = np.isin(annulus, (0, 20))
    np.testing.assert_allclose(found[commissure], exact[commissure], atol=1e-12)


def test_leaflets_in_another_order_are_no_match():
    ours, other = Template().valve(24, 8), Template().valve(24, 8)
    x, t, _ = parts(other)
    # Three regions, one after the other in opposite senses.
    loop = directed(ours.annulus, t)
    three = region_by_column(x, t, 3)
    swapped = np.array([0, 2, 1])[three]
    assert len(commissures(loop, t, three)) == 3
    with pytest.raises(InputError, match="regions follow each other as"):
        match_annulus((x, t, three), ours.annulus, (x, t, swapped), ours.annulus)


def region_by_column(x, t, count):
    """Regions of equal width by the angle of the triangle's centre."""
    centre = x[t].mean(axis=1)
    angle = np.mod(np.arctan2(centre[:, 1], centre[:, 0]), 2 * np.pi)
    return (angle * count / (2 * np.pi)).astype(np.int64)


def test_a_region_in_two_parts_has_no_commissures_of_its_own():
    valve = Template().valve(24, 8)
    x, t, _ = parts(valve)
    four = region_by_column(x, t, 4) % 2
    with pytest.raises(GeometryError, match="each once, in one piece"):
        commissures(directed(valve.annulus, t), t, four)
    with pytest.raises(GeometryError, match="one region only"):
        commissures(directed(valve.annulus, t), t, 0 * four)


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
    same, cured = without_ears(good)
    assert np.array_equal(same, good)
    assert not len(cured)
