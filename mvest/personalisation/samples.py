"""What errors of the frames that a model is built from do to what it predicts.

Each error sample of a case is a valve of its own, whose open shape, annulus, papillary tips and
chordae are elsewhere, and with them the closed valve. How far this moves against that of the case,
to first order (`mvest.closure.rest_geometry`), less how far its closed frame is moved, is one
sample of the error of the innovation, that of the observation included. What errors have in common
in both frames cancels so as far as the valve is the same elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.estimation.prediction import Prediction, predict
from mvest.mechanics.reference import RestVariation
from mvest.mechanics.valve_system import HeldState
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.personalisation.geometry import rest_lengths_by_ends
from mvest.personalisation.sources import TOLERANCE
from mvest.problem.estimate import Observed
from mvest.typing import FloatArray
from mvest.valve.anatomy.band import Band
from mvest.valve.geometry.proximity import closest_points


@dataclass(frozen=True, slots=True, eq=False)
class FrameSamples:
    """Samples of how a prediction moves if the frames it is built from were seen in error.

    Attributes
    ----------
    predicted : (K, n, 3) mm
        Displacement of the predicted closed valve.
    seen, opened : (K, n, 3) mm
        Displacement of the observed closed and of the open frame in the same samples.
    """

    predicted: FloatArray
    seen: FloatArray
    opened: FloatArray

    def __len__(self) -> int:
        return len(self.seen)


def sample_frames(
    case: ValveCase,
    model: ClosureModel,
    m: FloatArray,
    states: Sequence[HeldState],
    vertices: FloatArray,
    tips: FloatArray,
) -> FrameSamples | str:
    """How far the closed valve moves with samples of all frames, or why that is not known.

    Parameters
    ----------
    case : ValveCase
    model : ClosureModel
        Of the case; its last closed state is gone on from.
    m : (p,)
        Parameters of the closure at which it is linearised.
    states : sequence of HeldState
        What further frames are held by.
    vertices : (K, f, n, 3) mm
    tips : (K, f, t, 3) mm
    """
    geometry = RestGeometry(model)
    change = geometry.change(m, frame_errors(case, geometry, vertices, tips), states, TOLERANCE)
    if isinstance(change, str):
        return change
    open_, closed = _numbers(case)
    return FrameSamples(np.moveaxis(change[-1], -1, 0), vertices[:, closed], vertices[:, open_])


def frame_errors(
    case: ValveCase, geometry: RestGeometry, moves: FloatArray, tips: FloatArray
) -> RestVariation:
    """What a model is built from, as it is moved by samples of open and closed frame.

    Parameters
    ----------
    case : ValveCase
    geometry : RestGeometry
        Of its model.
    moves : (K, f, n, 3) mm
    tips : (K, f, t, 3) mm
    """
    open_, closed = _numbers(case)
    valve, contact, chordae = geometry.model.valve, geometry.model.contact_valve, case.chordae
    annulus = moves[:, closed][:, case.annulus]
    if contact is not valve:
        band, rest = Band(valve), valve.surface.vertices[valve.annulus]
        phi = 360.0 * np.arange(len(contact.annulus)) / len(contact.annulus)
        still = band.annulus_positions(phi, rest)
        annulus = np.stack([band.annulus_positions(phi, rest + own) - still for own in annulus])
    surface = case.surface
    place = closest_points(chordae.insertion, surface.vertices, surface.triangles)

    def from_tips(number: int) -> FloatArray:
        ends = place.interpolate(np.moveaxis(moves[:, number], 0, -1), surface.triangles)
        return np.asarray(np.moveaxis(ends, -1, 0) - tips[:, number][:, chordae.tip])

    rest_lengths = rest_lengths_by_ends(case, from_tips(open_), from_tips(closed))
    return RestVariation.summed(
        [
            geometry.shape(moves[:, open_]),
            geometry.annulus(annulus),
            geometry.tips(tips[:, closed], rest_lengths),
        ]
    )


def _numbers(case: ValveCase) -> tuple[int, int]:
    """Of the open and the closed frame."""
    roles = [frame.role for frame in case.frames]
    return roles.index(Role.REFERENCE), roles.index(Role.CLOSED)


def errors_of_samples(
    observation: Observed, closed: Frame, generic: FloatArray, samples: FrameSamples
) -> FloatArray:
    """Samples of the error of an observation's innovation ``(k, K)`` mm, one in each column.

    Parameters
    ----------
    observation : Observed
        Of the closed frame, by its vertices or by its surface.
    closed : Frame
    generic : array
        Both frames as they are predicted, stacked.
    samples : FrameSamples
        About this prediction.
    """
    if isinstance(observation, Observation):
        moved = samples.predicted - samples.seen
        return np.asarray(moved[:, observation.seen[0]].reshape(len(moved), -1).T)
    assert isinstance(observation, SurfaceObservation)
    points = observation.seen[-1]
    _, at = cKDTree(closed.vertices).query(points.points)
    edge = None if points.free_edge is None else cKDTree(closed.vertices).query(points.free_edge)[1]
    half = len(generic) // 2
    plain = replace(observation, correlation_length_mm=0.0)

    def distances(what: SurfaceObservation, predicted: FloatArray) -> FloatArray:
        y = np.concatenate([generic[:half], generic[half:] + predicted.ravel()])
        return predict(what.of(lambda _: Prediction.undifferentiated(y)), np.zeros(1)).y

    first = distances(plain, np.zeros(half))
    columns = []
    for predicted, seen in zip(samples.predicted, samples.seen, strict=True):
        there = replace(
            points,
            points=points.points + seen[at],
            free_edge=None if edge is None else points.free_edge + seen[edge],
        )
        columns.append(distances(replace(plain, seen=(there,)), predicted) - first)
    return np.stack(columns, axis=1)
