"""The model of a whole cycle as it is configured, and what studies of it have in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.gate import model_of
from experiments.mirror import build
from experiments.truth import StoredModel, truth_key
from mvest.cycle import CycleModel, CycleObservation, CycleProtocol
from mvest.errors import ConfigurationError
from mvest.estimation import (
    Estimate,
    Gaussian,
    Identifiability,
    Prediction,
    shift_by_model_error,
)
from mvest.estimation.transform import to_filter
from mvest.gate import GateCase
from mvest.typing import FloatArray

__all__ = [
    "bound_entry",
    "closed_frame",
    "cycle_model",
    "frames_on_mesh",
    "shift_by_mesh",
    "stored_cycle",
    "stored_frames",
]

Values = Mapping[str, Any]


def cycle_model(config: Values, **changes: Any) -> CycleModel:
    """The configured model of a cycle, its protocol with ``changes``."""
    protocol = build(CycleProtocol, {**config["cycle"]["protocol"], **changes})
    return CycleModel(model_of(config, GateCase("reference")), protocol)


def closed_frame(protocol: CycleProtocol) -> int:
    """The last frame in which the valve is held closed."""
    held = [k for k, t in enumerate(protocol.times) if protocol.phase(t) > 1 - 1e-9]
    if not held:
        raise ConfigurationError("cycle.protocol.times has no frame on the plateau of the pressure")
    return held[-1]


def bound_entry(label: str, frames: list[int], bound: Identifiability) -> dict[str, Any]:
    """Plain data of a Cramér-Rao bound; standard deviations relative to the parameters."""
    relative = bound.std / bound.scale
    return {
        "frames": label,
        "count": len(frames),
        "std": [float(v) if np.isfinite(v) else None for v in relative],
        "correlation": [[_finite(v) for v in row] for row in bound.correlation],
        "condition_number": _finite(bound.condition_number),
        "flat": list(bound.flat(0.05)),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def stored_cycle(config: Values, model: CycleModel) -> StoredModel:
    """A model of ``config`` whose runs are kept, so that a study goes on where it was stopped."""
    return StoredModel(model, _store(config), _key(config, model), jacobian=True)


def stored_frames(config: Values, model: CycleModel, m: FloatArray) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of parameters ``m (p,)``, simulated once."""

    def positions(values: FloatArray) -> Prediction:
        y = model.frames(values).ravel()
        return Prediction(y, np.zeros((len(y), len(values))))

    found = StoredModel(positions, _store(config), _key(config, model))(m)
    return found.y.reshape(len(model.protocol.times), -1, 3)


def frames_on_mesh(config: Values, m: FloatArray, mesh: str) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of parameters ``m (p,)`` on the "finer" or the "check" mesh."""
    settings = config["cycle"]
    cells = {"columns": settings[f"{mesh}_columns"], "rows": settings[f"{mesh}_rows"]}
    points = dict(zip(("columns", "rows"), settings[f"{mesh}_contact"], strict=True))
    mechanics = {**config["mechanics"], "contact_points": points}
    changed = {**config, "mesh": {**config["mesh"], **cells}, "mechanics": mechanics}
    dt = settings["protocol"]["dt"] * settings["finer_dt_factor"]
    return stored_frames(changed, cycle_model(changed, dt=dt), m)


def shift_by_mesh(
    found: Estimate,
    predicted: Prediction,
    prior: Gaussian,
    observation: CycleObservation,
    off: FloatArray,
) -> FloatArray:
    """How far a model whose frames are ``off (f, n, 3)`` mm moves an estimate, ``(p,)``.

    In the filter's coordinates; ``predicted`` is what the model says of the observation at the
    estimate, with its derivative.
    """
    H = predicted.jacobian * found.transform.derivative(found.transform.forward(found.mean))
    wanted = off[observation.seen].ravel()
    return shift_by_model_error(H, observation.R, wanted, to_filter(found.transform, prior))


def _store(config: Values) -> Path:
    return Path(config["paths"]["outputs"]) / "cycles"


def _key(config: Values, model: CycleModel) -> str:
    parts = ("valve", "mechanics", "mesh", "parameters", "fixed")
    described = {name: config[name] for name in parts}
    observed = [config["observation"][name] for name in ("columns", "rows")]
    return truth_key(
        {**described, "observed": observed, "protocol": repr(model.protocol)}, more=("cycle",)
    )
