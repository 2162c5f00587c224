"""Several closed frames of one valve as one prediction, each under a pressure of its own.

The tissue, the chordae and everything else are those of one valve. Each frame is the equilibrium
under its own pressure, annulus and papillary tips, reached from the one before it. A pressure of P
mmHg that is stated may be in error in three ways: it is truly ``scale (P + offset + error)``, with
one scale and one offset for all frames (how the measurement is calibrated, and where its zero is),
and an error of each frame alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mvest.closure.anchors import ClosedState
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.valve_system import HeldState
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve

OFFSET, ERROR = "pressure_offset", "pressure_error"
"""Parameters in mmHg: the offset of all stated pressures, and (``ERROR.FRAME``) that of one."""

SCALE = "pressure_scale"
"""The factor on all of them, a parameter of the closure."""


def is_frame_pressure(name: str) -> bool:
    """Whether a parameter is an error of stated pressures that only several frames tell apart."""
    return name.partition(".")[0] in (OFFSET, ERROR)


@dataclass(frozen=True, slots=True, eq=False)
class FramesModel:
    """The open valve, and several closed frames of it.

    Attributes
    ----------
    model : ClosureModel
        Closes the valve to the closed frame, under the pressure of its protocol.
    closed_name : str
        Of that frame.
    states : mapping of str to HeldState
        Frame -> what it is held by, on the contact valve's annulus. They are gone to in this order.
    pressure_mmHg : float
        Stated of the closed frame, as the protocol of the model has it.
    errors : tuple of str
        Parameters that are errors of stated pressures; with any of them, the factor on the pressure
        is a parameter of the model.

    Raises
    ------
    InputError
        If an error is of no frame, or the factor is missing.
    """

    model: ClosureModel
    closed_name: str
    states: Mapping[str, HeldState]
    pressure_mmHg: float
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
        """Parameters, those of the closure first ``(p,)``."""
        return (*self.model.names, *self.errors)

    @property
    def frames(self) -> tuple[str, ...]:
        """Closed frames in the order in which they are predicted, the closed one last."""
        return (*self.states, self.closed_name)

    @property
    def valve(self) -> Valve:
        """That of the closure."""
        return self.model.valve

    @property
    def closed(self) -> ClosedState | None:
        """Where the next prediction would start from."""
        return self.model.closed

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything but where to start from."""
        self.model.restart(closed)

    def of_closure(self, m: FloatArray) -> FloatArray:
        """Parameters with which the closure has the true pressure in the closed frame."""
        own = np.array(m[: len(self.model.names)], dtype=np.float64)
        if self.errors:
            own[self.model.names.index(SCALE)] *= self._true_over_stated(m)
        return own

    def under(self, m: FloatArray, states: Mapping[str, HeldState]) -> list[HeldState]:
        """What frames are truly held by, those of ``states`` or others without an own error.

        The pressures are those that the closure with parameters `of_closure` multiplies.
        """
        errors, share = self._errors(m), self._true_over_stated(m)
        offset = errors.get(OFFSET, 0.0)
        return [
            replace(
                one,
                pressure_mmHg=(one.pressure_mmHg + offset + errors.get(f"{ERROR}.{name}", 0.0))
                / share,
            )
            for name, one in states.items()
        ]

    def __call__(self, m: FloatArray, /) -> Prediction:
        """The open valve, the frames of ``states`` and the closed one, and their Jacobian.

        A frame without an equilibrium is a failed prediction.
        """
        m = np.asarray(m, dtype=np.float64)
        if not self._true_over_stated(m) > 0.0:
            return Prediction.failed("errors of the pressure leave none in the closed frame")
        parts = self.model.predict_held(self.of_closure(m), self.under(m, self.states))
        if not parts[-1].converged:
            where = self.closed_name if len(parts) == 1 else list(self.states)[len(parts) - 2]
            return Prediction.failed(f"{parts[-1].reason} in frame {where}")
        closed, *others = parts
        rest = self.valve.surface.vertices.ravel()
        stated = [*(one.pressure_mmHg for one in self.states.values()), self.pressure_mmHg]
        jacobian = [
            self._by_all(part.jacobian, m, frame, pressure)
            for part, frame, pressure in zip((*others, closed), self.frames, stated, strict=True)
        ]
        return Prediction(
            np.concatenate([rest, *(part.y for part in others), closed.y]),
            np.concatenate([np.zeros((len(rest), len(m))), *jacobian]),
        )

    def _errors(self, m: FloatArray) -> dict[str, float]:
        return dict(zip(self.errors, map(float, m[len(self.model.names) :]), strict=True))

    def _true_over_stated(self, m: FloatArray) -> float:
        """Of the closed frame's pressure, without the scale."""
        errors = self._errors(m)
        off = errors.get(OFFSET, 0.0) + errors.get(f"{ERROR}.{self.closed_name}", 0.0)
        return 1.0 + off / self.pressure_mmHg

    def _by_all(
        self, by_closure: FloatArray, m: FloatArray, frame: str, stated: float
    ) -> FloatArray:
        """Derivatives ``(k, p)`` of a frame by all parameters from those by the closure's."""
        if not self.errors:
            return by_closure
        errors, at = self._errors(m), self.model.names.index(SCALE)
        # The pressure is scale * unscaled; the closure has a factor of its own on another product.
        scale = float(m[at])
        unscaled = stated + errors.get(OFFSET, 0.0) + errors.get(f"{ERROR}.{frame}", 0.0)
        whole = np.zeros((len(by_closure), len(m)))
        whole[:, : by_closure.shape[1]] = by_closure
        by_pressure = by_closure[:, at] * (self._true_over_stated(m) / unscaled)
        whole[:, at] = by_pressure * unscaled
        for k, name in enumerate(self.errors, start=by_closure.shape[1]):
            if name in (OFFSET, f"{ERROR}.{frame}"):
                whole[:, k] = by_pressure * scale
        return whole
