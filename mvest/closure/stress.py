r"""Principal stress of a valve: at the nodes, and its extremes by leaflet.

With the right stretch :math:`U = \sqrt{I + 2E}` and the second Piola-Kirchhoff stress :math:`S` the
Cauchy stress is :math:`\sigma = F S F^T / \det F = R \, (U S U / \det U) \, R^T` (Holzapfel 2000,
Nonlinear Solid Mechanics, equation 3.65, with :math:`F = R U`), so that its principal values are
those of :math:`U S U / \det U`. Computed from the Green-Lagrange strain rather than from F, they
include the enhanced strain of solid-shells, which is not part of F.
"""

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.system import System
from mvest.typing import FloatArray
from mvest.valve.measure.strain import weighted_quantiles

_PLACE = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])
"""Index of each tensor component in the six-vector 11, 22, 33, 23, 13, 12."""


PEAKS = {"p95": 0.95, "p99": 0.99, "max": 1.0}
"""Kind of a peak -> share of the leaflet's volume that it bounds."""


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


def _stress(system: System, x: FloatArray) -> FloatArray:
    """First principal Cauchy stress ``(e, q)`` MPa at the quadrature points."""
    solid = system.solid
    state = solid.evaluate(x, solid.initial_strain(), 0.0)
    return principal_cauchy(state.green, state.stress)


def peak_stress(system: System, x: FloatArray) -> dict[str, float]:
    """Peak stress of each region in equilibrium, by name; volumes are at rest.

    The names are ``stress_KIND_REGION_mpa`` with the kinds of `PEAKS`. The largest stress occurs at
    a chordal insertion or at the hinge, and grows with mesh refinement; the percentiles grow much
    less.

    InputError if an element is inverted.

    Parameters
    ----------
    system : System
        Set to its parameters.
    x : ndarray
        ``(n, 3)`` mm nodal positions.
    """
    values, mesh = _stress(system, x), system.solid.mesh
    if not np.isfinite(values).all():
        raise InputError("the stress is not finite: an element is turned inside out")
    peaks: dict[str, float] = {}
    for number, name in enumerate(mesh.region_names):
        own, volumes = (of[mesh.region == number] for of in (values, system.solid.volumes))
        found = weighted_quantiles(own, volumes, tuple(PEAKS.values()))
        peaks |= {f"stress_{kind}_{name}_mpa": v for kind, v in zip(PEAKS, found, strict=True)}
    return peaks


def nodal_stress(system: System, x: FloatArray) -> FloatArray:
    """First principal Cauchy stress ``(n,)`` (MPa) at the nodes, averaged over their elements.

    Parameters are those of `peak_stress`.
    """
    solid = system.solid
    weight = solid.volumes.sum(axis=1)
    mean = (_stress(system, x) * solid.volumes).sum(axis=1) / weight
    nodes, count = solid.mesh.elements, solid.mesh.elements.shape[1]
    total = np.bincount(nodes.ravel(), np.repeat(weight, count), len(x))
    stress = np.bincount(nodes.ravel(), np.repeat(mean * weight, count), len(x))
    return np.asarray(stress / np.maximum(total, np.finfo(float).tiny), dtype=np.float64)
