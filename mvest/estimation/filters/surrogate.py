"""A polynomial in the place of a model: fitted to runs of it, with their derivatives if there are.

A posterior is drawn from by thousands of evaluations, a valve is closed in a second. Between runs
of the model that lie close enough, its prediction is a smooth function of few parameters, and a
polynomial of total degree d through values and slopes (least squares; Legendre's polynomials, so
that the system is well conditioned) is as good as the model to a small part of the noise. How good
is measured where it is used, by further runs of the model (`mvest.estimation.filters.monte_carlo`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import comb
from typing import TypeAlias

import numpy as np
from numpy.polynomial import legendre

from mvest.errors import InputError
from mvest.estimation.noise import ObservationNoise
from mvest.typing import BoolArray, FloatArray, IntArray

Misfit: TypeAlias = Callable[[FloatArray], FloatArray]
"""½ (y − h)ᵀ R⁻¹ (y − h) of each of many points (k, p), as (k,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A box with any axes, x = centre + axes u with every ``|u| ≤ 1``.

    Attributes
    ----------
    centre : (p,)
    axes : (p, p)
        Column i is half of edge i; not singular.
    """

    centre: FloatArray
    axes: FloatArray

    def coordinates(self, points: FloatArray) -> FloatArray:
        """Coordinates u (k, p) of points (k, p)."""
        return np.asarray(np.linalg.solve(self.axes, (points - self.centre).T).T)

    def points(self, u: FloatArray) -> FloatArray:
        """Points (k, p) with coordinates u (k, p)."""
        return self.centre + u @ self.axes.T

    def holds(self, points: FloatArray, share: float = 1.0) -> BoolArray:
        """Which of the points (k, p) lie in the box, or in one of a ``share`` of its size."""
        return np.asarray(np.all(np.abs(self.coordinates(points)) <= share, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Surrogate:
    """A polynomial of p parameters with n values.

    Attributes
    ----------
    region : Region
        Where it was fitted; beyond it means nothing.
    powers : (t, p)
        Degree of each term in each coordinate of the region.
    coefficients : (t, n)
    """

    region: Region
    powers: IntArray
    coefficients: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Values (k, n) at points (k, p)."""
        return self._terms(points) @ self.coefficients

    def jacobian(self, point: FloatArray) -> FloatArray:
        """Derivative (n, p) at one point (p,)."""
        by_u = _slopes(self.region.coordinates(point[None]), self.powers)[0]
        return np.asarray(self.coefficients.T @ np.linalg.solve(self.region.axes.T, by_u.T).T)

    def misfit(self, y: FloatArray, noise: ObservationNoise) -> Misfit:
        """½ (y − h)ᵀ R⁻¹ (y − h) as a function of points, infinite outside the region.

        With h = Bᵀ φ and the thin factors W Bᵀ = Q T it is
        ``½ (|Qᵀ e − T (φ − φ₀)|² + |e − Q Qᵀ e|²)`` of the residual e = W (y − h) at the region's
        centre: one evaluation costs t², not n.
        """
        centre = self._terms(self.region.centre[None])[0]
        e = noise.whiten(y - centre @ self.coefficients)
        Q, T = np.linalg.qr(noise.whiten(self.coefficients.T))
        inside = Q.T @ e
        rest = max(float(e @ e - inside @ inside), 0.0)

        def evaluate(points: FloatArray) -> FloatArray:
            r = inside - (self._terms(points) - centre) @ T.T
            values = 0.5 * (np.einsum("kt,kt->k", r, r) + rest)
            return np.where(self.region.holds(points), values, np.inf)

        return evaluate

    def _terms(self, points: FloatArray) -> FloatArray:
        return _terms(self.region.coordinates(points), self.powers)


def fit_surrogate(
    points: FloatArray,
    values: FloatArray,
    jacobians: FloatArray | None,
    region: Region,
    degree: int,
) -> Surrogate:
    """The polynomial of total degree ``degree`` nearest to runs of a model.

    Parameters
    ----------
    points : (r, p)
    values : (r, n)
    jacobians : (r, n, p) or None
        Derivatives of the values; each weighs as much as a value, in coordinates of the region.
    region : Region
    degree : int

    Raises
    ------
    InputError
        If there are more terms than numbers to fit them to.
    """
    r, p = points.shape
    powers = _powers(p, degree)
    u = region.coordinates(points)
    rows, right = _terms(u, powers), values
    if jacobians is not None:
        by_u = np.einsum("rnp,pq->rqn", jacobians, region.axes)
        rows = np.vstack([rows, _slopes(u, powers).transpose(0, 2, 1).reshape(r * p, -1)])
        right = np.vstack([right, by_u.reshape(r * p, -1)])
    if len(rows) < len(powers):
        raise InputError(
            f"a polynomial of degree {degree} in {p} parameters has {len(powers)} terms, but "
            f"{len(points)} runs give {len(rows)} numbers"
        )
    coefficients = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    return Surrogate(region, powers, coefficients)


def affordable_degree(numbers: int, size: int, max_degree: int, spare: float = 1.6) -> int:
    """Largest degree, up to ``max_degree``, of ``spare`` times fewer terms than numbers to fit."""
    fitting = [d for d in range(1, max_degree + 1) if spare * comb(size + d, size) <= numbers]
    return max(fitting, default=1)


def _powers(size: int, degree: int) -> IntArray:
    """Exponents (t, p) of all terms of total degree up to ``degree``."""
    every = product(range(degree + 1), repeat=size)
    return np.array([powers for powers in every if sum(powers) <= degree], dtype=np.int64)


def _terms(u: FloatArray, powers: IntArray) -> FloatArray:
    """Π Pₖ(uᵢ) of every term at points (k, p), as (k, t)."""
    return np.asarray(np.prod(_factors(u, powers), axis=1))


def _slopes(u: FloatArray, powers: IntArray) -> FloatArray:
    """Derivatives (k, t, p) of the terms by each coordinate."""
    factors, derived = _factors(u, powers), _factors(u, powers, derivative=True)
    slopes = []
    for i in range(u.shape[1]):
        mixed = factors.copy()
        mixed[:, i] = derived[:, i]
        slopes.append(np.prod(mixed, axis=1))
    return np.stack(slopes, axis=-1)


def _factors(u: FloatArray, powers: IntArray, *, derivative: bool = False) -> FloatArray:
    """Legendre polynomials (k, p, t) of each coordinate, of the degree that each term has in it."""
    max_degree = int(powers.max(initial=1)) or 1
    values = legendre.legvander(u, max_degree)
    if derivative:
        values = values[..., :max_degree] @ legendre.legder(np.eye(max_degree + 1))
    coordinate = np.arange(u.shape[1])[:, None]
    return np.asarray(values[:, coordinate, powers.T])
