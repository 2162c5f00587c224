"""What is not known of a case's geometry, as an error of what a model predicts.

The model of a case is built from its open shape, its annulus and papillary tips, a thickness and a
direction of fibres, all as they were seen or stated. Each is uncertain: independent smooth modes
with a standard deviation. Derivatives of the closed valve by the modes
(`mvest.closure.rest_geometry`) times their standard deviations are columns C of the observation,
which add C Cᵀ to the covariance of its errors. To first order that is the same as to estimate all
modes with the parameters, and to report the parameters alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import FramesModel
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import InputError, require_numbers
from mvest.estimation.noise import ErrorColumns, ObservationNoise
from mvest.estimation.prediction import Prediction, predict
from mvest.estimation.spectrum import smooth_basis
from mvest.mechanics.reference import RestVariation
from mvest.mechanics.valve_system import HeldState
from mvest.problem.problem import Observed
from mvest.problem.registration import RegisteredModel, registration_of
from mvest.quantities import Angle, Count, Factor, Length, Share, Thickness
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points

SEEN = 0.3
"""Standard deviations of the stated noise below which a combination of columns is left out."""

TOLERANCE = 1e-4
"""Of derivatives, relative, far below what is known of the size of errors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsideredGeometry:
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
    tips_mm: Length = 1.0
    insertions_mm: Length = 0.5
    rest_lengths: Share = 0.0
    thickness: Thickness = 0.1
    fibre_degrees: Angle = 10.0
    factor: Factor = 2.0
    share: Share = 0.9
    renewals: Count = 0

    def __post_init__(self) -> None:
        what = "considered geometry"
        sizes = "shape_mm", "annulus_mm", "tips_mm", "insertions_mm", "rest_lengths", "thickness"
        require_numbers(self, what, *sizes, "fibre_degrees", "renewals", least=0)
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


@dataclass(frozen=True, slots=True, eq=False)
class GeometryColumns:
    """What modes of a geometry's error do to an observation, to first order.

    Attributes
    ----------
    modes : tuple of GeometryModes
    rows : tuple of (k, q)
        Of each kind: the observation by its modes.
    columns : tuple of ErrorColumns
        The same of low rank, as far as it can be told from noise.
    """

    modes: tuple[GeometryModes, ...]
    rows: tuple[FloatArray, ...]
    columns: tuple[ErrorColumns, ...]

    def offset(self, modes: Sequence[FloatArray]) -> FloatArray:
        """What modes ``(q,)`` of each kind do to the observation ``(k,)``."""
        return np.sum([rows @ z for rows, z in zip(self.rows, modes, strict=True)], axis=0)


def displacement(
    modes: Sequence[GeometryModes], sizes: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """What as much ``(q,)`` of each kind does to a geometry, for `RestGeometry.displaced`."""
    total: dict[str, FloatArray] = {}
    for own, z in zip(modes, sizes, strict=True):
        for part, moves in own.parts.items():
            total[part] = total.get(part, 0.0) + np.tensordot(z, moves, 1)
    return total


def geometry_columns(
    modes: Sequence[GeometryModes],
    registered: RegisteredModel,
    observation: Observed,
    noise: ObservationNoise,
    m: FloatArray,
    predicted: FloatArray,
    seen: ClosureModel | None = None,
) -> GeometryColumns | str:
    """Errors of an observation from those of the geometry, one kind after another, or why none.

    Parameters
    ----------
    modes : sequence of GeometryModes
    registered : RegisteredModel
        Of the case; its last closed state is gone on from.
    observation : Observed
        Of the case.
    noise : ObservationNoise
        Of the observation as it is stated, without what the geometry adds.
    m : (p,)
        Parameters at which the model is linearised.
    predicted : array
        All frames as predicted at ``m``, stacked.
    seen : ClosureModel, optional
        Of the valve as it was seen, whose errors these are, if that of ``registered`` is displaced.
    """
    if not modes:
        return GeometryColumns((), (), ())
    model, at, states = closure_at(registered, m)
    geometry = RestGeometry(model, seen)
    joined = RestVariation.joined([geometry.variation(own.parts) for own in modes])
    change = geometry.change(at, joined, states, TOLERANCE)
    if isinstance(change, str):
        return change
    rows = observed_change(registered, observation, m, predicted, change)
    ends = np.cumsum([len(own) for own in modes])[:-1]
    split = tuple(np.split(rows, ends, axis=1))
    columns = tuple(
        ErrorColumns(own.name, of_low_rank(members, noise), own.factor)
        for own, members in zip(modes, split, strict=True)
    )
    return GeometryColumns(tuple(modes), split, columns)


def closure_at(
    registered: RegisteredModel, m: FloatArray
) -> tuple[ClosureModel, FloatArray, list[HeldState]]:
    """The closure of a model, its parameters at ``m (p,)``, and what further frames are held by."""
    model = registered.model
    if not isinstance(model, FramesModel):
        return model, registered.mechanical(m), []
    return model.model, registered.mechanical(m), model.under(registered.own(m), model.states)


def observed_change(
    registered: RegisteredModel,
    observation: Observed,
    m: FloatArray,
    predicted: FloatArray,
    change: FloatArray,
) -> FloatArray:
    """What changes ``(f, n, 3, q)`` mm of the valve do to an observation ``(k, q)``.

    ``predicted`` are all frames at ``m (p,)``, stacked.
    """
    turn = Rotation.from_rotvec(registration_of(registered.names, m)[3:], degrees=True).as_matrix()
    turned = np.concatenate([change[:1], np.einsum("ij,fnjq->fniq", turn, change[1:])])
    jacobian = turned.reshape(len(predicted), -1)
    linear = observation.of(lambda _: Prediction(predicted, jacobian))
    return predict(linear, np.zeros(jacobian.shape[1]), derivatives=True).jacobian


def geometry_modes(
    case: ValveCase, considered: ConsideredGeometry, model: ClosureModel
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
        if considered.annulus_mm:
            annulus = model.contact_valve.motion.annulus[-1]
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


def of_low_rank(columns: FloatArray, noise: ObservationNoise) -> FloatArray:
    """Fewer columns with nearly the same C Cᵀ, as far as that can be told from noise."""
    _, s, Vt = np.linalg.svd(noise.whiten(columns), full_matrices=False)
    return np.asarray(columns @ Vt[s > SEEN].T)
