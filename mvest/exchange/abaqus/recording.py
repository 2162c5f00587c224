"""A closure of a valve as it was computed with Abaqus: its input deck and the frames beside it.

A folder ``NAME`` holds ``NAME.inp`` and ``NAME_0.vtu``, ``NAME_1.vtu``, ..., the positions of all
nodes of the deck at equal intervals of its step. Lengths are mm, stresses MPa, times s. Leaflets
are shells, chordae trusses; which sets are leaflets, annulus and free edge is given by their names,
and the deck itself says what else there is: thickness, chord materials and sections, which chord
nodes are held (the papillary muscles), how annulus and papillary muscles move, and the pressure.

Such a case is the Texas TriValve 1.1 (SoftTissueBiomechanicsLab/Texas_TriValve_1.1, CC BY 4.0;
Mathur et al. 2022, Engineering with Computers, doi 10.1007/s00366-022-01659-w), a human donor
**tricuspid** valve (three leaflets, right heart). It is not part of this package.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mvest.errors import InputError, MvestError
from mvest.exchange.abaqus.deck import TRUSSES, Deck, ElementSection
from mvest.exchange.abaqus.deck_file import read_deck
from mvest.exchange.abaqus.mesh import (
    ChordPaths,
    LeafletMesh,
    SetNames,
    leaflet_mesh,
    shell_numbers,
    trace_cables,
    truss_stiffness,
)
from mvest.exchange.surfaces import read_mesh
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import surface_coordinates
from mvest.valve.mesh.remesh import Remeshed

TOLERANCE_MM = 1e-3
"""Frames are stored in single precision, whose rounding at 30 mm is 2e-6 mm."""
SAME_MM = 1e-6
"""Between anchors at one place."""
MAX_FRAMES = 500
MAX_COORDINATES = 2**26
"""Of all frames together: half a GiB."""
EXTENT_MM = (5.0, 500.0)
"""Of the leaflets: a valve in cm or m is not taken for one in mm."""
PRESSURE_MPA = (1e-4, 0.1)
"""1 to 750 mmHg."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A valve at rest and as it was recorded closing.

    Attributes
    ----------
    surface : LeafletSurface
        Fine midsurface in frame 0, normals to the ventricle, fibres parallel to the annulus.
    annulus, free_edge : ndarray
        Vertices of the two edges in loop order.
    frames : ndarray
        ``(f, n, 3)`` mm, recorded positions of the vertices of ``surface``.
    times : ndarray
        ``(f,)`` s, from 0 to the end of the step.
    annulus_displacement : ndarray
        ``(f, n_annulus, 3)`` mm, prescribed for the vertices ``annulus``.
    papillary_tips : ndarray
        ``(f, n_tips, 3)`` mm; the anchors grouped by position in frame 0.
    cables : ChordPaths
        The chord network as straight cables; ``anchor`` counts papillary tips and ``insertion``
        vertices of ``surface``.
    cable_family : ndarray
        ``(c,)`` number of the section of each cable's end at the leaflet.
    cable_sections : tuple of ElementSection
    deck : Deck
    pressure : float
        MPa on the ventricular face at the end.
    pressure_share : ndarray
        ``(f,)`` share of the pressure.
    """

    surface: LeafletSurface
    annulus: IntArray
    free_edge: IntArray
    frames: FloatArray
    times: FloatArray
    annulus_displacement: FloatArray
    papillary_tips: FloatArray
    cables: ChordPaths
    cable_family: IntArray
    cable_sections: tuple[ElementSection, ...]
    deck: Deck
    pressure: float
    pressure_share: FloatArray

    @property
    def phase(self) -> FloatArray:
        """``(f,)`` smooth step over the recorded time, from 0 to 1, as a closure is paced."""
        t = self.times / self.times[-1]
        return np.asarray(t**3 * (10 - 15 * t + 6 * t**2))

    def positions(self, triangle: IntArray, weights: FloatArray, frame: int) -> FloatArray:
        """Recorded positions ``(k, 3)`` mm of material points in one frame.

        Parameters
        ----------
        triangle, weights : ndarray
            ``(k,)`` and ``(k, 3)``: triangles of ``surface`` and barycentric weights, as from
            :func:`mvest.valve.mesh.remesh.remesh` or :meth:`locate`.
        frame : int
            0 is the reference; -1 the last, closed one.
        """
        corner = self.frames[frame][self.surface.triangles[triangle]]
        return np.einsum("ij,ijk->ik", weights, corner)

    def locate(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles and weights of the material points closest to ``points (k, 3)`` at rest."""
        closest = closest_points(points, self.surface.vertices, self.surface.triangles)
        return closest.triangle, closest.barycentric

    def valve(
        self,
        coarse: Remeshed | None = None,
        *,
        linearisation_strain: float = 0.01,
        toe_strain: float = 0.01,
    ) -> Valve:
        """The valve on its fine midsurface or on a remeshed one.

        Parameters
        ----------
        coarse : Remeshed, optional
            ``remesh(recording.surface, recording.annulus, recording.free_edge, n)``.
        linearisation_strain : float
            Strain of the secant stiffness of the chordae. At 1 %, chordae act as strings that
            hardly lengthen; the far higher stiffness of exponential ones at several percent would
            describe a state that no recorded closure reaches.
        toe_strain : float
            Toe of the cable law.

        Raises
        ------
        InputError
            If the deck's chord materials are none that are read.
        """
        surface = self.surface if coarse is None else coarse.surface
        annulus = self.annulus if coarse is None else coarse.annulus
        free_edge = self.free_edge if coarse is None else coarse.free_edge
        stiffness = np.array(
            [
                truss_stiffness(section, self.deck.materials, linearisation_strain)
                for section in self.cable_sections
            ]
        )
        chordae = Chordae(
            tip=self.cables.anchor,
            insertion=self.surface.vertices[self.cables.insertion],
            family=self.cable_family,
            family_names=tuple(section.material.lower() for section in self.cable_sections),
            rest_length=self.cables.length,
            axial_stiffness=stiffness[self.cable_family] * self.cables.stiffness_share,
            toe_strain=toe_strain,
        )
        return Valve(
            surface=surface,
            annulus=annulus,
            free_edge=free_edge,
            papillary_tips=self.papillary_tips[0],
            chordae=chordae,
            motion=self._motion(surface.vertices[annulus]),
        )

    def _motion(self, annulus_points: FloatArray) -> Motion:
        triangle, weights = self.locate(annulus_points)
        corners = self.surface.triangles[triangle]
        displacement = np.zeros((len(self.times), *self.surface.vertices.shape))
        displacement[:, self.annulus] = self.annulus_displacement
        step = np.einsum("ij,fijk->fik", weights, displacement[:, corners])
        return Motion(
            phase=self.phase,
            annulus=annulus_points + step,
            papillary_tips=self.papillary_tips,
        )


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


def read_recording(folder: Path, names: SetNames) -> Recording:
    """Read a recorded closure.

    Raises
    ------
    InputError
        If files are absent or damaged, the deck states what is not read, or frames and deck
        contradict each other.
    """
    path, *frame_files = recording_files(folder)
    deck = read_deck(path)
    times = np.linspace(0.0, deck.period, len(frame_files))
    try:
        pressure, share = _pressure(deck, names, times)
        mesh = leaflet_mesh(deck, names, turned=pressure < 0)
        _check_extent(mesh)
        trusses = _Trusses.of(deck)
        anchors = trusses.anchors(deck, mesh)
        tips, tip_of_anchor = _group_anchors(deck, anchors, times)
        cables = trace_cables(deck.nodes, trusses.edges, anchors, mesh.nodes)
        order = np.argsort(anchors)
        anchor = order[np.searchsorted(anchors[order], cables.anchor)]
        family = trusses.section_at(cables.insertion)
        moved = deck.moved(mesh.nodes[mesh.annulus], times)
    except MvestError as fault:
        raise type(fault)(f"{path}: {fault}") from fault
    positions = _read_frames(frame_files, deck)
    _check_motion(frame_files, deck, mesh.nodes[mesh.annulus], times, positions)
    _check_motion(frame_files, deck, anchors, times, positions)
    coordinates = surface_coordinates(mesh.vertices, mesh.triangles, mesh.annulus, mesh.free_edge)
    insertion = np.searchsorted(mesh.nodes, cables.insertion)
    return Recording(
        surface=LeafletSurface(
            vertices=mesh.vertices,
            triangles=mesh.triangles,
            region=mesh.region,
            region_names=tuple(names.leaflets),
            fibre=coordinates.circumferential,
            thickness=mesh.thickness,
        ),
        annulus=mesh.annulus,
        free_edge=mesh.free_edge,
        frames=np.ascontiguousarray(positions[:, mesh.nodes]),
        times=times,
        annulus_displacement=moved,
        papillary_tips=tips,
        cables=replace(cables, anchor=tip_of_anchor[anchor], insertion=insertion),
        cable_family=family,
        cable_sections=trusses.sections,
        deck=deck,
        pressure=abs(pressure),
        pressure_share=share,
    )


def _check_extent(mesh: LeafletMesh) -> None:
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if not EXTENT_MM[0] <= extent <= EXTENT_MM[1]:
        raise InputError(
            f"the leaflets span {extent:g}, expected {EXTENT_MM[0]:g} to {EXTENT_MM[1]:g}: lengths "
            "must be mm"
        )


def _pressure(deck: Deck, names: SetNames, times: FloatArray) -> tuple[float, FloatArray]:
    """Pressure (MPa) against the shells' normals at the end, and its share at each time."""
    leaflets = np.concatenate(shell_numbers(deck, names))
    loaded = [load for load in deck.pressures if np.isin(load.elements, leaflets).any()]
    covered = np.concatenate([np.zeros(0, np.int64), *(load.elements for load in loaded)])
    once = len(np.unique(covered)) == len(covered) and not np.setdiff1d(leaflets, covered).size
    if not once or len({(load.value, load.amplitude) for load in loaded}) != 1:
        raise InputError("expected one pressure on all leaflets, once")
    share = deck.share(loaded[0].amplitude, times)
    if share[0] != 0 or share[-1] == 0:
        raise InputError(
            f"the pressure's share runs from {share[0]:g} to {share[-1]:g}, expected from 0"
        )
    pressure = loaded[0].value * float(share[-1])
    if not PRESSURE_MPA[0] <= abs(pressure) <= PRESSURE_MPA[1]:
        raise InputError(
            f"pressure {pressure:g}, expected {PRESSURE_MPA[0]:g} to {PRESSURE_MPA[1]:g}: stresses "
            "must be MPa"
        )
    return pressure, share / share[-1]


@dataclass(frozen=True, slots=True, eq=False)
class _Trusses:
    """The chord network: ``(k, 2)`` nodes, ``(k,)`` number of the section, and the sections."""

    edges: IntArray
    section: IntArray
    sections: tuple[ElementSection, ...]

    @classmethod
    def of(cls, deck: Deck) -> _Trusses:
        """All trusses of a deck."""
        blocks = [block for block in deck.elements if block.kind in TRUSSES]
        if not blocks:
            raise InputError(f"no chordae: no elements of type {', '.join(TRUSSES)}")
        numbers = np.concatenate([block.first + np.arange(len(block.nodes)) for block in blocks])
        sections = [s for s in deck.sections if np.isin(s.elements, numbers).any()]
        section = np.full(len(numbers), -1)
        for k, one in enumerate(sections):
            section[np.isin(numbers, one.elements)] = k
        if (section < 0).any():
            raise InputError("trusses without a section")
        edges = np.concatenate([block.nodes for block in blocks])
        return cls(edges, section, tuple(sections))

    def anchors(self, deck: Deck, mesh: LeafletMesh) -> IntArray:
        """Chord nodes that are held, but not on the leaflets."""
        nodes = np.setdiff1d(self.edges, mesh.nodes)
        held = nodes[np.isfinite(deck.displacement[nodes]).all(axis=1)]
        if not held.size:
            raise InputError("no node of the chordae is held, so no papillary muscle is known")
        return held

    def section_at(self, insertion: IntArray) -> IntArray:
        """ElementSection ``(c,)`` of the truss, the first in the deck, that ends at each node."""
        nodes, first = np.unique(self.edges.ravel(), return_index=True)
        return self.section[first // 2][np.searchsorted(nodes, insertion)]


def _group_anchors(deck: Deck, anchors: IntArray, times: FloatArray) -> tuple[FloatArray, IntArray]:
    """Positions ``(f, t, 3)`` of the distinct anchors, and the position number of each anchor."""
    start = deck.nodes[anchors]
    near = np.linalg.norm(start[:, None] - start[None], axis=2) < SAME_MM
    count, group = connected_components(coo_matrix(near), directed=False)
    path = start + deck.moved(anchors, times)
    tips = np.stack([path[:, group == g].mean(axis=1) for g in range(count)], axis=1)
    if np.abs(tips[:, group] - path).max() > TOLERANCE_MM:
        raise InputError("chord anchors at one place move apart")
    return tips, group.astype(np.int64)


def _read_frames(files: Sequence[Path], deck: Deck) -> FloatArray:
    """Positions ``(f, n, 3)`` mm of all nodes."""
    if len(files) * deck.nodes.size > MAX_COORDINATES:
        raise InputError(f"{files[0]}: {len(files)} frames of {len(deck.nodes)} nodes are too many")
    result = np.empty((len(files), *deck.nodes.shape))
    for k, file in enumerate(files):
        points = read_mesh(file).points
        if points.shape != deck.nodes.shape:
            raise InputError(f"{file}: {len(points)} points, the deck has {len(deck.nodes)} nodes")
        result[k] = points
    if np.abs(result[0] - deck.nodes).max() > TOLERANCE_MM:
        raise InputError(f"{files[0]}: points are not the nodes of the deck")
    return result


def _check_motion(
    files: Sequence[Path], deck: Deck, nodes: IntArray, times: FloatArray, positions: FloatArray
) -> None:
    """Refuse frames that are not where the deck moves its constrained nodes."""
    expected = deck.nodes[nodes] + deck.moved(nodes, times)
    error = np.abs(expected - positions[:, nodes]).max(axis=(1, 2))
    if error.max() > TOLERANCE_MM:
        worst = files[int(np.argmax(error))]
        raise InputError(
            f"{worst}: {error.max():.2g} mm away from the deck's prescribed motion "
            f"(tolerance {TOLERANCE_MM} mm)"
        )
