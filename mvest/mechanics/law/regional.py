r"""Tissue that varies in space: regional laws, a modulus field, and prestretch.

Within a leaflet, log E_f may vary as a Gaussian field with few coefficients: its leaflet's value
plus a field of mean zero with the covariance :math:`\sigma^2 k(X, X')`, the squared exponential
:math:`k = \exp(-|X - X'|^2 / (2 l^2))` of the distance in the reference (open) frame. The field is
expanded in its first modes (Karhunen-Loeve; Rasmussen and Williams 2006, Gaussian Processes for
Machine Learning, section 4.3.1; for points in between eq. 4.44),

.. math::
    \log E_f(X) = \log E_f + \sum_k a_k \phi_k(X), \qquad
    \phi_k(X) = \frac{\sigma}{\sqrt{\lambda_k}} \sum_j \sqrt{w_j} \, k(X, X_j) \, v_{jk}

with the eigenpairs :math:`v_k, \lambda_k` of :math:`\sqrt{w_i} k(X_i, X_j) \sqrt{w_j}` over the
vertices of the leaflet's surface and their areas w. A priori the coefficients :math:`a_k` are
independent and standard normal. The field does not depend on the mesh. All stiffness at a point,
damping included, is scaled by :math:`\exp(\sum_k a_k \phi_k)`.

A :class:`StiffPatch` is not estimated; it simulates a valve with stiffer tissue at one place.

Prestretch: the leaflets of an imaged open valve are under load and were grown under tension; free
of stress they would be smaller. If a leaflet of the same volume appears :math:`\lambda` times as
long along its fibres and :math:`\rho \lambda` times as long across them, its deformation in the
fibre frame is

.. math::
    F_0 = F\,G, \qquad G = \mathrm{diag}(\lambda, \rho \lambda, 1 / (\rho \lambda^2)),

where F deforms the imaged shape. If the shape that is free of stress is known point by point, as
that of a valve about to open at the end of isovolumic relaxation, its right stretch U relative to
the imaged shape gives :math:`G = U^{-1} \mathrm{diag}(\ldots)`; the fibres of the law turn with the
leaflet. With :math:`E_0 = \frac12 (G^T (I + 2E)\, G - I)` and :math:`J = \det U` the stress is
:math:`S = J\, G\, S_0(E_0)\, G^T`. The imaged shape itself is then not in equilibrium.
Prot and Skallerud (2017, Int. J. Numer. Meth. Biomed. Engng 33:e2806) found leaflets
in the heart to be prestrained, and a model with prestrain to be closer to echocardiography.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.mechanics.law import Law, Points
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import ModulusField
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import LeafletSurface, lumped_areas
from mvest.valve.mesh.solid_mesh import SolidMesh


@dataclass(frozen=True, slots=True, eq=False)
class FieldBasis:
    """The modes of one leaflet as functions of the point."""

    support: FloatArray  #: (s, 3) mm, vertices of the leaflet
    combination: FloatArray  #: (s, k), factors on their covariances with a point
    length: float  #: mm

    @classmethod
    def of(cls, surface: LeafletSurface, region: str, settings: ModulusField) -> FieldBasis:
        """The basis of a leaflet; InputError if it is missing or has fewer vertices than modes."""
        _check_region(region, surface.region_names)
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
        # The sign of a mode is arbitrary: the larger of its extremes is made positive.
        shapes = vectors / root[:, None]
        largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(settings.modes)]
        combination = settings.std_log * root[:, None] * vectors * np.sign(largest)
        return cls(support, combination / np.sqrt(values), settings.correlation_length_mm)

    def __call__(self, points: FloatArray) -> FloatArray:
        """The modes ``(..., k)`` at points ``(..., 3)`` mm of the reference frame."""
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        values = _kernel(flat, self.support, self.length) @ self.combination
        return values.reshape(*np.shape(points)[:-1], -1)


def _check_region(region: str, names: tuple[str, ...]) -> None:
    if region not in names:
        raise InputError(f"field of {region!r}: no such leaflet; there are {', '.join(names)}")


def _kernel(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    return np.asarray(np.exp(-cdist(a, b, "sqeuclidean") / (2 * length**2)))


def at_quadrature(
    mesh: SolidMesh, region: str, of: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Values of a function at the quadrature points of a leaflet, 0 in the other elements.

    ``of`` maps points ``(e, q, 3)`` mm of the reference frame to values ``(e, q, ...)``. InputError
    if the mesh has no such leaflet.
    """
    _check_region(region, mesh.region_names)
    shape = mesh.reference.shape(mesh.reference.points)
    here = mesh.region == mesh.region_names.index(region)
    values = of(np.einsum("qa,eai->eqi", shape, mesh.nodes[mesh.elements[here]]))
    out = np.zeros((len(here), *values.shape[1:]))
    out[here] = values
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ModulusVariation:
    """Variation of the modulus within the leaflets, at the quadrature points of a mesh."""

    #: region -> ``(e, q, k)`` modes of its field, see `at_quadrature`
    modes: Mapping[str, FloatArray]
    given: FloatArray | float = 0.0  #: ``(e, q)`` part of log E_f that is not estimated

    def scale(self, values: Mapping[str, float]) -> FloatArray:
        """Factor ``(e, q)`` on the stiffness; missing coefficients are 0."""
        log = np.asarray(self.given)
        for region, own in self.modes.items():
            a = [values.get(f"field.{region}.{k}", 0.0) for k in range(own.shape[2])]
            log = log + own @ np.array(a)
        return np.exp(log)


POWERS = np.array([2.0, 2.0, -4.0, -1.0, -1.0, 2.0])
"""Powers of the prestretch in the components of C of the shape that is free of stress."""
NORMAL = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
ROWS, COLUMNS = np.array([0, 1, 2, 1, 0, 0]), np.array([0, 1, 2, 2, 2, 1])
"""Tensor entry of each component of a six-vector."""


def stress_free_map(G: FloatArray) -> FloatArray:
    """Matrices ``(..., 6, 6)`` from C to ``G^T C G`` in engineering shear, for symmetric G."""
    i, j, a, b = ROWS[:, None], COLUMNS[:, None], ROWS, COLUMNS
    both = G[..., i, a] * G[..., j, b] + G[..., i, b] * G[..., j, a]
    return np.asarray(both * np.where(ROWS == COLUMNS, 0.5, 1.0)[:, None])


def prestretch_map(along: FloatArray, ratio: FloatArray) -> FloatArray:
    """The matrices ``(..., 6, 6)`` of prestretches along the fibres; ratio: across over along."""
    stretch = np.stack([along, along * ratio, 1 / (along**2 * ratio)], axis=-1)
    return stress_free_map(stretch[..., None] * np.eye(3))


def relaxed_map(green: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The matrices of a shape of Green-Lagrange strain ``(e, q, 6)``, and its det U ``(e, q)``."""
    C = np.empty((*green.shape[:2], 3, 3))
    C[..., ROWS, COLUMNS] = C[..., COLUMNS, ROWS] = NORMAL + (1 + NORMAL) * green
    squared, axes = np.linalg.eigh(C)
    G = (axes / np.sqrt(squared)[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return stress_free_map(G), np.sqrt(squared.prod(axis=-1))


def _times(matrices: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray((matrices @ values[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class LeafletLaw:
    """Laws of the regions of a mesh, with prestretch and varying stiffness."""

    laws: tuple[Law, ...]  #: one law of all regions, or one law of a single region for each
    region: IntArray  #: ``(e,)`` of the elements
    #: ``(e, 1 or q, 6, 6)``, from C to that of the shape that is free of stress (`prestretch_map`,
    #: `relaxed_map`)
    stress_free: FloatArray
    scale: FloatArray | float = 1.0  #: factor ``(e, q)`` on the stress: of ``variation``, and det U
    variation: ModulusVariation | None = None
    relaxed: FloatArray | None = None  #: ``(e, q, 6)`` strain of the shape that is free of stress

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the parameters of all laws, the prestretch and the field."""
        own = [kind for law in self.laws for kind in law.kinds]
        return tuple(dict.fromkeys([*own, "prestretch", "field"]))

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measures ``(e, q, 6)`` of the laws, relative to stress-free leaflets."""
        whole, out = self._whole(green), np.empty_like(green)
        for law, own, *_ in self._parts():
            out[own] = law.strain(whole[own])
        return out

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measures of the laws."""
        whole, d_whole = self._whole(green), _times(self.stress_free, d_green)
        out = np.empty_like(green)
        for law, own, *_ in self._parts():
            out[own] = law.strain_change(whole[own], d_whole[own])
        return out

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stress, tangent = self._of_laws(at)
        scale, turned = np.asarray(self.scale)[..., None], np.swapaxes(self.stress_free, -1, -2)
        return _times(turned, stress) * scale, turned @ tangent @ self.stress_free * scale[
            ..., None
        ]

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of the stress ``(e, q, 6)``.

        Raises
        ------
        InputError
            For an unknown mode, or a prestretch of a moving valve (damping depends on it, too).
        """
        if parameter.kind == "field":
            return stress * self._mode(parameter)[..., None]
        scale, turned = np.asarray(self.scale)[..., None], np.swapaxes(self.stress_free, -1, -2)
        if parameter.kind == "prestretch":
            if at.rate:
                raise InputError(
                    f"parameter {parameter.name!r}: derivatives by a prestretch exist at an "
                    "equilibrium only"
                )
            given, tangent = self._of_laws(at)
            by = np.where(self.region == which, 1.0 / parameter.value, 0.0)[:, None, None] * POWERS
            change = by * given + _times(tangent, by * (self._whole(at.green) + 0.5 * NORMAL))
            return np.asarray(scale * _times(turned, change))
        given = np.linalg.solve(turned, (stress / scale)[..., None])[..., 0]
        out = np.zeros_like(stress)
        for law, own, region, first in self._parts():
            if first == which or len(self.laws) == 1:
                points, number = self._points(at, own, region), which - first
                out[own] = law.partial_stress(parameter, points, which=number, stress=given[own])
        return np.asarray(scale * _times(turned, out))

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of the stress ``(e, q, 6)`` for a change of the previous strain measures."""
        out = np.empty_like(d_previous)
        for law, own, region, _ in self._parts():
            out[own] = law.history_stress(self._points(at, own, region), d_previous[own])
        turned = np.swapaxes(self.stress_free, -1, -2)
        return np.asarray(np.asarray(self.scale)[..., None] * _times(turned, out))

    def _whole(self, green: FloatArray) -> FloatArray:
        """Green-Lagrange strain ``(e, q, 6)`` relative to the stress-free shape."""
        at_rest = 0.5 * (_times(self.stress_free, NORMAL) - NORMAL)
        return _times(self.stress_free, green) + at_rest

    def _parts(self) -> Iterator[tuple[Law, slice | IntArray, IntArray, int]]:
        """Each law, its elements, their regions in its numbering, and its first region."""
        if len(self.laws) == 1:
            yield self.laws[0], slice(None), self.region, 0
            return
        for k, law in enumerate(self.laws):
            own = np.flatnonzero(self.region == k)
            yield law, own, np.zeros_like(own), k

    def _points(self, at: Points, own: slice | IntArray, region: IntArray) -> Points:
        return Points(self._whole(at.green)[own], region, at.previous[own], at.rate)

    def _of_laws(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress and tangent of the laws, from leaflets free of stress."""
        stress, tangent = np.empty_like(at.green), np.empty((*at.green.shape, 6))
        for law, own, region, _ in self._parts():
            stress[own], tangent[own] = law.response(self._points(at, own, region))
        return stress, tangent

    def _mode(self, parameter: Parameter) -> FloatArray:
        known = {} if self.variation is None else self.variation.modes
        modes = known.get(parameter.region)
        if modes is None or not 0 <= parameter.mode < modes.shape[2]:
            names = [f"field.{name}.0 to {own.shape[2] - 1}" for name, own in known.items()]
            raise InputError(
                f"parameter {parameter.name!r}: unknown mode; known: {', '.join(names)}"
            )
        return modes[:, :, parameter.mode]
