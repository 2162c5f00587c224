"""Reference finite elements: shape functions, quadrature and faces.

Conventions
-----------
* Reference coordinates are ``(xi, eta, zeta)``. Bricks live on ``[-1, 1]^3``; tetrahedra on the
  unit simplex; wedges on unit triangle ``x [-1, 1]``.
* ``zeta`` is the thickness direction of every layered element. By convention of the valve meshes it
  runs from the atrial (-1) to the ventricular (+1) face.
* Node orders. Bricks are tensor products with ``xi`` fastest: node ``i + 3 j + 9 k`` sits at
  ``(xi_i, eta_j, zeta_k)`` with ``xi_i, eta_j`` in (-1, 0, 1). ``hex18`` has ``zeta`` in (-1, 1),
  ``hex27`` in (-1, 0, 1). Wedges repeat the six-node triangle (corners 0, 1, 2, then the middles of
  01, 12, 20) for each ``zeta``. ``tet10`` has corners 0..3, then the middles of 01, 12, 02, 03, 13,
  23 (the order VTK uses for ``tetra10``).
* ``enhanced`` returns the thickness-strain modes of a solid-shell: with two nodes through the
  thickness the strain E33 is constant in ``zeta`` while bending makes Poisson's effect linear in it
  (thickness locking). The enhanced modes ``zeta * p(xi, eta)`` remove that (Buechter, Ramm and
  Roehl 1994, Int. J. Numer. Meth. Engng 37:2551, enhanced assumed strain of the thickness
  direction).
* ``hex18_thin`` is ``hex18`` for thin bodies. In a biquadratic element that bends without being
  stretched the membrane strain cannot vanish (membrane locking), and neither can the transverse
  shear. Its covariant strains E11 and E13 are projected on what is linear in ``xi``, E22 and E23 on
  what is linear in ``eta``, E12 on both, as if sampled at the two points of Gauss' rule in that
  direction (assumed strains: Huang and Hinton 1986, Int. J. Numer. Meth. Engng 22:73; Bucalem and
  Bathe 1993, ibid. 36:3729, with the same points).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

Evaluate = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Element:
    """One reference element.

    Attributes
    ----------
    name : str
    n_nodes : int
    shape : callable
        ``(q, 3) -> (q, n_nodes)`` shape functions.
    gradient : callable
        ``(q, 3) -> (q, n_nodes, 3)`` derivatives with respect to the reference coordinates.
    points, weights : ndarray
        Stiffness quadrature, ``(q, 3)`` and ``(q,)``; the weights sum to the reference volume.
    enhanced : callable
        ``(q, 3) -> (q, n_modes)`` enhanced thickness-strain modes; ``n_modes`` is 0 for elements
        that need none.
    node_coordinates : ndarray
        ``(n_nodes, 3)`` reference coordinates of the nodes.
    outside : callable
        ``(q, 3) -> (q,)`` distance (in reference coordinates) by which a point is outside; <= 0
        inside.
    inside : callable
        ``(q, 3) -> (q, 3)`` a point of the element near to each point; the point itself where it
        is inside.
    face : str
        Name of the face element of the element's outer faces (of the ``zeta`` faces for layers).
    sampling : callable or None
        Points ``(q, 3)`` and weights ``(q,)`` of the quadrature -> ``(6, q, q)`` what the covariant
        strains 11, 22, 33, 23, 13, 12 are multiplied by; None where they are as they are.
    """

    name: str
    n_nodes: int
    shape: Evaluate
    gradient: Evaluate
    points: FloatArray
    weights: FloatArray
    enhanced: Evaluate
    node_coordinates: FloatArray
    outside: Evaluate
    inside: Evaluate
    face: str
    centre: FloatArray
    top_face: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    sampling: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    @property
    def layered(self) -> bool:
        """Whether ``zeta`` is a distinguished thickness direction."""
        return self.top_face.size > 0


@dataclass(frozen=True, slots=True)
class Face:
    """One reference face with nodes, quadrature and shape tables.

    Attributes
    ----------
    name : str
    n_nodes : int
    shape : ndarray
        ``(q, n_nodes)`` shape functions at the quadrature points.
    gradient : ndarray
        ``(q, n_nodes, 2)`` derivatives at the quadrature points.
    weights : ndarray
        ``(q,)``.
    corners : ndarray
        Local indices of triangles ``(m, 3)`` that cover the face, for drawing.
    """

    name: str
    n_nodes: int
    shape: FloatArray
    gradient: FloatArray
    weights: FloatArray
    corners: IntArray


def _lagrange(order: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values and derivatives ``(q, order + 1)`` of the Lagrange basis on equispaced [-1, 1]."""
    if order == 1:
        return (
            np.stack([0.5 * (1 - x), 0.5 * (1 + x)], axis=-1),
            np.stack([np.full_like(x, -0.5), np.full_like(x, 0.5)], axis=-1),
        )
    return (
        np.stack([0.5 * x * (x - 1), 1 - x * x, 0.5 * x * (x + 1)], axis=-1),
        np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1),
    )


def _gauss(n: int) -> tuple[FloatArray, FloatArray]:
    points, weights = np.polynomial.legendre.leggauss(n)
    return np.asarray(points), np.asarray(weights)


def _simplex(xi: FloatArray) -> FloatArray:
    """Points ``(q, d)`` with coordinates >= 0 that sum to at most 1, near to any points."""
    positive = np.maximum(xi, 0.0)
    total = positive.sum(axis=1, keepdims=True)
    return np.asarray(positive / np.maximum(total, 1.0))


# -- the plane of layered elements, and their faces -----------------------------------------------
Factors = tuple[FloatArray, ...]
"""Arrays ``(q, ...)`` whose product is a shape function."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """A quadratic element of the plane.

    Attributes
    ----------
    face : str
    nodes : (n, 2)
    tables : callable
        Coordinates -> factors of the shape functions, and of their two derivatives.
    product : str
        The factors' subscripts, and those of their product, for `numpy.einsum`.
    points, weights : (q, 2), (q,)
        Quadrature.
    modes : callable
        ``(q, 2) -> (q, m)``, what zeta is multiplied by in the enhanced modes.
    outside, inside : callable
        As those of `Element`.
    centre : (2,)
    corners : (m, 3)
        As those of `Face`.
    """

    face: str
    nodes: FloatArray
    tables: Callable[[FloatArray], tuple[Factors, tuple[Factors, Factors]]]
    product: tuple[str, str]
    points: FloatArray
    weights: FloatArray
    modes: Evaluate
    outside: Evaluate
    inside: Evaluate
    centre: tuple[float, float]
    corners: IntArray

    def as_face(self) -> Face:
        """The face with its tables at the points of quadrature."""
        factors, slopes = self.tables(self.points)
        rule, q = f"{self.product[0]}->q{self.product[1]}", len(self.points)
        shape, *by = (np.einsum(rule, *one).reshape(q, -1) for one in (factors, *slopes))
        gradient = np.stack(by, axis=-1)
        return Face(self.face, len(self.nodes), shape, gradient, self.weights, self.corners)


def _square_tables(xi: FloatArray) -> tuple[Factors, tuple[Factors, Factors]]:
    (a, da), (b, db) = _lagrange(2, xi[:, 0]), _lagrange(2, xi[:, 1])
    return (b, a), ((b, da), (db, a))


def _triangle_tables(xi: FloatArray) -> tuple[Factors, tuple[Factors, Factors]]:
    """Of the six-node triangle."""
    x, y = xi[:, 0], xi[:, 1]
    z, o = 1 - x - y, np.zeros_like(x)
    value = np.stack(
        [z * (2 * z - 1), x * (2 * x - 1), y * (2 * y - 1), 4 * z * x, 4 * x * y, 4 * y * z],
        axis=-1,
    )
    d_x = np.stack([1 - 4 * z, 4 * x - 1, o, 4 * (z - x), 4 * y, -4 * y], axis=-1)
    d_y = np.stack([1 - 4 * z, o, 4 * y - 1, -4 * x, 4 * x, 4 * (z - y)], axis=-1)
    return (value,), ((d_x,), (d_y,))


def _square() -> _Plane:
    g, w = _gauss(3)
    quads = [3 * j + i for j in (0, 1) for i in (0, 1)]
    return _Plane(
        face="quad9",
        nodes=np.array([[x, y] for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)]),
        tables=_square_tables,
        product=("qj,qi", "ji"),
        points=np.column_stack([np.tile(g, 3), np.repeat(g, 3)]),
        weights=np.tile(w, 3) * np.repeat(w, 3),
        modes=lambda xi: np.column_stack([np.ones(len(xi)), xi, xi[:, 0] * xi[:, 1]]),
        outside=lambda xi: np.max(np.abs(xi), axis=1) - 1.0,
        inside=lambda xi: np.clip(xi, -1.0, 1.0),
        centre=(0.0, 0.0),
        corners=np.array([t for n in quads for t in ([n, n + 1, n + 4], [n, n + 4, n + 3])]),
    )


def _triangle() -> _Plane:
    # Degree-4 rule with six points (Strang and Fix 1973; weights sum to 1/2).
    a, b = 0.445948490915965, 0.091576213509771
    inner = [[a, a], [1 - 2 * a, a], [a, 1 - 2 * a]]
    outer = [[b, b], [1 - 2 * b, b], [b, 1 - 2 * b]]
    return _Plane(
        face="tri6",
        nodes=np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]]),
        tables=_triangle_tables,
        product=("qa", "a"),
        points=np.array(inner + outer),
        weights=0.5 * np.repeat([0.223381589678011, 0.109951743655322], 3),
        modes=lambda xi: np.column_stack([np.ones(len(xi)), xi - 1.0 / 3.0]),
        outside=lambda xi: np.max([-xi[:, 0], -xi[:, 1], xi.sum(axis=1) - 1], axis=0),
        inside=_simplex,
        centre=(1 / 3, 1 / 3),
        corners=np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]),
    )


SQUARE, TRIANGLE = _square(), _triangle()


# -- elements -------------------------------------------------------------------------------------
def _no_modes(xi: FloatArray) -> FloatArray:
    return np.zeros((xi.shape[0], 0))


def _reduced(xi: FloatArray, weights: FloatArray) -> FloatArray:
    """Projections ``(6, q, q)`` of ``hex18_thin``, within each layer of points."""
    same = (xi[:, None, 2] == xi[None, :, 2]) * weights

    def without(axis: int) -> FloatArray:
        # Along its axis, what is less than quadratic, from the values on the same line.
        line = same * (xi[:, None, 1 - axis] == xi[None, :, 1 - axis])
        quadratic = 1.5 * xi[:, axis] ** 2 - 0.5
        norm = line @ quadratic**2
        return np.asarray(np.eye(len(xi)) - (quadratic / norm)[:, None] * line * quadratic)

    first, second, all_of_it = without(0), without(1), np.eye(len(xi))
    return np.stack([first, second, all_of_it, second, first, first @ second])


def _layered(name: str, plane: _Plane, order: int, *, thin: bool = False) -> Element:
    """Plane times thickness, in which it is of an order."""
    rule = f"qk,{plane.product[0]}->qk{plane.product[1]}"

    def product(*factors: FloatArray) -> FloatArray:
        return np.asarray(np.einsum(rule, *factors).reshape(len(factors[0]), -1))

    def shape(xi: FloatArray) -> FloatArray:
        return product(_lagrange(order, xi[:, 2])[0], *plane.tables(xi)[0])

    def gradient(xi: FloatArray) -> FloatArray:
        (c, dc), (factors, (by_x, by_y)) = _lagrange(order, xi[:, 2]), plane.tables(xi)
        return np.stack([product(c, *by_x), product(c, *by_y), product(dc, *factors)], axis=-1)

    def with_zeta(values: FloatArray, zetas: FloatArray) -> FloatArray:
        return np.column_stack([np.tile(values, (len(zetas), 1)), np.repeat(zetas, len(values))])

    (g, w), n = _gauss(2), len(plane.nodes)
    return Element(
        name=name,
        n_nodes=n * (order + 1),
        shape=shape,
        gradient=gradient,
        points=with_zeta(plane.points, g),
        weights=(plane.weights * w[:, None]).ravel(),
        enhanced=(lambda xi: xi[:, 2:3] * plane.modes(xi[:, :2])) if order == 1 else _no_modes,
        node_coordinates=with_zeta(plane.nodes, np.linspace(-1.0, 1.0, order + 1)),
        outside=lambda xi: np.maximum(plane.outside(xi[:, :2]), np.abs(xi[:, 2]) - 1),
        inside=lambda xi: np.column_stack([plane.inside(xi[:, :2]), np.clip(xi[:, 2], -1.0, 1.0)]),
        face=plane.face,
        centre=np.array([[*plane.centre, 0.0]]),
        top_face=np.arange(n) + n * order,
        sampling=_reduced if thin else None,
    )


def _tetrahedron(name: str, order: int) -> Element:
    edges = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
    d_bary = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])

    def bary(xi: FloatArray) -> FloatArray:
        return np.column_stack([1 - xi.sum(axis=1), xi])

    def shape(xi: FloatArray) -> FloatArray:
        b = bary(xi)
        if order == 1:
            return b
        return np.hstack([b * (2 * b - 1), 4 * b[:, edges[:, 0]] * b[:, edges[:, 1]]])

    def gradient(xi: FloatArray) -> FloatArray:
        b = bary(xi)
        corner = np.broadcast_to(d_bary, (xi.shape[0], 4, 3))
        if order == 1:
            return corner.copy()
        middle = 4 * (
            b[:, edges[:, 0], None] * d_bary[edges[:, 1]]
            + b[:, edges[:, 1], None] * d_bary[edges[:, 0]]
        )
        return np.concatenate([(4 * b[:, :, None] - 1) * corner, middle], axis=1)

    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points, weights = np.full((1, 3), 0.25), np.array([1 / 6])
    if order == 2:
        # Degree 2, four points (Hammer and Stroud 1956).
        a, b = 0.585410196624969, 0.138196601125011
        points = np.array([[b, b, b], [a, b, b], [b, a, b], [b, b, a]])
        weights = np.full(4, 1 / 24)
        nodes = np.vstack([nodes, 0.5 * (nodes[edges[:, 0]] + nodes[edges[:, 1]])])
    return Element(
        name=name,
        n_nodes=len(nodes),
        shape=shape,
        gradient=gradient,
        points=points,
        weights=weights,
        enhanced=_no_modes,
        node_coordinates=nodes,
        outside=lambda xi: -np.min(bary(xi), axis=1),
        inside=_simplex,
        face="tri3" if order == 1 else "tri6",
        centre=np.full((1, 3), 0.25),
    )


_TRI3 = Face(
    "tri3",
    3,
    np.full((1, 3), 1 / 3),
    np.array([[[-1.0, -1], [1, 0], [0, 1]]]),
    np.array([0.5]),
    np.array([[0, 1, 2]]),
)
FACES = {face.name: face for face in (SQUARE.as_face(), TRIANGLE.as_face(), _TRI3)}
ELEMENTS = {
    e.name: e
    for e in (
        _tetrahedron("tet4", 1),
        _tetrahedron("tet10", 2),
        _layered("hex18", SQUARE, 1),
        _layered("hex18_thin", SQUARE, 1, thin=True),
        _layered("hex27", SQUARE, 2),
        _layered("wedge12", TRIANGLE, 1),
        _layered("wedge18", TRIANGLE, 2),
    )
}


def element(name: str) -> Element:
    """The reference element called ``name``.

    Raises
    ------
    InputError
        If there is none; the message lists what there is.
    """
    try:
        return ELEMENTS[name]
    except KeyError:
        raise InputError(
            f"unknown element {name!r}; known elements: {', '.join(ELEMENTS)}"
        ) from None
