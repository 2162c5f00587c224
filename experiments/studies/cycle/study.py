"""What the frames of a cycle tell of each parameter, and parameters that drift over beats."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import build_filter
from experiments.common.expectation import foresee_cycle
from experiments.common.forward import forward_record
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.study import Section, Study
from experiments.common.whole_cycle import (
    bound_entry,
    closed_frame,
    cycle_model,
    stored_cycle,
    stored_frames,
)
from experiments.studies.cycle.report import cycle_text, write_cycle
from experiments.studies.cycle.settings import Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import Beats, CycleObservation
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.filters.drift import DriftSmoother
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.trajectory import Trajectory
from mvest.estimation.transform import Log
from mvest.typing import FloatArray

__all__ = ["STUDY", "frame_sets", "run_cycle_study"]

Values = Mapping[str, Any]


def frame_sets(total: int, closed: int) -> list[list[int]]:
    """Two frames, open and closed, and ever more of them spread evenly over the cycle."""
    counts = [n for n in (3, 5, 8) if n < total]
    spread = [
        sorted(set(np.linspace(0, total - 1, n).round().astype(int).tolist())) for n in counts
    ]
    return [[0, closed], *spread, list(range(total))]


def run_cycle_study(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Information per frame, set of frames and phase; the time step; a drift over beats."""
    settings = config["cycle"]
    truth = np.array(config["truth"]["values"], dtype=float)
    model = cycle_model(config)
    with SolveBar("cycle", len(model.protocol.steps()), 1) as bar:
        model.closure.on_step = bar.step
        prediction = stored_cycle(config, model)(truth)
    if not prediction.converged:
        raise ConfigurationError(f"the truth has no cycle: {prediction.reason}")
    protocol = model.protocol
    frames = prediction.y.reshape(len(protocol.times), -1, 3)
    H = prediction.jacobian.reshape(*frames.shape, len(truth))
    closed = closed_frame(protocol)

    def bound(label: str, wanted: list[int]) -> dict[str, Any]:
        rows = H[wanted].reshape(-1, len(truth))
        return bound_entry(label, wanted, identifiability(rows, settings["noise_mm"] ** 2, truth))

    plateau = [k for k, t in enumerate(protocol.times) if protocol.phase(t) > 1 - 1e-9]
    phases = {
        "closing": list(range(1, plateau[0])),
        "held closed": plateau,
        "opening": list(range(closed + 1, len(frames))),
    }
    sets = frame_sets(len(frames), closed)
    record = forward_record(config, config_hash, model.closure, truth, started, 1)
    record |= {
        "noise_mm": settings["noise_mm"],
        "vertices": int(frames.shape[1]),
        "frames": [
            _frame(t, model, frames, H[k], truth, settings["noise_mm"], k)
            for k, t in enumerate(protocol.times)
        ],
        "curve": _curve(model),
        "sets": [bound(", ".join(f"{protocol.times[k]:g}" for k in s), s) for s in sets],
        "phases": [bound(label, wanted) for label, wanted in phases.items() if wanted],
        "steps": _time_steps(config, truth),
    }
    record["measures"] = {
        f"bound_{entry['count']}_frames.{name}": value
        for entry in record["sets"]
        for name, value in zip(config["parameters"], entry["std"], strict=True)
        if value is not None
    }
    drift = _drift(config, truth)
    record["drift"] = drift
    record["forward_solves"] = 1 + record["steps"]["runs"] + drift["runs"]
    if drift["status"] != "converged":
        record |= {"status": "failed", "reason": drift["reason"]}
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


def _frame(
    t: float,
    model: CycleModel,
    frames: FloatArray,
    H: FloatArray,
    truth: FloatArray,
    noise: float,
    k: int,
) -> dict[str, Any]:
    """What one frame says of each parameter if the others were known."""
    size = np.sqrt(np.sum(H.reshape(-1, len(truth)) ** 2, axis=0)) * truth
    with np.errstate(divide="ignore"):
        std = noise / size
    return {
        "time": t,
        "pressure_mmHg": model.protocol.pressure_mmHg * model.protocol.phase(t),
        "displacement_mm": float(np.linalg.norm(frames[k] - frames[0], axis=1).mean()),
        "std_alone": [float(v) if np.isfinite(v) else None for v in std],
    }


def _curve(model: CycleModel) -> dict[str, list[float]]:
    t = np.linspace(0.0, model.protocol.times[-1], 141)
    p = model.protocol
    return {"time": t.tolist(), "pressure_mmHg": [p.pressure_mmHg * p.phase(v) for v in t]}


def _time_steps(config: Values, truth: FloatArray) -> dict[str, Any]:
    """What depends on the time step: the frames, and how smoothly they follow the parameters."""
    dts: list[float] = config["cycle"]["time_steps"]
    if any(not np.isclose(b, 0.5 * a) for a, b in pairwise(dts)):
        raise ConfigurationError(
            f"cycle.time_steps = {dts}, expected each to be half of the one before"
        )
    path = np.tile(truth, (config["cycle"]["path_steps"] + 1, 1))
    path[:, 0] *= np.linspace(1.0, 1.0 + config["cycle"]["drift"], len(path))
    found, along = [], []
    for dt in dts:
        model = cycle_model(config, dt=dt)
        with SolveBar(f"time step {dt:g} s", len(model.protocol.steps()), len(path)) as bar:
            model.closure.on_step = bar.step
            frames, reason = _followed(config, model, path)
        found.append(frames[0] if frames else None)
        changes = [_rms(b - a) for a, b in pairwise(frames)]
        along.append({"rms_mm": changes, "reason": reason})
        told = reason or f"unevenness {max(changes) / np.median(changes):.1f}"
        print(f"time step {dt:g} s: {told}", file=sys.stderr, flush=True)
    halved = [None if a is None or b is None else b - a for a, b in pairwise(found)]
    whole = [None if change is None else _rms(change) for change in halved]
    return {
        "dt": dts,
        "rms_mm": whole,
        "order": [None if not (a and b) else float(np.log2(a / b)) for a, b in pairwise(whole)],
        "path": path.tolist(),
        "along": along,
        "runs": len(dts) * len(path),
    }


def _followed(config: Values, model: CycleModel, path: FloatArray) -> tuple[list[FloatArray], str]:
    """Frames of the parameters along a path, up to the first that has none, and why it has none."""
    frames: list[FloatArray] = []
    try:
        for m in path:
            frames.append(stored_frames(config, model, m))
    except InputError as error:
        return frames, str(error)
    return frames, ""


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _drift(config: Values, truth: FloatArray) -> dict[str, Any]:
    """A modulus that drifts from beat to beat, filtered and smoothed."""
    settings = config["cycle"]
    moduli = [k for k, name in enumerate(config["parameters"]) if name.startswith("E_f.")]
    kept = {n: truth[k] for k, n in enumerate(config["parameters"]) if k not in moduli}
    changed = {
        **config,
        "parameters": [config["parameters"][k] for k in moduli],
        "fixed": {**config["fixed"], **kept},
    }
    beats, times = settings["beats"], settings["beat_times"]
    path = np.tile(truth[moduli], (beats, 1))
    path[:, 0] *= 1 + settings["drift"] * 0.5 * (1 - np.cos(np.pi * np.arange(beats) / (beats - 1)))
    maker, model = (cycle_model(changed, times=times) for _ in range(2))
    rng = np.random.default_rng(config["seed"])
    seen = [
        CycleObservation.simulated(stored_frames(changed, maker, m), settings["noise_mm"], rng)
        for m in path
    ]
    _, _, whole = build_filter(config["filter"], tuple(config["parameters"]))
    initial = type(whole)(whole.mean[moduli], whole.covariance[np.ix_(moduli, moduli)])
    smoother = DriftSmoother(
        tuple(sum(o.sizes) for o in seen), settings["drift_std"] ** 2, tolerance=0.1
    )
    y, R = (np.concatenate([getattr(o, name) for o in seen]) for name in ("y", "R"))
    with SolveBar("drift", len(model.protocol.steps()), beats * TYPICAL_SOLVES) as bar:
        model.closure.on_step = bar.step
        found = smoother(Beats(stored_cycle(changed, model)), initial, y, R, transform=Log())
    print(f"drift: {found.reason.value}, {found.forward_solves} runs", file=sys.stderr, flush=True)
    if found.smoothed is None:
        return {"status": "failed", "reason": found.detail, "runs": found.forward_solves}
    filtered = Trajectory(
        np.array([s.filtered.mean for s in found.extended]),
        np.array([s.filtered.covariance for s in found.extended]),
    )
    return {
        "status": "converged" if found.converged else "failed",
        "reason": found.reason.value,
        "runs": found.forward_solves + beats,
        "parameters": changed["parameters"],
        "times": list(times),
        "truth": path.tolist(),
        "told_std": settings["drift_std"],
        "filter": _band(filtered, path),
        "smoother": _band(found.smoothed, path),
    }


def _band(trajectory: Trajectory, path: FloatArray) -> dict[str, Any]:
    """Medians and 95 % bands of parameters that are estimated by their logarithm."""
    error = trajectory.mean - np.log(path)
    low, high = (np.exp(trajectory.mean + s * 1.96 * trajectory.std) for s in (-1, 1))
    return {
        "mean": np.exp(trajectory.mean).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "rms_error": np.sqrt(np.mean(error**2, axis=0)).tolist(),
        "mean_std": trajectory.std.mean(axis=0).tolist(),
        "coverage": np.mean(np.abs(error) <= 1.96 * trajectory.std, axis=0).tolist(),
    }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_cycle_study),
    words=lambda record: cycle_text(flat(record)),
    write=each(write_cycle),
    keeps_failures=True,
    checks=lambda: (foresee_cycle,),
    sections=(
        Section(
            "cycle",
            {
                "cycle": "The cycle and its frames, what they tell of each parameter, and a "
                "modulus "
                "that drifts over beats, filtered and smoothed. Simulated."
            },
        ),
    ),
)
