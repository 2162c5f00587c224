"""What is not known of the geometry that the model of a case is built from.

That is its open shape, annulus and papillary tips, thickness and direction of fibres, all as they
were seen or stated. Each is uncertain: independent modes, one standard deviation each. What they do
to a prediction is in `mvest.personalisation.sources`.
"""

from __future__ import annotations

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
    """How well the geometry of a case is known: standard deviations, 0 where it is known exactly.

    The defaults are choices: a third of the spread between observers of a leaflet in 3D
    echocardiography for the open shape, which a case takes from the sharpest frame; a voxel for the
    annulus; two for the tips, of which images show the muscle rather than a point; the size of a
    patch of chordal branches for the insertions; thickness and fibres as they vary between hearts.

    Attributes
    ----------
    shape_mm, shape_length_mm : float
        Of each coordinate of the open shape, and over which distance its errors are alike.
    annulus_mm, annulus_length_mm : float
        Of the closed annulus.
    leaflet_scale, annulus_scale, frame_scale : float
        Relative: of the length of each leaflet from annulus to free edge in the open frame, of the
        size of the closed annulus, and of all lengths of all frames together. Errors that are alike
        over a few millimetres hardly contain them, and an outline drawn too wide is one of them.
    tips_mm : float
        Of each coordinate of a papillary tip.
    insertions_mm : float
        Of each coordinate of where a chord ends, along the leaflet.
    rest_lengths : float
        Relative, of the rest length of each chord that was laid out by the shape of the frames,
        beside a factor on all of them. Those that a case states are as long as it says, up to that
        factor.
    thickness : float
        Relative, of each leaflet.
    fibre_degrees : float
        Of each leaflet.
    factor : float
        How well the scale of the open shape's and the annulus' errors is known itself, where errors
        are learned: one standard deviation of its logarithm, as a factor.
    share : float
        Of the variance of smooth modes that is represented; finer ones are left out.
    renewals : int
        How often, at most, all is estimated anew about the geometry that the last estimate expects:
        with it, what is not known of the geometry is of first order about there, and not about what
        was seen. Each costs somewhat less than the estimate.
    """

    shape_mm: Length = 0.3
    shape_length_mm: Length = 10.0
    annulus_mm: Length = 0.5
    annulus_length_mm: Length = 20.0
    leaflet_scale: Share = 0.0
    annulus_scale: Share = 0.0
    frame_scale: Share = 0.0
    tips_mm: Length = 1.0
    insertions_mm: Length = 0.5
    rest_lengths: Share = 0.0
    thickness: Share = 0.1
    fibre_degrees: Angle = 10.0
    factor: Factor = 2.0
    share: Share = 0.9
    renewals: Count = 0

    def __post_init__(self) -> None:
        what = "considered geometry"
        scales = "leaflet_scale", "annulus_scale", "frame_scale"
        sizes = "shape_mm", "annulus_mm", "tips_mm", "insertions_mm", "rest_lengths", "thickness"
        require_numbers(self, what, *scales, *sizes, "fibre_degrees", "renewals", least=0)
        require_numbers(self, what, "shape_length_mm", "annulus_length_mm")
        require_numbers(self, what, "factor", least=1)
        if not 0.0 < self.share < 1.0:
            raise InputError(f"{what} share = {self.share}, expected within 0 and 1")


@dataclass(frozen=True, slots=True, eq=False)
class GeometryModes:
    """Independent errors of one kind of a geometry, one standard deviation each.

    Attributes
    ----------
    name : str
    parts : mapping
        Of `mvest.closure.rest_geometry.PARTS` -> ``(q, ...)``, what each mode does to it.
    factor : float
        To which their size is known.
    """

    name: str
    parts: Mapping[str, FloatArray]
    factor: float = 1.0

    def __len__(self) -> int:
        return len(next(iter(self.parts.values())))


def displacement(
    modes: Sequence[GeometryModes], sizes: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """What as much ``(q,)`` of each kind does to a geometry, for `RestGeometry.displaced`."""
    total: dict[str, FloatArray] = {}
    for own, z in zip(modes, sizes, strict=True):
        for part, moves in own.parts.items():
            total[part] = total.get(part, 0.0) + np.tensordot(z, moves, 1)
    return total


def geometry_modes(
    case: ValveCase, considered: NuisanceGeometry, model: ClosureModel
) -> tuple[GeometryModes, ...]:
    """What is not known of the geometry that the closure of a case is built from.

    Where samples tell how all frames may be in error, only what they do not tell is considered.
    """
    surface, geometry = case.surface, RestGeometry(model)
    kinds: list[GeometryModes] = []
    if case.error_samples is None:
        if considered.shape_mm:
            modes = smooth_modes(surface.vertices, considered.shape_length_mm, considered.share)
            moves = considered.shape_mm * _each_way(modes)
            kinds.append(GeometryModes("open shape", {"shape": moves}, considered.factor))
        if considered.leaflet_scale:
            moves = considered.leaflet_scale * leaflet_scales(case)
            kinds.append(GeometryModes("leaflet scale", {"shape": moves}))
        annulus = model.contact_valve.motion.annulus[-1]
        if considered.annulus_scale:
            moves = considered.annulus_scale * (annulus - annulus.mean(axis=0))[None]
            kinds.append(GeometryModes("annulus scale", {"annulus": moves}))
        if considered.annulus_mm:
            modes = smooth_modes(annulus, considered.annulus_length_mm, considered.share)
            moves = considered.annulus_mm * _each_way(modes)
            kinds.append(GeometryModes("annulus", {"annulus": moves}, considered.factor))
        if considered.tips_mm:
            moves = considered.tips_mm * _each_way(np.eye(len(case.valve.papillary_tips)))
            lengths = rest_lengths_by_tips(case, moves)
            follow = {} if lengths is None else {"rest_lengths": lengths}
            kinds.append(GeometryModes("papillary tips", {"tips": moves} | follow))
    if considered.insertions_mm:
        ends = np.eye(len(case.valve.chordae))[:, None, :, None]
        moves = considered.insertions_mm * ends * geometry.along_ends()[:, :, None]
        kinds.append(
            GeometryModes("insertions", {"insertions": moves.reshape(-1, *moves.shape[2:])})
        )
    if considered.rest_lengths and case.chordae_follow:
        changes = considered.rest_lengths * np.eye(len(case.valve.chordae))
        kinds.append(GeometryModes("rest lengths", {"rest_lengths": changes}))
    if considered.thickness:
        factors = considered.thickness * _leaflets(surface)
        kinds.append(GeometryModes("thickness", {"thickness": factors}))
    if considered.frame_scale:
        # A valve of twice the size under the same pressure has the same shape if it is twice as
        # thick: all lengths seen too large are leaflets that are too thin.
        factors = considered.frame_scale * np.ones((1, len(surface.vertices)))
        kinds.append(GeometryModes("frame scale", {"thickness": factors}))
    if considered.fibre_degrees:
        angles = np.deg2rad(considered.fibre_degrees) * np.eye(len(surface.region_names))
        kinds.append(GeometryModes("fibres", {"fibres": angles}))
    return tuple(kinds)


def smooth_modes(points: FloatArray, length: float, share: float) -> FloatArray:
    """Modes ``(q, n)`` of a smooth field of unit variance over points ``(n, d)``.

    Leading eigenvectors of its Matérn correlation, as many as have a share of its variance.
    """
    basis = smooth_basis(points, length)
    order = np.argsort(basis.w)[::-1]
    w = basis.w[order]
    count = int(np.searchsorted(np.cumsum(w), share * len(points))) + 1
    return np.asarray((basis.U[:, order[:count]] * np.sqrt(w[:count])).T)


BLEND_STEPS = 10
"""Averages over neighbours by which the scale of one leaflet fades into that of the next."""


def leaflet_scales(case: ValveCase) -> FloatArray:
    """Displacements ``(regions, n, 3)`` mm that make each leaflet twice as long, from its annulus.

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
    """Of each region ``(r, n)`` whether a vertex is its own."""
    own = surface.vertex_region == np.arange(len(surface.region_names))[:, None]
    return own.astype(np.float64)


def rest_lengths_by_tips(case: ValveCase, moves: FloatArray) -> FloatArray | None:
    """As `rest_lengths_by_ends` where tips ``(q, t, 3)`` mm are in error in all frames alike.

    What is hard to make out is so at any time.
    """
    if not case.chordae_follow:
        return None
    away = -moves[:, case.chordae.tip]
    return rest_lengths_by_ends(case, away, away)


def rest_lengths_by_ends(
    case: ValveCase, open_moves: FloatArray, closed_moves: FloatArray
) -> FloatArray | None:
    """Relative change ``(q, c)`` of the chordae's rest lengths where they follow from the frames.

    They are in proportion to a chord's distance in the closed frame, or, where that would be too
    short, in the open one (`mvest.cases.tissue.lay_out_chordae`). Where vertices of the
    closed frame do not correspond, so that it is not known where a chord ends there, the open one
    stands for it. None: they are known by themselves.

    Parameters
    ----------
    case : ValveCase
    open_moves, closed_moves : (q, c, 3) mm
        By which the end of each chord moves against its tip in these frames.
    """
    if not case.chordae_follow:
        return None
    closed, surface, chordae = case.frame(Role.CLOSED), case.surface, case.chordae
    away = chordae.insertion - np.asarray(case.frame(Role.REFERENCE).papillary_tips)[chordae.tip]
    moves = open_moves
    if closed.corresponds:
        place = closest_points(chordae.insertion, surface.vertices, surface.triangles)
        ends = place.interpolate(closed.vertices, surface.triangles)
        in_closed = ends - np.asarray(closed.papillary_tips)[chordae.tip]
        by_open = ChordLayout().open_slack * np.linalg.norm(away, axis=1)
        by_closed = (chordae.rest_length > (1 + 1e-6) * by_open)[:, None]
        away = np.where(by_closed, in_closed, away)
        moves = np.where(by_closed, closed_moves, open_moves)
    return np.asarray(np.einsum("qci,ci->qc", moves, away) / np.sum(away**2, axis=1))
