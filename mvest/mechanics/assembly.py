"""Where element arrays become global: the sparsity pattern and the scatter into it.

Everything that adds stiffness does so as dense node-pair blocks: a group couples a list of row
nodes with a list of column nodes, and its tangent is ``(rows, columns, 3, 3)``. The pattern is kept
at node level (block rows of 3x3), so positions are looked up once and the scatter is a plain
indexed addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mvest.typing import FloatArray, IntArray

__all__ = [
    "SparsityPattern",
    "add_forces",
    "adjacency",
    "coupling",
    "scatter_blocks",
    "scatter_matrices",
]


@dataclass(frozen=True, eq=False)
class SparsityPattern:
    """Sparsity pattern of a matrix with 3x3 blocks.

    Attributes
    ----------
    n : int
        Number of nodes.
    keys : ndarray
        Sorted ``row * n + column`` of all blocks; the position of a block is its rank.
    """

    n: int
    keys: IntArray

    @classmethod
    def of(cls, coupled: sparse.csr_matrix) -> SparsityPattern:
        """Pattern of the entries stored in ``coupled (n, n)``."""
        coupled.sort_indices()
        n = coupled.shape[0]
        rows = np.repeat(np.arange(n, dtype=np.int64), np.diff(coupled.indptr))
        return cls(n, rows * n + coupled.indices)

    def positions(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Positions ``(g, r, c)`` of the blocks coupling ``rows (g, r)`` and ``columns (g, c)``.

        All of them must be in the pattern.
        """
        return _positions(self.pointer, self.columns, rows, columns)

    @property
    def diagonal(self) -> IntArray:
        """Positions ``(n,)`` of the diagonal blocks."""
        return np.searchsorted(self.keys, np.arange(self.n, dtype=np.int64) * (self.n + 1))

    def zeros(self) -> FloatArray:
        """Block data ``(n_blocks, 3, 3)``."""
        return np.zeros((len(self.keys), 3, 3))

    @cached_property
    def rows(self) -> IntArray:
        """Row ``(n_blocks,)`` of each block."""
        return self.keys // self.n

    @cached_property
    def columns(self) -> NDArray[np.int32]:
        """Column ``(n_blocks,)`` of each block."""
        return (self.keys % self.n).astype(np.int32)

    @cached_property
    def pointer(self) -> NDArray[np.int32]:
        """Where each row starts ``(n + 1,)``."""
        return np.searchsorted(self.rows, np.arange(self.n + 1)).astype(np.int32)

    def matrix(self, blocks: FloatArray) -> sparse.bsr_matrix:
        """The matrix ``(3n, 3n)`` with the given block data, which it refers to.

        All matrices of one pattern have the very same array of indices.
        """
        matrix = sparse.bsr_matrix((3 * self.n, 3 * self.n), blocksize=(3, 3))
        matrix.data, matrix.indices, matrix.indptr = blocks, self.columns, self.pointer
        return matrix


def adjacency(n: int, groups: Sequence[IntArray]) -> sparse.csr_matrix:
    """Matrix ``(n, n)`` with an entry for each pair of nodes that are in a group together.

    Parameters
    ----------
    n : int
        Number of nodes.
    groups : sequence of ndarray
        ``(g, k)`` nodes of each group. The diagonal is there in any case.
    """
    total = sparse.identity(n, format="csr", dtype=np.int32)
    for nodes in groups:
        incidence = _incidence(n, nodes)
        total = total + incidence.T @ incidence
    return total.tocsr()


def coupling(n: int, nodes: IntArray, pairs: IntArray) -> sparse.csr_matrix:
    """Matrix ``(n, n)`` with an entry for all nodes of groups that are coupled, both ways round.

    Parameters
    ----------
    n : int
        Number of nodes.
    nodes : ndarray
        ``(g, k)`` nodes of each group.
    pairs : ndarray
        ``(p, 2)`` which groups are coupled.
    """
    incidence = _incidence(n, nodes)
    one = np.ones(len(pairs), dtype=np.int32)
    both = sparse.csr_matrix((one, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes),) * 2)
    return (incidence.T @ ((both + both.T) @ incidence)).tocsr()


def _incidence(n: int, nodes: IntArray) -> sparse.csr_matrix:
    """Incidence ``(g, n)`` of groups and nodes."""
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    ones = np.ones(nodes.size, dtype=np.int32)
    return sparse.csr_matrix((ones, (rows, nodes.ravel())), shape=(len(nodes), n))


@nb.njit(cache=True)
def _positions(
    pointer: NDArray[np.int32], indices: NDArray[np.int32], rows: IntArray, columns: IntArray
) -> IntArray:
    """Positions of entries of a matrix with sorted rows, by bisection within each row."""
    out = np.empty((rows.shape[0], rows.shape[1], columns.shape[1]), dtype=np.int64)
    for g in range(rows.shape[0]):
        for a in range(rows.shape[1]):
            start, end = pointer[rows[g, a]], pointer[rows[g, a] + 1]
            for b in range(columns.shape[1]):
                low, high, wanted = start, end, columns[g, b]
                while high - low > 1:
                    middle = (low + high) // 2
                    if indices[middle] <= wanted:
                        low = middle
                    else:
                        high = middle
                out[g, a, b] = low
    return out


@nb.njit(cache=True)
def add_forces(out: FloatArray, nodes: IntArray, forces: FloatArray) -> None:
    """Add group forces ``(g, k, 3)`` on ``nodes (g, k)`` into ``out (n, 3)``."""
    for g in range(nodes.shape[0]):
        for a in range(nodes.shape[1]):
            for i in range(3):
                out[nodes[g, a], i] += forces[g, a, i]


@nb.njit(cache=True)
def scatter_matrices(data: FloatArray, positions: IntArray, matrices: FloatArray) -> None:
    """Add matrices ``(g, 3r, 3c)`` (node-major) into block data at ``positions (g, r, c)``."""
    for g in range(positions.shape[0]):
        for a in range(positions.shape[1]):
            for b in range(positions.shape[2]):
                block = data[positions[g, a, b]]
                for i in range(3):
                    for j in range(3):
                        block[i, j] += matrices[g, 3 * a + i, 3 * b + j]


@nb.njit(cache=True)
def scatter_blocks(
    data: FloatArray, positions: IntArray, weights: FloatArray, blocks: FloatArray
) -> None:
    """Add ``w_a w_b block`` for points ``(k, w)`` with one 3x3 block each into the data."""
    for k in range(positions.shape[0]):
        for a in range(positions.shape[1]):
            if weights[k, a] == 0.0:
                continue
            for b in range(positions.shape[2]):
                factor = weights[k, a] * weights[k, b]
                if factor == 0.0:
                    continue
                target = data[positions[k, a, b]]
                for i in range(3):
                    for j in range(3):
                        target[i, j] += factor * blocks[k, i, j]
