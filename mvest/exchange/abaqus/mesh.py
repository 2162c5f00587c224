"""The leaflets of a deck as one band of triangles with two rims, its chordae as straight cables.

Detailed valve models hold chordae as a graph: a trunk leaves a papillary anchor, splits, and fans
out into many insertions. The mechanics here knows one straight tension-only cable per (anchor,
insertion). Two quantities carry over exactly and one is shared out:

* the **rest length** is the length of the shortest path along the network, so that a cable tightens
  exactly when its path is drawn straight;
* the **insertion** is the network's end on the leaflet;
* the **axial stiffness** shares each trunk among the insertions beyond it. If the insertions of one
  anchor pull equally hard, the force in network edge ``e`` is ``n_e`` times that at an insertion,
  where ``n_e`` counts the insertions whose path contains ``e``. Insertion ``j`` then gives by
  ``sum_e n_e l_e / EA`` per unit force, and a cable of rest length ``L_j`` that gives as much has
  the stiffness ``EA L_j / sum_e n_e l_e``.

What is lost: a trunk can only point in one direction, so branches of one trunk restrain each other
sideways; straight cables do not.

The axial stiffness of a truss follows from the material that the deck states for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from mvest.errors import GeometryError, InputError
from mvest.exchange.abaqus.deck import SHELLS, Block, Deck, ElementSection
from mvest.reading.text import one_line
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import boundary_loops


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


@dataclass(frozen=True, slots=True, eq=False)
class ChordPaths:
    """Straight cables that stand for a network.

    Attributes
    ----------
    anchor, insertion : ndarray
        ``(c,)`` node indices.
    length : ndarray
        ``(c,)`` mm along the network.
    stiffness_share : ndarray
        ``(c,)`` in (0, 1]: axial stiffness of the cable over that of the chord material.
    """

    anchor: IntArray
    insertion: IntArray
    length: FloatArray
    stiffness_share: FloatArray

    def __len__(self) -> int:
        return len(self.anchor)


def trace_cables(
    nodes: FloatArray, edges: IntArray, anchors: IntArray, leaflet: IntArray
) -> ChordPaths:
    """Trace every path of a chord network from an anchor to the leaflet.

    Parameters
    ----------
    nodes : ndarray
        ``(n, 3)`` mm.
    edges : ndarray
        ``(k, 2)`` chord segments between nodes.
    anchors : ndarray
        Nodes fixed in the papillary muscles.
    leaflet : ndarray
        Nodes of the leaflets. A path ends at the first one it meets.

    Raises
    ------
    InputError
        If indices are out of range or a segment has no length.
    GeometryError
        If a chord segment reaches no anchor or an anchor reaches no leaflet.
    """
    nodes = np.asarray(nodes, dtype=float)
    edges, anchors = np.asarray(edges), np.asarray(anchors)
    n = len(nodes)
    for name, index in (("edges", edges), ("anchors", anchors), ("leaflet", np.asarray(leaflet))):
        if index.size and not (index.min() >= 0 and index.max() < n):
            raise InputError(f"chord network: {name} refer to nodes outside 0 to {n - 1}")
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    if np.any(length <= 0):
        raise InputError(f"chord segment {int(np.argmin(length))} has no length")
    on_leaflet = np.zeros(n, dtype=bool)
    on_leaflet[leaflet] = True

    # Edges out of leaflet nodes are left out: two chords that insert at one node do not continue.
    both = np.vstack([edges, edges[:, ::-1]])
    outward = ~on_leaflet[both[:, 0]]
    graph = sp.csr_matrix(
        (np.concatenate([length, length])[outward], (both[outward, 0], both[outward, 1])),
        shape=(n, n),
    )
    distance, predecessor = dijkstra(graph, indices=anchors, return_predecessors=True)
    reached: NDArray[np.bool_] = np.asarray(np.isfinite(distance).any(axis=0))
    loose = np.flatnonzero(~reached[edges].all(axis=1))
    if loose.size:
        raise GeometryError(
            f"{loose.size} chord segments are connected to no anchor (first: {loose[:5].tolist()})"
        )
    ends = np.unique(edges[on_leaflet[edges]])
    reachable = np.isfinite(distance[:, ends])
    ending = reachable.any(axis=1)
    if not ending.all():
        raise GeometryError(
            f"chord anchor at node {int(anchors[np.argmin(ending)])} reaches no leaflet"
        )
    anchor_index, end_index = np.nonzero(reachable)
    share = np.concatenate(
        [
            _stiffness_shares(distance[i], predecessor[i], ends[reachable[i]])
            for i in range(len(anchors))
        ]
    )
    return ChordPaths(
        anchor=anchors[anchor_index],
        insertion=ends[end_index],
        length=distance[anchor_index, ends[end_index]],
        stiffness_share=share,
    )


def _stiffness_shares(distance: FloatArray, predecessor: IntArray, ends: IntArray) -> FloatArray:
    """``L_j / sum_e n_e l_e`` for the insertions of one anchor."""
    paths = []
    users: dict[int, int] = {}
    for end in ends.tolist():
        path = [end]
        while predecessor[path[-1]] >= 0:
            path.append(int(predecessor[path[-1]]))
        path.pop()  # the anchor itself; the others name the segment that leads to them
        for node in path:
            users[node] = users.get(node, 0) + 1
        paths.append(path)
    give = [
        sum(users[node] * (distance[node] - distance[predecessor[node]]) for node in path)
        for path in paths
    ]
    return distance[ends] / np.array(give)


MAX_STRAIN = 0.1
"""Of a linearisation: chordae tear beyond."""


def truss_stiffness(
    section: ElementSection, materials: Mapping[str, Mapping[str, Block]], strain: float
) -> float:
    """Secant stiffness (N for mm and MPa) of a truss: force over ``strain``.

    Raises
    ------
    InputError
        If the section has no area, or its material no law that is read.
    """
    if section.size is None:
        raise InputError(f"trusses of {one_line(section.material, 40)} have no cross section")
    return section.size * secant_modulus(materials.get(section.material, {}), strain)


def secant_modulus(material: Mapping[str, Block], strain: float) -> float:
    """Nominal stress over ``strain`` of a bar under tension.

    Linear elastic, or incompressible Ogden with the nominal stress
    ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))`` at stretch ``l = 1 + strain`` (Ogden 1972,
    Proc. R. Soc. A 326:565, in Abaqus' convention).

    Raises
    ------
    InputError
        If it is neither, or the strain is not between 0 and 0.1.
    """
    if not 0 < strain < MAX_STRAIN:
        raise InputError(f"linearisation strain {strain}, expected between 0 and {MAX_STRAIN}")
    if "ELASTIC" in material:
        linear = material["ELASTIC"]
        isotropic = linear.options.get("TYPE", "ISOTROPIC").upper() in ("ISO", "ISOTROPIC")
        values = linear.checked(linear.words)
        if not isotropic or len(values) < 1 or not values[0] > 0:
            raise InputError(f"{linear}: expected isotropic, with a modulus > 0")
        return float(values[0])
    block = material.get("HYPERELASTIC")
    if block is None or "OGDEN" not in block.options:
        what = "no elastic material" if block is None else str(block)
        raise InputError(f"trusses: {what}, expected *ELASTIC or *HYPERELASTIC, OGDEN")
    terms = block.options.get("N", "1")
    values = block.checked(block.words)
    count = int(terms) if terms in "123456" and len(terms) == 1 else 0
    if not count or len(values) < 2 * count or not all(values[1 : 2 * count : 2]):
        raise InputError(f"{block}: N = {one_line(terms, 20)}, expected 1 to 6 pairs mu, alpha")
    stretch = 1 + strain
    stress = sum(
        2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
        for mu, alpha in values[: 2 * count].reshape(-1, 2)
    )
    if not 0 < stress < float("inf"):
        raise InputError(f"{block}: nominal stress {stress:g} at {strain:g}, expected > 0")
    return float(stress / strain)
