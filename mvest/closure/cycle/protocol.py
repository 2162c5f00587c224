"""How a valve is driven through a cycle, open to closed and back, and when it is looked at."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.settings import smooth_step
from mvest.mechanics.steps import Step
from mvest.quantities import BeatTime, Pressure, TimeStep

DEFAULT_TIMES = tuple(round(0.05 * k, 2) for k in range(21))
"""s, from the open valve until it is open again."""


@dataclass(frozen=True, slots=True)
class CycleProtocol:
    """Pressure, boundary motion, time steps and observed times of one cycle.

    Pressure, annulus and papillary tips follow one phase: a smooth rise from the open valve's 0 to
    the closed valve's 1, a plateau, and a smooth fall.

    Attributes
    ----------
    pressure_mmHg : float
        Transmitral, on the plateau.
    rise, hold, fall : float
        s, of the three parts.
    dt : float
        s, the largest time step: the time between two frames is divided evenly into steps no
        larger than this.
        Leaflets flip within some milliseconds; where a step leaps over that, frames jump with the
        parameters (`experiment=cycle` measures it).
    times : tuple of float
        s at which the valve is looked at, strictly increasing from >= 0; the run ends at the last.
    """

    pressure_mmHg: Pressure = 120.0
    rise: BeatTime = 0.3
    hold: BeatTime = 0.2
    fall: BeatTime = 0.3
    dt: TimeStep = 0.00625
    times: tuple[BeatTime, ...] = field(default=DEFAULT_TIMES)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"time step of a cycle dt = {self.dt} s, expected > 0")
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"pressure {self.pressure_mmHg} mmHg, expected a finite number")
        if not (self.rise > 0 and self.hold >= 0 and self.fall > 0):
            raise InputError(
                f"cycle with rise = {self.rise}, hold = {self.hold}, fall = {self.fall} s, "
                f"expected rise and fall > 0 and hold >= 0"
            )
        times = np.asarray(self.times, dtype=float)
        if not (
            times.ndim == 1
            and times.size
            and np.all(np.isfinite(times))
            and times[0] >= 0
            and np.all(np.diff(times) > 0)
            and times[-1] > 0
        ):
            raise InputError(
                f"observed times {self.times} s, expected increasing ones from 0 on, "
                f"at least one after it"
            )

    def phase(self, t: float, /) -> float:
        """Share of the closure at time ``t`` (s)."""
        return smooth_step(t / self.rise) - smooth_step((t - self.rise - self.hold) / self.fall)

    def pressure(self, t: float, /) -> float:
        """Transmitral pressure (mmHg) at time ``t`` (s)."""
        return self.pressure_mmHg * self.phase(t)

    def steps(self, until: int | None = None) -> tuple[Step, ...]:
        """The time steps to the observed frame ``until`` (default: the last)."""
        wanted = self.times if until is None else self.times[: until + 1]
        steps: list[Step] = []
        last = 0.0
        for time in wanted:
            # A gap that is a multiple of dt but for rounding is not given one step more.
            n = int(np.ceil((time - last) / self.dt * (1 - 1e-9)))
            steps += [Step(last + (time - last) * (k + 1) / n) for k in range(n)]
            last = time
        return tuple(steps)

    @property
    def frame_steps(self) -> tuple[int, ...]:
        """Number of steps taken when each frame is reached, ``(f,)``."""
        return tuple(len(self.steps(k)) for k in range(len(self.times)))
