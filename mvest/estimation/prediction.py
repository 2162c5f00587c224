"""What a filter needs from a model: the predicted observation and its Jacobian."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from mvest.errors import InputError, MaterialError
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Predicted observation h(m) and its Jacobian H = dh/dm, or the reason why there is none.

    InputError if a converged prediction has wrong shapes or values that are not finite, or a failed
    one has values or no reason.
    """

    #: (n,) in units of the observation, predicted observation; empty if the model failed
    y: FloatArray
    #: (n, p) in units of the observation per unit of each parameter, derivative of `y`; empty if
    #: the model failed, of shape (n, 0) if the model does not differentiate
    #: (`Prediction.undifferentiated`)
    jacobian: FloatArray
    converged: bool = True  #: False if the model has no solution. Filters then read only `reason`.
    reason: str = "converged"  #: why the model stopped; not empty if it failed
    aux: object = None  #: object, anything else for the caller of the filter, which ignores it

    def __post_init__(self) -> None:
        y = read_only(self.y)
        jacobian = read_only(self.jacobian)
        if self.converged:
            if y.ndim != 1 or jacobian.ndim != 2 or len(jacobian) != len(y):
                raise InputError(
                    f"a prediction must have y of shape (n,) and jacobian of shape (n, p); "
                    f"got {y.shape} and {jacobian.shape}"
                )
            for name, values in (("y", y), ("jacobian", jacobian)):
                require_finite(values, f"the prediction's {name}")
        else:
            if y.size or jacobian.size:
                raise InputError(
                    f"a failed prediction must carry no values, so that nobody uses them; got y of "
                    f"shape {y.shape} and jacobian of shape {jacobian.shape}: "
                    f"use Prediction.failed(reason)"
                )
            if not self.reason.strip():
                raise InputError("a failed prediction must say why; its reason is empty")
        object.__setattr__(self, "y", y)
        object.__setattr__(self, "jacobian", jacobian)

    @classmethod
    def undifferentiated(cls, y: FloatArray) -> "Prediction":
        """The prediction of a model without derivatives, for filters that need none."""
        return cls(y, np.empty((np.size(y), 0)))

    @property
    def differentiated(self) -> bool:
        """Whether there is a Jacobian."""
        return self.jacobian.shape[1] > 0

    @classmethod
    def failed(cls, reason: str) -> "Prediction":
        """The prediction of a model without a solution, and why."""
        return cls(np.empty(0), np.empty((0, 0)), converged=False, reason=reason)


Predicted: TypeAlias = Prediction | tuple[FloatArray, FloatArray]
"""What a model may return: a `Prediction`, or the pair (y, jacobian) of one that converged."""


class ObservationModel(Protocol):
    """Any function from parameters (p,) to a prediction; a filter knows nothing else of a model.

    The model must accept every finite m. If m is inadmissible, or the computation does not
    converge, it returns `Prediction.failed(reason)`: filters shorten a step that fails.
    """

    def __call__(self, m: FloatArray, /) -> Predicted:
        """Predict the observation of parameters m (p,)."""
        ...


def predict(
    model: ObservationModel, m: FloatArray, n: int | None = None, *, derivatives: bool = False
) -> Prediction:
    """Run a model at m (p,) and check its prediction, see `as_prediction`.

    If the model raises MaterialError the prediction has failed.
    """
    try:
        returned = model(np.array(m, dtype=np.float64))
    except MaterialError as error:
        return Prediction.failed(str(error))
    return as_prediction(returned, np.size(m), n, derivatives=derivatives)


def as_prediction(
    returned: Predicted, p: int, n: int | None = None, *, derivatives: bool = False
) -> Prediction:
    """Check what a model of p parameters returned, n observations if n is given.

    InputError if it is no prediction, its shapes are not (n,) and (n, p), or ``derivatives`` are
    missing.
    """
    if isinstance(returned, Prediction):
        prediction = returned
    else:
        try:
            pair = returned if isinstance(returned, tuple) else ()
            y, jacobian = (np.asarray(part, dtype=np.float64) for part in pair)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"a model must return a Prediction, or a tuple of y of shape (n,) and jacobian of "
                f"shape (n, {p}); got {type(returned).__name__}"
            ) from error
        prediction = Prediction(y, jacobian)
    if not prediction.converged:
        return prediction
    y, jacobian = prediction.y, prediction.jacobian
    plain = not derivatives and not prediction.differentiated
    if (n is not None and len(y) != n) or not (plain or jacobian.shape[1] == p):
        raise InputError(
            f"the model must predict {len(y) if n is None else n} observations and their "
            f"derivatives with respect to {p} parameters; got y of shape {y.shape} and jacobian of "
            f"shape {jacobian.shape}"
        )
    return prediction


def of_some(
    model: ObservationModel, values: FloatArray, kept: IntArray, *, snap: float = 0.0
) -> Callable[[FloatArray], Prediction]:
    """A model as a function of its parameters ``kept (k,)``; the others stay at ``values (p,)``.

    A parameter within the relative distance ``snap`` of its value is set to it, so that
    `SharedStart` recognises its start.
    """

    def part(m: FloatArray) -> Prediction:
        whole = np.array(values, dtype=np.float64)
        changed = ~np.isclose(m, whole[kept], rtol=snap, atol=0.0)
        whole[kept[changed]] = m[changed]
        prediction = predict(model, whole, derivatives=True)
        if not prediction.converged:
            return prediction
        return replace(prediction, jacobian=prediction.jacobian[:, kept])

    return part


class Remembered:
    """A model that runs once for each parameter vector.

    ``runs`` are pairs of parameters (p,) and predictions so far, failed ones included. Parameters
    within the relative distance ``rtol`` are the same.
    """

    def __init__(
        self,
        model: ObservationModel,
        runs: Iterable[tuple[FloatArray, Prediction]] = (),
        rtol: float = 0.0,
    ) -> None:
        self.model, self.runs, self.rtol = model, list(runs), rtol

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict once."""
        for at, prediction in self.runs:
            if np.allclose(at, m, rtol=self.rtol, atol=0.0):
                return prediction
        prediction = predict(self.model, m)
        self.runs.append((np.array(m, dtype=np.float64), prediction))
        return prediction


class SharedStart:
    """A model for many estimations that all begin at the same parameters ``start (p,)``.

    The prediction there is computed once. Each request for it resets the model to its state after
    that run (``model.restart(model.closed)``), so that an estimation gives the same numbers, bit
    for bit, alone or after others. No other code may use the model meanwhile.
    """

    def __init__(self, model: Any, start: FloatArray) -> None:
        self._model = model
        self.start = np.array(start, dtype=np.float64)
        self._first: tuple[Prediction, Any] | None = None

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an `ObservationModel` does."""
        if not np.array_equal(m, self.start):
            return predict(self._model, m)
        if self._first is None:
            self._model.restart(None)
            prediction = predict(self._model, m)
            self._first = prediction, self._model.closed
        prediction, closed = self._first
        self._model.restart(closed)
        return prediction


def read_only(values: FloatArray) -> FloatArray:
    """A view (no copy) of `values` in double precision that cannot be written through."""
    view = np.asarray(values, dtype=np.float64).view()
    view.flags.writeable = False
    return view


def require_positive(values: FloatArray, what: str) -> None:
    """Raise InputError unless all entries of `values` are finite and positive."""
    require_finite(np.atleast_1d(values), what)
    if np.any(values <= 0.0):
        raise InputError(f"{what} is {np.min(values):g}, expected > 0")


def require_finite(values: FloatArray, what: str) -> None:
    """Raise InputError naming the first entry of `values` that is NaN or infinite."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = index[0] if len(index) == 1 else index
        raise InputError(
            f"{what} must be finite; entry {where} is {values[index]}"
            + (f" ({len(bad)} such entries)" if len(bad) > 1 else "")
        )
