r"""Peak first principal Cauchy stress of the leaflets.

With the right stretch :math:`U = \sqrt{I + 2E}` and the second Piola-Kirchhoff stress :math:`S` the
Cauchy stress is :math:`\sigma = F S F^T / \det F = R \, (U S U / \det U) \, R^T` (Holzapfel 2000,
Nonlinear Solid Mechanics, equation 3.65, with :math:`F = R U`), so that its principal values are
those of :math:`U S U / \det U`. Taken from the Green-Lagrange strain rather than from F, they
include the enhanced strain of solid-shells, which no displacement has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.system import System
from mvest.typing import FloatArray

_PLACE = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""Of tensor components in a six-vector 11, 22, 33, 23, 13, 12."""


@dataclass(frozen=True, slots=True)
class PeakStress:
    """Largest first principal Cauchy stress of one region, MPa.

    Attributes
    ----------
    p95, p99 : float
        Below which 95 and 99 % of the region's volume lies.
    largest : float
        At any quadrature point. It belongs to the insertion of a chord or to the hinge, where the
        stress grows as the mesh is refined; the percentiles do so much less.
    """

    p95: float
    p99: float
    largest: float


def principal_cauchy(green: FloatArray, stress: FloatArray) -> FloatArray:
    """Largest principal Cauchy stress (MPa).

    Parameters
    ----------
    green : ndarray
        ``(..., 6)`` Green-Lagrange strain, engineering shear.
    stress : ndarray
        ``(..., 6)`` second Piola-Kirchhoff stress, MPa.
    """
    strain = green[..., _PLACE] * np.where(np.eye(3, dtype=bool), 1.0, 0.5)
    squared, axes = np.linalg.eigh(np.eye(3) + 2 * strain)
    stretch = np.sqrt(squared)
    u = np.einsum("...ik,...k,...jk->...ij", axes, stretch, axes)
    sigma = u @ stress[..., _PLACE] @ u / np.prod(stretch, axis=-1)[..., None, None]
    return np.asarray(np.linalg.eigvalsh(sigma)[..., -1])


def peak_stress(
    system: System, x: FloatArray, changes: dict[Parameter, float] | None = None
) -> dict[str, PeakStress]:
    """Region -> its peak stress in equilibrium, weighted by volume in the reference frame.

    Parameters
    ----------
    system : System
        Set to its parameters.
    x : ndarray
        ``(n, 3)`` mm nodal positions.
    changes : dict, optional
        Parameter -> by how much it differs from the system's; to first order.

    Raises
    ------
    InputError
        If an element is turned inside out.
    """
    solid = system.solid
    rest = solid.initial_strain()
    state = solid.evaluate(x, rest, 0.0)
    stress = state.stress
    for parameter, change in (changes or {}).items():
        stress = stress + change * system.partial_stress(parameter, state, rest, 0.0)
    values = principal_cauchy(state.green, stress)
    if not np.isfinite(values).all():
        raise InputError("the stress is not finite: an element is turned inside out")
    mesh = solid.mesh
    peaks = {}
    for number, name in enumerate(mesh.region_names):
        own = mesh.region == number
        peaks[name] = _peaks(values[own].ravel(), solid.volumes[own].ravel())
    return peaks


def nodal_stress(system: System, x: FloatArray) -> FloatArray:
    """First principal Cauchy stress ``(n,)`` (MPa) at the nodes, means of their elements by volume.

    Parameters
    ----------
    system : System
        Set to its parameters.
    x : ndarray
        ``(n, 3)`` mm nodal positions.
    """
    solid = system.solid
    state = solid.evaluate(x, solid.initial_strain(), 0.0)
    values = principal_cauchy(state.green, state.stress)
    weight = solid.volumes.sum(axis=1)
    mean = (values * solid.volumes).sum(axis=1) / weight
    nodes, count = solid.mesh.elements, solid.mesh.elements.shape[1]
    total = np.bincount(nodes.ravel(), np.repeat(weight, count), len(x))
    stress = np.bincount(nodes.ravel(), np.repeat(mean * weight, count), len(x))
    return np.asarray(stress / np.maximum(total, np.finfo(float).tiny), dtype=np.float64)


def contact_pressure(system: System, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the midsurface is sampled for contact ``(k, 3)`` (mm, at rest), and the pressure there.

    The pressure ``(k,)`` (MPa) is the force on a point over its area; empty without contact.
    """
    contact = system.contact
    if contact is None:
        return np.zeros((0, 3)), np.zeros(0)
    y = contact.points(x)
    force = np.linalg.norm(contact.forces(contact.search(y), y), axis=1)
    return contact.rest, force / contact.areas


def _peaks(values: FloatArray, volumes: FloatArray) -> PeakStress:
    order = np.argsort(values)
    below = np.cumsum(volumes[order]) / volumes.sum()
    p95, p99 = (float(values[order][np.searchsorted(below, q)]) for q in (0.95, 0.99))
    return PeakStress(p95, p99, float(values.max()))
