"""Uncertain geometry of the model of a case, as independent modes of one standard deviation each.

Open shape, annulus, papillary tips, thickness and fibre direction are measured or stated with
errors. `mvest.personalisation.sources` computes what the modes do to a prediction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from mvest.cases.case import Role, ValveCase
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import InputError, require_numbers
from mvest.estimation.spectrum import smooth_basis
from mvest.quantities import Angle, Count, Factor, Length, Share
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_coordinates import surface_coordinates
from mvest.valve.geometry.triangles import surface_edges


@dataclass(frozen=True, slots=True, kw_only=True)
class NuisanceGeometry:
    """Standard deviations of the geometry of a case; 0: known exactly.

    The defaults are choices: for the open shape a third of the spread between observers of a
    leaflet in 3D echocardiography; a voxel for the annulus; two voxels for the tips, of which
    images show the muscle; the size of a patch of chordal branches for the insertions; for
    thickness and fibres the variation between hearts.
    """

    shape_mm: Length = 0.3  #: of each coordinate of the open shape
    shape_length_mm: Length = 10.0  #: correlation length of these errors
    annulus_mm: Length = 0.5  #: of each coordinate of the closed annulus
    annulus_length_mm: Length = 20.0  #: correlation length of these errors
    #: Relative, of each open leaflet's length from annulus to free edge. Errors correlated over a
    #: few millimetres hardly contain such errors of scale, but an outline drawn too wide does.
    leaflet_scale: Share = 0.0
    annulus_scale: Share = 0.0  #: relative, of the size of the closed annulus
    frame_scale: Share = 0.0  #: relative, of all lengths of all frames
    tips_mm: Length = 1.0  #: of each coordinate of a papillary tip
    insertions_mm: Length = 0.5  #: of each coordinate of a chordal insertion, along the leaflet
    #: Relative, of the rest length of each chord that was laid out from the frames, besides a
    #: common factor. Stated rest lengths have only the common factor.
    rest_lengths: Share = 0.0
    thickness: Share = 0.1  #: relative, of each leaflet
    fibre_degrees: Angle = 10.0  #: of each leaflet
    #: One standard deviation, as a factor, of the size of errors of open shape and annulus, if
    #: errors are learned.
    factor: Factor = 2.0
    #: Share of the variance that smooth modes represent; finer modes are dropped.
    share: Share = 0.9
    #: How often, at most, the effects of the geometry are computed anew, with the parameters that
    #: were estimated. Each takes somewhat less time than the estimate.
    renewals: Count = 0

    def __post_init__(self) -> None:
        what = "nuisance geometry"
        scales = "leaflet_scale", "annulus_scale", "frame_scale"
        sizes = "shape_mm", "annulus_mm", "tips_mm", "insertions_mm", "rest_lengths", "thickness"
        require_numbers(self, what, *scales, *sizes, "fibre_degrees", "renewals", least=0)
        require_numbers(self, what, "shape_length_mm", "annulus_length_mm")
        require_numbers(self, what, "factor", least=1)
        if not 0.0 < self.share < 1.0:
            raise InputError(f"{what} share = {self.share}, expected within 0 and 1")


@dataclass(frozen=True, slots=True, eq=False)
class GeometryModes:
    """Independent errors of one kind of geometry, one standard deviation each."""

    name: str
    #: Of `mvest.closure.rest_geometry.PARTS` -> ``(q, ...)``, the change by each mode.
    parts: Mapping[str, FloatArray]
    factor: float = 1.0  #: one standard deviation, as a factor, of their size

    def __len__(self) -> int:
        return len(next(iter(self.parts.values())))


def displacement(
    modes: Sequence[GeometryModes], sizes: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """Change of each part of a geometry by amplitudes ``(q,)`` of each kind."""
    total: dict[str, FloatArray] = {}
    for own, z in zip(modes, sizes, strict=True):
        for part, moves in own.parts.items():
            total[part] = total.get(part, 0.0) + np.tensordot(z, moves, 1)
    return total


def geometry_modes(
    case: ValveCase, nuisance: NuisanceGeometry, model: ClosureModel
) -> tuple[GeometryModes, ...]:
    """Uncertain geometry of a case; error samples, if it has any, replace errors of the frames."""
    surface, chordae = case.surface, case.chordae
    kinds: list[GeometryModes] = []
    if case.error_samples is None:
        if nuisance.shape_mm:
            modes = smooth_modes(surface.vertices, nuisance.shape_length_mm, nuisance.share)
            moves = nuisance.shape_mm * _each_way(modes)
            kinds.append(GeometryModes("open shape", {"shape": moves}, nuisance.factor))
        if nuisance.leaflet_scale:
            moves = nuisance.leaflet_scale * leaflet_scales(case)
            kinds.append(GeometryModes("leaflet scale", {"shape": moves}))
        annulus = model.contact_valve.motion.annulus[-1]
        if nuisance.annulus_scale:
            moves = nuisance.annulus_scale * (annulus - annulus.mean(axis=0))[None]
            kinds.append(GeometryModes("annulus scale", {"annulus": moves}))
        if nuisance.annulus_mm:
            modes = smooth_modes(annulus, nuisance.annulus_length_mm, nuisance.share)
            moves = nuisance.annulus_mm * _each_way(modes)
            kinds.append(GeometryModes("annulus", {"annulus": moves}, nuisance.factor))
        if nuisance.tips_mm:
            moves = nuisance.tips_mm * _each_way(np.eye(len(case.valve.papillary_tips)))
            lengths = rest_lengths_by_tips(case, moves)
            follow = {} if lengths is None else {"rest_lengths": lengths}
            kinds.append(GeometryModes("papillary tips", {"tips": moves} | follow))
    if nuisance.insertions_mm:
        one = np.eye(len(chordae.insertion))
        ends = one[:, None, :, None] * RestGeometry(model).along_ends()[:, :, None]
        moves = nuisance.insertions_mm * ends.reshape(-1, *ends.shape[2:])
        kinds.append(GeometryModes("insertions", {"insertions": moves}))
    if nuisance.rest_lengths and case.chordae_follow:
        changes = nuisance.rest_lengths * np.eye(len(chordae))
        kinds.append(GeometryModes("rest lengths", {"rest_lengths": changes}))
    if nuisance.thickness:
        factors = nuisance.thickness * _leaflets(surface)
        kinds.append(GeometryModes("thickness", {"thickness": factors}))
    if nuisance.frame_scale:
        # Twice the size and twice the thickness give the same shape under the same pressure. So
        # lengths measured too large act as leaflets that are too thin.
        factors = nuisance.frame_scale * np.ones((1, len(surface.vertices)))
        kinds.append(GeometryModes("frame scale", {"thickness": factors}))
    if nuisance.fibre_degrees:
        angles = np.deg2rad(nuisance.fibre_degrees) * np.eye(len(surface.region_names))
        kinds.append(GeometryModes("fibres", {"fibres": angles}))
    return tuple(kinds)


def smooth_modes(points: FloatArray, length: float, share: float) -> FloatArray:
    """Modes ``(q, n)`` of a smooth field of unit variance over points ``(n, d)``.

    Leading eigenvectors of its Matérn correlation that together have a share of its variance.
    """
    basis = smooth_basis(points, length)
    order = np.argsort(basis.w)[::-1]
    w = basis.w[order]
    count = int(np.searchsorted(np.cumsum(w), share * len(points))) + 1
    return np.asarray((basis.U[:, order[:count]] * np.sqrt(w[:count])).T)


BLEND_STEPS = 10
"""Averages over neighbours that blend the scale of one leaflet into that of the next."""


def leaflet_scales(case: ValveCase) -> FloatArray:
    """Displacements ``(regions, n, 3)`` mm that double the length of each leaflet.

    A vertex moves away from the point of the annulus at the same angle; the annulus stays.
    """
    surface = case.surface
    x, n = surface.vertices, len(surface.vertices)
    edges = surface_edges(surface.triangles)
    ends = np.concatenate([edges, edges[:, ::-1]])
    near = sparse.csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))
    weights = _leaflets(surface).T
    for _ in range(BLEND_STEPS):
        weights = 0.5 * (weights + (near @ weights) / near.sum(axis=1)[:, None])
    theta = surface_coordinates(x, surface.triangles, case.annulus, case.free_edge).theta
    on = case.annulus[np.argsort(theta[case.annulus])]
    foot = [np.interp(theta, theta[on], x[on, k], period=2.0 * np.pi) for k in range(3)]
    return np.asarray(weights.T[:, :, None] * (x - np.stack(foot, axis=1)))


def _each_way(modes: FloatArray) -> FloatArray:
    """Displacements ``(3 q, n, 3)`` along x, y and z by modes ``(q, n)``."""
    moves = modes[:, None, :, None] * np.eye(3)[None, :, None, :]
    return np.asarray(moves.reshape(-1, modes.shape[1], 3))


def _leaflets(surface: LeafletSurface) -> FloatArray:
    """Indicator ``(regions, n)`` of the vertices of each leaflet."""
    own = surface.vertex_region == np.arange(len(surface.region_names))[:, None]
    return own.astype(np.float64)


def rest_lengths_by_tips(case: ValveCase, moves: FloatArray) -> FloatArray | None:
    """As `rest_lengths_by_ends`, for tips with the same error ``(q, t, 3)`` mm in all frames."""
    away = -moves[:, case.chordae.end_tip]
    return rest_lengths_by_ends(case, away, away)


def rest_lengths_by_ends(
    case: ValveCase, open_moves: FloatArray, closed_moves: FloatArray
) -> FloatArray | None:
    """Relative change ``(q, k)`` of rest lengths that were laid out from the frames.

    They are proportional to the lengths in the closed frame. A tree of chordae that the open frame
    needs longer is longer by the ratio of its tightest way from tip to leaflet in both frames
    (`mvest.valve.anatomy.template.laid_out`). A closed frame without correspondence does not show
    the insertions, so the open frame replaces it. None if rest lengths were stated.

    ``open_moves, closed_moves`` ``(q, c, 3) mm``: displacement of the insertion of each chord
    relative to its tip in these frames.
    """
    if not case.chordae_follow:
        return None
    closed, surface, chordae = case.frame(Role.CLOSED), case.surface, case.chordae
    c, tips = len(chordae.insertion), np.asarray(case.frame(Role.REFERENCE).papillary_tips)
    away = chordae.insertion - tips[chordae.end_tip]
    # Segments as sums of the vectors from the tips to the leaflet ends beyond them.
    through = chordae.paths
    parts = (through[:c] / through[:c].sum(axis=0)).T
    reach = np.linalg.norm(parts[c:] @ away, axis=1)
    fork = np.linalg.norm(chordae.junction - tips[chordae.tip[c:]], axis=1)
    parts[c:] *= (fork / reach)[:, None]
    branch = chordae.parent >= 0
    parts[branch] -= parts[c + chordae.parent[branch]]

    def changes(ends: FloatArray, moves: FloatArray) -> tuple[FloatArray, ...]:
        """Lengths of segments and ways, and the relative changes of both."""
        arms = parts @ ends
        length = np.linalg.norm(arms, axis=1)
        longer = np.einsum("qki,ki->qk", parts @ moves, arms) / length
        way = chordae.along(length)
        return length, way, longer / length, longer @ through[:c].T / way

    _, way, change, way_change = changes(away, open_moves)
    if not closed.corresponds:
        return change
    place = closest_points(chordae.insertion, surface.vertices, surface.triangles)
    ends = place.interpolate(closed.vertices, surface.triangles)
    ends -= np.asarray(closed.papillary_tips)[chordae.end_tip]
    length, closed_way, change, closed_change = changes(ends, closed_moves)
    root = np.argmax(through & ~branch, axis=1)
    least = ChordLayout().open_slack * way / closed_way
    tightest = np.argmax(np.where(root[:, None] == root[:c], least, 0.0), axis=1)
    by_open = chordae.rest_length <= (1 + 1e-6) * length * least[tightest]
    return change + np.where(by_open, (way_change - closed_change)[:, tightest], 0.0)
