"""Models made of models: of some of the parameters, with a memory."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from mvest.estimation.prediction import ObservationModel, Predicted, Prediction, predict
from mvest.typing import FloatArray, IntArray

State = TypeVar("State")


def of_some(
    model: ObservationModel, values: FloatArray, kept: IntArray, *, snap: float = 0.0
) -> Callable[[FloatArray], Prediction]:
    """A model as a function of some of its parameters, the others held.

    Parameters
    ----------
    model : ObservationModel
    values : (p,)
        Of all parameters.
    kept : (k,)
        Which are the function's.
    snap : float
        A parameter whose relative distance from its value in ``values`` is no larger is taken for
        it, so that a run that is known is met to the last bit.
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

    Parameters
    ----------
    model : ObservationModel
    runs : iterable of ((p,), Prediction)
        What is known already.
    rtol : float
        Relative distance within which parameters are the same.

    Attributes
    ----------
    runs : list of ((p,), Prediction)
        What is known, failures included.
    """

    def __init__(
        self,
        model: ObservationModel,
        runs: Iterable[tuple[FloatArray, Prediction]] = (),
        rtol: float = 0.0,
    ) -> None:
        self.model, self.runs, self.rtol = model, list(runs), rtol

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an `ObservationModel` does."""
        for at, prediction in self.runs:
            if np.allclose(at, m, rtol=self.rtol, atol=0.0):
                return prediction
        prediction = predict(self.model, m)
        self.runs.append((np.array(m, dtype=np.float64), prediction))
        return prediction


class Restartable(Protocol[State]):
    """A model whose next prediction may start from where an earlier one ended."""

    @property
    def closed(self) -> State | None:
        """Where the next prediction would start from."""
        ...

    def restart(self, closed: State | None) -> None:
        """Forget everything but where to start from."""
        ...

    def __call__(self, m: FloatArray, /) -> Predicted:
        """Predict, as an `ObservationModel` does."""
        ...


class SharedStart(Generic[State]):
    """A model for many estimations that all begin with one and the same prediction.

    The prediction at the common start is computed once, and whenever it is asked for the model goes
    on from there as if nothing else had been computed before. So an estimation gives the same
    numbers, to the last bit, by itself and after any others.

    Parameters
    ----------
    model : Restartable
        Nobody else may use it meanwhile.
    start : (p,)
        Parameters at which every estimation begins.
    """

    def __init__(self, model: Restartable[State], start: FloatArray) -> None:
        self._model = model
        self.start = np.array(start, dtype=np.float64)
        self._first: tuple[Prediction, State | None] | None = None

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
