"""Modulus that varies over a leaflet: the modes of the field, and the law that they scale."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.law import Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.regional import FieldBasis, LeafletLaw, ModulusVariation, at_quadrature
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import MechanicsSettings, ModulusField, StiffPatch, TissueSettings
from mvest.mechanics.solid import Solid
from mvest.mechanics.valve_system import material_law, variation_of
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh
from tests.mechanics.bodies import MATERIALS, block

SETTINGS = ModulusField(correlation_length_mm=8.0, std_log=0.4, modes=6)
TEMPLATE = Template()
SURFACE = TEMPLATE.valve(32, 8).surface


@pytest.fixture(scope="module")
def basis():
    return FieldBasis.of(SURFACE, "anterior", SETTINGS)


def leaflet(surface, region):
    own = surface.triangles[surface.region == surface.region_names.index(region)]
    return np.unique(own)


def test_all_modes_together_have_the_covariance_that_was_asked_for():
    # With as many modes as vertices the expansion is exact: sum_k phi_k(X) phi_k(Y) is the
    # covariance sigma^2 exp(-d^2 / 2 l^2) at any two vertices. A short length keeps the matrix far
    # from singular.
    surface = TEMPLATE.valve(16, 5).surface
    vertices = leaflet(surface, "posterior")
    settings = ModulusField(3.0, 0.3, len(vertices))
    points = surface.vertices[vertices]
    modes = FieldBasis.of(surface, "posterior", settings)(points)
    d2 = np.sum((points[:, None] - points) ** 2, axis=-1)
    np.testing.assert_allclose(
        modes @ modes.T, 0.3**2 * np.exp(-d2 / (2 * 3.0**2)), rtol=0, atol=1e-9
    )


def test_the_modulus_is_the_same_in_every_mesh(basis):
    # The modes at the quadrature points, and weighed with the volume there: their moments over the
    # leaflet are those of the leaflet, and the meshes approach it.
    moments = []
    for kind in (("hex18", 24, 3), ("hex18", 48, 6), ("tet10", 24, 3)):
        mesh = structured_mesh(TEMPLATE, *kind)
        modes = at_quadrature(mesh, "anterior", basis)
        assert np.all(modes[mesh.region != mesh.region_names.index("anterior")] == 0)
        shape = mesh.reference.shape(mesh.reference.points)
        points = np.einsum("qa,eai->eqi", shape, mesh.nodes[mesh.elements])
        volumes = Solid(mesh, BiotLaw.of([MATERIALS["A"]] * 2)).volumes
        weight = np.concatenate([np.ones((*volumes.shape, 1)), points / 10], axis=2)
        moments.append(np.einsum("eq,eqk,eqw->kw", volumes, modes, weight))
    size = np.abs(moments[0]).max()
    assert size > 10
    np.testing.assert_allclose(moments[1], moments[0], rtol=0, atol=2e-3 * size)
    np.testing.assert_allclose(moments[2], moments[0], rtol=0, atol=2e-3 * size)


def varied(base, mesh, modes, coefficients):
    variation = ModulusVariation(modes)
    values = {f"field.tissue.{k}": a for k, a in enumerate(coefficients)}
    return LeafletLaw(
        (base,), mesh.region, np.eye(6)[None, None], variation.scale(values), variation
    )


def test_derivatives_of_the_scaled_stress_agree_with_differences():
    mesh = block("hex18", cells=(2, 1, 1))
    rng = np.random.default_rng(5)
    n_e, n_q = len(mesh.elements), len(mesh.reference.points)
    green, previous = 0.05 * rng.standard_normal((2, n_e, n_q, 6))
    modes, at = {"tissue": rng.standard_normal((n_e, n_q, 2))}, np.array([0.3, -0.2])
    base = BiotLaw.of([MATERIALS["A"]])

    def law(coefficients):
        return varied(base, mesh, modes, coefficients)

    def stress(coefficients):
        return law(coefficients).response(Points(green, mesh.region, previous, 1.5))[0]

    def partial(name, value):
        return law(at).partial_stress(
            Parameter(name, value),
            Points(green, mesh.region, previous, 1.5),
            which=0,
            stress=stress(at),
        )

    for k in range(2):
        h = 1e-5 * np.eye(2)[k]
        # The scale is an exponential: the differences' error is h^2 / 6, far below 1e-8.
        np.testing.assert_allclose(
            partial(f"field.tissue.{k}", at[k]),
            (stress(at + h) - stress(at - h)) / 2e-5,
            rtol=0,
            atol=1e-8,
        )
    # S is linear in E_f, whatever the field.
    np.testing.assert_allclose(partial("E_f.tissue", 6.23), stress(at) / 6.23, rtol=1e-12)
    with pytest.raises(InputError, match=r"known: field.tissue.0 to 1"):
        partial("field.tissue.2", 0.0)


def test_a_field_of_no_leaflet_or_of_too_many_modes_is_refused():
    with pytest.raises(InputError, match="field of 'septal': no such leaflet"):
        FieldBasis.of(SURFACE, "septal", SETTINGS)
    with pytest.raises(InputError, match="10000 modes, expected at most"):
        FieldBasis.of(SURFACE, "anterior", ModulusField(8.0, 0.4, 10000))


def test_a_patch_is_smooth_of_bounded_extent_and_as_stiff_as_it_says():
    patch = StiffPatch("anterior", (1.0, 2.0, 3.0), 4.0, 2.0)
    points = np.array([[1.0, 2.0, 3.0], [1.0, 4.0, 3.0], [5.0, 2.0, 3.0], [1.0, 2.0, 9.0]])
    # At half the radius (1 - 1/4)^2 = 9/16 of the logarithm.
    np.testing.assert_allclose(np.exp(patch.log_scale(points)), [2, 2 ** (9 / 16), 1, 1])
    with pytest.raises(InputError, match="patch factor = 0"):
        StiffPatch("anterior", (1.0, 2.0, 3.0), 4.0, 0.0)
    with pytest.raises(InputError, match="centre of a patch"):
        StiffPatch("anterior", (1.0, 2.0), 4.0, 2.0)


def test_a_patch_of_the_settings_scales_the_law_of_its_leaflet_alone():
    mesh, valve = structured_mesh(TEMPLATE, "hex18", 24, 3), TEMPLATE.valve(32, 8)
    tissue = {"anterior": TissueSettings(2.6), "posterior": TissueSettings(1.1)}
    values = {"E_f.anterior": 6.0, "E_f.posterior": 2.0}
    at = tuple(float(x) for x in TEMPLATE.position(np.array([90.0]), np.array([0.5]))[0])
    patch = {"scar": StiffPatch("anterior", at, 7.0, 2.0)}
    settings = MechanicsSettings(tissue, patches=patch)
    law = material_law(mesh, settings, values, variation_of(valve, mesh, settings))
    anterior = mesh.region == mesh.region_names.index("anterior")
    assert 1.7 < law.scale[anterior].max() < 2.0
    assert np.all(law.scale[~anterior] == 1)
    lost = MechanicsSettings(tissue, patches={"scar": replace(patch["scar"], region="septal")})
    with pytest.raises(InputError, match="no such leaflet"):
        variation_of(valve, mesh, lost)
