"""The model of a whole cycle as it is configured, and what studies of it have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.building.cycle_settings import CycleSettings
from experiments.common.building.filters import build_filter
from experiments.common.building.store import Store, StoredModel
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.records.findings import finite, vector
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import CycleObservation
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.information.model_error import shift_by_model_error
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.estimation.transform import Transform, to_filter
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = [
    "Bound",
    "CycleEstimator",
    "MeshShift",
    "TrueCycle",
    "closed_frame",
    "cycle_model",
    "finer_steps",
    "frames_on_mesh",
    "iterated_from",
    "shift_by_check_mesh",
    "stored_cycle",
    "stored_frames",
    "true_cycle",
]

Values = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Bound:
    """What some frames of a cycle could tell at best: the Cramér-Rao bound of p parameters.

    Attributes
    ----------
    frames : str
        Which.
    count : int
    std : (p,)
        Relative to the parameters; None where the frames do not determine one.
    correlation : (p, p)
    condition_number : float or None
        Of the information, scaled by the parameters.
    flat : tuple of str
        Combinations that are known badly.
    """

    frames: str
    count: int
    std: tuple[float | None, ...]
    correlation: tuple[tuple[float | None, ...], ...]
    condition_number: float | None
    flat: tuple[str, ...]

    @classmethod
    def of(
        cls, label: str, frames: list[int], jacobian: FloatArray, noise_mm: float, truth: FloatArray
    ) -> Bound:
        """The bound of ``frames`` from the Jacobian ``(f, n, 3, p)`` mm of all at the truth."""
        rows = jacobian[frames].reshape(-1, len(truth))
        bound = identifiability(rows, noise_mm**2, truth)
        return cls(
            label,
            len(frames),
            tuple(map(finite, bound.std / bound.scale)),
            tuple(tuple(map(finite, row)) for row in bound.correlation),
            finite(bound.condition_number),
            tuple(bound.flat(0.05)),
        )


def cycle_model(config: Values, protocol: CycleProtocol) -> CycleModel:
    """The configured model of a cycle."""
    return CycleModel(closure_model(config), protocol)


@dataclass(frozen=True, slots=True, eq=False)
class TrueCycle:
    """What a model of its own, of which no estimator sees anything, says of the truth.

    Attributes
    ----------
    frames : (f, n, 3)
        mm.
    jacobian : (f, n, 3, p)
    mesh : SolidMesh
    """

    frames: FloatArray
    jacobian: FloatArray
    mesh: SolidMesh


def true_cycle(config: Values, protocol: CycleProtocol, truth: FloatArray) -> TrueCycle:
    """The cycle of the true parameters ``(p,)``.

    Raises
    ------
    ConfigurationError
        If the cycle cannot be followed to its end.
    """
    model = cycle_model(config, protocol)
    with SolveBar("true cycle", len(protocol.steps()), 1) as bar:
        model.closure.on_step = bar.step
        found = stored_cycle(config, model)(truth)
    if not found.converged:
        raise ConfigurationError(f"the truth has no cycle: {found.reason}")
    frames = found.y.reshape(len(protocol.times), -1, 3)
    jacobian = found.jacobian.reshape(*frames.shape, len(truth))
    return TrueCycle(frames, jacobian, model.closure.mesh)


@dataclass(frozen=True, slots=True, eq=False)
class CycleEstimator:
    """Estimates with one model, which says how far each is.

    Attributes
    ----------
    model : CycleModel
    parameters : tuple of str, (p,)
    transform : Transform
    prior : Gaussian
        Of the parameters.
    """

    model: CycleModel
    parameters: tuple[str, ...]
    transform: Transform
    prior: Gaussian

    @classmethod
    def of(cls, config: Values, protocol: CycleProtocol) -> CycleEstimator:
        """As it is configured."""
        parameters = tuple(config["parameters"])
        _, transform, prior = build_filter(config["filter"], parameters)
        return cls(cycle_model(config, protocol), parameters, transform, prior)

    def __call__(
        self,
        label: str,
        filter_: Callable[..., T],
        seen: ObservationModel,
        observation: CycleObservation,
    ) -> T:
        """What a filter makes of an observation that ``seen`` predicts."""
        steps = len(self.model.protocol.steps())
        with SolveBar(label, steps, TYPICAL_SOLVES, self.parameters) as bar:
            self.model.closure.on_step = bar.step
            return filter_(
                seen,
                self.prior,
                observation.y,
                observation.R,
                names=self.parameters,
                transform=self.transform,
                on_iterate=bar.iterate,
            )


def iterated_from(config: Values, start: FloatArray) -> IteratedFilter:
    """The configured iterated filter, whose search begins at parameters ``start (p,)``."""
    settings = config["filter"]
    return IteratedFilter(
        settings["tolerance"], max_iterations=settings["max_iterations"], start=vector(start)
    )


def closed_frame(protocol: CycleProtocol) -> int:
    """The last frame in which the valve is held closed."""
    held = [k for k, t in enumerate(protocol.times) if protocol.phase(t) > 1 - 1e-9]
    if not held:
        raise ConfigurationError("cycle.protocol.times has no frame on the plateau of the pressure")
    return held[-1]


def stored_cycle(config: Values, model: CycleModel) -> StoredModel:
    """A model of ``config`` whose runs are kept, so that a study goes on where it was stopped."""
    return _stored(config, model, model, jacobian=True)


def stored_frames(config: Values, model: CycleModel, m: FloatArray) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of parameters ``m (p,)``, simulated once."""

    def positions(values: FloatArray) -> Prediction:
        y = model.frames(values).ravel()
        return Prediction(y, np.zeros((len(y), len(values))))

    found = _stored(config, model, positions)(m)
    return found.y.reshape(len(model.protocol.times), -1, 3)


def frames_on_mesh(
    config: Values, settings: CycleSettings, m: FloatArray, mesh: Literal["finer", "check"]
) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of parameters ``m (p,)`` on the "finer" or the "check" mesh.

    Cells and contact points are those of ``cycle.finer_...`` or ``cycle.check_...``, the time step
    is shorter by ``cycle.finer_dt_factor``.

    Raises
    ------
    InputError
        If the cycle cannot be followed to its end.
    """
    columns, rows, points = (
        (settings.finer_columns, settings.finer_rows, settings.finer_contact)
        if mesh == "finer"
        else (settings.check_columns, settings.check_rows, settings.check_contact)
    )
    contact = dict(zip(("columns", "rows"), points, strict=True))
    changed = {
        **config,
        "mesh": {**config["mesh"], "columns": columns, "rows": rows},
        "mechanics": {**config["mechanics"], "contact_points": contact},
    }
    return stored_frames(changed, cycle_model(changed, finer_steps(settings)), m)


def finer_steps(settings: CycleSettings) -> CycleProtocol:
    """The protocol with the time step of a finer truth."""
    dt = settings.protocol.dt * settings.finer_dt_factor
    return replace(settings.protocol, dt=dt)


@dataclass(frozen=True, slots=True, eq=False)
class MeshShift:
    """What a model's own mesh does to an estimate.

    Attributes
    ----------
    shift : (p,)
        Of the estimate, in the filter's coordinates.
    distance_mm : float
        Mean distance of what is seen on the two meshes.
    """

    shift: FloatArray
    distance_mm: float


def shift_by_check_mesh(
    config: Values,
    settings: CycleSettings,
    found: Estimate,
    model: ObservationModel,
    prior: Gaussian,
    observation: CycleObservation,
) -> MeshShift | str:
    """How far its mesh may have moved an estimate, from one run of it on the "check" mesh.

    ``model`` predicts what is seen in the observation, ``prior`` is of the parameters themselves. A
    reason where there is no estimate or the cycle cannot be followed on that mesh.
    """
    if not found.converged:
        return f"no estimate: {found.reason.value}"
    predicted = predict(model, found.mean)
    try:
        check = frames_on_mesh(config, settings, found.mean, "check")
    except InputError as error:
        return f"on the mesh of the check: {error}"
    off = check[observation.seen].ravel() - predicted.y
    H = predicted.jacobian * found.transform.derivative(found.transform.forward(found.mean))
    shift = shift_by_model_error(H, observation.R, off, to_filter(found.transform, prior))
    return MeshShift(shift, float(np.linalg.norm(off.reshape(-1, 3), axis=1).mean()))


def _stored(
    config: Values, model: CycleModel, predict: ObservationModel, *, jacobian: bool = False
) -> StoredModel:
    parts = ("valve", "mechanics", "mesh", "parameters", "fixed")
    described = {name: config[name] for name in parts}
    observed = [config["observation"][name] for name in ("columns", "rows")]
    described |= {"observed": observed, "protocol": repr(model.protocol)}
    store = Store(config["paths"]["outputs"])
    return store.model("cycles", predict, described, (cycle_model,), jacobian=jacobian)
