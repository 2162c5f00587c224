"""What the frames of a cycle tell of each parameter, and parameters that drift over beats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from experiments.common.building.cycle_settings import CycleSettings
from experiments.common.building.filters import build_filter
from experiments.common.building.gate import gate_of
from experiments.common.building.whole_cycle import (
    Bound,
    closed_frame,
    cycle_model,
    stored_cycle,
    stored_frames,
    true_cycle,
)
from experiments.common.expectation import expect_cycle
from experiments.common.progress import TYPICAL_SOLVES, SolveBar, say
from experiments.common.records.findings import finite, rows, vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.cycle.findings import Along, Band, Curve, Drift, Findings, Frame, Steps
from experiments.studies.cycle.report import cycle_answer, cycle_figure, cycle_table, cycle_words
from experiments.studies.cycle.settings import Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import Beats, CycleObservation
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.filters.drift import DriftSmoother
from mvest.estimation.trajectory import Trajectory
from mvest.estimation.transform import Log
from mvest.typing import FloatArray

__all__ = ["STUDY", "frame_sets", "run_cycle"]

Values = Mapping[str, Any]


def frame_sets(total: int, closed: int) -> list[list[int]]:
    """Two frames, open and closed, and ever more of them spread evenly over the cycle."""
    counts = [n for n in (3, 5, 8) if n < total]
    spread = [
        sorted(set(np.linspace(0, total - 1, n).round().astype(int).tolist())) for n in counts
    ]
    return [[0, closed], *spread, list(range(total))]


def run_cycle(job: Job[Settings]) -> Outcome[Findings]:
    """Information per frame, set of frames and phase; the time step; a drift over beats.

    Raises
    ------
    ConfigurationError
        If the truth has no cycle, or time steps are not halved.
    """
    values, settings = job.values, job.settings.cycle
    truth, protocol = np.array(values["truth"]["values"], dtype=float), settings.protocol
    true = true_cycle(values, protocol, truth)
    frames, H = true.frames, true.jacobian
    closed = closed_frame(protocol)

    def bound(label: str, wanted: list[int]) -> Bound:
        return Bound.of(label, wanted, H, settings.noise_mm, truth)

    plateau = [k for k, t in enumerate(protocol.times) if protocol.phase(t) > 1 - 1e-9]
    phases = {
        "closing": list(range(1, plateau[0])),
        "held closed": plateau,
        "opening": list(range(closed + 1, len(frames))),
    }
    sets = tuple(
        bound(", ".join(f"{protocol.times[k]:g}" for k in wanted), wanted)
        for wanted in frame_sets(len(frames), closed)
    )
    steps = _time_steps(values, settings, truth)
    drift, runs = _drift(values, settings, truth)
    findings = Findings(
        truth=vector(truth),
        noise_mm=settings.noise_mm,
        vertices=frames.shape[1],
        frames=tuple(
            _frame(protocol, k, frames, H[k], truth, settings.noise_mm) for k in range(len(frames))
        ),
        curve=_curve(protocol),
        sets=sets,
        phases=tuple(bound(label, wanted) for label, wanted in phases.items() if wanted),
        steps=steps,
        drift=drift,
        measures={
            f"bound_{entry.count}_frames.{name}": value
            for entry in sets
            for name, value in zip(values["parameters"], entry.std, strict=True)
            if value is not None
        },
    )
    failed = (drift,) if isinstance(drift, str) else ()
    return outcome_of(findings, true.mesh, 1 + steps.runs + runs, failed, gate_of(values))


def _frame(
    protocol: CycleProtocol,
    k: int,
    frames: FloatArray,
    H: FloatArray,
    truth: FloatArray,
    noise: float,
) -> Frame:
    """What one frame says of each parameter if the others were known."""
    size = np.sqrt(np.sum(H.reshape(-1, len(truth)) ** 2, axis=0)) * truth
    with np.errstate(divide="ignore"):
        std = noise / size
    time = protocol.times[k]
    return Frame(
        time,
        protocol.pressure_mmHg * protocol.phase(time),
        float(np.linalg.norm(frames[k] - frames[0], axis=1).mean()),
        tuple(map(finite, std)),
    )


def _curve(protocol: CycleProtocol) -> Curve:
    t = np.linspace(0.0, protocol.times[-1], 141)
    return Curve(vector(t), tuple(protocol.pressure_mmHg * protocol.phase(v) for v in t))


def _time_steps(values: Values, settings: CycleSettings, truth: FloatArray) -> Steps:
    """What depends on the time step: the frames, and how smoothly they follow the parameters."""
    dts = settings.time_steps
    if any(not np.isclose(b, 0.5 * a) for a, b in pairwise(dts)):
        raise ConfigurationError(
            f"cycle.time_steps = {list(dts)}, expected each to be half of the one before"
        )
    path = np.tile(truth, (settings.path_steps + 1, 1))
    path[:, 0] *= np.linspace(1.0, 1.0 + settings.drift, len(path))
    found, along = [], []
    for dt in dts:
        model = cycle_model(values, replace(settings.protocol, dt=dt))
        with SolveBar(f"time step {dt:g} s", len(model.protocol.steps()), len(path)) as bar:
            model.closure.on_step = bar.step
            frames, reason = _followed(values, model, path)
        found.append(frames[0] if frames else None)
        changes = tuple(_rms(b - a) for a, b in pairwise(frames))
        along.append(Along(changes, reason))
        said = reason or f"unevenness {max(changes) / np.median(changes):.1f}"
        say(f"time step {dt:g} s: {said}")
    whole = tuple(None if a is None or b is None else _rms(b - a) for a, b in pairwise(found))
    order = tuple(None if not (a and b) else float(np.log2(a / b)) for a, b in pairwise(whole))
    return Steps(dts, whole, order, rows(path), tuple(along), len(dts) * len(path))


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


def _drift(values: Values, settings: CycleSettings, truth: FloatArray) -> tuple[Drift | str, int]:
    """A modulus that drifts from beat to beat, filtered and smoothed, and runs of the model."""
    names = values["parameters"]
    moduli = [k for k, name in enumerate(names) if name.startswith("E_f.")]
    kept = {name: truth[k] for k, name in enumerate(names) if k not in moduli}
    parameters = tuple(names[k] for k in moduli)
    changed = {**values, "parameters": parameters, "fixed": {**values["fixed"], **kept}}
    beats = settings.beats
    path = np.tile(truth[moduli], (beats, 1))
    path[:, 0] *= 1 + settings.drift * 0.5 * (1 - np.cos(np.pi * np.arange(beats) / (beats - 1)))
    protocol = replace(settings.protocol, times=settings.beat_times)
    maker, model = (cycle_model(changed, protocol) for _ in range(2))
    rng = np.random.default_rng(values["seed"])
    seen = [
        CycleObservation.simulated(stored_frames(changed, maker, m), settings.noise_mm, rng)
        for m in path
    ]
    _, _, whole = build_filter(values["filter"], tuple(names))
    initial = type(whole)(whole.mean[moduli], whole.covariance[np.ix_(moduli, moduli)])
    smoother = DriftSmoother(
        tuple(sum(o.sizes) for o in seen), settings.drift_std**2, tolerance=0.1
    )
    y, R = (np.concatenate([getattr(o, name) for o in seen]) for name in ("y", "R"))
    with SolveBar("drift", len(protocol.steps()), beats * TYPICAL_SOLVES) as bar:
        model.closure.on_step = bar.step
        found = smoother(Beats(stored_cycle(changed, model)), initial, y, R, transform=Log())
    say(f"drift: {found.reason.value}, {found.forward_solves} runs")
    if found.smoothed is None:
        return found.detail, found.forward_solves
    runs = found.forward_solves + beats
    if not found.converged:
        return found.reason.value, runs
    filtered = Trajectory(
        np.array([s.filtered.mean for s in found.extended]),
        np.array([s.filtered.covariance for s in found.extended]),
    )
    return Drift(
        runs,
        parameters,
        settings.beat_times,
        rows(path),
        settings.drift_std,
        _band(filtered, path),
        _band(found.smoothed, path),
    ), runs


def _band(trajectory: Trajectory, path: FloatArray) -> Band:
    """Medians and 95 % bands of parameters that are estimated by their logarithm."""
    error = trajectory.mean - np.log(path)
    low, high = (np.exp(trajectory.mean + s * 1.96 * trajectory.std) for s in (-1, 1))
    return Band(
        rows(np.exp(trajectory.mean)),
        rows(low),
        rows(high),
        vector(np.sqrt(np.mean(error**2, axis=0))),
        vector(trajectory.std.mean(axis=0)),
        vector(np.mean(np.abs(error) <= 1.96 * trajectory.std, axis=0)),
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_cycle,
    words=cycle_words,
    write=write_each(cycle_table, cycle_words, cycle_figure),
    keeps_failures=True,
    checks=lambda: (expect_cycle,),
    sections=(
        Section(
            "cycle",
            {
                "cycle": "The cycle and its frames, what they tell of each parameter, and a"
                " modulus that drifts over beats, filtered and smoothed. Simulated."
            },
            answer=answer_of_main(cycle_answer),
        ),
    ),
)
