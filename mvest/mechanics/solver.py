"""Sparse direct solvers: PARDISO (Intel MKL, x86-64 only) if installed, or SciPy's SuperLU."""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, Protocol

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from mvest.errors import InputError
from mvest.mechanics.assembly import BlockMatrix, SparsityPattern
from mvest.mechanics.krylov import gmres
from mvest.typing import BoolArray, FloatArray, IntArray

EXACT = 1e-13
"""Tolerance of a solution as accurate as double precision allows."""
ROUND_OFF = 1e-14
"""Residual, over matrix times solution, that counts as round-off."""
NEGLIGIBLE = 2e-5
"""A block is left out of the factor if its largest entry, over the geometric mean of those of both
diagonal blocks, is below this. A closed valve of 25 000 nodes takes 7 GMRES iterations to 1e-3 for
values up to 1e-5, and 16 at 1e-4; a factor of all blocks is seven times the work."""
TOGETHER = 4
"""Right-hand sides per call of PARDISO."""
SLACK = 1.3
"""Ratio of stored to needed blocks above which the symbolic analysis is repeated."""
NESTED_FROM = 20_000
"""Nodes from which nested dissection has less fill than minimum degree."""


class LinearSolver(Protocol):
    """Factorise a square matrix of 3x3 blocks, then solve with one or many right-hand sides."""

    @property
    def name(self) -> str:
        """The solver and its substitutes."""

    def factorize(self, matrix: BlockMatrix, *, near: bool = False) -> None:
        """Factorise ``matrix``; the symbolic analysis is reused for the same pattern object.

        If ``near``, the matrix hardly differs from the last one, whose factor may be reused by
        iterative solvers.
        """

    def solve(self, right: FloatArray, tolerance: float = EXACT) -> FloatArray:
        """Solution of the same shape ``(n,)`` or ``(n, p)`` as ``right``.

        ``tolerance`` is the estimated relative error; direct solvers may be more accurate.
        """


@cache
def _name_mkl() -> None:
    """Tell pypardiso where MKL is, so that it does not search the environment for each solver."""
    try:
        files = metadata.files("mkl") or []
    except metadata.PackageNotFoundError:
        return
    for file in files:
        if file.name.startswith(("libmkl_rt.so", "mkl_rt.")):
            os.environ.setdefault("PYPARDISO_MKL_RT", str(file.locate()))
            return


class PardisoSolver:
    """PARDISO for the main symmetric part of the matrix, GMRES for the whole.

    Only follower pressure at free edges makes the tangent unsymmetric, and only slightly. Most
    contact couplings are tiny, but cause as much fill as strong ones. So PARDISO factorises the
    symmetric part (type -2: half the memory and several times faster than the unsymmetric type 11)
    in single precision and without the blocks below ``NEGLIGIBLE``, and right-preconditioned GMRES
    (:mod:`mvest.mechanics.krylov`) solves the full system to the requested tolerance. The symbolic
    analysis, which costs a fraction of a factorisation, is repeated if other blocks become
    relevant. A factor is reused for nearby matrices until GMRES fails with it.

    The condition of a thin shell's tangent is about 1e13, as its layer is 1e9 times stiffer across
    than in bending; a single-precision factor is then useless. If GMRES fails, this and all further
    matrices are factorised in double precision, and if that is not enough (flat tetrahedra), with
    all blocks, without which such a matrix is not even positive definite. Even then the
    preconditioned residual may be round-off above the tolerance. So a solution is also accepted if
    its backward error is below ``ROUND_OFF``. Otherwise SuperLU solves with the whole matrix, and
    `name` reports for how many matrices it did.
    """

    def __init__(self) -> None:
        self._pardiso = _Pardiso()
        self._pattern: SparsityPattern | None = None
        self._kept: BoolArray | None = None
        self._factor: _Blocks | None = None
        self._matrix: BlockMatrix | None = None
        self._whole: SuperLUSolver | None = None
        self._single, self._all, self._stale = True, False, False
        self._substituted = 0

    @property
    def name(self) -> str:
        """``pardiso``, and the number of matrices for which SuperLU replaced it."""
        times = f"{self._substituted} matri{'x' if self._substituted == 1 else 'ces'}"
        return f"pardiso, superlu for {times}" if self._substituted else "pardiso"

    def factorize(self, matrix: BlockMatrix, *, near: bool = False) -> None:
        """Numeric factorisation, skipped for a ``near`` matrix; symbolic if blocks change.

        The matrix is not copied: its entries must not change until the last ``solve``.
        """
        self._matrix = matrix
        self._stale = near and self._factor is not None and self._whole is None
        if not self._stale:
            self._whole = None
            self._try_to_renew(matrix)

    def _try_to_renew(self, matrix: BlockMatrix) -> None:
        self._stale = False
        try:
            self._renew(matrix)
        except RuntimeError:
            self._substitute(matrix)

    def _renew(self, matrix: BlockMatrix) -> None:
        """Factorise in the current precision."""
        pattern = matrix.pattern
        if self._pattern is not pattern:
            self._pattern, self._kept = pattern, None
        needed = _significant(pattern.pointer, pattern.columns, matrix.blocks)
        if self._all:
            needed[:] = True
        renew = (
            self._factor is None
            or self._kept is None
            or self._pardiso.single != self._single
            or bool(np.any(needed & ~self._kept))
            or np.count_nonzero(self._kept) > SLACK * np.count_nonzero(needed)
        )
        if renew:
            self._release()
            self._kept = needed
            self._factor = _Blocks.of(pattern, needed, np.float32 if self._single else np.float64)
        assert self._factor is not None
        _by_columns(matrix.blocks, self._factor.here, self._factor.data)
        if renew:
            self._pardiso.analyse(self._factor, 0 if pattern.n < NESTED_FROM else 2)
        self._pardiso.factorize()

    def _substitute(self, matrix: BlockMatrix) -> SuperLUSolver:
        self._whole = SuperLUSolver()
        self._whole.factorize(matrix)
        self._substituted += 1
        return self._whole

    def _release(self) -> None:
        if self._factor is not None:
            self._factor = None
            self._pardiso.free()

    def solve(self, right: FloatArray, tolerance: float = EXACT) -> FloatArray:
        """Solution for one or many right-hand sides."""
        if self._matrix is None:
            raise InputError("solve called before factorize")
        if right.ndim == 1:
            return self._solve(self._matrix, right[None, :], tolerance)[0]
        columns = [
            self._solve(self._matrix, right[:, k : k + TOGETHER].T, tolerance)
            for k in range(0, right.shape[1], TOGETHER)
        ]
        return np.concatenate(columns).T

    def _solve(self, matrix: BlockMatrix, right: FloatArray, tolerance: float) -> FloatArray:
        """Solutions ``(p, n)``."""
        right = np.ascontiguousarray(right, dtype=np.float64)
        if self._whole is None:
            solution, good = gmres(
                matrix.__matmul__,
                self._pardiso.solve,
                right,
                tolerance,
                exact=lambda x, r, b: _is_exact(matrix, x, r, b),
            )
            if good.all():
                return solution
            if self._stale or not self._all:
                if not self._stale:
                    self._single, self._all = False, not self._single
                self._try_to_renew(matrix)
                return self._solve(matrix, right, tolerance)
            self._substitute(matrix)
        assert self._whole is not None
        return self._whole.solve(right.T).T

    def __del__(self) -> None:
        if getattr(self, "_factor", None) is not None and not sys.is_finalizing():
            self._release()


class _Pardiso:
    """MKL's PARDISO for symmetric matrices of 3x3 blocks (upper triangle)."""

    def __init__(self) -> None:
        _name_mkl()
        from pypardiso import PyPardisoSolver

        self._call_mkl = PyPardisoSolver(mtype=-2)._mkl_pardiso
        self._handle = np.zeros(64, dtype=np.int64)
        # Numbers of MKL's manual, from one: no defaults (1), ordering (2) set in `analyse`, pivots
        # perturbed at 1e-8 (10), no scaling (11) and matching (13) because of blocks,
        # Bunch-Kaufman pivots (21), single precision (28), 3x3 blocks (37).
        self.settings = np.zeros(64, dtype=np.int32)
        for number, value in ((1, 1), (10, 8), (21, 1), (37, 3)):
            self.settings[number - 1] = value

    @property
    def single(self) -> bool:
        """Whether the factor is of single precision."""
        return bool(self.settings[27])

    def analyse(self, blocks: _Blocks, ordering: int) -> None:
        """Symbolic analysis; numeric factorisations read the same arrays."""
        self._blocks = blocks
        self.settings[1] = ordering
        self.settings[27] = blocks.data.dtype == np.float32
        self._call(11, self._nothing)

    def factorize(self) -> None:
        """Numeric factorisation."""
        self._call(22, self._nothing)

    def free(self) -> None:
        """Give the memory back."""
        self._call(-1, self._nothing)

    @property
    def _nothing(self) -> FloatArray:
        return np.zeros((1, 1), dtype=self._blocks.data.dtype)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solutions ``(p, n)``."""
        if not self.single:
            return self._call(33, right)
        # Scaled into the range of single precision.
        size = np.maximum(np.abs(right).max(axis=1, keepdims=True), 1e-300)
        return self._call(33, (right / size).astype(np.float32)) * size

    def _call(self, phase: int, right: FloatArray) -> FloatArray:
        out, error, one = np.empty_like(right), ctypes.c_int32(0), ctypes.c_int32(1)
        self._call_mkl(
            _pointer(self._handle, ctypes.c_int64),
            one,
            one,
            ctypes.c_int32(-2),
            ctypes.c_int32(phase),
            ctypes.c_int32(len(self._blocks.pointer) - 1),
            _pointer(self._blocks.data),
            _pointer(self._blocks.pointer, ctypes.c_int32),
            _pointer(self._blocks.columns, ctypes.c_int32),
            ctypes.c_int32(0),
            ctypes.c_int32(len(right)),
            _pointer(self.settings, ctypes.c_int32),
            ctypes.c_int32(0),
            _pointer(right),
            _pointer(out),
            error,
        )
        if error.value:
            raise RuntimeError(f"PARDISO error {error.value}")
        return np.asarray(out, dtype=np.float64)


def _pointer(array: NDArray[Any], kind: type[ctypes._SimpleCData[Any]] | None = None) -> Any:
    """Address of the array."""
    if kind is None:
        return ctypes.c_void_p(array.ctypes.data)
    return array.ctypes.data_as(ctypes.POINTER(kind))


def _is_exact(
    matrix: BlockMatrix, solution: FloatArray, residual: FloatArray, right: FloatArray
) -> bool:
    """Whether the backward error is round-off (Rigal and Gaches 1967, J. ACM 14:543)."""
    largest = np.abs(matrix.blocks).sum(axis=2).max()
    scale = largest * np.abs(solution).max() + np.abs(right).max()
    return bool(np.abs(residual).max() <= ROUND_OFF * scale)


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """Blocks of the upper triangle in PARDISO's format.

    ``pointer`` and ``columns`` are the block pattern with indices from one; ``data (k, 3, 3)`` are
    the blocks by columns, and ``here (k,)`` their positions in the matrix.
    """

    pointer: NDArray[np.int32]
    columns: NDArray[np.int32]
    data: NDArray[np.floating[Any]]
    here: IntArray

    @classmethod
    def of(
        cls, pattern: SparsityPattern, kept: BoolArray, precision: type[np.floating[Any]]
    ) -> _Blocks:
        """The blocks marked in ``kept (u,)``, without their entries."""
        here = np.flatnonzero(kept)
        pointer = np.searchsorted(here, pattern.pointer).astype(np.int32) + 1
        data = np.zeros((len(here), 3, 3), dtype=precision)
        return cls(pointer, pattern.columns[here] + 1, data, here)


@nb.njit(cache=True)
def _significant(
    pointer: NDArray[np.int32], columns: NDArray[np.int32], blocks: FloatArray
) -> BoolArray:
    """Which blocks of the upper triangle belong to the factor: see ``NEGLIGIBLE``."""
    size, scale = np.empty(len(columns)), np.empty(len(pointer) - 1)
    for row in range(len(scale)):
        for k in range(pointer[row], pointer[row + 1]):
            largest = 0.0
            for i in range(3):
                for j in range(3):
                    largest = max(largest, abs(blocks[k, i, j]))
            size[k] = largest
        scale[row] = np.sqrt(size[pointer[row]])
    out = np.empty(len(columns), dtype=np.bool_)
    for row in range(len(scale)):
        for k in range(pointer[row], pointer[row + 1]):
            out[k] = size[k] > NEGLIGIBLE * scale[row] * scale[columns[k]]
        out[pointer[row]] = True
    return out


@nb.njit(cache=True)
def _by_columns(blocks: FloatArray, here: IntArray, out: NDArray[np.floating[Any]]) -> None:
    for k in range(len(here)):
        for i in range(3):
            for j in range(3):
                out[k, j, i] = blocks[here[k], i, j]


class SuperLUSolver:
    """SciPy's SuperLU in symmetric mode."""

    name = "superlu"

    def __init__(self) -> None:
        self._factor: SuperLU | None = None

    def factorize(self, matrix: BlockMatrix, *, near: bool = False) -> None:
        """Symbolic and numeric factorisation."""
        self._factor = splu(
            matrix.tobsr().tocsc(),
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
    """The solver ``pardiso``, ``superlu`` or ``auto`` (PARDISO if installed).

    InputError if the name is unknown, or PARDISO is requested and not installed.
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
