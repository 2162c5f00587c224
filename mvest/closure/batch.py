"""Many closures of one valve at once: one process for each core, one thread for each process."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.processes import side_by_side
from mvest.typing import FloatArray

__all__ = ["predict_many"]


def predict_many(
    model: ClosureModel, values: FloatArray, *, processes: int = 1
) -> list[Prediction]:
    """Predictions of one model at many parameter vectors, in their order.

    Every process builds the mechanics once and keeps them. Large arrays of the valve and its mesh
    are shared between the processes read-only, and the libraries below are held to one thread each,
    so that ``processes`` is the number of cores in use. A closure that fails is a failed prediction
    in its place, as for the model itself.

    Parameters
    ----------
    model : ClosureModel
        Left as it is. With ``continuation``, a closure starts from the one before in its process.
    values : ndarray
        ``(k, p)`` parameter vectors.
    processes : int
        1 computes here, without further processes.

    Raises
    ------
    InputError
        If the values have another shape or there is not at least one process.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(model.names):
        raise InputError(
            f"parameter vectors of shape {values.shape}, expected (k, {len(model.names)}) for "
            f"{', '.join(model.names)}"
        )
    if processes < 1:
        raise InputError(f"processes = {processes}, expected at least 1")
    # The mechanics that the model may have built belong to one process.
    fresh = model.fresh()
    if processes == 1:
        return _predict(fresh, values)
    # Neighbours in the list tend to cost alike: dealt out in turn, all processes get a like share.
    shares = [values[k::processes] for k in range(min(processes, len(values)))]
    done = list(side_by_side(_predict, ((fresh, share) for share in shares), processes))
    return [done[k % processes][k // processes] for k in range(len(values))]


def _predict(model: ClosureModel, values: Sequence[FloatArray] | FloatArray) -> list[Prediction]:
    return [model(m) for m in values]
