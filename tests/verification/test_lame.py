"""Thick sphere under inner pressure against Lame's solution: orders of convergence."""

import numpy as np
import pytest

from mvest.elements import ELEMENTS
from mvest.mechanics import BiotLaw, Loads, Step, System, box, outer_faces, simulate
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.solid import Solid
from mvest.valve.mesh.solid_mesh import SolidMesh

INNER, OUTER = 1.0, 2.0  # mm
YOUNG, NU = 1.0, 0.3
PRESSURE = 1e-7  # MPa: strains of 1e-7, so that geometric non-linearity stays below the errors seen


def lame(x):
    """Radial displacement (Lame and Clapeyron 1833) as vectors ``(n, 3)``.

    ``u = p a^3 / (E (b^3 - a^3)) [(1 - 2 nu) r + (1 + nu) b^3 / (2 r^2)]``
    """
    r = np.linalg.norm(x, axis=-1, keepdims=True)
    factor = PRESSURE * INNER**3 / (YOUNG * (OUTER**3 - INNER**3))
    return factor * ((1 - 2 * NU) * r + (1 + NU) * OUTER**3 / (2 * r**2)) * x / r


def error(element_type, n):
    """Relative L2 error of the displacement on a sixth of the sphere (a blown-up cube face).

    The four cut faces carry the exact displacement; the inner face is loaded, the outer one free.
    """
    nodes, elements = box(element_type, (n, n, n), (2.0, 2.0, 1.0))
    faces = outer_faces(elements, element_type)
    inside = faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)]
    cut = np.flatnonzero(np.any((nodes[:, :2] == 0) | (nodes[:, :2] == 2), axis=1))
    direction = np.column_stack([np.tan((nodes[:, :2] - 1) * np.pi / 4), np.ones(len(nodes))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x = direction * (INNER + (OUTER - INNER) * nodes[:, 2:])
    fibre = np.broadcast_to([1.0, 0.0, 0.0], x.shape)
    mesh = SolidMesh(
        x, elements, element_type, np.zeros(len(elements), dtype=int), ("wall",), fibre, inside
    )
    solid = Solid(mesh, BiotLaw.of((TransverselyIsotropic.isotropic(YOUNG, NU),)))
    system = System(solid, pressure=PressureLoad(inside, mesh.reference.face), fixed_nodes=cut)
    held = x[cut] + lame(x[cut])
    result = simulate(
        system, lambda t: Loads(pressure=PRESSURE, fixed=held), [Step(1.0, static=True)]
    )
    assert result.converged
    shape = ELEMENTS[element_type].shape(ELEMENTS[element_type].points)
    computed = np.einsum("qa,eai->eqi", shape, (result.frames[-1] - x)[elements])
    exact = lame(np.einsum("qa,eai->eqi", shape, x[elements]))
    square = np.sum((computed - exact) ** 2, axis=-1)
    return np.sqrt(np.sum(square * solid.volumes) / np.sum((exact**2).sum(-1) * solid.volumes))


# Quadratic elements: third order; the solid-shells are linear through the thickness, tet4
# everywhere: second order. An element that lost one order would fall below the band.
@pytest.mark.parametrize(
    ("element_type", "order", "sizes", "finest"),
    [
        ("tet4", 2, (4, 6, 8), 3e-2),
        ("tet10", 3, (2, 3, 4), 3e-3),
        ("hex18", 2, (2, 3, 4), 1e-2),
        ("hex27", 3, (2, 3, 4), 2e-3),
        ("wedge12", 2, (2, 3, 4), 1e-2),
        ("wedge18", 3, (2, 3, 4), 2e-3),
    ],
)
def test_displacement_converges_to_lame_with_the_order_of_the_element(
    element_type, order, sizes, finest
):
    errors = [error(element_type, n) for n in sizes]
    slope = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert errors[-1] < finest
    assert slope == pytest.approx(order, abs=0.3)
