"""The leaflets of a deck as one band of triangles with two rims."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.reading.text import one_line
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops
from mvest.valve.io.abaqus.deck import SHELLS, Deck


@dataclass(frozen=True, slots=True)
class SetNames:
    """Names of a deck's sets, with or without their instance; case does not matter.

    Attributes
    ----------
    leaflets : mapping
        Region -> element set.
    annulus, free_edge : str
        Node sets.
    """

    leaflets: Mapping[str, str]
    annulus: str
    free_edge: str

    def __post_init__(self) -> None:
        words = [*self.leaflets, *self.leaflets.values(), self.annulus, self.free_edge]
        if not self.leaflets or not all(isinstance(word, str) and word for word in words):
            raise InputError("names of sets: expected leaflets, annulus and free_edge, none empty")


@dataclass(frozen=True, slots=True, eq=False)
class LeafletMesh:
    """Leaflets as triangles.

    Attributes
    ----------
    nodes : ndarray
        ``(n,)`` numbers of the vertices in the deck, increasing.
    vertices : ndarray
        ``(n, 3)`` mm.
    triangles, region : ndarray
        ``(m, 3)`` vertices, and ``(m,)`` the number of the leaflet.
    thickness : ndarray
        ``(n,)`` mm; the mean of the leaflets where several meet.
    annulus, free_edge : ndarray
        Vertices in loop order.
    """

    nodes: IntArray
    vertices: FloatArray
    triangles: IntArray
    region: IntArray
    thickness: FloatArray
    annulus: IntArray
    free_edge: IntArray


def shell_numbers(deck: Deck, names: SetNames) -> list[IntArray]:
    """Numbers of the elements of each leaflet.

    Raises
    ------
    InputError
        If a set is missing, empty, or holds others than shells, or leaflets share elements.
    """
    shells = [e.first + np.arange(len(e.nodes)) for e in deck.elements if e.kind in SHELLS]
    known = np.concatenate([np.zeros(0, np.int64), *shells])
    result = [deck.element_set(name) for name in names.leaflets.values()]
    for name, numbers in zip(names.leaflets.values(), result, strict=True):
        if not numbers.size or np.setdiff1d(numbers, known).size:
            raise InputError(f"element set {one_line(name, 60)!r}: expected shells, one or more")
    together = np.concatenate(result)
    if len(np.unique(together)) != len(together):
        raise InputError("leaflets share elements")
    return result


def leaflet_mesh(deck: Deck, names: SetNames, *, turned: bool) -> LeafletMesh:
    """The leaflets as triangles, whose normals are the shells' or, if ``turned``, against them.

    Raises
    ------
    InputError
        If sets are missing, sections state no thickness, or annulus and free edge are not the two
        boundary loops.
    """
    groups = shell_numbers(deck, names)
    elements = np.concatenate(groups)
    region = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    nodes, corners = np.unique(_corners(deck)[elements], return_inverse=True)
    corners = corners.reshape(len(elements), 4)
    if nodes[0] < 0:
        # The fourth corner of a triangle.
        nodes, corners = nodes[1:], corners - 1
    vertices = deck.nodes[nodes]
    rims = [_vertices(deck, nodes, name) for name in (names.annulus, names.free_edge)]
    on_rim = np.zeros(len(nodes), dtype=np.int64)
    on_rim[rims[0]], on_rim[rims[1]] = 1, 2
    triangles, element = _split(vertices, corners, on_rim)
    if turned:
        triangles = triangles[:, [0, 2, 1]]
    loops = {frozenset(loop.tolist()): loop for loop in boundary_loops(triangles)}
    wanted = [frozenset(rim.tolist()) for rim in rims]
    if len(loops) != 2 or any(rim not in loops for rim in wanted):
        raise InputError(
            f"sets {one_line(names.annulus, 60)} and {one_line(names.free_edge, 60)}: expected the "
            f"two boundary loops of the leaflets, which have {len(loops)}"
        )
    return LeafletMesh(
        nodes,
        vertices,
        triangles,
        region[element],
        _thickness(deck, elements, corners, len(nodes)),
        *(loops[rim] for rim in wanted),
    )


def _corners(deck: Deck) -> IntArray:
    """Nodes ``(n_elements, 4)`` of shells; -1 where there is none."""
    table = np.full((sum(len(block.nodes) for block in deck.elements), 4), -1)
    for block in deck.elements:
        if block.kind in SHELLS:
            count, width = block.nodes.shape
            table[block.first : block.first + count, :width] = block.nodes
    return table


def _vertices(deck: Deck, nodes: IntArray, name: str) -> IntArray:
    """Vertices of a node set."""
    numbers = deck.node_set(name)
    if np.setdiff1d(numbers, nodes).size:
        raise InputError(f"node set {one_line(name, 60)!r}: a node is on no leaflet")
    return np.searchsorted(nodes, numbers)


def _thickness(deck: Deck, elements: IntArray, corners: IntArray, count: int) -> FloatArray:
    """Thickness ``(n,)`` of each vertex: the largest of its elements."""
    sizes = np.full(int(elements.max()) + 1, np.nan)
    for section in deck.sections:
        inside = section.elements[section.elements < len(sizes)]
        sizes[inside] = np.nan if section.size is None else section.size
    if np.isnan(sizes[elements]).any():
        raise InputError("shells without a section that states a thickness")
    result = np.zeros(count + 1)
    np.maximum.at(result, corners.ravel(), np.repeat(sizes[elements], 4))
    return result[:count]


def _split(vertices: FloatArray, corners: IntArray, on_rim: IntArray) -> tuple[IntArray, IntArray]:
    """Two triangles per quad along the shorter diagonal, and the element of each triangle.

    A quad with two sides on one rim is cut from their common corner, so that no triangle has all
    three corners on that rim. Triangles come last, as they are.
    """
    whole = np.flatnonzero(corners[:, 3] >= 0)
    rest = np.flatnonzero(corners[:, 3] < 0)
    quads = corners[whole]
    corner = vertices[quads]
    first = np.linalg.norm(corner[:, 2] - corner[:, 0], axis=1)
    second = np.linalg.norm(corner[:, 3] - corner[:, 1], axis=1)
    rim = on_rim[quads]
    ear = np.stack(
        [
            (rim[:, i] > 0) & (rim[:, i] == rim[:, i - 1]) & (rim[:, i] == rim[:, (i + 1) % 4])
            for i in range(4)
        ],
        axis=1,
    )
    by_02 = np.where(ear.any(axis=1), ear[:, 0] | ear[:, 2], first <= second)
    one = np.where(by_02[:, None], quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    two = np.where(by_02[:, None], quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    triangles = np.vstack([one, two, corners[rest, :3]])
    return triangles, np.concatenate([whole, whole, rest])
