"""The chord network of a detailed model as straight cables.

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
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray

TOE_STRAIN = 0.01
"""Where the secant stiffness of chordae is taken, up to which it rises.

Chordae act as strings that hardly lengthen; the far higher stiffness of exponential ones at several
percent would describe a state that no recorded closure reaches.
"""


def trace_cables(
    nodes: FloatArray, edges: IntArray, anchors: IntArray, leaflet: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
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

    Returns
    -------
    anchor, insertion : ndarray
        ``(c,)`` nodes at the ends of each straight cable.
    length : ndarray
        ``(c,)`` mm along the network.
    share : ndarray
        ``(c,)`` in (0, 1]: axial stiffness of the cable over that of the chord material.

    Raises
    ------
    InputError, GeometryError
        If a segment has no length or reaches no anchor, or an anchor reaches no leaflet.
    """
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    if np.any(length <= 0):
        raise InputError(f"chord segment {int(np.argmin(length))} has no length")
    on_leaflet = np.isin(np.arange(len(nodes)), leaflet)
    # Edges out of leaflet nodes are left out: two chords that insert at one node do not continue.
    both = np.vstack([edges, edges[:, ::-1]])
    outward = ~on_leaflet[both[:, 0]]
    graph = sp.csr_matrix(
        (np.tile(length, 2)[outward], (both[outward, 0], both[outward, 1])),
        shape=(len(nodes), len(nodes)),
    )
    distance, predecessor = dijkstra(graph, indices=anchors, return_predecessors=True)
    reached = np.asarray(np.isfinite(distance).any(axis=0))
    loose = np.flatnonzero(~reached[edges].all(axis=1))
    if loose.size:
        raise GeometryError(
            f"{loose.size} chord segments are connected to no anchor (first: {loose[:5].tolist()})"
        )
    ends = np.unique(edges[on_leaflet[edges]])
    reachable = np.isfinite(distance[:, ends])
    if not reachable.any(axis=1).all():
        alone = int(anchors[np.argmin(reachable.any(axis=1))])
        raise GeometryError(f"chord anchor at node {alone} reaches no leaflet")
    anchor_index, end_index = np.nonzero(reachable)
    shares = [
        _stiffness_shares(distance[i], predecessor[i], ends[reachable[i]])
        for i in range(len(anchors))
    ]
    reach = distance[anchor_index, ends[end_index]]
    return anchors[anchor_index], ends[end_index], reach, np.concatenate(shares)


def _stiffness_shares(distance: FloatArray, predecessor: IntArray, ends: IntArray) -> FloatArray:
    """``L_j / sum_e n_e l_e`` for the insertions of one anchor."""
    paths = []
    for end in ends.tolist():
        path = [end]
        while predecessor[path[-1]] >= 0:
            path.append(int(predecessor[path[-1]]))
        paths.append(path[:-1])  # without the anchor; a node names the segment that leads to it
    users = Counter(node for path in paths for node in path)
    give = [
        sum(users[node] * (distance[node] - distance[predecessor[node]]) for node in path)
        for path in paths
    ]
    return np.asarray(distance[ends] / np.array(give))


def truss_stiffness(area: float, ogden: FloatArray, strain: float = TOE_STRAIN) -> float:
    """Secant stiffness (N for mm and MPa) of an incompressible Ogden truss: force over ``strain``.

    The nominal stress is ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))`` at stretch
    ``l = 1 + strain`` (Ogden 1972, Proc. R. Soc. A 326:565, in Abaqus' convention).

    Parameters
    ----------
    area : float
        mm^2.
    ogden : ndarray
        ``(t, 2)`` mu (MPa) and alpha of each term.
    strain : float

    Raises
    ------
    InputError
        If area or stress is not positive.
    """
    mu, alpha = ogden.T
    stretch = 1 + strain
    with np.errstate(all="ignore"):
        terms = stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1)
        stress = sum(2 * mu / alpha * terms)
    if not 0 < area * stress < float("inf"):
        raise InputError(
            f"{area:g} mm2 and {stress:g} MPa at a strain of {strain:g}, expected a cross section "
            "and a stress > 0"
        )
    return float(area * (stress / strain))
