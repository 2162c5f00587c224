r"""GMRES for several right-hand sides with an inaccurate preconditioner.

Flexible right preconditioning (Saad 1993, SIAM J. Sci. Comput. 14:461): given a factor M of a
matrix near A, each iteration adds :math:`z_k = M^{-1} v_k` to the solution space, and the residual
of the given system is minimised. Errors of M, such as single precision, therefore cost iterations
but not accuracy; with left preconditioning the residual would stall at the precision of M.

The stopping criterion is :math:`M^{-1} r`, an estimate of the solution's error that weights soft
and stiff directions equally, while r itself hardly contains the soft ones. It is free: r is a
combination of the :math:`v_k`, and :math:`M^{-1} r` the same combination of the :math:`z_k`. Once
small enough, it is added to the solution as a last correction.
"""

from collections.abc import Callable

import numpy as np

from mvest.typing import BoolArray, FloatArray

REDUCTION = 1e-14
"""Relative residual since the restart below which the recursion is no longer accurate."""

TINY = 1e-300

Product = Callable[[FloatArray], FloatArray]
Exact = Callable[[FloatArray, FloatArray, FloatArray], bool]


def gmres(
    product: Product,
    precondition: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    tolerance: float,
    *,
    exact: Exact,
    restart: int = 40,
    cycles: int = 3,
) -> tuple[FloatArray, BoolArray]:
    """Solutions ``(p, n)`` of several systems with one matrix, and which of them converged.

    Parameters
    ----------
    product : callable
        ``(n,) -> (n,)``, the matrix times a vector.
    precondition : callable
        ``(p, n) -> (p, n)``, approximate solutions.
    right : (p, n)
    tolerance : float
        Preconditioned residual over preconditioned right-hand side.
    exact : callable
        Whether a residual is round-off: (solution, residual, right-hand side), each ``(n,)``.
    restart : int
        Iterations before a restart.
    cycles : int
        Largest number of restarts.
    """
    solution = np.zeros_like(right)
    scale = np.zeros(len(right))
    good = np.zeros(len(right), dtype=np.bool_)
    for cycle in range(cycles + 1):
        spaces: list[tuple[int, _Space]] = []
        for k in map(int, np.flatnonzero(~good)):
            residual = right[k] - product(solution[k]) if cycle else right[k]
            if not np.any(residual) or (cycle and exact(solution[k], residual, right[k])):
                good[k] = True
            elif np.isfinite(residual).all():
                spaces.append((k, _Space(residual, restart)))
        if cycle == cycles:
            break
        working = spaces
        for _ in range(restart):
            if not working:
                break
            directions = precondition(np.stack([space.basis[space.size] for _, space in working]))
            going = []
            for (k, space), direction in zip(working, directions, strict=True):
                correction = space.correction(direction)
                length = float(np.linalg.norm(correction))
                if cycle == 0 and space.size == 0:
                    scale[k] = length
                if length <= tolerance * scale[k]:
                    solution[k] += space.solution() + correction
                    good[k] = True
                elif np.isfinite(length) and space.reduction > REDUCTION:
                    space.extend(product(direction))
                    going.append((k, space))
            working = going
        for k, space in spaces:
            if not good[k]:
                solution[k] += space.solution()
    return solution, good


class _Space:
    """The Krylov space of one right-hand side and its least-squares problem.

    The Hessenberg matrix is stored as its QR factorisation by Givens rotations; ``projected`` is
    Q^T times the initial residual, whose last entry is the remaining residual.
    """

    def __init__(self, residual: FloatArray, room: int) -> None:
        length = float(np.linalg.norm(residual))
        self.size = 0
        self.basis = np.empty((room + 1, len(residual)))
        self.basis[0] = residual / length
        self.directions = np.empty((room, len(residual)))
        self.upper = np.zeros((room, room))
        self.rotations: list[tuple[float, float]] = []
        self.projected = [length]

    @property
    def reduction(self) -> float:
        """Residual over the initial one."""
        return abs(self.projected[-1]) / float(np.linalg.norm(self.projected))

    def correction(self, direction: FloatArray) -> FloatArray:
        """``M^-1 r (n,)``, given ``M^-1`` times the last vector of the basis."""
        self.directions[self.size] = direction
        share = np.zeros(self.size + 1)
        share[-1] = self.projected[-1]
        for k in range(self.size - 1, -1, -1):
            c, s = self.rotations[k]
            share[k], share[k + 1] = -s * share[k + 1], c * share[k + 1]
        return share @ self.directions[: self.size + 1]

    def extend(self, image: FloatArray) -> None:
        """Enlarge the space by the last direction, whose image under the matrix is given."""
        n = self.size
        basis, column = self.basis[: n + 1], np.zeros(n + 2)
        for _ in range(2):  # orthogonal to round-off (Kahan: "twice is enough")
            share = basis @ image
            image = image - share @ basis
            column[:-1] += share
        column[-1] = np.linalg.norm(image)
        self.basis[n + 1] = image / max(column[-1], TINY)
        for k, (c, s) in enumerate(self.rotations):
            above, below = column[k], column[k + 1]
            column[k], column[k + 1] = c * above + s * below, c * below - s * above
        length = max(float(np.hypot(column[-2], column[-1])), TINY)
        c, s = column[-2] / length, column[-1] / length
        self.upper[:n, n], self.upper[n, n] = column[:n], length
        self.rotations.append((c, s))
        last = self.projected.pop()
        self.projected += [c * last, -s * last]
        self.size = n + 1

    def solution(self) -> FloatArray:
        """The combination ``(n,)`` with the least residual."""
        m = self.size
        factors = np.linalg.solve(self.upper[:m, :m], self.projected[:m])
        return np.asarray(factors @ self.directions[:m])
