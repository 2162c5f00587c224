"""Chordal length and leaflet moduli, estimated together from a whole cycle."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
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
    frames_on_mesh,
    shift_by_check_mesh,
    stored_cycle,
)
from experiments.studies.joint.report import joint_text, write_joint
from experiments.studies.joint.settings import Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.sequential import SequentialEstimate, SequentialFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.consistency import nees
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.transform import Transform
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_joint_study"]

Values = Mapping[str, Any]


def run_joint_study(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Estimate from frames without noise, with noise, and of a finer model."""
    settings = config["cycle"]
    parameters = tuple(config["parameters"])
    _, transform, prior = build_filter(config["filter"], parameters)
    truth = np.array(config["truth"]["values"], dtype=float)
    # The truth is made by an object of its own; the estimator gets the observation alone.
    maker, model = cycle_model(config), cycle_model(config)
    at_truth = stored_cycle(config, maker)(truth)
    if not at_truth.converged:
        raise ConfigurationError(f"the truth has no cycle: {at_truth.reason}")
    frames = at_truth.y.reshape(len(maker.protocol.times), -1, 3)
    noise, told = settings["noise_mm"], settings["exact_told_mm"]
    seen = CycleObservation(frames, noise).of(stored_cycle(config, model))
    tolerance = settings["objective_tolerance"]
    study = _Study(model, parameters, transform, prior, seen, truth, tolerance)

    def rows_of(wanted: list[int]) -> FloatArray:
        return at_truth.jacobian.reshape(*frames.shape, -1)[wanted].reshape(-1, len(truth))

    everything, two = list(range(len(frames))), [0, closed_frame(maker.protocol)]
    bounds = [
        bound_entry(label, wanted, identifiability(rows_of(wanted), noise**2, truth))
        for label, wanted in (("open and closed", two), ("whole cycle", everything))
    ]
    bound = np.array(bounds[1]["std"], dtype=float)

    exact_seen = CycleObservation.simulated(frames, 0.0, _rng(config, 0), told)
    exact = study.sequential(exact_seen)
    _tell("no noise", exact.estimate, truth)
    seeds: list[Estimate] = []
    first: SequentialEstimate | None = None
    observations = [
        CycleObservation.simulated(frames, noise, _rng(config, k)) for k in range(settings["seeds"])
    ]
    for k, observation in enumerate(observations):
        if first is None:
            first = study.sequential(observation)
            seeds.append(first.estimate)
        else:
            # The mode does not depend on where its search starts.
            seeds.append(study.batch(observation, seeds[0].mean))
        _tell(f"seed {k}", seeds[-1], truth)
    assert first is not None
    finer = frames_on_mesh(config, truth, "finer")
    seen_finer = CycleObservation.simulated(finer, noise, _rng(config, 0))
    other = study.batch(seen_finer, seeds[0].mean)
    _tell("finer truth", other, truth)
    errors = np.array([e.mean / truth - 1 for e in seeds if e.converged])
    runs = [exact.estimate, *seeds, other]
    record = forward_record(
        config, config_hash, model.closure, truth, started, sum(e.forward_solves for e in runs)
    )
    record |= {
        "times": list(maker.protocol.times),
        "start": prior.mean.tolist(),
        "noise_mm": noise,
        "told_mm": told,
        "vertices": int(frames.shape[1]),
        "bounds": bounds,
        "exact": _entry(exact.estimate, truth, exact_seen) | {"frames": study.path(exact)},
        "seeds": [
            _entry(e, truth, observation) | {"seed": config["seed"] + k}
            for k, (e, observation) in enumerate(zip(seeds, observations, strict=True))
        ],
        "first": study.path(first),
        "passes": _passes(first.estimate, truth),
        "measures": {
            f"{what}.{name}": float(value)
            for what, values in (
                ("error_exact", exact.estimate.mean / truth - 1),
                ("rms_over_bound", np.sqrt(np.mean(errors**2, axis=0)) / bound),
                ("error_finer", other.mean / truth - 1),
            )
            for name, value in zip(parameters, values, strict=True)
        },
        "rms_over_bound": (np.sqrt(np.mean(errors**2, axis=0)) / bound).tolist(),
        "finer": _entry(other, truth, seen_finer)
        | {
            "cells": [settings["finer_columns"], settings["finer_rows"]],
            "distance_mm": float(np.linalg.norm(finer - frames, axis=2).mean()),
        },
        "told": _with_mesh_error(config, study, other, seen_finer),
    }
    failed = [e for e in runs if not e.converged]
    if failed:
        record |= {"status": "failed", "reason": failed[0].reason.value}
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


class _Study:
    """What all estimates of the study share."""

    def __init__(
        self,
        model: CycleModel,
        parameters: tuple[str, ...],
        transform: Transform,
        prior: Gaussian,
        seen: ObservationModel,
        truth: FloatArray,
        tolerance: float,
    ) -> None:
        self.model = model
        self.parameters, self.transform, self.prior = parameters, transform, prior
        self.seen = seen
        self.truth, self.tolerance = truth, tolerance

    def sequential(self, observation: CycleObservation) -> SequentialEstimate:
        with self._bar("frame by frame") as bar:
            return SequentialFilter(observation.sizes, relinearise=0.1).run(
                self.seen,
                self.prior,
                observation.y,
                observation.R,
                names=self.parameters,
                transform=self.transform,
                on_iterate=bar.iterate,
            )

    def batch(self, observation: CycleObservation, start: FloatArray) -> Estimate:
        filter_ = IteratedFilter(
            tolerance=1e-3, objective_tolerance=self.tolerance, start=tuple(map(float, start))
        )
        with self._bar("all frames at once") as bar:
            return filter_(
                self.seen,
                self.prior,
                observation.y,
                observation.R,
                names=self.parameters,
                transform=self.transform,
                on_iterate=bar.iterate,
            )

    def _bar(self, title: str) -> SolveBar:
        steps = len(self.model.protocol.steps())
        bar = SolveBar(title, steps, TYPICAL_SOLVES, self.parameters)
        self.model.closure.on_step = bar.step
        return bar

    def path(self, found: SequentialEstimate) -> list[dict[str, Any]]:
        """Relative error and relative standard deviation after each frame of the first pass."""
        rows = []
        for extended, final in zip(found.extended, found.final, strict=True):
            m = self.transform.inverse(extended.filtered.mean)
            rows.append(
                {
                    "error": (m / self.truth - 1).tolist(),
                    "std": extended.filtered.std.tolist(),
                    "nis": final.nis,
                    "nis_band": list(final.nis_band),
                    "gain_nats": final.information_gain,
                }
            )
        return rows


def _with_mesh_error(
    config: Values, study: _Study, found: Estimate, observation: CycleObservation
) -> dict[str, Any]:
    """The estimate with how far its mesh may have moved it, each parameter for itself."""
    cells = [config["cycle"]["check_columns"], config["cycle"]["check_rows"]]
    told = shift_by_check_mesh(config, found, study.seen, study.prior, observation)
    if isinstance(told, str):
        return {"status": "failed", "reason": told, "cells": cells}
    scale = study.transform.derivative(study.transform.forward(found.mean)) / study.truth
    covariance = found.transformed.covariance + np.diag(told.shift**2)
    offset = found.transformed.mean - study.transform.forward(study.truth)
    return _entry(found, study.truth, observation) | {
        "shift": (told.shift * scale).tolist(),
        "std": (np.sqrt(np.diag(covariance)) * scale).tolist(),
        "nees": nees(offset, covariance),
        "distance_mm": told.distance_mm,
        "cells": cells,
    }


def _passes(found: Estimate, truth: FloatArray) -> list[dict[str, Any]]:
    """Relative error and standard deviation at the end of each pass over all frames."""
    pairs = zip(found.iterates[1:], found.iterate_std[1:], strict=True)
    return [{"error": (m / truth - 1).tolist(), "std": (s / truth).tolist()} for m, s in pairs]


def _entry(found: Estimate, truth: FloatArray, seen: CycleObservation) -> dict[str, Any]:
    error = found.mean - truth
    return {
        "status": "converged" if found.converged else "failed",
        "reason": found.reason.value,
        "estimate": found.mean.tolist(),
        "error": (error / truth).tolist(),
        "std": (found.std / truth).tolist(),
        "nees": nees(error, found.covariance),
        "iterations": found.iterations,
        "runs": found.forward_solves,
        "residual_mm": found.residual_rms(seen.y),
    }


def _rng(config: Values, k: int) -> np.random.Generator:
    return np.random.default_rng(config["seed"] + k)


def _tell(label: str, found: Estimate, truth: FloatArray) -> None:
    errors = ", ".join(f"{100 * e:+.2f} %" for e in found.mean / truth - 1)
    print(f"{label}: {errors} ({found.forward_solves} runs)", file=sys.stderr, flush=True)


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_joint_study),
    words=lambda record: joint_text(flat(record)),
    write=each(write_joint),
    checks=lambda: (foresee_cycle,),
    sections=(
        Section(
            "joint",
            {
                "joint": "Estimates as frames come in, errors over seeds, and what two frames"
                " and a "
                "whole cycle could tell. Simulated."
            },
        ),
        Section(
            "joint_open",
            {"joint_open": "As the figure before, of a valve that opens fully. Simulated."},
        ),
    ),
)
