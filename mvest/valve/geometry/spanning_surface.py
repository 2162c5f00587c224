"""The minimal surface that spans an annulus: the soap film in a closed curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.measure.annulus import AnnulusPlane, checked_loop

RINGS = 12
"""Of vertices between the curve and its centre."""
MAX_ROUNDS = 100
TOLERANCE = 1e-7
"""Relative change of the area at which the surface is taken as minimal."""


@dataclass(frozen=True, slots=True, eq=False)
class SpanningSurface:
    """A triangulated disc whose edge is the curve.

    Attributes
    ----------
    vertices : (n, 3) mm
        The curve first, its points in their order.
    triangles : (m, 3)
    area : float
        mm².
    """

    vertices: FloatArray
    triangles: IntArray
    area: float


def spanning_surface(annulus: FloatArray, plane: AnnulusPlane) -> SpanningSurface:
    """Span a closed curve by the surface of least area that is a height over its plane.

    The height ``h`` solves the minimal surface equation ``div(grad h / sqrt(1 + |grad h|²)) = 0``
    with linear triangles, the root taken from the round before (Johnson and Thomée 1975, Math.
    Comp. 29:343, for the elements). Over a convex outline the minimal surface is such a height and
    unique (Radó 1930, Math. Z. 32:763).

    Parameters
    ----------
    annulus : (k, 3) mm
        In loop order.
    plane : AnnulusPlane
        Of this annulus.

    Raises
    ------
    GeometryError
        No curve, or one of which not every point is seen from its centre in the plane.
    """
    loop = plane.coordinates(checked_loop(annulus))
    k = len(loop)
    outline = loop[:, :2] - loop[:, :2].mean(axis=0)
    following = np.roll(outline, -1, axis=0)
    turn = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    if not ((turn > 0).all() or (turn < 0).all()):
        raise GeometryError(
            f"annulus: its outline turns back at point {int(np.argmin(np.abs(turn)))} seen from "
            "its centre; check the order of its points"
        )
    shrink = 1.0 - np.arange(RINGS) / RINGS
    flat = np.concatenate([(shrink[:, None, None] * outline).reshape(-1, 2), np.zeros((1, 2))])
    triangles = _disc(k)
    gradient, size = _gradient(flat, triangles)
    height = np.concatenate([np.tile(loop[:, 2], RINGS), [loop[:, 2].mean()]])
    area = np.inf
    for _ in range(MAX_ROUNDS):
        slope = (gradient @ height).reshape(2, -1)
        stretch = np.sqrt(1.0 + (slope**2).sum(axis=0))
        before, area = area, float((size * stretch).sum())
        if abs(before - area) <= TOLERANCE * area:
            break
        stiffness = (gradient.T @ sp.diags_array(np.tile(size / stretch, 2)) @ gradient).tocsr()
        rows = stiffness[k:]
        height = np.concatenate(
            [loop[:, 2], spla.spsolve(rows[:, k:].tocsc(), -(rows[:, :k] @ loop[:, 2]))]
        )
    flat = flat + loop[:, :2].mean(axis=0)
    axes = np.stack([plane.anterior, plane.lateral, plane.normal])
    vertices = plane.origin + np.column_stack([flat, height]) @ axes
    return SpanningSurface(vertices, triangles, area)


def _disc(k: int) -> IntArray:
    """Triangles of rings of k vertices from outside inwards and a centre."""
    here = np.arange(k)
    after = (here + 1) % k
    triangles = []
    for ring in range(RINGS - 1):
        a, b = here + ring * k, after + ring * k
        triangles += [np.stack([a, b, b + k], 1), np.stack([a, b + k, a + k], 1)]
    last = (RINGS - 1) * k
    triangles.append(np.stack([here + last, after + last, np.full(k, RINGS * k)], 1))
    return np.concatenate(triangles)


def _gradient(points: FloatArray, triangles: IntArray) -> tuple[sp.csr_array, FloatArray]:
    """Derivatives along x of all triangles, then along y, of vertex values; and areas, mm²."""
    m = len(triangles)
    corner = points[triangles]
    # The edge opposite to a corner, turned by a right angle, is the gradient times twice the area.
    edge = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
    doubled = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    derivative = np.stack([-edge[..., 1], edge[..., 0]]) / doubled[None, :, None]
    row = np.arange(2 * m).repeat(3)
    column = np.tile(triangles.ravel(), 2)
    matrix = sp.csr_array((derivative.ravel(), (row, column)), shape=(2 * m, len(points)))
    return matrix, np.abs(0.5 * doubled)
