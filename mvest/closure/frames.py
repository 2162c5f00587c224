"""Predicts several closed frames of one valve together, each under its own pressure.

All frames share the tissue, the chordae and everything else. Each frame is the equilibrium under
its own pressure, annulus and papillary tips, reached from the previous frame. A stated pressure P
(mmHg) may be wrong in three ways: the true pressure is ``scale (P + offset + error)``, with one
scale and offset for all frames (calibration and zero of the sensor) and one error per frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mvest.closure.continuation import ClosedState
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.valve_system import HeldState
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve

OFFSET, ERROR = "pressure_offset", "pressure_error"
"""Parameters in mmHg: offset of all stated pressures, and error of one (``ERROR.FRAME``)."""

SCALE = "pressure_scale"
"""The factor on all stated pressures, a parameter of the closure."""


def is_frame_pressure(name: str) -> bool:
    """Whether a parameter is a pressure error that one frame cannot determine."""
    return name.partition(".")[0] in (OFFSET, ERROR)


@dataclass(frozen=True, slots=True, eq=False)
class FramesModel:
    """A model of the open valve and several closed frames.

    InputError if an error refers to no frame, or `SCALE` is missing.
    """

    model: ClosureModel  #: closes the valve to the closed frame, under the pressure of its protocol
    closed_name: str  #: name of that frame
    #: frame -> its loads, on the contact valve's annulus, in the order in which they are reached
    states: Mapping[str, HeldState]
    pressure_mmHg: float  #: stated pressure of the closed frame, as in the model's protocol
    #: parameters that are errors of stated pressures; if there are any, `SCALE` must be a parameter
    #: of the model
    errors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        known = [OFFSET, *(f"{ERROR}.{frame}" for frame in (self.closed_name, *self.states))]
        strange = [name for name in self.errors if name not in known]
        if strange:
            raise InputError(
                f"unknown error of a pressure {strange[0]!r}; expected some of {', '.join(known)}"
            )
        if self.errors and SCALE not in self.model.names:
            raise InputError(
                f"errors of pressures ({', '.join(self.errors)}) need {SCALE} among the parameters "
                "that are estimated"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters ``(p,)``, those of the closure first."""
        return (*self.model.names, *self.errors)

    @property
    def frames(self) -> tuple[str, ...]:
        """Closed frames in the order in which they are predicted, the closed one last."""
        return (*self.states, self.closed_name)

    @property
    def valve(self) -> Valve:
        """The valve of the closure."""
        return self.model.valve

    @property
    def closed(self) -> ClosedState | None:
        """The closed state from which the next prediction starts."""
        return self.model.closed

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything except the starting state."""
        self.model.restart(closed)

    def of_closure(self, m: FloatArray) -> FloatArray:
        """Parameters that give the closure the true pressure in the closed frame."""
        own = np.array(m[: len(self.model.names)], dtype=np.float64)
        if self.errors:
            own[self.model.names.index(SCALE)] *= self._true_over_stated(m)
        return own

    def under(self, m: FloatArray, states: Mapping[str, HeldState]) -> list[HeldState]:
        """The true loads of ``states``; frames that are not fitted have no individual error.

        The closure multiplies these pressures by its own factor, see `of_closure`.
        """
        share = self._true_over_stated(m)
        return [
            replace(state, pressure_mmHg=self._unscaled(m, frame, state.pressure_mmHg) / share)
            for frame, state in states.items()
        ]

    def __call__(self, m: FloatArray, /) -> Prediction:
        """The open valve, the frames of ``states`` and the closed one, and their Jacobian.

        A frame without an equilibrium gives a failed prediction.
        """
        m = np.asarray(m, dtype=np.float64)
        if not self._true_over_stated(m) > 0.0:
            return Prediction.failed("errors of the pressure leave none in the closed frame")
        parts = self.model.predict_held(self.of_closure(m), self.under(m, self.states))
        if not parts[-1].converged:
            where = self.closed_name if len(parts) == 1 else list(self.states)[len(parts) - 2]
            return Prediction.failed(f"{parts[-1].reason} in frame {where}")
        parts = [*parts[1:], parts[0]]
        rest = self.valve.surface.vertices.ravel()
        stated = [*(one.pressure_mmHg for one in self.states.values()), self.pressure_mmHg]
        jacobian = [
            self._by_all(part.jacobian, m, frame, pressure)
            for part, frame, pressure in zip(parts, self.frames, stated, strict=True)
        ]
        return Prediction(
            np.concatenate([rest, *(part.y for part in parts)]),
            np.concatenate([np.zeros((len(rest), len(m))), *jacobian]),
        )

    def _unscaled(self, m: FloatArray, frame: str, stated: float) -> float:
        """Pressure (mmHg) of a frame with its offset and error, but without the scale."""
        errors = dict(zip(self.errors, map(float, m[len(self.model.names) :]), strict=True))
        return stated + errors.get(OFFSET, 0.0) + errors.get(f"{ERROR}.{frame}", 0.0)

    def _true_over_stated(self, m: FloatArray) -> float:
        """True over stated pressure of the closed frame, without the scale."""
        stated = self.pressure_mmHg
        return 1.0 + (self._unscaled(m, self.closed_name, stated) - stated) / stated

    def _by_all(
        self, by_closure: FloatArray, m: FloatArray, frame: str, stated: float
    ) -> FloatArray:
        """Derivatives ``(k, p)`` of a frame by all parameters, from those by the closure's."""
        if not self.errors:
            return by_closure
        at = self.model.names.index(SCALE)
        # The true pressure is scale * unscaled; the closure's factor is that of `of_closure`.
        unscaled = self._unscaled(m, frame, stated)
        whole = np.zeros((len(by_closure), len(m)))
        whole[:, : by_closure.shape[1]] = by_closure
        by_pressure = by_closure[:, at] * (self._true_over_stated(m) / unscaled)
        whole[:, at] = by_pressure * unscaled
        for k, name in enumerate(self.errors, start=by_closure.shape[1]):
            if name in (OFFSET, f"{ERROR}.{frame}"):
                whole[:, k] = by_pressure * float(m[at])
        return whole
