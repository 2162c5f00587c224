"""What studies of a whole cycle add to the configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvest.closure.cycle.protocol import CycleProtocol

__all__ = ["CycleSettings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleSettings:
    """What the studies of a whole cycle add."""

    protocol: CycleProtocol = field(default_factory=CycleProtocol)
    noise_mm: float = 0.5  # SD of each coordinate
    exact_assumed_mm: float = 0.1  # SD that the filter assumes of coordinates without noise
    seeds: int = 8
    # Decrease of the objective below which a search ends that starts near its end: 0.02 moves no
    # parameter by more than a fifth of its standard deviation, 0.05 by a third.
    objective_tolerance: float = 0.02
    finer_columns: int = 32  # cells of the mesh of a truth that is not the estimator's
    finer_rows: int = 4
    finer_contact: tuple[int, ...] = (96, 21)  # points, around and along
    finer_dt_factor: float = 0.5
    # Cells and contact points of the mesh on which the estimator looks for its own mesh's error,
    # with the time step of the finer truth's.
    check_columns: int = 40
    check_rows: int = 5
    check_contact: tuple[int, ...] = (120, 26)
    time_steps: tuple[float, ...] = ()  # s, each half of the one before
    path_steps: int = 16  # along which frames are looked at for jumps
    beats: int = 10  # over which a modulus drifts
    beat_times: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4)  # s
    drift: float = -0.3  # of the first parameter, from the first beat to the last
    drift_std: float = 0.04  # that the filter assumes of the logarithm from beat to beat
