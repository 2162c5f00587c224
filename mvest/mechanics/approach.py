"""The way of a free body to an equilibrium far from where it is.

A thin body that bends by many times its thickness is stretched by the straight steps that Newton's
method takes. The stress of that is nonsense and so is its geometric stiffness, and a line search
keeps such steps as short as the body is thin. Here the geometric stiffness is that of the stress
which the step before was to lead to, to first order; forces and all else are exact, and so is the
state that this converges to (Magisano, Leonetti and Garcea 2017, Int. J. Numer. Meth. Engng
109:1237, Newton's method with mixed integration points).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mvest.mechanics.solver import LinearSolver
from mvest.mechanics.system import Evaluation, System
from mvest.typing import FloatArray

ITERATIONS = 15
"""Steps in which the neighbourhood of an equilibrium is reached or given up."""
ASTRAY = 4
"""Steps not shorter than the ones before them after which nothing comes of it."""
FARTHEST, NEAR = 0.3, 1e-4
"""Moves over the body's size: how far one step may go, and what is left to Newton's method."""


def approach(
    system: System,
    solver: LinearSolver,
    evaluate: Callable[[FloatArray, FloatArray | None], Evaluation],
    start: FloatArray,
    far: float,
) -> tuple[FloatArray, list[float]]:
    """A state so near to an equilibrium that Newton's method takes a few steps from it.

    Parameters
    ----------
    system : System
        Without contact.
    solver : LinearSolver
    evaluate : callable
        Positions ``(n, 3)`` mm, and the stress ``(e, q, 6)`` MPa of the geometric stiffness (the
        present one if None) -> residual and tangent.
    start : ndarray
        ``(n, 3)`` mm.
    far : float
        mm, displacement beyond which nothing comes of it.

    Returns
    -------
    x : ndarray
        ``(n, 3)`` mm; ``start`` where nothing came of it.
    residuals : list of float
        Relative residual before each iteration.
    """
    solid, x = system.solid, start
    size = float(np.ptp(solid.mesh.nodes, axis=0).max())
    enhanced, stress = solid.enhanced_parameters, None
    residuals: list[float] = []
    last, astray = np.inf, 0
    for _ in range(ITERATIONS):
        try:
            current = evaluate(x, stress)
            assert current.blocks is not None
            solver.factorize(system.matrix(current.blocks, 0.0))
            d = -solver.solve(current.residual.ravel(), 1e-6).reshape(-1, 3)
        except (RuntimeError, ValueError):
            break
        residuals.append(float(np.linalg.norm(current.residual)) / current.scale)
        move = float(np.abs(d).max())
        if move <= NEAR * size:
            return x + d, residuals
        move, longest = min(move, FARTHEST * size), move
        astray += move >= last
        if astray == ASTRAY:
            break
        last = move
        d *= move / longest
        stress = solid.extrapolated(current.solid, d).stress
        x = x + d
        if not float(np.abs(x - start).max()) <= far:
            break
    solid.enhanced_parameters = enhanced
    return start, residuals
