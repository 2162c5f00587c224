"""The solid-shell for thin bodies: what its strains keep, what they lose, what depends on them."""

import numpy as np
import pytest

from mvest.elements import ELEMENTS
from mvest.mechanics import (
    BiotLaw,
    Loads,
    Parameter,
    System,
    TransverselyIsotropic,
    box,
    outer_faces,
    simulate_body,
)
from mvest.mechanics.solid import Solid
from tests.mechanics.bodies import MATERIALS, block

THIN = ELEMENTS["hex18_thin"]


def test_strains_are_projected_on_what_is_linear_along_their_own_axes():
    xi = THIN.points
    combination = THIN.sampling(xi, THIN.weights)
    kept = [xi[:, 0] ** 0, xi[:, 0], xi[:, 2], xi[:, 0] * xi[:, 2]]
    for component, axes in ((0, (0,)), (1, (1,)), (5, (0, 1)), (4, (0,)), (3, (1,)), (2, ())):
        matrix = combination[component]
        np.testing.assert_allclose(matrix @ matrix, matrix, atol=1e-14)
        for values in kept:
            np.testing.assert_allclose(matrix @ values, values, atol=1e-14)
        for axis in (0, 1):
            # x^2 = 1/3 + 2/3 P2(x), of which the first is left; anything times it likewise.
            square, other = xi[:, axis] ** 2, 1 + xi[:, 1 - axis]
            left = np.full(len(xi), 1 / 3) if axis in axes else square
            np.testing.assert_allclose(matrix @ (square * other), left * other, atol=1e-14)


@pytest.mark.parametrize("cells", [(1, 1, 1), (2, 2, 1)])
def test_only_rigid_motions_are_without_stiffness(cells):
    mesh = block("hex18_thin", cells, fibre=(0.8, 0.6, 0), distortion=(0.2, 0.2, 0.1))
    system = System(Solid(mesh, BiotLaw.of((MATERIALS["A"],))))
    blocks = system.evaluate(
        mesh.nodes, Loads(), None, system.solid.initial_strain(), 0.0, tangent=True
    ).blocks
    values = np.linalg.eigvalsh(system.pattern.matrix(blocks).tobsr().toarray())
    assert np.abs(values[:6]).max() < 1e-12 * values[-1]
    assert values[6] > 1e-4 * values[-1]


@pytest.mark.parametrize("static", [True, False])
def test_derivatives_are_those_of_differences(static):
    nodes, elements = box("hex18_thin", (3, 3, 1), (9.0, 9.0, 0.3))
    faces = outer_faces(elements, "hex18_thin")
    under = faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)]
    nodes[:, 2] += 0.3 * np.sin(nodes[:, 0] / 3)  # curved from the beginning
    given = {
        "fixed_nodes": np.flatnonzero(np.any((nodes[:, :2] == 0) | (nodes[:, :2] == 9), axis=1)),
        "pressure_faces": under,
        "pressure": 0.01,
        "times": [0.05, 0.1],
        "static": static,
    }

    def run(young, parameters=()):
        material = TransverselyIsotropic.isotropic(young, 0.45)
        return simulate_body(
            nodes, elements, "hex18_thin", material=material, parameters=parameters, **given
        )

    exact = run(2.0, [Parameter("E_f.0", 2.0)]).sensitivities[-1, 0]
    difference = (run(2.001).frames[-1] - run(1.999).frames[-1]) / 0.002
    assert np.abs(exact).max() > 0.05
    np.testing.assert_allclose(exact, difference, atol=2e-6)
