"""Sparse direct solvers behind one small interface.

``PardisoSolver`` (Intel MKL, x86-64 only) is used where its wheel exists; ``SuperLUSolver`` (SciPy)
everywhere else. Both factorise the same matrix and agree to round-off; a test compares them.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib import metadata
from typing import Protocol

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, gmres, splu

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray

__all__ = ["LinearSolver", "PardisoSolver", "SuperLUSolver", "linear_solver"]


EXACT = 1e-13
"""Tolerance of a solution that is as good as double precision allows."""


class LinearSolver(Protocol):
    """Factorise a square sparse matrix, then solve with one or many right-hand sides."""

    name: str

    def factorize(self, matrix: sparse.csr_matrix) -> None:
        """Factorise ``matrix``; a symbolic analysis is reused while the pattern is unchanged."""

    def solve(self, right: FloatArray, tolerance: float = EXACT) -> FloatArray:
        """Solution of the same shape ``(n,)`` or ``(n, p)`` as ``right``.

        ``tolerance`` is the residual over the right-hand side that suffices; direct solvers may do
        better.
        """


@cache
def _name_mkl() -> None:
    """Tell pypardiso where MKL is: it would search the whole environment for each new solver."""
    try:
        files = metadata.files("mkl") or []
    except metadata.PackageNotFoundError:
        return
    for file in files:
        if file.name.startswith(("libmkl_rt.so", "mkl_rt.")):
            os.environ.setdefault("PYPARDISO_MKL_RT", str(file.locate()))
            return


class PardisoSolver:
    """MKL PARDISO on the symmetric part, GMRES for the rest.

    Only the follower pressure at free edges makes the tangent unsymmetric, and only slightly. The
    symmetric part is factorised as such (type -2: half the memory, several times faster than the
    unsymmetric type 11) and serves GMRES (Saad and Schultz 1986) as preconditioner for the exact
    matrix, so that the solution is that of the unsymmetric system to the tolerance asked for.
    """

    name = "pardiso"

    def __init__(self) -> None:
        _name_mkl()
        from pypardiso import PyPardisoSolver

        self._solver = PyPardisoSolver(mtype=-2)
        self._matrix: sparse.csr_matrix | None = None
        self._upper: sparse.csr_matrix | None = None
        self._take: tuple[IntArray, IntArray] | None = None
        self._symmetric = True

    def factorize(self, matrix: sparse.csr_matrix) -> None:
        """Numeric factorisation; the symbolic one only when the pattern has changed.

        The pattern must be symmetric; the same index arrays mean the same pattern.
        """
        old = self._matrix
        same = old is not None and (
            old.indices is matrix.indices
            or (old.nnz == matrix.nnz and np.array_equal(old.indices, matrix.indices))
        )
        none = np.zeros((matrix.shape[0], 1))
        if not same:
            if old is not None:
                self._solver.free_memory(everything=True)
            self._analyse(matrix)
        assert self._take is not None
        assert self._upper is not None
        here, mirror = self._take
        upper, lower = matrix.data[here], matrix.data[mirror]
        self._upper.data = 0.5 * (upper + lower)
        self._symmetric = bool(np.max(np.abs(upper - lower)) <= 1e-14 * np.max(np.abs(upper)))
        self._matrix = matrix
        if not same:
            self._call(11, none)
        self._call(22, none)

    def _analyse(self, matrix: sparse.csr_matrix) -> None:
        """Where the upper triangle and its mirror image lie in the data of ``matrix``."""
        rank = sparse.csr_matrix(
            (np.arange(1, matrix.nnz + 1), matrix.indices, matrix.indptr), shape=matrix.shape
        )
        upper = sparse.triu(rank, format="csr")
        mirror = sparse.triu(rank.T.tocsr(), format="csr")
        upper.sort_indices()
        mirror.sort_indices()
        if not np.array_equal(upper.indices, mirror.indices):
            raise InputError("the matrix to factorise must have a symmetric sparsity pattern")
        self._take = (upper.data - 1, mirror.data - 1)
        self._upper = sparse.csr_matrix(
            (np.zeros(upper.nnz), upper.indices, upper.indptr), shape=matrix.shape
        )

    def _call(self, phase: int, right: FloatArray) -> FloatArray:
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._solver.set_phase(phase)
        try:
            return np.asarray(self._solver._call_pardiso(self._upper, right))
        except PyPardisoError as error:
            raise RuntimeError(str(error)) from error

    def _precondition(self, right: FloatArray) -> FloatArray:
        column = np.asfortranarray(right.reshape(len(right), -1), dtype=np.float64)
        return self._call(33, column).reshape(right.shape)

    def solve(self, right: FloatArray, tolerance: float = EXACT) -> FloatArray:
        """Solution for one or many right-hand sides."""
        if self._matrix is None:
            raise InputError("solve called before factorize")
        start = self._precondition(right)
        if self._symmetric:
            return start
        if right.ndim == 1:
            return self._refine(self._matrix, right, start, tolerance)
        columns = [
            self._refine(self._matrix, right[:, k], start[:, k], tolerance)
            for k in range(right.shape[1])
        ]
        return np.stack(columns, axis=1)

    def _refine(
        self, matrix: sparse.csr_matrix, right: FloatArray, start: FloatArray, tolerance: float
    ) -> FloatArray:
        solution, unfinished = gmres(
            matrix,
            right,
            x0=start,
            rtol=tolerance,
            atol=0.0,
            restart=60,
            maxiter=3,
            M=LinearOperator(matrix.shape, matvec=self._precondition, dtype=np.float64),
        )
        if unfinished and np.linalg.norm(matrix @ solution - right) > 1e-6 * np.linalg.norm(right):
            raise RuntimeError("GMRES did not converge: the symmetric part is nearly singular")
        return np.asarray(solution)

    def __del__(self) -> None:
        if getattr(self, "_matrix", None) is not None and not sys.is_finalizing():
            self._solver.free_memory(everything=True)


class SuperLUSolver:
    """SciPy's SuperLU in symmetric mode."""

    name = "superlu"

    def __init__(self) -> None:
        self._factor: SuperLU | None = None

    def factorize(self, matrix: sparse.csr_matrix) -> None:
        """Symbolic and numeric factorisation."""
        self._factor = splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )

    def solve(self, right: FloatArray, tolerance: float = EXACT) -> FloatArray:
        """Back-substitution."""
        if self._factor is None:
            raise InputError("solve called before factorize")
        return np.asarray(self._factor.solve(right))


def linear_solver(name: str = "auto") -> LinearSolver:
    """The solver called ``pardiso``, ``superlu`` or ``auto`` (PARDISO where it can be imported).

    Raises
    ------
    InputError
        If the name is unknown, or PARDISO was asked for and is not installed.
    """
    if name not in ("auto", "pardiso", "superlu"):
        raise InputError(f"unknown linear solver {name!r}; known: auto, pardiso, superlu")
    if name == "superlu":
        return SuperLUSolver()
    try:
        return PardisoSolver()
    except ImportError as error:
        if name == "pardiso":
            raise InputError("solver pardiso needs the package pypardiso (x86-64 only)") from error
        return SuperLUSolver()
