r"""Tissue that differs from place to place: a law for each region, and a modulus that varies.

Over a leaflet a modulus varies as a smooth random field in a few coefficients. The logarithm of E_f
is its leaflet's value plus a Gaussian field of mean zero whose covariance between two points of the
leaflet is :math:`\sigma^2 k(X, X')` with the squared exponential :math:`k = \exp(-|X - X'|^2 / (2
l^2))` of their distance in the reference (open) frame. It is expanded in its first modes
(Karhunen-Loeve; Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, section
4.3.1, which also has the way to points between, eq. 4.44),

.. math::
    \log E_f(X) = \log E_f + \sum_k a_k \phi_k(X), \qquad
    \phi_k(X) = \frac{\sigma}{\sqrt{\lambda_k}} \sum_j \sqrt{w_j} \, k(X, X_j) \, v_{jk}

with :math:`v_k, \lambda_k` the eigenpairs of :math:`\sqrt{w_i} k(X_i, X_j) \sqrt{w_j}` over the
vertices of the leaflet's surface and the areas w that belong to them. A priori the coefficients
:math:`a_k` are independent and standard normal. No mesh is in it: every mesh of a valve has the
same modulus at the same point.

All stiffness of a point, damping included, is scaled by :math:`\exp(\sum_k a_k \phi_k)`.

A :class:`StiffPatch` is no unknown: it is how a valve is simulated whose tissue differs somewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ModulusField
from mvest.mechanics.solid import Law
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface, lumped_areas
from mvest.valve.mesh.solid_mesh import SolidMesh


@dataclass(frozen=True, slots=True, eq=False)
class RegionalLaw:
    """Each element follows the law of its region; the strain that is damped is that law's.

    Attributes
    ----------
    laws : tuple of Law
        One per region, each of a body of one region.
    region : ndarray
        ``(e,)`` of the elements, which laws do not know when they are asked for a strain.
    """

    laws: tuple[Law, ...]
    region: IntArray

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of parameters that any of the laws knows."""
        return tuple(dict.fromkeys(kind for law in self.laws for kind in law.kinds))

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measures ``(e, q, 6)``."""
        out = np.empty_like(green)
        for law, own, _ in self._parts():
            out[own] = law.strain(green[own])
        return out

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stress, tangent = np.empty_like(green), np.empty((*green.shape, 6))
        for law, own, first in self._parts():
            stress[own], tangent[own] = law.response(green[own], first, previous[own], rate)
        return stress, tangent

    def partial_stress(
        self,
        parameter: Parameter,
        green: FloatArray,
        region: IntArray,
        previous: FloatArray,
        rate: float,
        *,
        which: int,
        stress: FloatArray,
    ) -> FloatArray:
        """Derivative of the stress; see :meth:`mvest.mechanics.law.biot.BiotLaw.partial_stress`."""
        out, own = np.zeros_like(green), self.region == which
        first = np.zeros(int(own.sum()), dtype=np.int64)
        out[own] = self.laws[which].partial_stress(
            parameter, green[own], first, previous[own], rate, which=0, stress=stress[own]
        )
        return out

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of the stress for a change of the previous strain measures."""
        out = np.empty_like(green)
        for law, own, first in self._parts():
            out[own] = law.history_stress(green[own], first, d_previous[own], rate)
        return out

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measures for a change of the Green-Lagrange strain."""
        out = np.empty_like(green)
        for law, own, _ in self._parts():
            out[own] = law.strain_change(green[own], d_green[own])
        return out

    def _parts(self) -> Iterator[tuple[Law, IntArray, IntArray]]:
        """Each law with its elements and their region in a body of their own."""
        for k, law in enumerate(self.laws):
            own = np.flatnonzero(self.region == k)
            yield law, own, np.zeros_like(own)


@dataclass(frozen=True, slots=True, eq=False)
class FieldBasis:
    """The modes of one leaflet, to be had at any point.

    Attributes
    ----------
    support : (s, 3) mm
        Vertices of the leaflet.
    combination : (s, k)
        What their covariances with a point are multiplied by.
    length : float
        mm.
    share : float
        Of the field's variance over the leaflet that the modes have.
    """

    support: FloatArray
    combination: FloatArray
    length: float
    share: float

    @classmethod
    def of(cls, surface: LeafletSurface, region: str, settings: ModulusField) -> FieldBasis:
        """The basis of a leaflet.

        Raises
        ------
        InputError
            If there is no such leaflet, or it has fewer vertices than modes are asked for.
        """
        if region not in surface.region_names:
            raise InputError(
                f"field of {region!r}: no such leaflet; there are {', '.join(surface.region_names)}"
            )
        own = surface.triangles[surface.region == surface.region_names.index(region)]
        vertices, triangles = np.unique(own, return_inverse=True)
        if len(vertices) < settings.modes:
            raise InputError(
                f"field of {region!r}: {settings.modes} modes, expected at most {len(vertices)}, "
                "the number of its vertices"
            )
        support = surface.vertices[vertices]
        root = np.sqrt(lumped_areas(support, triangles.reshape(own.shape)))
        covariance = (
            root[:, None] * _kernel(support, support, settings.correlation_length_mm) * root
        )
        n = len(vertices)
        values, vectors = eigh(covariance, subset_by_index=(n - settings.modes, n - 1))
        values, vectors = values[::-1], vectors[:, ::-1]
        # A mode is as good as its negative: the larger of its extremes is made positive.
        shapes = vectors / root[:, None]
        largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(settings.modes)]
        combination = settings.std_log * root[:, None] * vectors * np.sign(largest)
        return cls(
            support,
            combination / np.sqrt(values),
            settings.correlation_length_mm,
            float(values.sum() / np.sum(root**2)),
        )

    def __call__(self, points: FloatArray) -> FloatArray:
        """The modes ``(..., k)`` at points ``(..., 3)`` mm of the reference frame."""
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        values = _kernel(flat, self.support, self.length) @ self.combination
        return values.reshape(*np.shape(points)[:-1], -1)


def _kernel(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    return np.asarray(np.exp(-cdist(a, b, "sqeuclidean") / (2 * length**2)))


def at_quadrature(
    mesh: SolidMesh, region: str, of: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """What a function gives at the quadrature points of a leaflet's elements, 0 in the others.

    Parameters
    ----------
    mesh : SolidMesh
    region : str
    of : callable
        Points ``(e, q, 3)`` mm of the reference frame -> ``(e, q, ...)``.

    Raises
    ------
    InputError
        If the mesh has no such leaflet.
    """
    if region not in mesh.region_names:
        raise InputError(
            f"field of {region!r}: no such leaflet; there are {', '.join(mesh.region_names)}"
        )
    shape = mesh.reference.shape(mesh.reference.points)
    here = mesh.region == mesh.region_names.index(region)
    values = of(np.einsum("qa,eai->eqi", shape, mesh.nodes[mesh.elements[here]]))
    out = np.zeros((len(here), *values.shape[1:]))
    out[here] = values
    return out


@dataclass(frozen=True, slots=True, eq=False)
class FieldLaw:
    """A law whose stiffness varies from point to point.

    Attributes
    ----------
    base : Law
        At coefficients of zero.
    modes : mapping
        Region -> ``(e, q, k)``, see `at_quadrature`.
    coefficients : mapping
        Region -> ``(k,)``.
    given : ndarray or float
        ``(e, q)`` part of log E_f that is no unknown.
    """

    base: Law
    modes: Mapping[str, FloatArray]
    coefficients: Mapping[str, FloatArray]
    given: FloatArray | float = 0.0
    _scale: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        varied = (modes @ self.coefficients[region] for region, modes in self.modes.items())
        log = sum(varied, np.asarray(self.given))
        object.__setattr__(self, "_scale", np.exp(log)[:, :, None])

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that it knows: those of the base, and the coefficients."""
        return (*self.base.kinds, "field")

    @property
    def scale(self) -> FloatArray:
        """Factor ``(e, q)`` on the stiffness."""
        return self._scale[:, :, 0]

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measure of the base."""
        return self.base.strain(green)

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` of the base, scaled."""
        stress, tangent = self.base.response(green, region, previous, rate)
        return stress * self._scale, tangent * self._scale[:, :, :, None]

    def partial_stress(
        self,
        parameter: Parameter,
        green: FloatArray,
        region: IntArray,
        previous: FloatArray,
        rate: float,
        *,
        which: int,
        stress: FloatArray,
    ) -> FloatArray:
        """Derivative of the stress; see :meth:`mvest.mechanics.law.biot.BiotLaw.partial_stress`."""
        if parameter.kind != "field":
            own = stress / self._scale
            return self._scale * self.base.partial_stress(
                parameter, green, region, previous, rate, which=which, stress=own
            )
        modes = self.modes.get(parameter.region)
        if modes is None or not 0 <= parameter.mode < modes.shape[2]:
            known = [f"field.{name}.0 to {own.shape[2] - 1}" for name, own in self.modes.items()]
            raise InputError(
                f"parameter {parameter.name!r}: unknown mode; known: {', '.join(known)}"
            )
        return stress * modes[:, :, parameter.mode, None]

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of the stress for a change of the previous strain measure."""
        return self._scale * self.base.history_stress(green, region, d_previous, rate)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measure of the base."""
        return self.base.strain_change(green, d_green)
