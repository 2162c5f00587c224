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
* ``enhanced`` returns the thickness-strain modes of a solid-shell. With two nodes through the
  thickness the strain E33 is constant in ``zeta``, while bending makes Poisson's effect linear
  there (thickness locking). The enhanced modes ``zeta * p(xi, eta)`` remove that (Buechter, Ramm
  and Roehl 1994, Int. J. Numer. Meth. Engng 37:2551).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

Evaluate = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Element:
    """One reference element."""

    name: str
    n_nodes: int
    shape: Evaluate  #: ``(q, 3) -> (q, n_nodes)`` shape functions
    #: ``(q, 3) -> (q, n_nodes, 3)`` derivatives with respect to the reference coordinates
    gradient: Evaluate
    #: stiffness quadrature, ``(q, 3)`` and ``(q,)``; the weights sum to the reference volume
    points: FloatArray
    weights: FloatArray
    #: ``(q, 3) -> (q, n_modes)`` enhanced thickness-strain modes; ``n_modes`` may be 0
    enhanced: Evaluate
    node_coordinates: FloatArray  #: ``(n_nodes, 3)`` reference coordinates of the nodes
    #: ``(q, 3) -> (q,)`` distance of points outside, in reference coordinates; <= 0 inside
    outside: Evaluate
    #: ``(q, 3) -> (q, 3)`` a nearby point of the element; an inner point is returned unchanged
    inside: Evaluate
    #: name of the face element of the outer faces (the ``zeta`` faces of layered elements)
    face: str
    centre: FloatArray  #: (1, 3)
    #: local nodes of the face at ``zeta = 1`` of layered elements; empty for the others
    top_face: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def layered(self) -> bool:
        """Whether ``zeta`` is a distinguished thickness direction."""
        return self.top_face.size > 0


@dataclass(frozen=True, slots=True)
class Face:
    """One reference face with nodes, quadrature and shape tables."""

    name: str
    n_nodes: int
    #: (q, n_nodes) and (q, n_nodes, 2), shape functions and their derivatives at the quadrature
    #: points
    shape: FloatArray
    gradient: FloatArray
    weights: FloatArray  #: (q,)
    corners: IntArray  #: (m, 3), local nodes of triangles that cover the face


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


Factors = tuple[FloatArray, ...]
"""Arrays ``(q, k)``, ``(q, l)``, ... whose products ``(q, k l ...)`` are the shape functions."""


def _product(*factors: FloatArray) -> FloatArray:
    """All products ``(q, k l ...)``, with the last factor fastest."""
    out = factors[0]
    for factor in factors[1:]:
        out = (out[:, :, None] * factor[:, None]).reshape(len(out), -1)
    return out


def _triangle6(x: FloatArray, y: FloatArray) -> tuple[Factors, Factors, Factors]:
    """Six-node triangle: its shape functions, and their derivatives by x and by y."""
    z = 1 - x - y
    value = np.stack(
        [z * (2 * z - 1), x * (2 * x - 1), y * (2 * y - 1), 4 * z * x, 4 * x * y, 4 * y * z],
        axis=-1,
    )
    o = np.zeros_like(x)
    d_x = np.stack([1 - 4 * z, 4 * x - 1, o, 4 * (z - x), 4 * y, -4 * y], axis=-1)
    d_y = np.stack([1 - 4 * z, o, 4 * y - 1, -4 * x, 4 * x, 4 * (z - y)], axis=-1)
    return (value,), (d_x,), (d_y,)


def _no_modes(xi: FloatArray) -> FloatArray:
    return np.zeros((xi.shape[0], 0))


def _simplex(xi: FloatArray) -> FloatArray:
    """Nearby points ``(q, d)`` of the unit simplex."""
    positive = np.maximum(xi, 0.0)
    total = positive.sum(axis=1, keepdims=True)
    return np.asarray(positive / np.maximum(total, 1.0))


def _gauss(n: int) -> tuple[FloatArray, FloatArray]:
    points, weights = np.polynomial.legendre.leggauss(n)
    return np.asarray(points), np.asarray(weights)


# Degree-4 rule with six points on the unit triangle (Strang and Fix 1973; weights sum to 1/2).
_A, _B = 0.445948490915965, 0.091576213509771
_TRIANGLE_POINTS = np.array(
    [[_A, _A], [1 - 2 * _A, _A], [_A, 1 - 2 * _A], [_B, _B], [1 - 2 * _B, _B], [_B, 1 - 2 * _B]]
)
_TRIANGLE_WEIGHTS = 0.5 * np.repeat([0.223381589678011, 0.109951743655322], 3)


def _quad9(x: FloatArray, y: FloatArray) -> tuple[Factors, Factors, Factors]:
    """Nine-node quadrilateral: its shape functions, and their derivatives by x and by y."""
    (a, da), (b, db) = _lagrange(2, x), _lagrange(2, y)
    return (b, a), (b, da), (db, a)


@dataclass(frozen=True, slots=True)
class _Plane:
    """The in-plane part of a layered element (see `Element` and `Face`); points are ``(q, 2)``.

    ``evaluate`` returns the shape functions and their two derivatives, ``modes`` the polynomials
    ``(q, m)`` of the enhanced strain.
    """

    evaluate: Callable[[FloatArray, FloatArray], tuple[Factors, Factors, Factors]]
    points: FloatArray
    weights: FloatArray
    nodes: FloatArray
    centre: FloatArray
    modes: Evaluate
    outside: Evaluate
    inside: Evaluate
    corners: IntArray


_G3, _W3 = _gauss(3)
_PLANES = {
    "quad9": _Plane(
        _quad9,
        points=np.array([[x, y] for y in _G3 for x in _G3]),
        weights=np.tile(_W3, 3) * np.repeat(_W3, 3),
        nodes=np.array([[x, y] for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)]),
        centre=np.zeros(2),
        modes=lambda xi: np.column_stack([np.ones(len(xi)), xi, xi[:, 0] * xi[:, 1]]),
        outside=lambda xi: np.max(np.abs(xi), axis=1) - 1.0,
        inside=lambda xi: np.clip(xi, -1.0, 1.0),
        corners=np.array(
            [[n + k for k in corner] for n in (0, 1, 3, 4) for corner in ((0, 1, 4), (0, 4, 3))]
        ),
    ),
    "tri6": _Plane(
        _triangle6,
        points=_TRIANGLE_POINTS,
        weights=_TRIANGLE_WEIGHTS,
        nodes=np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]]),
        centre=np.full(2, 1 / 3),
        modes=lambda xi: np.column_stack([np.ones(len(xi)), xi - 1.0 / 3.0]),
        outside=lambda xi: np.max(np.stack([-xi[:, 0], -xi[:, 1], xi.sum(axis=1) - 1]), axis=0),
        inside=_simplex,
        corners=np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]),
    ),
}


def _layered(name: str, face: str, order: int) -> Element:
    """The product of a plane element and a line of ``order`` through the thickness."""
    plane = _PLANES[face]

    def shape(xi: FloatArray) -> FloatArray:
        return _product(_lagrange(order, xi[:, 2])[0], *plane.evaluate(*xi[:, :2].T)[0])

    def gradient(xi: FloatArray) -> FloatArray:
        (c, dc), (value, d_x, d_y) = _lagrange(order, xi[:, 2]), plane.evaluate(*xi[:, :2].T)
        return np.stack([_product(c, *d_x), _product(c, *d_y), _product(dc, *value)], axis=-1)

    def modes(xi: FloatArray) -> FloatArray:
        return np.asarray(xi[:, 2:] * plane.modes(xi[:, :2]))

    (g2, w2), levels = _gauss(2), np.linspace(-1.0, 1.0, order + 1)

    def stacked(points: FloatArray, zetas: FloatArray) -> FloatArray:
        return np.array([[*point, zeta] for zeta in zetas for point in points])

    nodes = stacked(plane.nodes, levels)
    return Element(
        name=name,
        n_nodes=len(nodes),
        shape=shape,
        gradient=gradient,
        points=stacked(plane.points, g2),
        weights=np.array([along * across for across in w2 for along in plane.weights]),
        enhanced=modes if order == 1 else _no_modes,
        node_coordinates=nodes,
        outside=lambda xi: np.maximum(plane.outside(xi[:, :2]), np.abs(xi[:, 2]) - 1.0),
        inside=lambda xi: np.column_stack([plane.inside(xi[:, :2]), np.clip(xi[:, 2], -1.0, 1.0)]),
        face=face,
        centre=np.append(plane.centre, 0.0)[None],
        top_face=np.arange(len(plane.nodes)) + len(plane.nodes) * order,
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

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    if order == 1:
        points, weights, nodes = np.full((1, 3), 0.25), np.array([1 / 6]), corners
    else:
        # Degree 2, four points (Hammer and Stroud 1956).
        a, b = 0.585410196624969, 0.138196601125011
        points = np.array([[b, b, b], [a, b, b], [b, a, b], [b, b, a]])
        weights = np.full(4, 1 / 24)
        nodes = np.vstack([corners, 0.5 * (corners[edges[:, 0]] + corners[edges[:, 1]])])
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


def _face(name: str) -> Face:
    plane = _PLANES[name]
    value, d_x, d_y = plane.evaluate(*plane.points.T)
    slope = np.stack([_product(*d_x), _product(*d_y)], axis=-1)
    return Face(name, len(plane.nodes), _product(*value), slope, plane.weights, plane.corners)


FACES: dict[str, Face] = {
    **{name: _face(name) for name in _PLANES},
    "tri3": Face(
        "tri3",
        3,
        np.full((1, 3), 1 / 3),
        np.array([[[-1.0, -1], [1, 0], [0, 1]]]),
        np.array([0.5]),
        np.array([[0, 1, 2]]),
    ),
}
ELEMENTS: dict[str, Element] = {
    e.name: e
    for e in (
        _tetrahedron("tet4", 1),
        _tetrahedron("tet10", 2),
        _layered("hex18", "quad9", 1),
        _layered("hex27", "quad9", 2),
        _layered("wedge12", "tri6", 1),
        _layered("wedge18", "tri6", 2),
    )
}


def element(name: str) -> Element:
    """The reference element called ``name``; InputError if there is none."""
    if name not in ELEMENTS:
        raise InputError(f"unknown element {name!r}; known elements: {', '.join(ELEMENTS)}")
    return ELEMENTS[name]
