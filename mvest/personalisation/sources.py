"""Errors of geometry, law, mesh and frames of a model, as errors of its prediction.

Each source is a few independent modes of one standard deviation. To first order their effects on
the closed valve are columns C of the observation, which add C Cᵀ to its error covariance. That
equals estimating the modes with the parameters and reporting the parameters alone.

Error samples of a case are complete valves with other open shape, annulus, papillary tips and
chordae. The linear change of the predicted closed valve (`mvest.closure.rest_geometry`) minus the
change of its closed frame is one sample of the error of the innovation. Errors that
move both frames as a whole cancel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import FramesModel
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.estimation.noise import ErrorColumns, ObservationNoise
from mvest.estimation.prediction import Prediction, predict
from mvest.mechanics.reference import RestVariation
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.steps import Simulation
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation.geometry import GeometryModes, rest_lengths_by_ends
from mvest.personalisation.model import contact_annulus
from mvest.personalisation.settings import CaseMesh
from mvest.problem.estimate import Observed
from mvest.problem.registration import RegisteredModel, registration_of
from mvest.typing import FloatArray
from mvest.valve.geometry.proximity import closest_points

LAW, MESH = "law", "mesh"
"""Names of the errors of the tissue's law and of the mesh."""

VISIBLE = 0.3
"""Standard deviations of the stated noise below which a combination of columns is dropped."""

TOLERANCE = 1e-3
"""Relative, of derivatives; far below the uncertainty of the size of errors."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSource:
    """One uncertain property of the valve: independent modes of one standard deviation each."""

    #: Effect of the modes on the observation, reduced to what noise does not hide.
    columns: ErrorColumns
    rows: FloatArray  #: (k, q), effect of every mode
    #: (f, n, 3, q) mm, effect of every mode on the observed valve, the open frame first.
    moves: FloatArray
    modes: GeometryModes | None = None  #: of a geometry; None for law and mesh
    expected: FloatArray | float = 0.0  #: (k,), expected error of the prediction

    @property
    def name(self) -> str:
        """What is in error."""
        return self.columns.name


@dataclass(frozen=True, slots=True, eq=False)
class ClosedValve:
    """A closed valve at which errors are linearised."""

    registered: RegisteredModel  #: its last closed state is the starting state
    m: FloatArray  #: (p,), parameters of the closed valve
    predicted: FloatArray  #: all its frames, stacked

    def closure(self) -> tuple[ClosureModel, FloatArray, list[HeldState]]:
        """The closure, its parameters, and the loads of further frames."""
        model, at = self.registered.model, self.registered.mechanical(self.m)
        if not isinstance(model, FramesModel):
            return model, at, []
        return model.model, at, model.under(self.registered.own(self.m), model.states)

    def turned(self, change: FloatArray) -> FloatArray:
        """Changes ``(f, n, 3, q)`` mm as observed: rotated in all frames except the open one."""
        vector = registration_of(self.registered.names, self.m)[3:]
        turn = Rotation.from_rotvec(vector, degrees=True).as_matrix()
        return np.concatenate([change[:1], np.einsum("ij,fnjq->fniq", turn, change[1:])])

    def rows(self, observation: Observed, moves: FloatArray) -> FloatArray:
        """Effect ``(k, q)`` of observed changes ``(f, n, 3, q)`` mm on an observation."""
        jacobian = moves.reshape(len(self.predicted), -1)
        linear = observation.of(lambda _: Prediction(self.predicted, jacobian))
        return predict(linear, np.zeros(jacobian.shape[1]), derivatives=True).jacobian


def geometry_sources(
    modes: Sequence[GeometryModes],
    valve: ClosedValve,
    observation: Observed,
    noise: ObservationNoise,
) -> tuple[ErrorSource, ...] | str:
    """Errors of an observation by those of the geometry, by kind, or why they are unknown.

    Parameters
    ----------
    observation : Observed
        Of the case.
    noise : ObservationNoise
        Of single observations, as stated.
    """
    if not modes:
        return ()
    model, at, states = valve.closure()
    geometry = RestGeometry(model)
    joined = RestVariation.joined([geometry.variation(own.parts) for own in modes])
    change = geometry.change(at, joined, states, TOLERANCE)
    if isinstance(change, str):
        return change
    moves = valve.turned(change)
    rows = valve.rows(observation, moves)
    ends = np.cumsum([len(own) for own in modes])[:-1]
    parts = zip(modes, np.split(rows, ends, axis=1), np.split(moves, ends, axis=3), strict=True)
    return tuple(
        ErrorSource(ErrorColumns(own.name, of_low_rank(by, noise), own.factor), by, moved, own)
        for own, by, moved in parts
    )


def law_and_mesh_sources(
    tissue: Mapping[str, ExponentialTissue],
    mesh: CaseMesh,
    valve: ClosedValve,
    observation: Observed,
) -> tuple[ErrorSource, ...] | str:
    """Errors of an observation by those of law and mesh, or why they are unknown.

    Tissue stiffens, so at the same mean stress its shape differs from that of the linear law. Each
    leaflet in turn gets an exponential tissue that is as stiff as the linear one at the stretch of
    closed leaflets. The change of the equilibrium is one standard deviation of the position of the
    tissue between both laws. Expected error of the mesh and its standard deviation are shares of
    its difference from the guide mesh, if there is one.

    ``tissue`` maps regions to exponential tissues, of which only the shape of the curve counts.
    """
    model, at, states = valve.closure()
    coarse = model.guide or model
    first = coarse.rests(np.asarray(at, dtype=np.float64), states)
    if not first[-1].converged:
        return first[-1].reason.value
    changes: dict[str, FloatArray] = {}
    if tissue:
        change = law_change(coarse, at, states, tissue, first)
        if isinstance(change, str):
            return change
        changes[LAW] = valve.turned(change)
    if mesh.error_std and model.guide is not None:
        fine = valve.predicted.reshape(-1, *model.valve.surface.vertices.shape)
        moves = np.zeros((*fine.shape, 1))
        coarser = valve.registered.seen(_observed(coarse, first)[1:], valve.m)
        moves[1:, ..., 0] = mesh.error_std * (fine[1:] - coarser)
        changes[MESH] = moves
    found = []
    for name, moves in changes.items():
        rows = valve.rows(observation, moves)
        times = -mesh.expected_error / mesh.error_std if name == MESH else 0.0
        expected = times * rows[:, 0] if times else 0.0
        found.append(ErrorSource(ErrorColumns(name, rows), rows, moves, expected=expected))
    return tuple(found)


def law_change(
    model: ClosureModel,
    m: FloatArray,
    states: Sequence[HeldState],
    tissue: Mapping[str, ExponentialTissue],
    first: Sequence[Simulation],
) -> FloatArray | str:
    """Change ``(f, n, 3, q)`` mm of the observed valve by another law, or the reason for failure.

    The frames are the open valve, which stays, the states (other loads, reached from the closed
    valve), and the closed valve. The mesh should be coarse: closing a fine one without a guide
    takes as long as an estimation. ``m (p,)`` are the parameters of the closure, ``first`` closed
    valve and states with the linear law.
    """
    at = np.asarray(m, dtype=np.float64)
    changes = []
    for region, linear in model.settings.tissue.items():
        if region not in tissue or f"E_f.{region}" not in {*model.names, *model.fixed}:
            continue
        own = replace(linear, law="exponential", exponential=tissue[region])
        settings = replace(model.settings, tissue={**model.settings.tissue, region: own})
        other = replace(model.fresh(), settings=settings, guide=None)
        moved = other.rests(at, states, start=first[0].frames[-1])
        if not moved[-1].converged:
            return f"{region} of an exponential law: {moved[-1].reason.value}"
        changes.append(_observed(model, moved) - _observed(model, first))
    n = len(model.valve.surface.vertices)
    return np.stack(changes, axis=-1) if changes else np.zeros((2 + len(states), n, 3, 0))


def _observed(model: ClosureModel, ends: Sequence[Simulation]) -> FloatArray:
    """The observed valve ``(f, n, 3)`` mm: open, under the states, closed."""
    closed, *others = [model.observed(end.frames[-1]) for end in ends]
    return np.stack([model.observed(model.mesh.nodes), *others, closed])


def of_low_rank(columns: FloatArray, noise: ObservationNoise) -> FloatArray:
    """Fewer columns with the same C Cᵀ except for directions hidden by the noise."""
    _, s, Vt = np.linalg.svd(noise.whiten(columns), full_matrices=False)
    return np.asarray(columns @ Vt[s > VISIBLE].T)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSamples:
    """Samples of the change of a prediction by errors of the frames it is built from."""

    predicted: FloatArray  #: (K, n, 3) mm, displacement of the predicted closed valve
    seen: FloatArray  #: (K, n, 3) mm, displacement of the observed closed frame
    opened: FloatArray  #: (K, n, 3) mm, displacement of the open frame

    def __len__(self) -> int:
        return len(self.seen)


def sample_frames(case: ValveCase, valve: ClosedValve) -> FrameSamples | str:
    """Change of the closed valve by each error sample of its case, or why it is unknown."""
    samples = case.error_samples
    assert samples is not None
    model, at, states = valve.closure()
    geometry, chordae, surface = RestGeometry(model), case.chordae, case.surface
    roles = [frame.role for frame in case.frames]
    opened, closed = (roles.index(role) for role in (Role.REFERENCE, Role.CLOSED))
    moves, tips = samples.vertices, samples.tips
    rest = model.valve.surface.vertices[model.valve.annulus]
    moved = contact_annulus(model, rest + moves[:, closed][:, case.annulus])
    moved -= contact_annulus(model, rest)
    place = closest_points(chordae.insertion, surface.vertices, surface.triangles)

    def from_tips(frame: int) -> FloatArray:
        ends = place.interpolate(np.moveaxis(moves[:, frame], 0, -1), surface.triangles)
        return np.asarray(np.moveaxis(ends, -1, 0) - tips[:, frame][:, chordae.end_tip])

    rest_lengths = rest_lengths_by_ends(case, from_tips(opened), from_tips(closed))
    shape, annulus = geometry.shape(moves[:, opened]), geometry.annulus(moved)
    parts = [shape, annulus, geometry.tips(tips[:, closed], rest_lengths)]
    change = geometry.change(at, RestVariation.summed(parts), states, TOLERANCE)
    if isinstance(change, str):
        return change
    return FrameSamples(np.moveaxis(change[-1], -1, 0), moves[:, closed], moves[:, opened])
