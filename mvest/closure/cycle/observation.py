"""What is seen of a valve over a cycle: any number of frames, not all vertices in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.prediction import ObservationModel, Predicted, require_finite
from mvest.estimation.wrappers import Remembered, rows_of
from mvest.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CycleObservation:
    """Vertices seen in frames of a cycle, and how well.

    Attributes
    ----------
    positions : (f, n, 3) mm
        Of every frame that the model predicts; NaN where a vertex is not seen. A frame of which
        nothing is seen is none.
    std : (f,) mm
        Standard deviation of each coordinate that the filter is to assume.
    """

    positions: FloatArray
    std: FloatArray

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)
        if positions.ndim != 3 or positions.shape[2] != 3:
            raise InputError(f"positions over a cycle: shape {positions.shape}, expected (f, n, 3)")
        unseen: BoolArray = np.all(np.isnan(positions), axis=2)
        require_finite(np.where(unseen[..., None], 0.0, positions), "the observed positions")
        if np.all(unseen):
            raise InputError("no vertex is seen in any frame")
        std = np.broadcast_to(np.asarray(self.std, dtype=np.float64), len(positions)).copy()
        require_finite(std, "the standard deviation of the positions")
        if np.any(std <= 0.0):
            raise InputError(f"standard deviation of a frame = {std.min():g} mm, expected > 0")
        for name, values in (("positions", positions), ("std", std)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @classmethod
    def simulated(
        cls,
        frames: FloatArray,
        noise_mm: float,
        rng: np.random.Generator,
        assumed_mm: float | None = None,
    ) -> CycleObservation:
        """Frames ``(f, n, 3)`` with independent noise of each coordinate.

        ``assumed_mm`` is the noise that the filter assumes; default what it is.
        """
        assumed = noise_mm if assumed_mm is None else assumed_mm
        return cls(frames + noise_mm * rng.normal(size=frames.shape), np.full(len(frames), assumed))

    def only(self, frames: Sequence[int]) -> CycleObservation:
        """The same with nothing seen in any other frame."""
        positions = np.full_like(self.positions, np.nan)
        positions[list(frames)] = self.positions[list(frames)]
        return CycleObservation(positions, self.std)

    @property
    def seen(self) -> BoolArray:
        """Which vertices are seen in each frame ``(f, n)``."""
        return np.isfinite(self.positions[..., 0])

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of coordinates in each frame of which something is seen."""
        return tuple(int(3 * k) for k in self.seen.sum(axis=1) if k)

    @property
    def y(self) -> FloatArray:
        """Coordinates ``(m,)`` mm of what is seen, frame by frame."""
        return self.positions[self.seen].ravel()

    @property
    def R(self) -> FloatArray:
        """Variances ``(m,)`` mm² of ``y``."""
        return np.repeat(self.std**2, 3 * self.seen.sum(axis=1))

    def of(self, model: ObservationModel) -> ObservationModel:
        """What a model of all vertices in all frames predicts of this; each run is kept."""
        return Remembered(rows_of(model, np.repeat(self.seen, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class Beats:
    """Cycles that follow one another, each from the open valve at rest with its own parameters.

    Attributes
    ----------
    model : ObservationModel
        Of one beat; all its frames make up the observation of a beat.
    """

    model: ObservationModel

    def frame(self, k: int, m: FloatArray, /) -> Predicted:
        """Predict beat ``k``, of which only the parameters differ from another's."""
        return self.model(m)
