"""What a filter needs from a biomechanical model: the observation it predicts, and its Jacobian."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Predicted observation h(m) and its Jacobian H = dh/dm, or the reason why there is none.

    Attributes
    ----------
    y : (n,) in units of the observation
        Predicted observation; empty where the model failed.
    jacobian : (n, p) in units of the observation per unit of each parameter
        Derivative of `y`; empty where the model failed, and of shape (n, 0) where the model does
        not differentiate (`Prediction.undifferentiated`).
    converged : bool
        False if the model found no answer. Filters then read nothing but `reason`.
    reason : str
        Why the model stopped; must say something where it failed.

    Raises
    ------
    InputError
        If a prediction that claims convergence has wrong shapes or values that are not finite, or
        a failed one carries values that could be taken for a result, or gives no reason.
    """

    y: FloatArray
    jacobian: FloatArray
    converged: bool = True
    reason: str = "converged"

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
        """Whether the Jacobian is there."""
        return self.jacobian.shape[1] > 0

    @classmethod
    def failed(cls, reason: str) -> "Prediction":
        """The prediction of a model that found no answer, and why."""
        return cls(np.empty(0), np.empty((0, 0)), converged=False, reason=reason)


class ObservationModel(Protocol):
    """Any function from parameters (p,) to a `Prediction`; this is all a filter knows of a model.

    The model must accept every finite m. Where m is inadmissible, or the computation does not
    converge, it returns `Prediction.failed(reason)` and raises nothing: filters try steps that may
    leave the admissible range and shorten them when told so.
    """

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict the observation of parameters m (p,)."""
        ...


def read_only(values: FloatArray) -> FloatArray:
    """A view (no copy) of `values` in double precision that cannot be written through."""
    view = np.asarray(values, dtype=np.float64).view()
    view.flags.writeable = False
    return view


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
