"""Material coordinates of a triangulated valve: where they must agree with geometry."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from mvest.errors import GeometryError
from mvest.valve.anatomy.band import Band
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import LeafletSurface, Motion, Valve
from mvest.valve.geometry.triangles import areas, edges_between
from mvest.valve.mesh.solid_mesh import jacobian_determinants
from mvest.valve.mesh.structured import structured_mesh
from tests.three_leaflets import ThreeLeaflets

TEMPLATE = Template()


@pytest.fixture(scope="module")
def valve():
    return TEMPLATE.valve(80, 21)


@pytest.fixture(scope="module")
def band(valve):
    return Band(valve)


def mirrored(valve: Valve) -> Valve:
    """The valve reflected in x, triangles turned round so that normals still face the ventricle."""
    flip = np.array([-1.0, 1.0, 1.0])
    surface = valve.surface
    return replace(
        valve,
        surface=LeafletSurface(
            surface.vertices * flip,
            surface.triangles[:, ::-1],
            surface.region,
            surface.region_names,
            surface.fibre * flip,
            surface.thickness,
        ),
        papillary_tips=valve.papillary_tips * flip,
        chordae=replace(valve.chordae, insertion=valve.chordae.insertion * flip),
        motion=Motion(
            valve.motion.phase, valve.motion.annulus * flip, valve.motion.papillary_tips * flip
        ),
    )


@pytest.mark.parametrize("make", [lambda v: v, mirrored])
def test_vertices_are_found_where_their_coordinates_say(valve, make):
    valve = make(valve)
    band = Band(valve)
    phi, s = band.coordinates()
    np.testing.assert_allclose(band.position(phi, s), valve.surface.vertices, atol=1e-6)
    np.testing.assert_allclose(s[valve.annulus], 0, atol=1e-12)
    np.testing.assert_allclose(s[valve.free_edge], 1, atol=1e-12)


@pytest.mark.parametrize("make", [lambda v: v, mirrored])
def test_the_first_leaflet_has_the_first_half_of_the_angle(valve, make):
    valve = make(valve)
    phi, _ = Band(valve).coordinates()
    surface = valve.surface
    for number in (0, 1):
        inner = np.setdiff1d(
            surface.triangles[surface.region == number],
            surface.triangles[surface.region != number],
        )
        assert np.all((phi[inner] > 180 * number) & (phi[inner] < 180 * (number + 1)))
    both = np.intersect1d(
        surface.triangles[surface.region == 0], surface.triangles[surface.region == 1]
    )
    assert np.abs((phi[both] + 90) % 180 - 90).max() < 1e-6


@pytest.mark.parametrize("make", [lambda v: v, mirrored])
@pytest.mark.parametrize("element", ["hex18", "tet10"])
def test_a_mesh_laid_out_on_it_is_the_body_of_the_template(valve, make, element):
    mesh = structured_mesh(Band(make(valve)), element, 24, 4)
    like = structured_mesh(TEMPLATE, element, 24, 4)
    points, weights = mesh.reference.points, mesh.reference.weights
    volumes = []
    for one in (mesh, like):
        det = jacobian_determinants(one.nodes, one.elements, one.reference, points)
        assert det.min() > 0
        volumes.append(float((det @ weights).sum()))
        assert set(one.region_names) == {"anterior", "posterior"}
    assert volumes[0] == pytest.approx(volumes[1], rel=0.01)


def test_fibres_are_those_of_the_leaflet_they_are_asked_of(valve, band):
    # At the commissure anterior fibres stand upright, posterior ones lie along the annulus, each
    # seen from its own side: the leaflets make an angle there.
    s = np.array([0.4])
    fibres = [band.fibre(np.array([0.0]), s, np.array([number]))[0] for number in (0, 1)]
    here = band.position(np.zeros(1), s)[0]
    tangents = [band.position(np.array([p]), s)[0] - here for p in (2.0, 358.0)]
    along = [abs(f @ t) / np.linalg.norm(t) for f, t in zip(fibres, tangents, strict=True)]
    assert along[0] < 0.5
    assert along[1] > 0.8
    np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1)


@pytest.fixture(scope="module")
def three():
    return ThreeLeaflets().valve()


def between_thirds(phi):
    """Distances in degrees from the nearest of 0, 120 and 240 degrees."""
    return np.abs((phi + 60.0) % 120.0 - 60.0)


def test_each_of_three_leaflets_has_a_third_of_the_angle(three):
    phi, s = Band(three).coordinates()
    surface = three.surface
    np.testing.assert_allclose(Band(three).position(phi, s), surface.vertices, atol=1e-9)
    # Around the valve they are the anterior, the posterior and the septal one.
    for number, begin in ((0, 0.0), (1, 240.0), (2, 120.0)):
        own = np.setdiff1d(
            surface.triangles[surface.region == number],
            surface.triangles[surface.region != number],
        )
        assert np.all((phi[own] > begin) & (phi[own] < begin + 120.0))
    lines = np.unique(edges_between(surface.triangles, surface.region))
    assert between_thirds(phi[lines]).max() < 1e-9


def relabelled(valve: Valve, region, names=("a", "b", "c")) -> Valve:
    """The valve with other leaflets."""
    return replace(valve, surface=replace(valve.surface, region=region, region_names=names))


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_names_in_any_order_are_those_of_the_same_leaflets(three, order):
    surface = three.surface
    names = tuple(surface.region_names[k] for k in order)
    band = Band(relabelled(three, np.argsort(order)[surface.region], names))
    sampled, mesh = band.valve(60, 25).surface, structured_mesh(band, "hex18", 24, 3)
    assert sampled.region_names == mesh.region_names == names
    for number, name in enumerate(names):
        own, same = (
            areas(one.vertices, one.triangles[one.region == one.region_names.index(name)]).sum()
            for one in (sampled, surface)
        )
        assert own == pytest.approx(same, rel=0.01)
        x, y, _ = mesh.nodes[mesh.elements[mesh.region == number]].mean(axis=(0, 1))
        assert {"anterior": y > abs(x), "septal": x > abs(y), "posterior": -x > abs(y)}[name]


@pytest.mark.parametrize("element", ["hex18", "tet10"])
def test_a_mesh_of_three_leaflets_is_the_body_of_its_shape(three, element):
    mesh, like = (structured_mesh(s, element, 24, 4) for s in (Band(three), ThreeLeaflets()))
    assert np.array_equal(mesh.region, like.region)
    points, weights = mesh.reference.points, mesh.reference.weights
    dets = [jacobian_determinants(m.nodes, m.elements, m.reference, points) for m in (mesh, like)]
    assert min(det.min() for det in dets) > 0
    assert (dets[0] @ weights).sum() == pytest.approx((dets[1] @ weights).sum(), rel=0.01)


def middles(valve: Valve):
    """``phi`` and ``s`` of the triangles' centroids."""
    phi, s = (own[valve.surface.triangles] for own in Band(valve).coordinates())
    turned = np.where((phi < 90.0) & (phi.max(axis=1, keepdims=True) > 270.0), phi + 360.0, phi)
    return turned.mean(axis=1), s.mean(axis=1)


def test_lines_of_any_course_are_found(three):
    # They wind by more than a leaflet's own angle, so that all angles are on some line.
    phi, s = middles(three)
    region = (np.mod(phi - 130.0 * s, 360.0) // 120.0).astype(int)
    wound = relabelled(three, region)
    own, _ = Band(wound).coordinates()
    lines = np.unique(edges_between(three.surface.triangles, region))
    assert between_thirds(own[lines]).max() < 2 * 360.0 / 108  # columns
    assert Band(wound).sections == (0, 1, 2)


def test_one_leaflet_alone_has_the_whole_angle(three):
    band = Band(relabelled(three, 0 * three.surface.region, ("whole",)))
    phi, s = band.coordinates()
    np.testing.assert_allclose(band.position(phi, s), three.surface.vertices, atol=1e-9)
    mesh = structured_mesh(band, "hex18", 25, 3)
    assert mesh.region_names == ("whole",)
    inner = np.flatnonzero(np.abs(phi - 180.0) < 175.0)
    fibre = band.fibre(phi[inner], s[inner], np.zeros(len(inner), dtype=int))
    np.testing.assert_allclose(np.abs((fibre * three.surface.fibre[inner]).sum(axis=1)), 1.0)


def test_leaflets_that_do_not_meet_from_edge_to_edge_are_refused(three):
    region = np.minimum(three.surface.region, 1)
    region[len(region) // 4] = 2
    with pytest.raises(GeometryError, match=r"2 lines between leaflets .* expected 3"):
        Band(relabelled(three, region))


def test_a_leaflet_in_two_pieces_is_refused(three):
    region = np.array([0, 1, 2, 1])[(middles(three)[0] // 90.0).astype(int) % 4]
    with pytest.raises(GeometryError, match="are a, b, c, b; expected each once"):
        Band(relabelled(three, region, ("a", "b", "c", "d")))
