"""A valve closure computed with Abaqus: an input deck and its frames.

A folder ``NAME`` holds ``NAME.inp`` and ``NAME_0.vtu``, ``NAME_1.vtu``, ..., the positions of all
nodes at equal time intervals. Lengths are mm, stresses MPa, times s. Leaflets are shells, chordae
trusses; the caller names the sets of leaflets, annulus and free edge. The deck gives thickness,
chord materials and sections, the fixed chord nodes (papillary muscles), and the pressure. The
frames give the motion of annulus and papillary muscles.

One such case is Texas TriValve 1.1 (SoftTissueBiomechanicsLab/Texas_TriValve_1.1, CC BY 4.0;
Mathur et al. 2022, Engineering with Computers, doi 10.1007/s00366-022-01659-w), a human donor
**tricuspid** valve (three leaflets, right heart). It is not part of this package.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from mvest.errors import GeometryError, InputError
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.surfaces import read_mesh
from mvest.reading.text import named, one_line, refusing
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates
from mvest.valve.mesh.remesh import remesh

TOE_STRAIN = 0.01
"""Strain at which the secant stiffness of chordae is taken.

Chordae act as strings that hardly lengthen. Exponential chordae are far stiffer at several percent
strain, which no recorded closure reaches.
"""
TOLERANCE_MM = 1e-3
"""Frames are stored in single precision: 2e-6 mm at 30 mm."""
SAME_MM = 1e-6
"""Largest distance between coincident anchors."""
MAX_FRAMES = 500
EXTENT_MM = (5.0, 500.0)
"""Bounds of the leaflets' size, to detect lengths in cm or m."""
PRESSURE_MPA = (1e-4, 0.1)
"""1 to 750 mmHg."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A valve at rest and its recorded closure.

    ``valve`` is the fine midsurface in frame 0, with normals towards the ventricle, fibres parallel
    to the annulus, and the recorded motion. ``frames (f, n, 3)`` mm are the recorded positions of
    its vertices at ``times (f,)`` s, from 0 to the end of the step. ``pressure`` (MPa) acts on the
    ventricular face at the end, ``pressure_share (f,)`` is its fraction in each frame.
    """

    valve: Valve
    frames: FloatArray
    times: FloatArray
    pressure: float
    pressure_share: FloatArray

    def remeshed(self, count: int) -> tuple[IntArray, Valve]:
        """Vertices ``(count,)`` of the midsurface, and the valve remeshed on these alone."""
        fine = self.valve
        coarse = remesh(fine.surface, fine.annulus, fine.free_edge, count)
        on_annulus = np.isin(fine.annulus, coarse.kept)
        motion = replace(fine.motion, annulus=fine.motion.annulus[:, on_annulus])
        surface = {name: getattr(coarse, name) for name in ("surface", "annulus", "free_edge")}
        return coarse.kept, replace(fine, **surface, motion=motion)


def recording_files(folder: Path) -> list[Path]:
    """The deck of a folder, followed by its frames in order.

    InputError if the deck or a frame is missing.
    """
    deck = folder / f"{folder.name}.inp"
    if not deck.is_file():
        raise InputError(f"there is no file {deck}")
    form = re.compile(re.escape(folder.name) + r"_(\d{1,4})\.vtu", re.ASCII)
    frames = {int(m.group(1)): p for p in folder.iterdir() if (m := form.fullmatch(p.name))}
    if not 2 <= len(frames) <= MAX_FRAMES or sorted(frames) != list(range(len(frames))):
        raise InputError(
            f"{folder}: {len(frames)} frames {folder.name}_NUMBER.vtu, expected 2 to {MAX_FRAMES}, "
            "numbered from 0 without gaps"
        )
    return [deck, *(frames[k] for k in range(len(frames)))]


def read_recording(
    folder: Path, leaflets: Mapping[str, str], annulus: str, free_edge: str
) -> Recording:
    """Read a recorded closure. ``leaflets`` maps regions to element sets; the others are node sets.

    Names are case-insensitive and may include their instance.

    InputError if files are missing or damaged, or the deck has unsupported content or contradicts
    the frames.
    """
    path, *files = recording_files(folder)
    with refusing(path, "input deck"):
        deck = Deck(path)
        nodes, times = np.array(deck.nodes), np.linspace(0.0, deck.period, len(files))
        shells = [deck.members("ELSET", name) for name in leaflets.values()]
        pressure, share = _pressure(deck, np.concatenate(shells), times)
        surface, vertices, rims = _leaflets(deck, shells, annulus, free_edge, turned=pressure < 0)
        fibre = surface_coordinates(nodes[vertices], surface["triangles"], *rims).circumferential
        anchors, chordae = _chordae(deck, nodes, vertices)
    points = np.zeros((len(files), *nodes.shape))
    for file, frame in zip(files, points, strict=True):
        found = read_mesh(file).vertices
        if found.shape != nodes.shape:
            raise InputError(f"{file}: {len(found)} points, the deck has {len(nodes)} nodes")
        frame[:] = found
    if not np.abs(points[0] - nodes).max() <= TOLERANCE_MM:
        raise InputError(f"{files[0]}: points are not the nodes of the deck")
    # The motion starts from the nodes of the deck, which have double precision.
    ring, held = (nodes[k] + (points[:, k] - points[0, k]) for k in (vertices[rims[0]], anchors))
    with named(folder):
        tips, tip = _group_anchors(held)
    t = times / times[-1]
    valve = Valve(
        surface=LeafletSurface(
            nodes[vertices], fibre=fibre, region_names=tuple(leaflets), **surface
        ),
        annulus=rims[0],
        free_edge=rims[1],
        papillary_tips=tips[0],
        chordae=replace(chordae, tip=tip[chordae.tip]),
        motion=Motion(t**3 * (10 - 15 * t + 6 * t**2), ring, tips),
    )
    return Recording(valve, points[:, vertices], times, abs(pressure), share)


def _chordae(deck: Deck, nodes: FloatArray, leaflets: IntArray) -> tuple[IntArray, Chordae]:
    """The anchors, and the chordae, which use anchor numbers as tip numbers."""
    trusses = deck.trusses
    edges, section = np.array([deck.cells[k] for k in trusses]), deck.section[trusses]
    if not trusses.size or section.min() < 0:
        raise InputError("no chordae: expected elements of type T3D2, each in a section")
    anchors = np.intersect1d(np.setdiff1d(edges, leaflets), deck.held)
    if not anchors.size:
        raise InputError("no chord node is constrained, so the papillary muscles are unknown")
    anchor, insertion, length, share = trace_cables(nodes, edges, anchors, leaflets)
    # A cable's family is the section of the first truss at its insertion.
    ends, first = np.unique(edges, return_index=True)
    used, of_truss = np.unique(section, return_inverse=True)
    family = of_truss[first // 2][np.searchsorted(ends, insertion)]
    stiffness, materials = [], [deck.sections[k][1] for k in used]
    for k, material in zip(used, materials, strict=True):
        with named(f"trusses of {one_line(material, 40)}"):
            if material not in deck.ogden:
                raise InputError("expected *HYPERELASTIC, OGDEN")
            stiffness.append(truss_stiffness(deck.sections[k][2], deck.ogden[material]))
    return anchors, Chordae(
        tip=np.searchsorted(anchors, anchor),
        insertion=nodes[insertion],
        family=family,
        rest_length=length,
        axial_stiffness=np.array(stiffness)[family] * share,
        family_names=tuple(material.lower() for material in materials),
        toe_strain=TOE_STRAIN,
    )


def trace_cables(
    nodes: FloatArray, edges: IntArray, anchors: IntArray, leaflet: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Replace the chord network of a detailed model by straight tension-only cables.

    Detailed models store chordae as a graph: a trunk leaves a papillary anchor, splits, and fans
    out into many insertions. Each pair of anchor and insertion becomes a cable with

    * the rest length of the shortest path along the network, so that it tightens exactly when the
      path is straight;
    * a share of the trunk's axial stiffness. If all insertions of an anchor pull equally, the
      force in edge ``e`` is ``n_e`` times that at an insertion, where ``n_e`` counts the paths
      through ``e``. Insertion ``j`` then moves by ``sum_e n_e l_e / EA`` per unit force. So does a
      cable of rest length ``L_j`` and stiffness ``EA L_j / sum_e n_e l_e``.

    Unlike branches of one trunk, the cables do not restrain each other sideways.

    InputError or GeometryError if a segment has no length or reaches no anchor, or an anchor
    reaches no leaflet.

    Parameters
    ----------
    nodes : (n, 3) mm
    edges : (k, 2)
        Chord segments between nodes.
    anchors, leaflet : (a,), (l,)
        Nodes in the papillary muscles and of the leaflets. A path ends at the first leaflet node.

    Returns
    -------
    anchor, insertion, length, share : (c,)
        End nodes of each cable; length along the network (mm); axial stiffness of the cable
        relative to that of the chord material, in (0, 1].
    """
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    if np.any(length <= 0):
        raise InputError(f"chord segment {int(np.argmin(length))} has no length")
    on_leaflet = np.isin(np.arange(len(nodes)), leaflet)
    # No edges leave leaflet nodes: a path must not continue into another chord at its insertion.
    both = np.vstack([edges, edges[:, ::-1]])
    outward = ~on_leaflet[both[:, 0]]
    graph = csr_matrix(
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
        paths = []  # without the anchor; a node represents the segment that leads to it
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
    """Secant stiffness (N), force over strain, of an incompressible Ogden truss of ``area`` (mm^2).

    The nominal stress is ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))`` at stretch
    ``l = 1 + strain`` (Ogden 1972, Proc. R. Soc. A 326:565, in Abaqus' convention); ``ogden``
    ``(t, 2)`` has mu (MPa) and alpha of each term. Raises an InputError if the area or the stress
    is not positive.
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


def _pressure(deck: Deck, leaflets: IntArray, times: FloatArray) -> tuple[float, FloatArray]:
    """Final pressure (MPa) against the shells' normals, and its fraction at each time."""
    loaded = [load for load in deck.pressures if np.isin(load[0], leaflets).any()]
    covered = np.concatenate([np.zeros(0, np.int64), *(members for members, _, _ in loaded)])
    once = len(np.unique(covered)) == len(covered) and np.isin(leaflets, covered).all()
    if not once or len({load[1:] for load in loaded}) != 1:
        raise InputError("expected one pressure on all leaflets, once")
    _, value, amplitude = loaded[0]
    share = deck.share(amplitude, times)
    if share[0] != 0 or share[-1] == 0:
        raise InputError(
            f"the pressure's share runs from {share[0]:g} to {share[-1]:g}, expected from 0"
        )
    pressure = value * float(share[-1])
    if not PRESSURE_MPA[0] <= abs(pressure) <= PRESSURE_MPA[1]:
        raise InputError(
            f"pressure {pressure:g}, expected {PRESSURE_MPA[0]:g} to {PRESSURE_MPA[1]:g}: stresses "
            "must be MPa"
        )
    return pressure, share / share[-1]


def _leaflets(
    deck: Deck, groups: Sequence[IntArray], annulus: str, free_edge: str, *, turned: bool
) -> tuple[dict[str, Any], IntArray, list[IntArray]]:
    """The leaflets as triangles with the shells' normals, reversed if ``turned``.

    Returns ``triangles``, ``region`` and ``thickness``; the increasing numbers of their nodes; and
    the vertices of annulus and free edge in loop order.
    """
    elements = np.concatenate(groups)
    if not all(map(len, groups)) or np.isin(elements, deck.trusses).any():
        raise InputError("element sets of leaflets: expected shells, one or more in each")
    if len(np.unique(elements)) != len(elements):
        raise InputError("leaflets share elements")
    region = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    cells = np.array([deck.cells[k] for k in elements])
    vertices, corners = np.unique(cells, return_inverse=True)
    corners = corners.reshape(cells.shape)
    extent = float(np.ptp(np.array(deck.nodes)[vertices], axis=0).max())
    if not EXTENT_MM[0] <= extent <= EXTENT_MM[1]:
        raise InputError(
            f"the leaflets span {extent:g}, expected {EXTENT_MM[0]:g} to {EXTENT_MM[1]:g}: lengths "
            "must be mm"
        )
    on_rim = np.zeros(len(vertices), dtype=np.int64)
    wanted = []
    for number, name in enumerate((annulus, free_edge), 1):
        nodes = deck.members("NSET", name)
        if np.setdiff1d(nodes, vertices).size:
            raise InputError(f"node set {one_line(name, 60)!r}: a node is on no leaflet")
        wanted.append(np.searchsorted(vertices, nodes))
        on_rim[wanted[-1]] = number
    triangles, element = _split(np.array(deck.nodes)[vertices], corners, on_rim)
    if turned:
        triangles = triangles[:, [0, 2, 1]]
    loops = {frozenset(loop.tolist()): loop for loop in boundary_loops(triangles)}
    rims = [loops[rim] for rim in map(frozenset, map(np.ndarray.tolist, wanted)) if rim in loops]
    if len(loops) != 2 or len(rims) != 2:
        raise InputError(
            f"sets {one_line(annulus, 60)} and {one_line(free_edge, 60)}: expected the two "
            f"boundary loops of the leaflets, which have {len(loops)}"
        )
    sizes = np.array([*(size for _, _, size in deck.sections), 0.0])[deck.section[elements]]
    if not sizes.all():
        raise InputError("shells without a section that states a thickness")
    # Where two leaflets meet, the thicker one counts.
    thickness = np.zeros(len(vertices))
    np.maximum.at(thickness, corners.ravel(), np.repeat(sizes, 4))
    surface = {"triangles": triangles, "region": region[element], "thickness": thickness}
    return surface, vertices, rims


def _split(vertices: FloatArray, quads: IntArray, on_rim: IntArray) -> tuple[IntArray, IntArray]:
    """Split each quad along its shorter diagonal; also return the element of each triangle.

    A quad with two sides on one rim is cut from their common corner, so that no triangle has three
    corners on that rim.
    """
    first, second = (
        np.linalg.norm(vertices[quads[:, i + 2]] - vertices[quads[:, i]], axis=1) for i in (0, 1)
    )
    rim = on_rim[quads]
    ear = (rim > 0) & (rim == np.roll(rim, 1, axis=1)) & (rim == np.roll(rim, -1, axis=1))
    by_02 = np.where(ear.any(axis=1), ear[:, 0] | ear[:, 2], first <= second)[:, None]
    one = np.where(by_02, quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    two = np.where(by_02, quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    triangles = np.vstack([one, two])
    proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return triangles[proper], np.tile(np.arange(len(quads)), 2)[proper]


def _group_anchors(path: FloatArray) -> tuple[FloatArray, IntArray]:
    """Merge coincident anchors ``(f, a, 3)`` to ``(f, t, 3)``; also return the number of each."""
    near = np.linalg.norm(path[0][:, None] - path[0][None], axis=2) < SAME_MM
    count, group = connected_components(coo_matrix(near), directed=False)
    tips = np.stack([path[:, group == g].mean(axis=1) for g in range(count)], axis=1)
    if np.abs(tips[:, group] - path).max() > TOLERANCE_MM:
        raise InputError("chord anchors at one place move apart")
    return tips, group.astype(np.int64)
