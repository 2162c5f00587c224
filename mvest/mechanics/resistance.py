"""How tissue resists: by tension or compression along its fibres, otherwise in its plane, bending.

A stress is split, in the fibre frame, into its mean through the thickness at every point of the
plane (membrane) and the deviation from it (bending). The membrane stress along the fibres is that
of tension where the mean strain along the fibres is positive, otherwise of compression; the rest is
that across the fibres and in shear. The parts add up to the stress. What is linear in the stress,
such as a derivative of the closed valve, adds up from its parts as well; so does the work of the
stress on the strain, because mean and deviation are orthogonal.
"""

from collections.abc import Sequence

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.assembly import add_forces
from mvest.mechanics.integrate import DERIVATIVES
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import LinearSolver
from mvest.mechanics.system import Loads, System
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

WAYS = (
    "tension along the fibres",
    "compression along the fibres",
    "across the fibres and shear",
    "bending",
)
"""The parts, in the order of every array here."""


def has_one_layer(mesh: SolidMesh) -> bool:
    """Whether the thickness is one layered element, as the split needs."""
    top, layered = mesh.reference.top_face, mesh.reference.layered
    bottom = np.arange(len(top))
    return layered and not bool(np.isin(mesh.elements[:, top], mesh.elements[:, bottom]).any())


def thickness_mean(solid: Solid, values: FloatArray) -> FloatArray:
    """Mean ``(e, q, k)`` of values ``(e, q, k)`` through the thickness, by volume, at each point.

    InputError if the thickness is not one layered element.
    """
    if not has_one_layer(solid.mesh):
        raise InputError(
            f"mesh of {solid.mesh.element_type}: the thickness is not one layered element, so "
            "membrane and bending cannot be told apart"
        )
    levels = len(np.unique(solid.mesh.reference.points[:, 2]))
    # Quadrature points are stacked level by level.
    weights, shape = solid.volumes[..., None], (len(values), levels, -1, values.shape[2])
    total = (weights * values).reshape(shape).sum(axis=1)
    mean = total / weights.reshape(*shape[:3], 1).sum(axis=1)
    return np.tile(mean, (1, levels, 1))


def split(solid: Solid, strain: FloatArray, stress: FloatArray) -> FloatArray:
    """Parts ``(4, e, q, 6)`` of a stress, or of its derivative, ``(e, q, 6)``, see `WAYS`.

    ``strain (e, q, 6)`` is that of the law; errors are those of `thickness_mean`.
    """
    mean = thickness_mean(solid, stress)
    stretched = thickness_mean(solid, strain[..., :1])[..., 0] > 0
    parts = np.zeros((4, *stress.shape))
    parts[0, ..., 0] = np.where(stretched, mean[..., 0], 0.0)
    parts[1, ..., 0] = np.where(stretched, 0.0, mean[..., 0])
    parts[2, ..., 1:] = mean[..., 1:]
    parts[3] = stress - mean
    return parts


def work_shares(system: System, x: FloatArray) -> FloatArray:
    """Shares ``(r, 4)`` in the work of each region's stress on its strain at ``x (n, 3)`` mm.

    That is twice the energy of a linear law in its own strain. A share is negative where tissue
    that is stretched along its fibres is pressed there, because it shrinks across them.
    """
    solid = system.solid
    state = solid.evaluate(x, solid.initial_strain(), 0.0)
    strain = solid.law.strain(state.green)
    work = np.sum(split(solid, strain, state.stress) * strain, axis=-1) * solid.volumes
    regions = range(len(solid.mesh.region_names))
    own = np.stack([work[:, solid.mesh.region == r].sum(axis=(1, 2)) for r in regions])
    return np.asarray(own / own.sum(axis=1, keepdims=True))


def sensitivity_parts(
    system: System,
    x: FloatArray,
    loads: Loads,
    parameters: Sequence[Parameter],
    solver: LinearSolver,
) -> FloatArray:
    """Parts ``(p, 4, n, 3)`` of the derivatives of an equilibrium by moduli, see `WAYS`.

    With the tangent A the derivative is -A⁻¹ ∂r/∂m, and ∂r/∂m is the integral of ∂S/∂m, which is
    split. The parts add up to the derivative of `mvest.mechanics.integrate`. ``x (n, 3)`` mm is in
    equilibrium under the loads; the parameters must change the stress only. Errors are those of
    `thickness_mean`, and an InputError if the body has no such parameter.
    """
    solid, still = system.solid, system.solid.initial_strain()
    pairs = system.search_contact(x)
    now = system.evaluate(x, loads, pairs, still, 0.0, tangent=True)
    assert now.blocks is not None
    strain, right = solid.law.strain(now.solid.green), []
    for parameter in parameters:
        d_stress = system.partial_stress(parameter, now.solid, still, 0.0)
        for part in split(solid, strain, d_stress):
            r = np.zeros((system.n, 3))
            add_forces(r, solid.mesh.elements, solid.condensed_forces(now.solid, part))
            r[system.held] = 0.0
            right.append(-r.ravel())
    solver.factorize(system.matrix(now.blocks, 0.0))
    parts = solver.solve(np.stack(right, axis=1), DERIVATIVES)
    return np.asarray(parts.T.reshape(len(parameters), len(WAYS), system.n, 3))


def information_shares(parts: FloatArray) -> FloatArray:
    """Shares ``(p, 4)`` in the Fisher information on each parameter, all else known.

    ``parts (p, 4, k)`` are those of the derivatives of the observation, whitened by its errors, so
    that the information is the squared length of their sum J. The share of a part is J · part / J ·
    J. The shares add up to one; one is negative if its part works against the others.
    """
    whole = parts.sum(axis=1)
    return np.asarray(
        np.einsum("pk,pwk->pw", whole, parts) / np.sum(whole**2, axis=-1, keepdims=True)
    )
