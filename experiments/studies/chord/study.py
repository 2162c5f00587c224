"""Stiffness and length of each family of chordae, estimated together with the moduli."""

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
from experiments.common.whole_cycle import bound_entry, closed_frame, cycle_model
from experiments.studies.chord.report import chord_text, write_chord
from experiments.studies.chord.settings import Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.information.consistency import nees
from mvest.estimation.information.identifiability import identifiability
from mvest.estimation.transform import to_filter
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_chord_study"]

Values = Mapping[str, Any]


def run_chord_study(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Estimate all parameters from open and closed frame, and from the whole cycle."""
    settings, parameters = config["cycle"], tuple(config["parameters"])
    _, transform, prior = build_filter(config["filter"], parameters)
    truth = np.array(config["truth"]["values"], dtype=float)
    # The truth is made by an object of its own; the estimator gets the observation alone.
    maker, model = cycle_model(config), cycle_model(config)
    at_truth = maker(truth)
    if not at_truth.converged:
        raise ConfigurationError(f"the truth has no cycle: {at_truth.reason}")
    frames = at_truth.y.reshape(len(maker.protocol.times), -1, 3)
    jacobian = at_truth.jacobian.reshape(*frames.shape, -1)
    noise = settings["noise_mm"]
    sets = {
        "open and closed": [0, closed_frame(maker.protocol)],
        "whole cycle": list(range(len(frames))),
    }

    def observed(seed: int) -> CycleObservation:
        rng = np.random.default_rng(config["seed"] + seed)
        return CycleObservation.simulated(frames, noise, rng)

    # Both sets are predicted from the same runs.
    whole = observed(0).of(model)

    def fit(label: str, observation: CycleObservation, start: FloatArray) -> Estimate:
        filter_ = IteratedFilter(
            config["filter"]["tolerance"],
            max_iterations=config["filter"]["max_iterations"],
            start=tuple(map(float, start)),
        )
        with SolveBar(label, len(maker.protocol.steps()), TYPICAL_SOLVES, parameters) as bar:
            model.closure.on_step = bar.step
            found = filter_(
                observation.of(whole),
                prior,
                observation.y,
                observation.R,
                names=parameters,
                transform=transform,
                on_iterate=bar.iterate,
            )
        errors = ", ".join(f"{100 * e:+.1f} %" for e in found.mean / truth - 1)
        print(f"{label}: {errors} ({found.reason.value})", file=sys.stderr, flush=True)
        return found

    results, bounds = [], []
    for label, wanted in sets.items():
        found = fit(label, observed(0).only(wanted), prior.mean)
        results.append(_entry(label, 0, found, truth))
        rows = jacobian[wanted].reshape(-1, len(truth))
        bounds.append(bound_entry(label, wanted, identifiability(rows, noise**2, truth)))
    start = np.array(results[-1]["estimate"])
    for seed in range(1, settings["seeds"]):
        # The mode does not depend on where its search starts.
        found = fit(f"seed {seed}", observed(seed), start)
        results.append(_entry("whole cycle", seed, found, truth))
    record = forward_record(config, config_hash, model.closure, truth, started, 0)
    record |= {
        "start": prior.mean.tolist(),
        "prior_std": to_filter(transform, prior).std.tolist(),
        "noise_mm": noise,
        "times": list(maker.protocol.times),
        "vertices": int(frames.shape[1]),
        "results": results,
        "bounds": bounds,
        "measures": {
            f"{what}.{name}": value
            for what in ("error", "std")
            for name, value in zip(parameters, results[1][what], strict=True)
        },
        "forward_solves": sum(entry["runs"] for entry in results),
    }
    failed = [entry for entry in results if entry["status"] != "converged"]
    if failed:
        record |= {"status": "failed", "reason": failed[0]["reason"]}
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


def _entry(label: str, seed: int, found: Estimate, truth: FloatArray) -> dict[str, Any]:
    covariance = found.transformed.covariance
    std = np.sqrt(np.diag(covariance))
    # In filter coordinates, where the posterior is nearly normal.
    offset = found.transformed.mean - found.transform.forward(truth)
    return {
        "frames": label,
        "seed": seed,
        "status": "converged" if found.converged else "failed",
        "reason": found.reason.value,
        "estimate": found.mean.tolist(),
        "error": (found.mean / truth - 1).tolist(),
        "std": std.tolist(),
        "correlation": (covariance / np.outer(std, std)).tolist(),
        "nees": nees(offset, covariance),
        "runs": found.forward_solves,
    }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_chord_study),
    words=lambda record: chord_text(flat(record)),
    write=each(write_chord),
    keeps_failures=True,
    checks=lambda: (foresee_cycle,),
    sections=(
        Section(
            "chord",
            {
                "chord": "What is known of chordae and leaflets before and after the data. "
                "Simulated."
            },
        ),
    ),
)
