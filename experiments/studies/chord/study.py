"""Stiffness and length of each family of chordae, estimated together with the moduli."""

from __future__ import annotations

import sys

import numpy as np

from experiments.common.build import build_filter
from experiments.common.expectation import expect_cycle
from experiments.common.forward import outcome_of
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.record import Outcome
from experiments.common.report import write_each
from experiments.common.study import Job, Section, Study
from experiments.common.whole_cycle import Bound, closed_frame, cycle_model
from experiments.studies.chord.findings import Findings, Fit
from experiments.studies.chord.report import chord_figure, chord_table, chord_words
from experiments.studies.chord.settings import Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.transform import to_filter
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_chord"]


def run_chord(job: Job[Settings]) -> Outcome[Findings]:
    """Estimate all parameters from open and closed frame, and from the whole cycle.

    Raises
    ------
    ConfigurationError
        If the truth has no cycle.
    """
    values, settings = job.values, job.settings.cycle
    parameters, protocol, noise = tuple(values["parameters"]), settings.protocol, settings.noise_mm
    _, transform, prior = build_filter(values["filter"], parameters)
    truth = np.array(values["truth"]["values"], dtype=float)
    # The truth is made by an object of its own; the estimator gets the observation alone.
    maker, model = (cycle_model(values, protocol) for _ in range(2))
    at_truth = maker(truth)
    if not at_truth.converged:
        raise ConfigurationError(f"the truth has no cycle: {at_truth.reason}")
    frames = at_truth.y.reshape(len(protocol.times), -1, 3)
    jacobian = at_truth.jacobian.reshape(*frames.shape, -1)
    sets = {
        "open and closed": [0, closed_frame(protocol)],
        "whole cycle": list(range(len(frames))),
    }

    def observed(seed: int) -> CycleObservation:
        rng = np.random.default_rng(values["seed"] + seed)
        return CycleObservation.simulated(frames, noise, rng)

    # Both sets are predicted from the same runs.
    whole = observed(0).of(model)

    def fit(label: str, observation: CycleObservation, start: FloatArray) -> Estimate:
        filter_ = IteratedFilter(
            values["filter"]["tolerance"],
            max_iterations=values["filter"]["max_iterations"],
            start=tuple(map(float, start)),
        )
        with SolveBar(label, len(model.protocol.steps()), TYPICAL_SOLVES, parameters) as bar:
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
        results.append(Fit.of(label, 0, found, truth))
        bounds.append(Bound.of(label, wanted, jacobian, noise, truth))
    start = found.mean
    for seed in range(1, settings.seeds):
        # The mode does not depend on where its search starts.
        found = fit(f"seed {seed}", observed(seed), start)
        results.append(Fit.of("whole cycle", seed, found, truth))
    findings = Findings(
        truth=tuple(truth.tolist()),
        start=tuple(prior.mean.tolist()),
        prior_std=tuple(to_filter(transform, prior).std.tolist()),
        noise_mm=noise,
        times=protocol.times,
        vertices=frames.shape[1],
        results=tuple(results),
        bounds=tuple(bounds),
        measures={
            f"{what}.{name}": value
            for what, shares in (("error", results[1].error), ("std", results[1].std))
            for name, value in zip(parameters, shares, strict=True)
        },
    )
    return outcome_of(
        findings,
        model.closure.mesh,
        sum(entry.runs for entry in results),
        (entry.reason for entry in results if entry.status != "converged"),
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_chord,
    words=chord_words,
    write=write_each(chord_table, chord_words, chord_figure),
    keeps_failures=True,
    checks=lambda: (expect_cycle,),
    sections=(
        Section(
            "chord",
            {
                "chord": "What is known of chordae and leaflets before and after the data."
                " Simulated."
            },
        ),
    ),
)
