"""Observations of corresponding vertices, and what a model predicts of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError
from mvest.estimation.noise import NoiseCovariance, scaled_noise, stacked_noise
from mvest.estimation.prediction import (
    ObservationModel,
    Prediction,
    predict,
    read_only,
    require_finite,
    require_positive,
)
from mvest.observation.errors import SpatialCorrelation
from mvest.typing import BoolArray, FloatArray

ALL_VERTICES = "all vertices"
LANDMARKS = 10
"""On the free edge, and as many halfway to it, evenly around the valve."""

FRAMES = ("open", "closed")
"""Frames that a valve model predicts, in the order in which it stacks them."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observed positions of vertices, with the assumed noise."""

    frames: tuple[str, ...]  #: tuple of str, (f,), observed frames, the closed one last
    #: (f, n, 3) mm, positions of the vertices in each frame; NaN for vertices that are not seen
    positions: FloatArray
    variance: FloatArray  #: (f,) mm², assumed variance of each coordinate in each frame
    #: assumed correlation between vertices; None for independent errors
    correlation: SpatialCorrelation | None = None
    #: (n,) or None, standard deviation of each vertex over that of its frame; None: all 1
    scale: FloatArray | None = None
    #: frames that the model predicts, in the order in which it stacks them
    predicted: tuple[str, ...] = FRAMES

    def __post_init__(self) -> None:
        require_frames(self.frames, self.predicted)
        f, positions = len(self.frames), np.array(self.positions, dtype=np.float64)
        if positions.ndim != 3 or positions.shape[::2] != (f, 3):
            raise InputError(
                f"observed positions have shape {positions.shape}, expected ({f}, n, 3): one row "
                f"for each of {', '.join(self.frames)}"
            )
        unseen: BoolArray = np.all(np.isnan(positions), axis=2)
        require_finite(np.where(unseen[..., None], 0.0, positions), "the observed positions")
        if np.all(unseen):
            raise InputError("no observed position is finite: no vertex is seen")
        variance = np.array(self.variance, dtype=np.float64)
        if variance.shape not in ((), (f,)):
            raise InputError(
                f"R has shape {variance.shape}; expected one variance, or one for each of the {f} "
                "observed frames"
            )
        require_positive(variance, "R")
        if self.correlation is not None and len(self.correlation.points) != positions.shape[1]:
            raise InputError(
                f"R is correlated between {len(self.correlation.points)} vertices, but "
                f"{positions.shape[1]} are observed"
            )
        object.__setattr__(self, "positions", read_only(positions))
        object.__setattr__(self, "variance", np.broadcast_to(variance, f))
        if self.scale is not None:
            scale = scales("scale of R", self.scale, positions.shape[1])
            object.__setattr__(self, "scale", scale)

    @property
    def seen(self) -> BoolArray:
        """Which vertices are seen in each frame ``(f, n)``."""
        return np.isfinite(self.positions[:, :, 0])

    @property
    def y(self) -> FloatArray:
        """Stacked coordinates ``(3 k,)`` mm of the k seen vertices, frame by frame."""
        return self.positions[self.seen].ravel()

    @property
    def sizes(self) -> tuple[int, ...]:
        """Length of each frame's part of ``y``."""
        return tuple((3 * self.seen.sum(axis=1)).tolist())

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """The model's prediction of this observation; see :func:`observed_frames`."""
        return observed_frames(model, self.frames, self.seen, self.predicted)

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distance ``(n,)`` mm of each vertex of the last frame from fitted ``(f, n, 3)``.

        NaN for vertices that are not seen.
        """
        return np.asarray(np.linalg.norm(fitted[-1] - self.positions[-1], axis=1))

    @property
    def R(self) -> NoiseCovariance:
        """Covariance in mm² of ``y``: its variances ``(3 k,)``, or factorised if correlated."""
        scale = np.ones(self.positions.shape[1]) if self.scale is None else self.scale
        if self.correlation is None:
            stds = np.concatenate([np.repeat(scale[seen], 3) for seen in self.seen])
            return np.asarray(np.repeat(self.variance, self.sizes) * stds**2)
        blocks = []
        for seen, variance in zip(self.seen, self.variance, strict=True):
            if seen.any():
                noise = self.correlation.of(seen).noise(float(variance), 3)
                own = np.repeat(scale[seen], 3)
                blocks.append(noise if self.scale is None else scaled_noise(noise, own))
        return stacked_noise(blocks)


def scales(what: str, values: FloatArray, size: int) -> FloatArray:
    """A read-only copy of ``size`` positive factors on standard deviations, or InputError."""
    scale = np.array(values, dtype=np.float64)
    if scale.shape != (size,):
        raise InputError(f"{what} has shape {scale.shape}, expected ({size},)")
    require_positive(scale, what)
    return read_only(scale)


def require_frames(frames: Sequence[str], predicted: Sequence[str] = FRAMES) -> None:
    """Raise InputError unless ``frames`` are different frames out of those ``predicted``."""
    if not frames or not set(frames) <= set(predicted) or len(set(frames)) != len(frames):
        raise InputError(f"observed frames {list(frames)}, expected some of {list(predicted)}")


def observed_frames(
    model: ObservationModel,
    frames: Sequence[str],
    seen: BoolArray | None = None,
    predicted: Sequence[str] = FRAMES,
) -> Callable[[FloatArray], Prediction]:
    """The observed frames of a model that predicts all of ``predicted``, stacked.

    ``aux`` of a prediction are these frames with all vertices, ``(f, n, 3)`` mm.

    Parameters
    ----------
    model : ObservationModel
    frames : sequence of str, (f,)
    seen : (f, n), optional
        Vertices that are predicted in each frame; default all.
    predicted : sequence of str
    """
    rows = slice(None) if seen is None else np.repeat(seen, 3)

    def observed(m: FloatArray) -> Prediction:
        prediction = predict(model, m)
        if not prediction.converged:
            return prediction
        y, jacobian = (
            select_frames(a, frames, predicted) for a in (prediction.y, prediction.jacobian)
        )
        whole = y.reshape(len(frames), -1, 3)
        return replace(prediction, y=y[rows], jacobian=jacobian[rows], aux=whole)

    return observed


def select_frames(
    stacked: FloatArray, frames: Sequence[str], predicted: Sequence[str] = FRAMES
) -> FloatArray:
    """Rows of the named frames out of all that are ``predicted``."""
    size = len(stacked) // len(predicted)
    starts = [size * predicted.index(frame) for frame in frames]
    return np.concatenate([stacked[start : start + size] for start in starts])


def vertex_sets(columns: int, rows: int) -> dict[str, BoolArray]:
    """Sets of vertices that might be seen, out of ``columns x rows``, annulus first; each ``(n,)``.

    ``columns, rows``: vertices around the valve, and from the annulus to the free edge.
    """
    row, column = np.divmod(np.arange(columns * rows), columns)
    way = row / (rows - 1)
    around = np.isin(column, np.linspace(0, columns, LANDMARKS, endpoint=False).astype(int))
    return {
        ALL_VERTICES: way >= 0.0,
        "belly (middle third)": (way >= 1 / 3) & (way <= 2 / 3),
        "annulus and free edge": (way == 0.0) | (way == 1.0),
        "free edge": way == 1.0,
        f"{2 * LANDMARKS} landmarks": around
        & ((way == 1.0) | (way == way[np.argmin(abs(way - 0.5))])),
    }
