"""Sparse direct solvers behind one small interface.

``PardisoSolver`` (Intel MKL, x86-64 only) is used where its wheel exists; ``SuperLUSolver`` (SciPy)
everywhere else. Both factorise the same matrix and agree to round-off; a test compares them.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from mvest.errors import InputError
from mvest.typing import FloatArray

__all__ = ["LinearSolver", "PardisoSolver", "SuperLUSolver", "linear_solver"]


class LinearSolver(Protocol):
    """Factorise a square sparse matrix, then solve with one or many right-hand sides."""

    name: str

    def factorize(self, matrix: sparse.csr_matrix) -> None:
        """Factorise ``matrix``; a symbolic analysis is reused while the pattern is unchanged."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the same shape ``(n,)`` or ``(n, p)`` as ``right``."""


class PardisoSolver:
    """MKL PARDISO for real unsymmetric matrices with symmetric structure (type 11)."""

    name = "pardiso"

    def __init__(self) -> None:
        from pypardiso import PyPardisoSolver

        self._solver = PyPardisoSolver(mtype=11)
        self._matrix: sparse.csr_matrix | None = None

    def factorize(self, matrix: sparse.csr_matrix) -> None:
        """Numeric factorisation; the symbolic one only when the pattern has changed."""
        empty = np.zeros((matrix.shape[0], 1))
        old = self._matrix
        same = (
            old is not None
            and old.shape == matrix.shape
            and old.nnz == matrix.nnz
            and np.array_equal(old.indices, matrix.indices)
        )
        if not same:
            if old is not None:
                self._solver.free_memory(everything=True)
            self._solver.set_phase(11)
            self._solver._call_pardiso(matrix, empty)
        self._matrix = matrix
        self._solver.set_phase(22)
        self._solver._call_pardiso(matrix, empty)

    def solve(self, right: FloatArray) -> FloatArray:
        """Back-substitution."""
        if self._matrix is None:
            raise InputError("solve called before factorize")
        self._solver.set_phase(33)
        column = np.asfortranarray(right.reshape(len(right), -1))
        return np.asarray(self._solver._call_pardiso(self._matrix, column)).reshape(right.shape)

    def __del__(self) -> None:
        if getattr(self, "_matrix", None) is not None:
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

    def solve(self, right: FloatArray) -> FloatArray:
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
