"""The global sparsity pattern, and the assembly of element arrays into it.

All stiffness is added as dense blocks of node pairs: a group couples row nodes with column nodes,
and its tangent is ``(rows, columns, 3, 3)``. The pattern is one of nodes (3x3 blocks), so that
positions are looked up once and assembly is an indexed addition.

Tissue, chordae and contact have an energy and hence a symmetric tangent, of which the upper
triangle is stored. Follower pressure adds a skew part along the rim of the loaded surface, which
has blocks of its own.
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
from mvest.valve.mesh.solid_mesh import Embedding

Positions = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class SparsityPattern:
    """Positions of the blocks of a matrix: the upper triangle by rows, then the skew part."""

    #: ``(n + 1,)`` start of each row of the upper triangle, which begins with its diagonal block
    pointer: Positions
    columns: Positions  #: ``(u,)`` sorted in each row
    skew: IntArray  #: ``(s, 2)`` sorted rows and columns of the skew blocks, with row <= column

    @classmethod
    def of(cls, coupled: sparse.csr_matrix, skew: IntArray) -> SparsityPattern:
        """Pattern of a symmetric matrix ``coupled (n, n)`` with its full diagonal.

        ``skew (s, 2)`` are pairs of nodes with unsymmetric coupling, in any order.
        """
        upper = sparse.triu(coupled, format="csr")
        upper.sort_indices()
        pairs = np.unique(np.sort(skew.reshape(-1, 2), axis=1), axis=0)
        return cls(upper.indptr.astype(np.int32), upper.indices.astype(np.int32), pairs)

    def with_coupling(
        self, elements: IntArray, pairs: IntArray, around: tuple[IntArray, IntArray]
    ) -> SparsityPattern:
        """The pattern with all nodes of the element ``pairs (g, 2)`` coupled in addition.

        ``elements (e, k)`` have the nodes, and ``around`` is from `elements_of_nodes`.
        """
        if len(pairs) == 0:
            return self
        columns = np.empty(len(self.columns) + len(pairs) * elements.shape[1] ** 2, dtype=np.int32)
        pointer = _coupled(self.pointer, self.columns, elements, pairs, *around, columns)
        columns = columns[: pointer[-1]]
        stored = np.ones(len(columns), dtype=np.int8)
        rows = sparse.csr_matrix((stored, columns, pointer), shape=(self.n, self.n), copy=True)
        rows.sort_indices()
        return SparsityPattern(pointer, rows.indices, self.skew)

    @property
    def n(self) -> int:
        """Number of nodes."""
        return len(self.pointer) - 1

    @cached_property
    def rows(self) -> IntArray:
        """Row ``(u + s,)`` of each block."""
        upper = np.repeat(np.arange(self.n, dtype=np.int64), np.diff(self.pointer))
        return np.concatenate([upper, self.skew[:, 0]])

    @cached_property
    def all_columns(self) -> IntArray:
        """Column ``(u + s,)`` of each block."""
        return np.concatenate([self.columns, self.skew[:, 1]])

    def within(self, nodes: IntArray, others: IntArray | None = None) -> Positions:
        """Positions ``(g, k, k)`` of the blocks between the nodes ``(g, k)`` of each group.

        With ``others (g, m)`` the blocks ``(g, k, m)`` of these columns. -1 in the lower triangle.
        All blocks must be in the pattern.
        """
        return _within(self.pointer, self.columns, nodes, nodes if others is None else others)

    def between(self, first: IntArray, second: IntArray) -> Positions:
        """Positions ``(g, k, k)`` of the blocks that couple nodes ``(g, k)`` with others.

        A block of the lower triangle has the position of its mirror image. The diagonal block of a
        node, which is its own mirror image, has its position p as ``-1 - p``.
        """
        return _between(self.pointer, self.columns, first, second)

    def within_skew(self, nodes: IntArray) -> Positions:
        """Positions ``(g, k, k)`` in the skew part, -1 where it has no block."""
        n = self.n
        keys = self.skew[:, 0] * n + self.skew[:, 1]
        wanted = nodes[:, :, None] * n + nodes[:, None, :]
        at = np.searchsorted(keys, wanted)
        there = np.isin(wanted, keys)
        return np.where(there, len(self.columns) + at, -1).astype(np.int32)

    def zeros(self) -> FloatArray:
        """Block data ``(u + s, 3, 3)``."""
        return np.zeros((len(self.columns) + len(self.skew), 3, 3))

    def matrix(self, blocks: FloatArray) -> BlockMatrix:
        """The matrix ``(3n, 3n)`` that refers to the given block data."""
        return BlockMatrix(self, blocks)


@dataclass(frozen=True, eq=False)
class BlockMatrix:
    """A symmetric matrix of 3x3 blocks with a small skew part."""

    pattern: SparsityPattern
    #: ``(u + s, 3, 3)``; each stands for its mirror image as well: its transpose, or its negative
    #: transpose in the skew part
    blocks: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (3 * self.pattern.n, 3 * self.pattern.n)

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """The matrix times a vector ``(3n,)`` or some ``(3n, p)``."""
        if x.ndim == 2:
            return np.stack([self @ column for column in x.T], axis=1)
        pattern, x = self.pattern, np.ascontiguousarray(x)
        return _product(pattern.pointer, pattern.columns, pattern.skew, self.blocks, x)

    def tobsr(self) -> sparse.bsr_matrix:
        """The same as a SciPy matrix with all blocks."""
        rows, columns = self.pattern.rows, self.pattern.all_columns
        off = rows != columns
        sign = np.where(np.arange(len(rows)) < len(self.pattern.columns), 1.0, -1.0)[off]
        mirrored = sign[:, None, None] * self.blocks[off].transpose(0, 2, 1)
        every = np.concatenate([self.blocks, mirrored])
        at = (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]]))
        entry = np.arange(3)
        i = (3 * at[0][:, None, None] + entry[:, None]) + 0 * entry
        j = (3 * at[1][:, None, None] + entry) + 0 * entry[:, None]
        matrix = sparse.coo_matrix((every.ravel(), (i.ravel(), j.ravel())), shape=self.shape)
        return matrix.tobsr((3, 3))


def adjacency(n: int, groups: Sequence[IntArray]) -> sparse.csr_matrix:
    """Matrix ``(n, n)`` with the diagonal and all pairs of nodes in a group; groups ``(g, k)``."""
    total = sparse.identity(n, format="csr", dtype=np.int32)
    for nodes in groups:
        incidence = _incidence(n, nodes)
        total = total + incidence.T @ incidence
    return total.tocsr()


def elements_of_nodes(n: int, elements: IntArray) -> tuple[IntArray, IntArray]:
    """Start ``(n + 1,)`` of the elements of each of n nodes, and these elements."""
    around = _incidence(n, elements).tocsc()
    return around.indptr.astype(np.int64), around.indices.astype(np.int64)


def _incidence(n: int, nodes: IntArray) -> sparse.csr_matrix:
    """Incidence ``(g, n)`` of groups and nodes."""
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    ones = np.ones(nodes.size, dtype=np.int32)
    return sparse.csr_matrix((ones, (rows, nodes.ravel())), shape=(len(nodes), n))


@nb.njit(cache=True)
def _coupled(
    pointer: Positions,
    columns: Positions,
    elements: IntArray,
    pairs: IntArray,
    start: IntArray,
    around: IntArray,
    out: Positions,
) -> Positions:
    """Write the unsorted columns of each row with the coupled elements; return the pointer."""
    n = len(pointer) - 1
    first = np.zeros(len(elements) + 1, dtype=np.int64)
    for g in range(len(pairs)):
        for side in range(2):
            first[pairs[g, side] + 1] += 1
    first = np.cumsum(first)
    filled, partners = first.copy(), np.empty(2 * len(pairs), dtype=np.int64)
    for g in range(len(pairs)):
        for side in range(2):
            e = pairs[g, side]
            partners[filled[e]] = pairs[g, 1 - side]
            filled[e] += 1
    seen = np.full(n, -1, dtype=np.int32)
    ends = np.zeros(n + 1, dtype=np.int32)
    count = 0
    for row in range(n):
        for k in range(pointer[row], pointer[row + 1]):
            seen[columns[k]] = row
            out[count] = columns[k]
            count += 1
        for k in range(start[row], start[row + 1]):
            for p in range(first[around[k]], first[around[k] + 1]):
                for node in elements[partners[p]]:
                    if node > row and seen[node] != row:
                        seen[node] = row
                        out[count] = node
                        count += 1
        ends[row + 1] = count
    return ends


@nb.njit(cache=True)
def _find(pointer: Positions, columns: Positions, row: int, column: int) -> int:
    """Position of an entry of a matrix with sorted rows, by bisection."""
    low, high = pointer[row], pointer[row + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if columns[middle] <= column:
            low = middle
        else:
            high = middle
    return low


@nb.njit(cache=True)
def _within(pointer: Positions, columns: Positions, nodes: IntArray, others: IntArray) -> Positions:
    out = np.full((*nodes.shape, others.shape[1]), -1, dtype=np.int32)
    for e in range(out.shape[0]):
        for a in range(out.shape[1]):
            for b in range(out.shape[2]):
                if nodes[e, a] <= others[e, b]:
                    out[e, a, b] = _find(pointer, columns, nodes[e, a], others[e, b])
    return out


@nb.njit(cache=True)
def _between(
    pointer: Positions, columns: Positions, first: IntArray, second: IntArray
) -> Positions:
    out = np.empty((len(first), first.shape[1], second.shape[1]), dtype=np.int32)
    for g in range(len(first)):
        for a in range(first.shape[1]):
            for b in range(second.shape[1]):
                i, j = first[g, a], second[g, b]
                at = _find(pointer, columns, min(i, j), max(i, j))
                out[g, a, b] = -1 - at if i == j else at
    return out


@nb.njit(cache=True)
def _product(
    pointer: Positions, columns: Positions, skew: IntArray, blocks: FloatArray, x: FloatArray
) -> FloatArray:
    out = np.zeros_like(x)
    for row in range(len(pointer) - 1):
        r = 3 * row
        x0, x1, x2 = x[r], x[r + 1], x[r + 2]
        diagonal = blocks[pointer[row]]
        y0 = diagonal[0, 0] * x0 + diagonal[0, 1] * x1 + diagonal[0, 2] * x2
        y1 = diagonal[1, 0] * x0 + diagonal[1, 1] * x1 + diagonal[1, 2] * x2
        y2 = diagonal[2, 0] * x0 + diagonal[2, 1] * x1 + diagonal[2, 2] * x2
        for k in range(pointer[row] + 1, pointer[row + 1]):
            block, c = blocks[k], 3 * columns[k]
            z0, z1, z2 = x[c], x[c + 1], x[c + 2]
            y0 += block[0, 0] * z0 + block[0, 1] * z1 + block[0, 2] * z2
            y1 += block[1, 0] * z0 + block[1, 1] * z1 + block[1, 2] * z2
            y2 += block[2, 0] * z0 + block[2, 1] * z1 + block[2, 2] * z2
            out[c] += block[0, 0] * x0 + block[1, 0] * x1 + block[2, 0] * x2
            out[c + 1] += block[0, 1] * x0 + block[1, 1] * x1 + block[2, 1] * x2
            out[c + 2] += block[0, 2] * x0 + block[1, 2] * x1 + block[2, 2] * x2
        out[r] += y0
        out[r + 1] += y1
        out[r + 2] += y2
    for s in range(len(skew)):
        block, r, c = blocks[len(columns) + s], 3 * skew[s, 0], 3 * skew[s, 1]
        for i in range(3):
            for j in range(3):
                out[r + i] += block[i, j] * x[c + j]
                if r != c:
                    out[c + j] -= block[i, j] * x[r + i]
    return out


@nb.njit(cache=True)
def add_forces(out: FloatArray, nodes: IntArray, forces: FloatArray) -> None:
    """Add group forces ``(g, k, 3)`` on ``nodes (g, k)`` into ``out (n, 3)``."""
    for g in range(nodes.shape[0]):
        for a in range(nodes.shape[1]):
            for i in range(3):
                out[nodes[g, a], i] += forces[g, a, i]


def add_forces_at(out: FloatArray, points: Embedding, force: FloatArray) -> None:
    """Add forces ``(k, 3)`` N at embedded points to the nodal forces ``out (n, 3)``."""
    add_forces(out, points.nodes, points.weights[:, :, None] * force[:, None, :])


@nb.njit(cache=True)
def scatter_blocks(
    data: FloatArray,
    positions: Positions,
    rows: FloatArray,
    columns: FloatArray,
    blocks: FloatArray,
) -> None:
    """Add ``w_a v_b block`` to the data, for weights w in ``rows (g, k)`` and v in ``columns``.

    Blocks ``(g, 3, 3)`` couple two points each. Those of a symmetric matrix come in both orders,
    of which the upper triangle is stored, or couple a point with itself.
    """
    for k in range(positions.shape[0]):
        for a in range(positions.shape[1]):
            if rows[k, a] == 0.0:
                continue
            for b in range(positions.shape[2]):
                factor = rows[k, a] * columns[k, b]
                if factor == 0.0 or positions[k, a, b] < 0:
                    continue
                target = data[positions[k, a, b]]
                for i in range(3):
                    for j in range(3):
                        target[i, j] += factor * blocks[k, i, j]
