"""Where a case's valve is closed while its unknowns are estimated: moduli, and a geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mvest.closure.frames import FramesModel
from mvest.closure.model import ClosedState, ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.estimation.prediction import Prediction
from mvest.estimation.wrappers import SharedStart
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation.observation_errors import ObservationErrors
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CaseClosure:
    """The closure of a case's valve, in the forms in which the parts of an estimation take it.

    Attributes
    ----------
    model : ClosureModel
    frames : FramesModel or None
        All closed frames that are fitted, if they are several.
    registered : RegisteredModel
        The same, displaced as a whole before it is seen.
    shared : SharedStart
        The same, for many estimations.
    displacement : mapping
        Part -> by what the geometry differs from the one that was seen; see
        `RestGeometry.displaced`.
    """

    model: ClosureModel
    frames: FramesModel | None
    registered: RegisteredModel
    shared: SharedStart[ClosedState]
    displacement: Mapping[str, FloatArray]

    @classmethod
    def of(
        cls,
        model: ClosureModel,
        frames: FramesModel | None,
        names: tuple[str, ...],
        start: FloatArray,
        displacement: Mapping[str, FloatArray] | None = None,
    ) -> CaseClosure:
        """The closure of a valve, gone on from ``start (p,)`` in the order of ``names``."""
        registered = RegisteredModel(frames or model, names)
        return cls(model, frames, registered, SharedStart(registered, start), displacement or {})

    def displaced(self, parts: Mapping[str, FloatArray], start: FloatArray) -> CaseClosure:
        """Of the valve with another geometry, see `RestGeometry.displaced`.

        All closed frames have the same errors of annulus and tips, as their derivatives say.
        """
        model = RestGeometry(self.model).displaced(parts)
        closure = self.of(model, self.frames, self.registered.names, start, parts)
        if self.frames is None:
            return closure
        states = {name: closure.held(state) for name, state in self.frames.states.items()}
        frames = replace(self.frames, model=model, states=states)
        return self.of(model, frames, self.registered.names, start, parts)

    def held(self, state: HeldState) -> HeldState:
        """A state as it was seen, whose annulus and tips are off as those of this valve."""
        return replace(
            state,
            annulus=state.annulus + self.displacement.get("annulus", 0.0),
            papillary_tips=state.papillary_tips + self.displacement.get("tips", 0.0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Moduli and geometry at which a valve was closed, and about which errors are linearised."""

    closure: CaseClosure
    errors: ObservationErrors
    m: FloatArray
    prediction: Prediction
