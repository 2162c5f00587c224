"""A closure of a valve as it was computed with Abaqus: its input deck and the frames beside it.

A folder ``NAME`` holds ``NAME.inp`` and ``NAME_0.vtu``, ``NAME_1.vtu``, ..., the positions of all
nodes of the deck at equal intervals of its step. Lengths are mm, stresses MPa, times s. Leaflets
are shells, chordae trusses; which sets are leaflets, annulus and free edge is given by their names.
The deck states thickness, chord materials and sections, which chord nodes are held (the papillary
muscles), and the pressure. The frames state how annulus and papillary muscles move.

Such a case is the Texas TriValve 1.1 (SoftTissueBiomechanicsLab/Texas_TriValve_1.1, CC BY 4.0;
Mathur et al. 2022, Engineering with Computers, doi 10.1007/s00366-022-01659-w), a human donor
**tricuspid** valve (three leaflets, right heart). It is not part of this package.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mvest.errors import InputError
from mvest.exchange.abaqus.chordae import TOE_STRAIN, trace_cables, truss_stiffness
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.child import in_child
from mvest.exchange.surfaces import read_mesh
from mvest.reading.text import named, one_line
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates
from mvest.valve.mesh.remesh import Remeshed, remesh

TOLERANCE_MM = 1e-3
"""Frames are stored in single precision, whose rounding at 30 mm is 2e-6 mm."""
SAME_MM = 1e-6
"""Between anchors at one place."""
MAX_FRAMES = 500
EXTENT_MM = (5.0, 500.0)
"""Of the leaflets: a valve in cm or m is not taken for one in mm."""
PRESSURE_MPA = (1e-4, 0.1)
"""1 to 750 mmHg."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A valve at rest and as it was recorded closing.

    Attributes
    ----------
    valve : Valve
        On its fine midsurface in frame 0, normals to the ventricle, fibres parallel to the annulus.
        Its motion is that of the frames.
    frames : ndarray
        ``(f, n, 3)`` mm, recorded positions of the vertices.
    times : ndarray
        ``(f,)`` s, from 0 to the end of the step.
    pressure : float
        MPa on the ventricular face at the end.
    pressure_share : ndarray
        ``(f,)`` share of the pressure.
    """

    valve: Valve
    frames: FloatArray
    times: FloatArray
    pressure: float
    pressure_share: FloatArray

    def positions(self, triangle: IntArray, weights: FloatArray, frame: int) -> FloatArray:
        """Recorded positions ``(k, 3)`` mm in one frame of material points of the midsurface.

        Parameters
        ----------
        triangle, weights : ndarray
            ``(k,)`` and ``(k, 3)``: triangles and barycentric weights, as those of
            :class:`mvest.valve.mesh.remesh.Remeshed`.
        frame : int
            0 is the reference; -1 the last, closed one.
        """
        corner = self.frames[frame][self.valve.surface.triangles[triangle]]
        return np.einsum("ij,ijk->ik", weights, corner)

    def remeshed(self, count: int) -> tuple[Remeshed, Valve]:
        """The midsurface with so many vertices, and the valve on it."""
        fine = self.valve
        coarse = remesh(fine.surface, fine.annulus, fine.free_edge, count)
        own = coarse.annulus
        step = np.zeros((len(self.times), *fine.surface.vertices.shape))
        step[:, fine.annulus] = fine.motion.annulus - fine.surface.vertices[fine.annulus]
        corners = step[:, fine.surface.triangles[coarse.triangle[own]]]
        moved = np.einsum("ij,fijk->fik", coarse.weights[own], corners)
        motion = replace(fine.motion, annulus=coarse.surface.vertices[own] + moved)
        surface = {name: getattr(coarse, name) for name in ("surface", "annulus", "free_edge")}
        return coarse, replace(fine, **surface, motion=motion)


def recording_files(folder: Path) -> list[Path]:
    """The deck of a folder and its frames in their order.

    Raises
    ------
    InputError
        If there is no deck, or frames are missing.
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
    folder: Path,
    leaflets: Mapping[str, str],
    annulus: str,
    free_edge: str,
) -> Recording:
    """Read a recorded closure.

    Parameters
    ----------
    folder : Path
    leaflets : mapping
        Region -> element set. Names of sets are given with or without their instance, in any case.
    annulus, free_edge : str
        Node sets.

    Raises
    ------
    InputError
        If files are absent or damaged, the deck states what is not read, or frames and deck
        contradict each other.
    """
    path, *files = recording_files(folder)
    sets = [list(leaflets.values()), annulus, free_edge]
    found = in_child(recorded, path, *sets, len(files), seconds=600.0)
    rest, vertices = found["nodes"], found["vertices"]
    frames, held_path = [], []
    for k, file in enumerate(files):
        points = read_mesh(file).vertices
        if points.shape != rest.shape:
            raise InputError(f"{file}: {len(points)} points, the deck has {len(rest)} nodes")
        if k == 0 and not np.abs(points - rest).max() <= TOLERANCE_MM:
            raise InputError(f"{file}: points are not the nodes of the deck")
        frames.append(points[vertices])
        held_path.append(points[found["held"]])
    # Frames are stored in single precision, the motion begins at the nodes of the deck.
    path_of_held = rest[found["held"]] + (np.array(held_path) - held_path[0])
    ring, times = len(found["annulus"]), found["times"]
    with named(folder):
        tips, tip = _group_anchors(path_of_held[:, ring:])
    t = times / times[-1]
    valve = Valve(
        surface=LeafletSurface(**found["surface"], region_names=tuple(leaflets)),
        annulus=found["annulus"],
        free_edge=found["free_edge"],
        papillary_tips=tips[0],
        chordae=Chordae(
            **found["chordae"],
            tip=tip[found["anchor"]],
            family_names=tuple(found["family_names"]),
            toe_strain=TOE_STRAIN,
        ),
        # The phase is that by which a closure is paced.
        motion=Motion(t**3 * (10 - 15 * t + 6 * t**2), path_of_held[:, :ring], tips),
    )
    return Recording(valve, np.array(frames), times, found["pressure"], found["pressure_share"])


def recorded(
    path: Path,
    leaflets: Sequence[str],
    annulus: str,
    free_edge: str,
    count: int,
) -> dict[str, Any]:
    """Read what a deck states of a recording of ``count`` frames; runs in the child process.

    Returns
    -------
    dict
        Parts of the valve, and its pressure. ``vertices`` are numbers of ``nodes``; ``held`` are
        the nodes of the annulus, then the anchors of the chordae; ``anchor`` is the number of the
        anchor of each chord.
    """
    deck = Deck(path)
    nodes, times = np.array(deck.nodes), np.linspace(0.0, deck.period, count)
    groups = [deck.members("ELSET", name) for name in leaflets]
    elements = np.concatenate(groups)
    if not all(map(len, groups)) or np.isin(elements, deck.trusses).any():
        listed = one_line(", ".join(leaflets), 160)
        raise InputError(f"element sets {listed}: expected shells, one or more in each")
    if len(np.unique(elements)) != len(elements):
        raise InputError("leaflets share elements")
    pressure, share = _pressure(deck, elements, times)
    surface, vertices, rims = _leaflets(deck, groups, annulus, free_edge, turned=pressure < 0)
    at_rest = nodes[vertices]
    extent = float(np.ptp(at_rest, axis=0).max())
    if not EXTENT_MM[0] <= extent <= EXTENT_MM[1]:
        raise InputError(
            f"the leaflets span {extent:g}, expected {EXTENT_MM[0]:g} to {EXTENT_MM[1]:g}: lengths "
            "must be mm"
        )
    fibre = surface_coordinates(at_rest, surface["triangles"], *rims).circumferential
    trusses = deck.trusses
    edges, section = np.array([deck.cells[k] for k in trusses]), deck.section[trusses]
    if not trusses.size or section.min() < 0:
        raise InputError("no chordae: expected elements of type T3D2, each in a section")
    anchors = np.intersect1d(np.setdiff1d(edges, vertices), deck.held)
    if not anchors.size:
        raise InputError("no node of the chordae is held, so no papillary muscle is known")
    anchor, insertion, length, stiffness_share = trace_cables(nodes, edges, anchors, vertices)
    # The family of a cable is the section of the first truss in the deck at its insertion.
    ends, first = np.unique(edges, return_index=True)
    used, of_truss = np.unique(section, return_inverse=True)
    family = of_truss[first // 2][np.searchsorted(ends, insertion)]
    stiffness, materials = [], [deck.sections[k][1] for k in used]
    for k, material in zip(used, materials, strict=True):
        with named(f"trusses of {one_line(material, 40)}"):
            if material not in deck.ogden:
                raise InputError("expected *HYPERELASTIC, OGDEN")
            stiffness.append(truss_stiffness(deck.sections[k][2], deck.ogden[material]))
    return {
        "nodes": nodes,
        "vertices": vertices,
        "held": np.concatenate([vertices[rims[0]], anchors]),
        "anchor": np.searchsorted(anchors, anchor),
        "times": times,
        "surface": {"vertices": at_rest, "fibre": fibre, **surface},
        "annulus": rims[0],
        "free_edge": rims[1],
        "chordae": {
            "insertion": nodes[insertion],
            "family": family,
            "rest_length": length,
            "axial_stiffness": np.array(stiffness)[family] * stiffness_share,
        },
        "family_names": [material.lower() for material in materials],
        "pressure": abs(pressure),
        "pressure_share": share,
    }


def _pressure(deck: Deck, leaflets: IntArray, times: FloatArray) -> tuple[float, FloatArray]:
    """Pressure (MPa) against the shells' normals at the end, and its share at each time."""
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
    """The leaflets as triangles, whose normals are the shells' or, if ``turned``, against them.

    Returns
    -------
    surface : dict
        ``triangles``, ``region`` and ``thickness``.
    vertices : ndarray
        Their nodes in the deck, increasing.
    rims : list of ndarray
        Vertices of annulus and free edge in loop order.
    """
    elements = np.concatenate(groups)
    region = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    cells = np.array([deck.cells[k] for k in elements])
    vertices, corners = np.unique(cells, return_inverse=True)
    corners = corners.reshape(cells.shape)
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
    # Where leaflets meet, the thicker one counts.
    thickness = np.zeros(len(vertices))
    np.maximum.at(thickness, corners.ravel(), np.repeat(sizes, 4))
    surface = {"triangles": triangles, "region": region[element], "thickness": thickness}
    return surface, vertices, rims


def _split(vertices: FloatArray, quads: IntArray, on_rim: IntArray) -> tuple[IntArray, IntArray]:
    """Two triangles per quad along the shorter diagonal, and the element of each triangle.

    A quad with two sides on one rim is cut from their common corner, so that no triangle has all
    three corners on that rim.
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
    """Positions ``(f, t, 3)`` of the distinct anchors ``(f, a, 3)``, and the number of each."""
    near = np.linalg.norm(path[0][:, None] - path[0][None], axis=2) < SAME_MM
    count, group = connected_components(coo_matrix(near), directed=False)
    tips = np.stack([path[:, group == g].mean(axis=1) for g in range(count)], axis=1)
    if np.abs(tips[:, group] - path).max() > TOLERANCE_MM:
        raise InputError("chord anchors at one place move apart")
    return tips, group.astype(np.int64)
