"""Errors of what a model is built from, its geometry and its law, as errors of what it predicts.

Each is a few independent modes of one standard deviation. What they do to the closed valve, to
first order, are columns C of the observation, which add C Cᵀ to the covariance of its errors. That
is the same as to estimate all modes with the parameters, and to report the parameters alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.closure.frames import FramesModel
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.estimation.noise import ErrorColumns, ObservationNoise
from mvest.estimation.prediction import Prediction, predict
from mvest.mechanics.law.exponential import as_stiff
from mvest.mechanics.reference import RestVariation
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.steps import Simulation
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation.geometry import GeometryModes
from mvest.problem.estimate import Observed
from mvest.problem.registration import RegisteredModel, registration_of
from mvest.typing import FloatArray

LAW, MESH = "law", "mesh"
"""Names of the errors of the tissue's law and of the mesh."""

VISIBLE = 0.3
"""Standard deviations of the stated noise below which a combination of columns is left out."""

TOLERANCE = 1e-3
"""Of derivatives, relative, far below what is known of the size of errors."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSource:
    """One thing that is not known of the valve: independent modes, one standard deviation each.

    Attributes
    ----------
    columns : ErrorColumns
        What the modes do to the observation, of low rank as far as noise lets it be told.
    rows : (k, q)
        The same of every mode.
    moves : (f, n, 3, q) mm
        The same of the observed valve, the open frame first.
    modes : GeometryModes or None
        Those of a geometry; None of the law.
    """

    columns: ErrorColumns
    rows: FloatArray
    moves: FloatArray
    modes: GeometryModes | None = None

    @property
    def name(self) -> str:
        """What is in error."""
        return self.columns.name


def geometry_sources(
    modes: Sequence[GeometryModes],
    registered: RegisteredModel,
    observation: Observed,
    noise: ObservationNoise,
    m: FloatArray,
    predicted: FloatArray,
    seen: ClosureModel | None = None,
) -> tuple[ErrorSource, ...] | str:
    """Errors of an observation from those of the geometry, by kind, or why they are not known.

    Parameters
    ----------
    modes : sequence of GeometryModes
    observation : Observed
        Of the case.
    noise : ObservationNoise
        Of single observations as it is stated.
    registered, m, predicted, seen
        As of `mvest.personalisation.errors.linearise`.
    """
    if not modes:
        return ()
    model, at, states = closure_at(registered, m)
    geometry = RestGeometry(model, seen)
    joined = RestVariation.joined([geometry.variation(own.parts) for own in modes])
    change = geometry.change(at, joined, states, TOLERANCE)
    if isinstance(change, str):
        return change
    moves = seen_change(registered, m, change)
    rows = observed_change(observation, predicted, moves)
    ends = np.cumsum([len(own) for own in modes])[:-1]
    return tuple(
        ErrorSource(
            ErrorColumns(own.name, of_low_rank(by, noise), own.factor), by, moved, modes=own
        )
        for own, by, moved in zip(
            modes, np.split(rows, ends, axis=1), np.split(moves, ends, axis=3), strict=True
        )
    )


def law_and_mesh_sources(
    tissue: Mapping[str, ExponentialTissue],
    mesh_share: float,
    registered: RegisteredModel,
    observation: Observed,
    m: FloatArray,
    predicted: FloatArray,
) -> tuple[ErrorSource, ...] | str:
    """Errors of an observation from those of law and mesh, or why they are not known.

    A case is estimated with the linear law, and tissue stiffens: at the same mean stress its shape
    is another. One leaflet after another gets an exponential tissue that is as stiff as the linear
    one where closed leaflets are stretched. By how much the new equilibrium moves what is observed
    is one standard deviation of how far the tissue is on its way from one law to the other.

    What a mesh leaves of the error of a coarser one, where there is one, is one standard deviation
    of the error of the mesh.

    Parameters
    ----------
    tissue : mapping
        Region -> exponential tissue, of which only the shape of its curve counts.
    mesh_share : float
        Share of the difference between both meshes that the finer one is off; 0: not asked.
    registered, observation, m, predicted
        As of `geometry_sources`; at ``m`` the tissues are as stiff as the linear ones.
    """
    model, at, states = closure_at(registered, m)
    coarse = model.guide or model
    first = coarse.rests(np.asarray(at, dtype=np.float64), states)
    if not first[-1].converged:
        return first[-1].reason.value
    found = []
    if tissue:
        change = law_change(coarse, at, states, tissue, first)
        if isinstance(change, str):
            return change
        moves = seen_change(registered, m, change)
        rows = observed_change(observation, predicted, moves)
        found.append(ErrorSource(ErrorColumns(LAW, rows), rows, moves))
    if mesh_share and model.guide is not None:
        fine = predicted.reshape(-1, *model.valve.surface.vertices.shape)
        moves = np.zeros((*fine.shape, 1))
        moves[1:, ..., 0] = mesh_share * (
            fine[1:] - registered.seen(_observed(coarse, first)[1:], m)
        )
        rows = observed_change(observation, predicted, moves)
        found.append(ErrorSource(ErrorColumns(MESH, rows), rows, moves))
    return tuple(found)


def law_change(
    model: ClosureModel,
    m: FloatArray,
    states: Sequence[HeldState],
    tissue: Mapping[str, ExponentialTissue],
    first: Sequence[Simulation],
) -> FloatArray | str:
    """Change ``(f, n, 3, q)`` mm of the observed valve with another law, or why there is none.

    The open valve is the first frame and stays, the closed one the last; the states come between
    them.

    Parameters
    ----------
    model : ClosureModel
        On a coarse mesh: a closure that follows no guide takes as long as an estimation on a fine
        one.
    m : (p,)
        Parameters of the closure.
    states : sequence of HeldState
        Under other loads, gone to from the closed valve.
    tissue : mapping
        As for `law_and_mesh_sources`.
    first : sequence of Simulation
        Closed valve and states with the linear law.
    """
    at = np.asarray(m, dtype=np.float64)
    values = {**model.fixed, **dict(zip(model.names, map(float, at), strict=True))}
    changes = []
    for region, linear in model.settings.tissue.items():
        name = f"E_f.{region}"
        if region not in tissue or name not in values:
            continue
        own = as_stiff(tissue[region], linear, values[name])
        stiffening = replace(linear, law="exponential", exponential=own)
        other = replace(
            model.fresh(),
            settings=replace(model.settings, tissue={**model.settings.tissue, region: stiffening}),
            names=tuple(known for known in model.names if known != name),
            fixed={known: value for known, value in model.fixed.items() if known != name},
            guide=None,
        )
        kept = at[[known != name for known in model.names]]
        moved = other.rests(kept, states, start=first[0].frames[-1])
        if not moved[-1].converged:
            return f"{region} of an exponential law: {moved[-1].reason.value}"
        changes.append(_observed(model, moved) - _observed(model, first))
    n = len(model.valve.surface.vertices)
    return np.stack(changes, axis=-1) if changes else np.zeros((2 + len(states), n, 3, 0))


def _observed(model: ClosureModel, ends: Sequence[Simulation]) -> FloatArray:
    """The observed valve ``(f, n, 3)`` mm: open, under the states, closed."""
    closed, *others = [model.observed(end.frames[-1]) for end in ends]
    return np.stack([model.observed(model.mesh.nodes), *others, closed])


def closure_at(
    registered: RegisteredModel, m: FloatArray
) -> tuple[ClosureModel, FloatArray, list[HeldState]]:
    """The closure of a model, its parameters at ``m (p,)``, and what further frames are held by."""
    model = registered.model
    if not isinstance(model, FramesModel):
        return model, registered.mechanical(m), []
    return model.model, registered.mechanical(m), model.under(registered.own(m), model.states)


def seen_change(registered: RegisteredModel, m: FloatArray, change: FloatArray) -> FloatArray:
    """Changes ``(f, n, 3, q)`` mm of the valve as they are seen, all frames but the open turned."""
    turn = Rotation.from_rotvec(registration_of(registered.names, m)[3:], degrees=True).as_matrix()
    return np.concatenate([change[:1], np.einsum("ij,fnjq->fniq", turn, change[1:])])


def observed_change(observation: Observed, predicted: FloatArray, moves: FloatArray) -> FloatArray:
    """What seen changes ``(f, n, 3, q)`` mm of the valve do to an observation ``(k, q)``.

    ``predicted`` are all frames, stacked.
    """
    jacobian = moves.reshape(len(predicted), -1)
    linear = observation.of(lambda _: Prediction(predicted, jacobian))
    return predict(linear, np.zeros(jacobian.shape[1]), derivatives=True).jacobian


def of_low_rank(columns: FloatArray, noise: ObservationNoise) -> FloatArray:
    """Fewer columns with nearly the same C Cᵀ, as far as that can be told from noise."""
    _, s, Vt = np.linalg.svd(noise.whiten(columns), full_matrices=False)
    return np.asarray(columns @ Vt[s > VISIBLE].T)
