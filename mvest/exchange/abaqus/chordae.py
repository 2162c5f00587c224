"""The chord network of a detailed model as straight cables.

Detailed models hold chordae as a graph: a trunk leaves a papillary anchor, splits, and fans out
into many insertions. The mechanics here has one straight tension-only cable per pair of anchor and
insertion. Each cable has

* the **rest length** of the shortest path along the network, so that it tightens exactly when the
  path is straight;
* the **insertion** where the path meets the leaflet;
* a share of the **axial stiffness** of the trunk. If all insertions of an anchor pull equally, the
  force in edge ``e`` is ``n_e`` times that at an insertion, where ``n_e`` counts the paths through
  ``e``. Insertion ``j`` then yields by ``sum_e n_e l_e / EA`` per unit force, as does a cable of
  rest length ``L_j`` and stiffness ``EA L_j / sum_e n_e l_e``.

Lost is that branches of one trunk restrain each other sideways.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray

TOE_STRAIN = 0.01
"""Strain of the secant stiffness of chordae.

Chordae act as strings that hardly lengthen. The far higher stiffness of exponential ones at several
percent would describe a state that no recorded closure reaches.
"""


def trace_cables(
    nodes: FloatArray, edges: IntArray, anchors: IntArray, leaflet: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Trace every path of a chord network from an anchor to the leaflet.

    Parameters
    ----------
    nodes : (n, 3) ndarray
        mm.
    edges : (k, 2) ndarray
        Chord segments between nodes.
    anchors : ndarray
        Nodes in the papillary muscles.
    leaflet : ndarray
        Nodes of the leaflets. A path ends at the first one.

    Returns
    -------
    anchor, insertion : (c,) ndarray
        Nodes at the ends of each cable.
    length : (c,) ndarray
        mm along the network.
    share : (c,) ndarray
        Axial stiffness of the cable over that of the chord material, in (0, 1].

    Raises
    ------
    InputError, GeometryError
        A segment has no length or reaches no anchor, or an anchor reaches no leaflet.
    """
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    if np.any(length <= 0):
        raise InputError(f"chord segment {int(np.argmin(length))} has no length")
    on_leaflet = np.isin(np.arange(len(nodes)), leaflet)
    # No edges out of leaflet nodes: two chords that insert at one node do not continue.
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
    shares = []
    for far, back, there in zip(distance, predecessor, reachable, strict=True):
        own = ends[there].tolist()
        paths = []  # without the anchor; a node stands for the segment that leads to it
        for end in own:
            path = [end]
            while back[path[-1]] >= 0:
                path.append(int(back[path[-1]]))
            paths.append(path[:-1])
        users = Counter(node for path in paths for node in path)
        shares += [
            far[end] / sum(users[node] * (far[node] - far[back[node]]) for node in path)
            for end, path in zip(own, paths, strict=True)
        ]
    reach = distance[anchor_index, ends[end_index]]
    return anchors[anchor_index], ends[end_index], reach, np.array(shares)


def truss_stiffness(area: float, ogden: FloatArray, strain: float = TOE_STRAIN) -> float:
    """Secant stiffness (N for mm and MPa) of an incompressible Ogden truss: force over ``strain``.

    The nominal stress is ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))`` at stretch
    ``l = 1 + strain`` (Ogden 1972, Proc. R. Soc. A 326:565, in Abaqus' convention).

    Parameters
    ----------
    area : float
        mm^2.
    ogden : (t, 2) ndarray
        mu (MPa) and alpha of each term.
    strain : float

    Raises
    ------
    InputError
        The area or the stress is not positive.
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
