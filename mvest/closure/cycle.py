"""A valve over a whole cycle, open to closed and back: the observed frames and their derivatives.

The dynamics determine the valve's state (positions, velocities, strain history) from the
parameters, so the state is not estimated. New parameters require a new run of the whole cycle, so
that parameters and state are consistent in every frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, zip_longest
from typing import Any

import numpy as np

from mvest.closure.model import ClosureModel, failure_of
from mvest.errors import InputError, MaterialError, require_numbers
from mvest.estimation.estimate import Estimate
from mvest.estimation.information.identifiability import shift_by_model_error, with_shift
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import Prediction
from mvest.mechanics.integrate import simulate
from mvest.mechanics.settings import smooth_step
from mvest.mechanics.steps import Simulation, Step
from mvest.mechanics.valve_system import boundary_loading
from mvest.quantities import BeatTime, Pressure, TimeStep
from mvest.typing import FloatArray

DEFAULT_TIMES = tuple(round(0.05 * k, 2) for k in range(21))
"""s, from the open valve until it reopens."""


@dataclass(frozen=True, slots=True)
class CycleProtocol:
    """Pressure, boundary motion, time steps and observed times of one cycle.

    Pressure, annulus and papillary tips follow one phase: a smooth rise from the open valve's 0 to
    the closed valve's 1, a plateau, and a smooth fall.
    """

    pressure_mmHg: Pressure = 120.0  #: transmitral, on the plateau
    #: s, durations of the three parts
    rise: BeatTime = 0.3
    hold: BeatTime = 0.2
    fall: BeatTime = 0.3
    #: s, largest time step; the time between two frames is divided evenly. Leaflets flip within a
    #: few milliseconds. If a step is longer, frames jump as parameters change (measured by
    #: `experiment=cycle`).
    dt: TimeStep = 0.00625
    #: s, times of the observed frames, strictly increasing from >= 0; the run ends at the last
    times: tuple[BeatTime, ...] = field(default=DEFAULT_TIMES)

    def __post_init__(self) -> None:
        require_numbers(self, "cycle", "dt", "rise", "fall")
        require_numbers(self, "cycle", "hold", least=0)
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"pressure {self.pressure_mmHg} mmHg, expected a finite number")
        times = np.asarray(self.times, dtype=float)
        increasing = times.size and times[0] >= 0 and np.all(np.diff(times) > 0) and times[-1] > 0
        if not (increasing and np.isfinite(times).all()):
            raise InputError(
                f"observed times {self.times} s, expected increasing ones from 0 on, "
                f"at least one after it"
            )

    def phase(self, t: float, /) -> float:
        """Phase of the closure at time ``t`` (s), from 0 (open) to 1 (closed)."""
        return smooth_step(t / self.rise) - smooth_step((t - self.rise - self.hold) / self.fall)

    def pressure(self, t: float, /) -> float:
        """Transmitral pressure (mmHg) at time ``t`` (s)."""
        return self.pressure_mmHg * self.phase(t)

    def steps(self) -> tuple[Step, ...]:
        """The time steps to the last observed frame."""
        return tuple(
            Step(last + (time - last) * (k + 1) / n)
            for last, time, n in zip(
                (0.0, *self.times[:-1]), self.times, self._steps_between(), strict=True
            )
            for k in range(n)
        )

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames, ``(f,)``."""
        return tuple(f"{time:g} s" for time in self.times)

    @property
    def frame_steps(self) -> tuple[int, ...]:
        """Number of steps up to each frame, ``(f,)``."""
        return tuple(np.cumsum(self._steps_between()).tolist())

    def frame_sets(self) -> dict[str, list[int]]:
        """Named sets of observed frames: increasing numbers of frames, and parts of the cycle.

        InputError if the valve is not held closed in any frame.
        """
        total = len(self.times)
        held = [k for k, time in enumerate(self.times) if self.phase(time) > 1 - 1e-9]
        if not held:
            raise InputError(f"observed times {self.times} s, expected one on the plateau")
        evenly = {
            f"{n} frames, evenly": sorted({round(k * (total - 1) / (n - 1)) for k in range(n)})
            for n in (3, 5, 8)
            if n < total
        }
        sets = {
            "open and closed": [0, held[-1]],
            **evenly,
            "whole cycle": list(range(total)),
            "only closing": list(range(1, held[0])),
            "only held closed": held,
            "only opening": list(range(held[-1] + 1, total)),
        }
        return {name: frames for name, frames in sets.items() if frames}

    def _steps_between(self) -> list[int]:
        # If a gap is a multiple of dt, rounding must not add a step.
        gaps = np.diff([0.0, *self.times]) / self.dt
        return np.ceil(gaps * (1 - 1e-9)).astype(int).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class CycleModel:
    """Predicted positions of the observed vertices in every frame of a cycle."""

    #: valve, mesh, mechanics and parameter names; its own protocol is not used
    closure: ClosureModel
    protocol: CycleProtocol

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.closure.names

    def run(self, m: FloatArray, *, sensitivities: bool = True) -> Simulation:
        """Run the cycle with parameters ``m (p,)`` from the open valve at rest.

        With ``sensitivities``, all frames are differentiated. Raises MaterialError if a modulus is
        inadmissible.
        """
        own, (system, parameters) = self.closure, self.closure.tuned(m)
        return simulate(
            system,
            boundary_loading(system, own.valve, own.contact_valve, own.settings, self.protocol),
            self.protocol.steps(),
            damping=own.damping(m),
            newton=own.settings.newton,
            parameters=parameters if sensitivities else (),
            solver=own.solver,
            on_step=own.on_step,
        )

    def frames(self, m: FloatArray) -> FloatArray:
        """Positions ``(f, n, 3)`` mm of the observed vertices with parameters ``m (p,)``.

        MaterialError if a modulus is inadmissible. InputError if the cycle does not converge.
        """
        simulation = self.run(m, sensitivities=False)
        if not simulation.converged:
            raise InputError(f"no cycle with the parameters {m}: {failure_of(simulation)}")
        return self._observed(simulation.frames)

    def _observed(self, steps: FloatArray) -> FloatArray:
        """Observed vertices ``(f, n, 3)`` in the observed frames, from the steps' nodal values."""
        return np.stack([self.closure.observed(steps[k]) for k in self.protocol.frame_steps])

    def __call__(self, m: FloatArray, /) -> Prediction:
        """All frames, one after another, and their Jacobian.

        Inadmissible moduli and cycles that do not converge give failed predictions, not errors.
        """
        try:
            simulation = self.run(m)
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not simulation.converged:
            return Prediction.failed(failure_of(simulation))
        moved = np.moveaxis(simulation.sensitivities, 1, 0)
        columns = [self._observed(by_one).ravel() for by_one in moved]
        return Prediction(self._observed(simulation.frames).ravel(), np.stack(columns, axis=-1))


def compare_time_steps(
    model: CycleModel, dts: Sequence[float], path: FloatArray
) -> list[dict[str, Any]]:
    """Measure how the frames of a cycle depend on the time step, along a path of parameters.

    InputError if a step is not half of the one before.

    Returns a list of dicts: one for each time step ``dt`` (s): ``change`` (mm, root mean square
    over all frames) when the step is halved; its ``order``, the binary logarithm of the ratio of
    two such changes; ``unevenness``, the largest over the median change along the path, large if
    frames jump; and the ``reason`` why the path ended early. Unknown numbers are None.

    Parameters
    ----------
    model : CycleModel
    dts : sequence of float
        s, each half of the one before.
    path : (n, p)
    """
    if any(not np.isclose(b, 0.5 * a) for a, b in pairwise(dts)):
        raise InputError(f"time steps {list(dts)} s, expected each to be half of the one before")
    first, uneven, reasons = list[FloatArray | None](), list[float | None](), list[str]()
    for dt in dts:
        of_step = replace(model, protocol=replace(model.protocol, dt=dt))
        frames, reason = list[FloatArray](), ""
        try:
            for m in path:
                frames.append(of_step.frames(m))
        except InputError as error:
            reason = str(error)
        along = [_rms(b - a) for a, b in pairwise(frames)]
        first.append(frames[0] if frames else None)
        uneven.append(None if reason else max(along) / float(np.median(along)))
        reasons.append(reason)
    change = [None if a is None or b is None else _rms(b - a) for a, b in pairwise(first)]
    order = [float(np.log2(a / b)) if a and b else None for a, b in pairwise(change)]
    names = ("dt", "change", "order", "unevenness", "reason")
    rows = zip_longest(dts, change, order, uneven, reasons)
    return [dict(zip(names, row, strict=True)) for row in rows]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def with_mesh_error(
    found: Estimate, R: NoiseCovariance, other: CycleModel
) -> tuple[Estimate, float]:
    """Add the mesh error to the covariance of an estimate from a whole cycle.

    Also returns the mean distance (mm) between the frames of the two meshes. InputError if there is
    no prediction, or no cycle on the other mesh.

    Parameters
    ----------
    found : Estimate
        Includes a prediction of all vertices in all frames.
    R : noise covariance
        Of the observation.
    other : CycleModel
        The same cycle on a finer mesh; it is run once.
    """
    frames = other.frames(found.mean)
    if found.prediction is None:
        raise InputError("an estimate without a prediction has no derivatives")
    off = frames - found.prediction.y.reshape(frames.shape)
    shift = shift_by_model_error(found, R, off.ravel())
    return with_shift(found, shift), float(np.linalg.norm(off, axis=-1).mean())
