"""Harmonic coordinates, coarsening and thickening of cylinders, which are known by hand."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.elements import FACES
from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates
from mvest.valve.geometry.triangles import areas
from mvest.valve.mesh.remesh import layered_wedges, remesh
from mvest.valve.mesh.solid_mesh import jacobian_determinants

RADIUS, HEIGHT = 10.0, 12.0


@pytest.fixture(scope="module")
def cylinder(shapes):
    """Vertices, triangles, annulus (bottom) and free edge (top); normals outwards."""
    n, layers = 120, 24
    rings = [shapes.circle(RADIUS, n, z) for z in np.linspace(0, HEIGHT, layers + 1)]
    vertices, triangles = shapes.bands(rings)
    return vertices, triangles, np.arange(n), np.arange(n) + layers * n


@pytest.fixture(scope="module")
def leaflets(cylinder):
    """The cylinder as three leaflets of 60, 120 and 180 degrees with circumferential fibres."""
    vertices, triangles, _, _ = cylinder
    middle = vertices[triangles].mean(axis=1)
    angle = np.degrees(np.arctan2(middle[:, 1], middle[:, 0])) % 360
    tangent = np.column_stack([-vertices[:, 1], vertices[:, 0], np.zeros(len(vertices))])
    return LeafletSurface(
        vertices=vertices,
        triangles=triangles,
        region=np.searchsorted([60.0, 180.0], angle),
        region_names=("a", "b", "c"),
        fibre=tangent,
        thickness=np.full(len(vertices), 1.2),
    )


def test_coordinates_of_a_cylinder(cylinder):
    vertices, *rest = cylinder
    found = surface_coordinates(vertices, *rest)
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    turn = np.exp(1j * (found.theta - angle))
    assert found.s == pytest.approx(vertices[:, 2] / HEIGHT, abs=1e-10)
    assert np.abs(turn - turn[0]).max() < 1e-10
    # The strip of a cylinder is its development: height over radius. A 120-sided prism has the
    # perimeter 2 n R sin(pi / n), 1.1e-4 less than the circle.
    assert found.modulus == pytest.approx(HEIGHT / RADIUS, rel=2e-4)
    tangent = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    along = np.abs(np.einsum("ij,ij->i", found.circumferential, tangent))
    # Averaging over unevenly cut facets of 3 degrees leaves a third of half a facet.
    assert along.min() > np.cos(np.radians(0.51))


def test_the_angle_of_a_band_across_its_own_axis(cylinder):
    # Sheared by 2.5 radii, as a leaflet that has closed: the axis of the annulus pierces its wall.
    vertices, triangles, annulus, free_edge = cylinder
    sheared = vertices + np.outer(vertices[:, 2] / HEIGHT, [2.5 * RADIUS, 0.0, 0.0])
    found = surface_coordinates(sheared, triangles, annulus, free_edge)
    for rim in (annulus, free_edge):
        step = np.angle(np.exp(1j * np.diff(found.theta[np.append(rim, rim[0])])))
        assert (step > 0).all()
        assert step.sum() == pytest.approx(2 * np.pi)


def test_an_overhang_does_not_fold_the_coordinates(cylinder):
    # One vertex in the middle lies two rows too far along the leaflet, half a mm above the wall:
    # the weights of its slivers are so negative that the harmonic map folds one of them over.
    vertices, triangles, annulus, free_edge = cylinder
    n, rows = len(annulus), 24
    one = 12 * n + 5
    moved = np.array(vertices)
    moved[one] *= [1.05, 1.05, 1.0]
    moved[one, 2] += 2.0 * HEIGHT / rows
    found = surface_coordinates(moved, triangles, annulus, free_edge)
    assert not len(found.folded())
    # Everywhere else they are where they were, to half a cell.
    rest = np.arange(len(vertices)) != one
    assert found.s[rest] == pytest.approx(vertices[rest, 2] / HEIGHT, abs=0.5 / rows)
    turn = np.exp(1j * (found.theta - np.arctan2(vertices[:, 1], vertices[:, 0])))
    assert np.abs(np.angle(turn / turn[0]))[rest].max() < 0.5 * 2 * np.pi / n


def test_locate_inverts_the_coordinates(cylinder):
    vertices, triangles, *loops = cylinder
    found = surface_coordinates(vertices, triangles, *loops)
    rng = np.random.default_rng(4)
    hosts = rng.integers(len(triangles), size=200)
    weights = rng.dirichlet(np.ones(3), size=200)
    strip = np.einsum("ij,ijk->ik", weights, found.strip_triangles()[hosts])
    triangle, w = found.locate(np.mod(strip[:, 0], 2 * np.pi), strip[:, 1] / found.modulus)
    back = np.einsum("ij,ijk->ik", w, vertices[triangles[triangle]])
    assert back == pytest.approx(np.einsum("ij,ijk->ik", weights, vertices[triangles[hosts]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: np.vstack([t, [[*t[1500, :2], 0]]]), "not a manifold: edge .* belongs to 3"),
        (lambda t: np.vstack([t[:5], t[5:6, ::-1], t[6:]]), "orient all triangles alike"),
        (lambda t: np.vstack([t[:1500], t[1501:]]), "must be the two boundary loops"),
    ],
)
def test_bad_bands_are_named(cylinder, change, message):
    vertices, triangles, *loops = cylinder
    with pytest.raises(GeometryError, match=message):
        surface_coordinates(vertices, change(triangles), *loops)


def test_a_triangle_on_one_edge_only_is_named(cylinder):
    vertices, triangles, annulus, free_edge = cylinder
    low, up = free_edge[:3] - len(annulus), free_edge[:3]
    around = np.isin(triangles, up[1]).any(axis=1)
    recut = [
        [low[0], low[1], up[0]],
        [low[1], up[2], up[0]],
        [up[0], up[2], up[1]],
        [low[1], low[2], up[2]],
    ]
    kept = triangles[~around & ~np.all(np.isin(triangles, [*low, *up]), axis=1)]
    with pytest.raises(GeometryError, match="has all three corners on one edge loop"):
        surface_coordinates(vertices, np.vstack([kept, recut]), annulus, free_edge)


@pytest.mark.parametrize("wanted", [60, 300])
def test_remesh(cylinder, leaflets, wanted):
    coarse = remesh(leaflets, *cylinder[2:], wanted)
    surface = coarse.surface
    np.testing.assert_array_equal(surface.vertices, leaflets.vertices[coarse.kept])
    n, edge = len(surface.vertices), len(coarse.annulus) + len(coarse.free_edge)
    assert n == wanted
    # Euler: a band has V - E + F = 0 and 3 F = 2 E - (edges of its two loops).
    assert len(surface.triangles) == 2 * n - edge
    loops = {frozenset(loop.tolist()) for loop in boundary_loops(surface.triangles)}
    assert loops == {frozenset(coarse.annulus.tolist()), frozenset(coarse.free_edge.tolist())}
    assert np.all(surface.vertices[coarse.annulus, 2] == 0)
    assert np.all(surface.vertices[coarse.free_edge, 2] == HEIGHT)
    corner = surface.vertices[surface.triangles]
    squared = ((corner - np.roll(corner, 1, axis=1)) ** 2).sum(axis=(1, 2))
    area = areas(surface.vertices, surface.triangles)
    # 1 for an equilateral triangle.
    quality = 4 * np.sqrt(3) * area / squared
    assert quality.min() > 0.4
    assert quality.mean() > 0.8
    outward = surface.normals[:, :2] * surface.vertices[:, :2]
    assert np.all(outward.sum(axis=1) > 0)
    # Areas of the leaflets are as 1 : 2 : 3.
    share = np.bincount(surface.region, area) / area.sum()
    assert share == pytest.approx(np.array([1, 2, 3]) / 6, abs=0.005)


@pytest.mark.parametrize(
    ("element_type", "layers", "levels"), [("wedge12", 1, 2), ("wedge18", 2, 5)]
)
def test_thickened_cylinder(cylinder, leaflets, element_type, layers, levels):
    coarse = remesh(leaflets, *cylinder[2:], 400)
    solid = layered_wedges(coarse.surface, leaflets, element_type, layers)
    assert len(solid.elements) == layers * len(coarse.surface.triangles)
    # A hollow cylinder whose midsurface has radius R holds exactly 2 pi R h t.
    reference = solid.reference
    j = jacobian_determinants(solid.nodes, solid.elements, reference, reference.points)
    volume = float((j @ reference.weights).sum())
    assert volume == pytest.approx(2 * np.pi * RADIUS * HEIGHT * 1.2, rel=2e-3)
    # Pressure faces are the outer ones, normals outwards.
    face = FACES["tri6"]
    corner = solid.nodes[solid.pressure_faces]
    tangent = np.einsum("fai,qaj->fqij", corner, face.gradient)
    normal = np.cross(tangent[..., 0], tangent[..., 1])
    place = np.einsum("fai,qa->fqi", corner, face.shape)
    assert np.all(np.einsum("fqi,fqi->fq", normal[..., :2], place[..., :2]) > 0)
    radius = np.linalg.norm(solid.nodes[:, :2], axis=1)
    column = radius.reshape(levels, -1)
    assert column[0] == pytest.approx(RADIUS - 0.6, abs=0.02)
    assert column[-1] == pytest.approx(RADIUS + 0.6, abs=0.02)
    # Fibres run round, whatever the level.
    round_ = np.column_stack([-solid.nodes[:, 1], solid.nodes[:, 0], 0 * radius]) / radius[:, None]
    along = np.einsum("maj,maj->ma", solid.fibre, round_[solid.elements])
    assert np.abs(along).min() > 0.999


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda s, loops: remesh(s, *loops, 10), InputError, "expected 24 to 3000"),
        (
            lambda s, loops: layered_wedges(s, s, "hex18"),
            InputError,
            "expected 1 or more of wedge12",
        ),
        (
            lambda s, loops: layered_wedges(s, replace(s, thickness=40 * s.thickness)),
            GeometryError,
            "inverted elements",
        ),
    ],
)
def test_what_cannot_be_coarsened_or_thickened_is_refused(cylinder, leaflets, make, error, message):
    with pytest.raises(error, match=message):
        make(leaflets, cylinder[2:])
