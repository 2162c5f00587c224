"""The recorded human donor valve: the healthy tricuspid valve of Texas TriValve 1.1.

It is a **tricuspid** valve (three leaflets, right heart), not a mitral one: the same kind of organ
with other proportions, and a good test that nothing in the chain is special to one template. The
data are not part of this package. They come from the public repository SoftTissueBiomechanicsLab/
Texas_TriValve_1.1 (licence CC BY 4.0); cite Mathur et al. 2022, "Texas TriValve 1.0: a
reverse-engineered, open model of the human tricuspid valve", Engineering with Computers,
doi 10.1007/s00366-022-01659-w, wherever a result of it is shown.

Facts of its Abaqus deck used here: shell thickness 0.65 mm; 3.06 kPa on the ventricular face and
the prescribed displacement both follow Abaqus' smooth step ``10 t^3 - 15 t^4 + 6 t^5`` over 1 s;
frame 0 is a cylindrical reference skirt, not an imaged diastole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.units import kpa_to_mpa
from mvest.valve.anatomy.chord_network import ChordPaths, trace_cables
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates
from mvest.valve.io.donor.arrays import REGION_NAMES, DonorArrays, donor_file, load_arrays
from mvest.valve.mesh.remesh import Remeshed

__all__ = [
    "PRESSURE_MPA",
    "THICKNESS_MM",
    "DonorRecording",
    "chord_axial_stiffness",
    "read_donor",
]

THICKNESS_MM = 0.65
"""Shell thickness of all leaflets in the deck."""
PRESSURE_MPA = kpa_to_mpa(3.06)
"""Transvalvular pressure at the end of the deck's step."""
_RECORDING_TOLERANCE_MM = 1e-3
"""Frames are stored in single precision, whose rounding at 30 mm is 2e-6 mm."""

OGDEN_CHORDAE: dict[str, tuple[float, tuple[tuple[float, float], ...]]] = {
    "anterior": (
        0.35634654,
        (
            (18.884147787615671, 98.253655062498183),
            (22.682992286286954, 98.251894443391549),
            (19.502933935159177, 98.253228660027887),
        ),
    ),
    "septal": (
        0.269284347,
        (
            (33.7534784879460, 0.0001531670654),
            (0.0000145962860, 0.0003488130193),
            (0.0203430173299, 113.4473866780919),
        ),
    ),
    "posterior": (
        0.330046348,
        (
            (4.241553984852658, 55.914887194545429),
            (2.724796146859668, 55.915477229563507),
            (0.000037265674134, 70.715073154655229),
        ),
    ),
}
"""Cross section (mm^2) and Ogden pairs (mu in MPa, alpha) of the chordae, from the deck."""


@dataclass(frozen=True, slots=True, eq=False)
class DonorRecording:
    """The donor valve at rest and as it was recorded closing.

    Attributes
    ----------
    surface : LeafletSurface
        Fine midsurface in frame 0, normals to the ventricle, fibres parallel to the annulus.
    annulus, free_edge : ndarray
        Vertices of the two edges in loop order.
    frames : ndarray
        ``(f, n, 3)`` mm, recorded positions of the vertices of ``surface``.
    phase : ndarray
        ``(f,)`` from 0 to 1: share of the final load and displacement at each frame.
    annulus_displacement : ndarray
        ``(n_annulus, 3)`` mm, prescribed at phase 1 for the vertices ``annulus``.
    papillary_tips : ndarray
        ``(n_tips, 3)`` mm; the anchors grouped by position. They do not move.
    cables : ChordPaths
        The chord network as straight cables; ``anchor`` counts papillary tips and ``insertion``
        vertices of ``surface``.
    """

    surface: LeafletSurface
    annulus: IntArray
    free_edge: IntArray
    frames: FloatArray
    phase: FloatArray
    annulus_displacement: FloatArray
    papillary_tips: FloatArray
    cables: ChordPaths

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
            Strain of the secant stiffness of the chordae, see :func:`chord_axial_stiffness`.
        toe_strain : float
            Toe of the cable law.
        """
        surface = self.surface if coarse is None else coarse.surface
        annulus = self.annulus if coarse is None else coarse.annulus
        free_edge = self.free_edge if coarse is None else coarse.free_edge
        return Valve(
            surface=surface,
            annulus=annulus,
            free_edge=free_edge,
            papillary_tips=self.papillary_tips,
            chordae=self._chordae(linearisation_strain, toe_strain),
            motion=self._motion(surface.vertices[annulus]),
        )

    def _chordae(self, linearisation_strain: float, toe_strain: float) -> Chordae:
        material = np.array(
            [
                chord_axial_stiffness(name, linearisation_strain)
                for name in self.surface.region_names
            ]
        )
        family = self.surface.vertex_region[self.cables.insertion]
        return Chordae(
            tip=self.cables.anchor,
            insertion=self.surface.vertices[self.cables.insertion],
            family=family,
            family_names=self.surface.region_names,
            rest_length=self.cables.length,
            axial_stiffness=material[family] * self.cables.stiffness_share,
            toe_strain=toe_strain,
        )

    def _motion(self, annulus_points: FloatArray) -> Motion:
        displacement = np.zeros_like(self.surface.vertices)
        displacement[self.annulus] = self.annulus_displacement
        triangle, weights = self.locate(annulus_points)
        step = np.einsum("ij,ijk->ik", weights, displacement[self.surface.triangles[triangle]])
        return Motion(
            phase=self.phase,
            annulus=annulus_points + self.phase[:, None, None] * step,
            papillary_tips=np.repeat(self.papillary_tips[None], len(self.phase), axis=0),
        )


def chord_axial_stiffness(leaflet: str, strain: float) -> float:
    """Secant stiffness (N) of the deck's chordae: force over ``strain``.

    Incompressible uniaxial Ogden, nominal stress ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))``
    at stretch ``l = 1 + strain`` (Ogden 1972, Proc. R. Soc. A 326:565, in Abaqus' convention),
    times the cross section. At 1 % strain: 90 N (anterior), 27 N (septal), 8 N (posterior). That
    strain is the default because in the recorded closure no truss is stretched by more than 0.8 %
    and 95 % of them by at most 0.1 %: the chordae act as inextensible strings, and the far higher
    stiffness of the anterior set at several percent would describe a state never reached.
    """
    if leaflet not in OGDEN_CHORDAE:
        raise InputError(f"no chordae of leaflet {leaflet!r}; known: {', '.join(OGDEN_CHORDAE)}")
    if not 0 < strain < 0.1:
        raise InputError(f"linearisation strain {strain}, expected between 0 and 0.1")
    area, pairs = OGDEN_CHORDAE[leaflet]
    stretch = 1 + strain
    stress = sum(
        2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
        for mu, alpha in pairs
    )
    return float(area * stress / strain)


def read_donor(data_dir: str | Path | None = None) -> DonorRecording:
    """Read the recorded donor tricuspid valve.

    Parameters
    ----------
    data_dir : path, optional
        Folder that holds ``healthy.npz``, or that file; default: environment variable
        ``MVEST_TRIVALVE``.

    Raises
    ------
    InputError
        If the file is absent, unreadable, lacks an array, or its arrays contradict each other.
    """
    path = donor_file(data_dir)
    data = load_arrays(path)
    n = int(data.quads.max()) + 1
    if len(np.unique(data.quads)) != n:
        raise InputError(f"{path}: leaflet nodes must be numbered 0 to {n - 1} without gaps")
    if np.abs(data.frames[0] - data.nodes).max() > _RECORDING_TOLERANCE_MM:
        raise InputError(f"{path}: frame 0 of frames_xyz_mm differs from nodes_ref_mm")
    on_rim = np.zeros(len(data.nodes), dtype=np.int64)
    on_rim[data.annulus], on_rim[data.free_edge] = 1, 2
    vertices = data.nodes[:n]
    triangles, quad = _split_quads(vertices, data.quads, on_rim)
    annulus, free_edge = _name_loops(path, triangles, data)
    phase = _smooth_step(np.linspace(0.0, 1.0, len(data.frames)))
    displacement = _prescribed_displacement(path, data, phase)
    tips, tip_of_anchor = _group_anchors(data.nodes[data.chord_anchors])
    cables = trace_cables(data.nodes, data.chord_edges, data.chord_anchors, np.arange(n))
    order = np.argsort(data.chord_anchors)
    anchor = order[np.searchsorted(data.chord_anchors[order], cables.anchor)]
    coordinates = surface_coordinates(vertices, triangles, annulus, free_edge)
    return DonorRecording(
        surface=LeafletSurface(
            vertices=vertices,
            triangles=triangles,
            region=data.quad_region[quad],
            region_names=REGION_NAMES,
            fibre=coordinates.circumferential,
            thickness=np.full(n, THICKNESS_MM),
        ),
        annulus=annulus,
        free_edge=free_edge,
        frames=np.ascontiguousarray(data.frames[:, :n]),
        phase=phase,
        annulus_displacement=displacement[annulus],
        papillary_tips=tips,
        cables=replace(cables, anchor=tip_of_anchor[anchor]),
    )


def _prescribed_displacement(path: Path, data: DonorArrays, phase: FloatArray) -> FloatArray:
    """Displacement ``(n_nodes, 3)`` at phase 1 (NaN where free), checked against all frames."""
    displacement = np.full_like(data.nodes, np.nan)
    displacement[data.constrained] = data.displacement
    anchored = np.concatenate([data.annulus, data.chord_anchors])
    free = anchored[np.isnan(displacement[anchored]).any(axis=1)]
    if free.size:
        raise InputError(f"{path}: node {int(free[0])} of annulus or anchors is not in bc_nodes")
    if np.any(displacement[data.chord_anchors] != 0):
        raise InputError(f"{path}: bc_displacement_mm moves a chord anchor, expected 0")
    step = phase[:, None, None] * displacement[anchored]
    error = np.abs(data.nodes[anchored] + step - data.frames[:, anchored]).max(axis=(1, 2))
    if error.max() > _RECORDING_TOLERANCE_MM:
        raise InputError(
            f"{path}: frame {int(np.argmax(error))} of frames_xyz_mm is {error.max():.2g} mm away "
            f"from bc_displacement_mm by the smooth step (tolerance {_RECORDING_TOLERANCE_MM} mm)"
        )
    return displacement


def _smooth_step(t: FloatArray) -> FloatArray:
    """Abaqus' smooth step from 0 to 1 with zero first and second derivatives at both ends."""
    return t**3 * (10 - 15 * t + 6 * t**2)


def _split_quads(
    vertices: FloatArray, quads: IntArray, on_rim: IntArray
) -> tuple[IntArray, IntArray]:
    """Two triangles per quad along the shorter diagonal, and the quad of each triangle.

    A quad with two sides on one rim is cut from their common corner, so that no triangle has all
    three corners on that rim.
    """
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
    return np.vstack([one, two]), np.tile(np.arange(len(quads)), 2)


def _name_loops(path: Path, triangles: IntArray, data: DonorArrays) -> tuple[IntArray, IntArray]:
    """The two boundary loops in order, matched with the lists of the file."""
    loops = {frozenset(loop.tolist()): loop for loop in boundary_loops(triangles)}
    wanted = [frozenset(data.annulus.tolist()), frozenset(data.free_edge.tolist())]
    if len(loops) != 2 or any(name not in loops for name in wanted):
        raise InputError(
            f"{path}: annulus_nodes and free_edge_nodes must be the two boundary loops of the "
            "leaflets"
        )
    return loops[wanted[0]], loops[wanted[1]]


def _group_anchors(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distinct anchor positions and the position number of each anchor."""
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 1e-6
    count, group = connected_components(coo_matrix(near), directed=False)
    tips = np.stack([points[group == g].mean(axis=0) for g in range(count)])
    return tips, group.astype(np.int64)
