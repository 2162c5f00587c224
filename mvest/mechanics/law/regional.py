r"""Tissue that differs from place to place: its laws, a modulus that varies, and prestretch.

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

A :class:`StiffPatch` is not estimated: it simulates a valve whose tissue is stiffer in one place.

Prestretched leaflets are stretched already in the shape in which they were seen open. The open
valve of an image is under load, and its leaflets were grown under tension: free of stress they
would be smaller. A leaflet that was seen :math:`\lambda` times as long in both directions of its
plane as it would be then, at the same volume, has in its fibre frame the deformation

.. math::
    F_0 = F\,G, \qquad G = \mathrm{diag}(\lambda, \lambda, \lambda^{-2}),

of which the law is asked, F being what is done to the shape that was seen. With
:math:`E_0 = \frac12 (G^T (I + 2E)\, G - I)` the stress is :math:`S = G\, S_0(E_0)\, G^T`, since
the volume is the same. The shape that was seen is then in no equilibrium by itself; what is
computed is the closed valve of such leaflets.

That leaflets in the heart are prestrained, and that a closed valve of porcine leaflets comes nearer
to what echocardiography shows where the model has it, is found by Prot and Skallerud (2017, Int. J.
Numer. Meth. Biomed. Engng 33:e2806).
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
    """The modes of one leaflet, to be had at any point.

    Attributes
    ----------
    support : (s, 3) mm
        Vertices of the leaflet.
    combination : (s, k)
        What their covariances with a point are multiplied by.
    length : float
        mm.
    """

    support: FloatArray
    combination: FloatArray
    length: float

    @classmethod
    def of(cls, surface: LeafletSurface, region: str, settings: ModulusField) -> FieldBasis:
        """The basis of a leaflet.

        Raises
        ------
        InputError
            If there is no such leaflet, or it has fewer vertices than modes.
        """
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
        # A mode is as good as its negative: the larger of its extremes is made positive.
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
    """What a function gives at the quadrature points of a leaflet's elements, 0 in the others.

    ``of`` maps points ``(e, q, 3)`` mm of the reference frame to values ``(e, q, ...)``.

    Raises
    ------
    InputError
        If the mesh has no such leaflet.
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
    """How the modulus varies within the leaflets, at the quadrature points of a mesh.

    Attributes
    ----------
    modes : mapping
        Region -> ``(e, q, k)`` modes of its field, see `at_quadrature`.
    given : ndarray or float
        ``(e, q)`` part of log E_f that is not estimated.
    """

    modes: Mapping[str, FloatArray]
    given: FloatArray | float = 0.0

    def scale(self, values: Mapping[str, float]) -> FloatArray:
        """Factor ``(e, q)`` on the stiffness; coefficients without a value are 0."""
        log = np.asarray(self.given)
        for region, own in self.modes.items():
            a = [values.get(f"field.{region}.{k}", 0.0) for k in range(own.shape[2])]
            log = log + own @ np.array(a)
        return np.exp(log)


POWERS = np.array([2.0, 2.0, -4.0, -1.0, -1.0, 2.0])
"""Of the prestretch, by which components of C and S of the shape that was seen are multiplied."""
NORMAL = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class LeafletLaw:
    """The laws of the regions of a mesh, whose tissue may be prestretched and vary in stiffness.

    Attributes
    ----------
    laws : tuple of Law
        One that knows all regions, or one per region that knows this region alone.
    region : ndarray
        ``(e,)`` of the elements; a law is not given it with a strain.
    prestretch : ndarray
        ``(r,)`` of each region.
    scale : ndarray or float
        Factor ``(e, q)`` on the stiffness, of ``variation``.
    variation : ModulusVariation, optional
    """

    laws: tuple[Law, ...]
    region: IntArray
    prestretch: FloatArray
    scale: FloatArray | float = 1.0
    variation: ModulusVariation | None = None

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of parameters that any of the laws knows, the prestretch and coefficients."""
        own = [kind for law in self.laws for kind in law.kinds]
        return tuple(dict.fromkeys([*own, "prestretch", "field"]))

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measures ``(e, q, 6)`` of the laws, from leaflets free of stress."""
        whole, out = self._whole(green), np.empty_like(green)
        for law, own, *_ in self._parts():
            out[own] = law.strain(whole[own])
        return out

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measures of the laws."""
        whole, d_whole = self._whole(green), self._stretch * d_green
        out = np.empty_like(green)
        for law, own, *_ in self._parts():
            out[own] = law.strain_change(whole[own], d_whole[own])
        return out

    def response(self, at: Points) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stress, tangent = self._of_laws(at)
        stretch, scale = self._stretch, np.asarray(self.scale)[..., None]
        both = stretch[..., None] * stretch[..., None, :]
        return stretch * stress * scale, both * tangent * scale[..., None]

    def partial_stress(
        self, parameter: Parameter, at: Points, *, which: int, stress: FloatArray
    ) -> FloatArray:
        """Derivative of the stress ``(e, q, 6)``.

        Raises
        ------
        InputError
            If it is by a prestretch and the valve moves: what is damped depends on it as well; or
            by a mode that the leaflet's field does not have.
        """
        if parameter.kind == "field":
            return stress * self._mode(parameter)[..., None]
        stretch, scale = self._stretch, np.asarray(self.scale)[..., None]
        if parameter.kind == "prestretch":
            if at.rate:
                raise InputError(
                    f"parameter {parameter.name!r}: there are derivatives by a prestretch at an "
                    "equilibrium only"
                )
            given, tangent = self._of_laws(at)
            by = np.where(self.region == which, 1.0 / self.prestretch[self.region], 0.0)
            slope = POWERS * by[:, None, None] * stretch
            by_strain = np.einsum("eqij,eqj->eqi", tangent, slope * (at.green + 0.5 * NORMAL))
            return np.asarray(scale * (slope * given + stretch * by_strain))
        out, given = np.zeros_like(stress), stress / scale / stretch
        for law, own, region, first in self._parts():
            if first == which or len(self.laws) == 1:
                points, number = self._points(at, own, region), which - first
                out[own] = law.partial_stress(parameter, points, which=number, stress=given[own])
        return np.asarray(scale * (stretch * out))

    def history_stress(self, at: Points, d_previous: FloatArray) -> FloatArray:
        """Change of the stress ``(e, q, 6)`` for a change of the previous strain measures."""
        out = np.empty_like(d_previous)
        for law, own, region, _ in self._parts():
            out[own] = law.history_stress(self._points(at, own, region), d_previous[own])
        return np.asarray(np.asarray(self.scale)[..., None] * (self._stretch * out))

    @property
    def _stretch(self) -> FloatArray:
        """Factor ``(e, 1, 6)`` on the components of C and S by the prestretch."""
        return np.asarray(self.prestretch[self.region, None, None] ** POWERS)

    def _whole(self, green: FloatArray) -> FloatArray:
        """Green-Lagrange strain ``(e, q, 6)`` from the shape that is free of stress."""
        stretch = self._stretch
        return np.asarray(stretch * green + 0.5 * (stretch - 1.0) * NORMAL)

    def _parts(self) -> Iterator[tuple[Law, slice | IntArray, IntArray, int]]:
        """Each law, its elements, their regions as it counts them, and the first of its regions."""
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
