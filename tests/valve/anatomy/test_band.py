"""Material coordinates of a triangulated valve: where they must agree with geometry."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.band import Band
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import LeafletSurface, Motion, Valve
from mvest.valve.mesh.solid_mesh import jacobian_determinants
from mvest.valve.mesh.structured import structured_mesh

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
    # At the commissure anterior fibres stand upright, posterior ones lie along the annulus.
    s = np.array([0.4])
    fibres = [band.fibre(np.array([0.0]), s, np.array([number]))[0] for number in (0, 1)]
    along = [band.position(np.array([p]), s)[0] for p in (2.0, 358.0)]
    tangent = (along[0] - along[1]) / np.linalg.norm(along[0] - along[1])
    assert abs(fibres[0] @ tangent) < 0.5
    assert abs(fibres[1] @ tangent) > 0.8
    np.testing.assert_allclose(np.linalg.norm(fibres, axis=1), 1)


def test_a_valve_of_three_leaflets_is_refused(valve):
    surface = valve.surface
    region = surface.region.copy()
    region[: len(region) // 5] = 2
    three = replace(surface, region=region, region_names=("a", "b", "c"))
    with pytest.raises(InputError, match="of 3 leaflets"):
        Band(replace(valve, surface=three))


def test_leaflets_that_do_not_meet_from_edge_to_edge_are_refused(valve):
    surface = valve.surface
    island = np.zeros_like(surface.region)
    island[len(island) // 4] = 1
    with pytest.raises(GeometryError, match="two lines"):
        Band(replace(valve, surface=replace(surface, region=island)))
