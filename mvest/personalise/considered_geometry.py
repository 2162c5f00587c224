"""What is not known of a case's geometry, as an error of what a model predicts.

The model of a case is built from its open shape, its annulus and papillary tips, a thickness and a
direction of fibres, all as they were seen or stated. Each is uncertain: independent smooth modes
with a standard deviation. Derivatives of the closed valve by the modes
(`mvest.closure.rest_geometry`) times their standard deviations are columns C of the observation,
which add C Cᵀ to the covariance of its errors. To first order that is the same as to estimate all
modes with the parameters, and to report the parameters alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import ErrorSamples, ValveCase
from mvest.cases.displaced import displaced_case
from mvest.closure.frames import FramesModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import InputError
from mvest.estimation.noise import ObservationNoise
from mvest.estimation.noise_family import ErrorColumns, smooth_basis
from mvest.estimation.prediction import Prediction, predict
from mvest.mechanics.reference import RestVariation
from mvest.problem.problem import Observed
from mvest.problem.registration import RegisteredModel, registration_of
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface

__all__ = ["ConsideredGeometry", "geometry_columns"]

SEEN = 0.3
"""Standard deviations of the stated noise below which a combination of columns is left out."""

_SCALES = ("shape_mm", "annulus_mm", "tips_mm", "insertions_mm", "thickness", "fibre_degrees")

TOLERANCE = 1e-4
"""Of derivatives, relative, far below what is known of the size of errors."""

TIP_STEP = 0.01
"""mm, by which tips are moved to differentiate rest lengths that follow from them."""


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
    thickness : float
        Relative, of each leaflet.
    fibre_degrees : float
        Of each leaflet.
    factor : float
        How well the scale of the open shape's and the annulus' errors is known itself, where errors
        are learned: one standard deviation of its logarithm, as a factor.
    share : float
        Of the variance of smooth modes that is represented; finer ones are left out.
    """

    shape_mm: float = 0.3
    shape_length_mm: float = 10.0
    annulus_mm: float = 0.5
    annulus_length_mm: float = 20.0
    tips_mm: float = 1.0
    insertions_mm: float = 0.5
    thickness: float = 0.1
    fibre_degrees: float = 10.0
    factor: float = 2.0
    share: float = 0.9

    def __post_init__(self) -> None:
        for name in _SCALES:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"considered geometry {name} = {value}, expected >= 0")
        for name in ("shape_length_mm", "annulus_length_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"considered geometry {name} = {value}, expected > 0")
        if not (np.isfinite(self.factor) and self.factor >= 1.0):
            raise InputError(f"considered geometry factor = {self.factor}, expected >= 1")
        if not 0.0 < self.share < 1.0:
            raise InputError(f"considered geometry share = {self.share}, expected within 0 and 1")


def geometry_columns(
    case: ValveCase,
    considered: ConsideredGeometry,
    registered: RegisteredModel,
    observation: Observed,
    noise: ObservationNoise,
    m: FloatArray,
    predicted: FloatArray,
) -> tuple[ErrorColumns, ...] | str:
    """Errors of an observation from those of the geometry, one kind after another, or why none.

    Where samples tell how all frames may be in error, only what they do not tell is considered.

    Parameters
    ----------
    case : ValveCase
    considered : ConsideredGeometry
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
    """
    model, states = registered.model, []
    if isinstance(model, FramesModel):
        states = model.under(registered.own(m), model.states)
        model = model.model
    geometry = RestGeometry(model)
    kinds = _variations(case, considered, geometry)
    if not kinds:
        return ()
    joined = RestVariation.joined([own for _, own, _ in kinds])
    change = geometry.change(registered.mechanical(m), joined, states, TOLERANCE)
    if isinstance(change, str):
        return change
    turn = Rotation.from_rotvec(registration_of(registered.names, m)[3:], degrees=True).as_matrix()
    change[1:] = np.einsum("ij,fnjq->fniq", turn, change[1:])
    jacobian = change.reshape(len(predicted), -1)
    linear = observation.of(lambda _: Prediction(predicted, jacobian))
    rows = predict(linear, np.zeros(jacobian.shape[1]), derivatives=True).jacobian
    columns, start = [], 0
    for name, own, factor in kinds:
        members = rows[:, start : start + len(own)]
        columns.append(ErrorColumns(name, _of_low_rank(members, noise), factor))
        start += len(own)
    return tuple(columns)


def _variations(
    case: ValveCase, considered: ConsideredGeometry, geometry: RestGeometry
) -> list[tuple[str, RestVariation, float]]:
    """Name, modes of one standard deviation each, and factor of each kind."""
    surface = case.surface
    kinds: list[tuple[str, RestVariation, float]] = []
    if case.error_samples is None:
        if considered.shape_mm:
            modes = smooth_modes(surface.vertices, considered.shape_length_mm, considered.share)
            moves = considered.shape_mm * _each_way(modes)
            kinds.append(("open shape", geometry.shape(moves), considered.factor))
        if considered.annulus_mm:
            annulus = geometry.model.contact_valve.motion.annulus[-1]
            modes = smooth_modes(annulus, considered.annulus_length_mm, considered.share)
            moves = considered.annulus_mm * _each_way(modes)
            kinds.append(("annulus", geometry.annulus(moves), considered.factor))
        if considered.tips_mm:
            moves = considered.tips_mm * _each_way(np.eye(len(case.valve.papillary_tips)))
            kinds.append(("papillary tips", geometry.tips(moves, _lengths(case, moves)), 1.0))
    if considered.insertions_mm:
        ends = np.eye(len(case.valve.chordae))[:, None, :, None]
        moves = considered.insertions_mm * ends * geometry.along_ends()[:, :, None]
        moves = moves.reshape(-1, *moves.shape[2:])
        kinds.append(("insertions", geometry.insertions(moves), 1.0))
    if considered.thickness:
        factors = considered.thickness * _leaflets(surface)
        kinds.append(("thickness", geometry.thickness(factors), 1.0))
    if considered.fibre_degrees:
        angles = np.deg2rad(considered.fibre_degrees) * np.eye(len(surface.region_names))
        kinds.append(("fibres", geometry.fibres(angles), 1.0))
    return kinds


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


def _lengths(case: ValveCase, moves: FloatArray) -> FloatArray | None:
    """Relative change ``(q, c)`` of the chordae's rest lengths where they follow from the tips.

    Tips are in error in all frames alike: what is hard to make out is so at any time.
    """
    if not case.chordae_follow:
        return None
    frames = len(case.frames)
    still = np.zeros((2 * len(moves), frames, len(case.surface.vertices), 3))
    steps = np.concatenate([TIP_STEP * moves, -TIP_STEP * moves])
    there = np.repeat(steps[:, None], frames, axis=1)
    sampled = replace(case, error_samples=ErrorSamples(still, there))
    lengths = np.array([displaced_case(sampled, k).chordae.rest_length for k in range(len(steps))])
    ahead, behind = np.split(lengths, 2)
    return np.asarray((ahead - behind) / (2 * TIP_STEP * case.chordae.rest_length))


def _of_low_rank(columns: FloatArray, noise: ObservationNoise) -> FloatArray:
    """Fewer columns with nearly the same C Cᵀ, as far as that can be told from noise."""
    _, s, Vt = np.linalg.svd(noise.whiten(columns), full_matrices=False)
    return np.asarray(columns @ Vt[s > SEEN].T)
