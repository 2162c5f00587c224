"""Stiffness and length of each family of chordae, estimated together with the moduli."""

from __future__ import annotations

import numpy as np

from experiments.common.building.gate import gate_of
from experiments.common.building.whole_cycle import (
    Bound,
    CycleEstimator,
    closed_frame,
    iterated_from,
    true_cycle,
)
from experiments.common.expectation import expect_cycle
from experiments.common.progress import say
from experiments.common.records.findings import vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.chord.findings import Findings, Fit
from experiments.studies.chord.report import chord_answer, chord_figure, chord_table, chord_words
from experiments.studies.chord.settings import Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.estimation.estimate import Estimate
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
    protocol, noise = settings.protocol, settings.noise_mm
    truth = np.array(values["truth"]["values"], dtype=float)
    true = true_cycle(values, protocol, truth)
    frames, jacobian = true.frames, true.jacobian
    estimator = CycleEstimator.of(values, protocol)
    prior = estimator.prior
    sets = {
        "open and closed": [0, closed_frame(protocol)],
        "whole cycle": list(range(len(frames))),
    }

    def observed(seed: int) -> CycleObservation:
        rng = np.random.default_rng(values["seed"] + seed)
        return CycleObservation.simulated(frames, noise, rng)

    # Both sets are predicted from the same runs.
    whole = observed(0).of(estimator.model)

    def fit(label: str, observation: CycleObservation, start: FloatArray) -> Estimate:
        filter_ = iterated_from(values, start)
        found = estimator(label, filter_, observation.of(whole), observation)
        errors = ", ".join(f"{100 * e:+.1f} %" for e in found.mean / truth - 1)
        say(f"{label}: {errors} ({found.reason.value})")
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
        truth=vector(truth),
        start=vector(prior.mean),
        prior_std=vector(to_filter(estimator.transform, prior).std),
        noise_mm=noise,
        times=protocol.times,
        vertices=frames.shape[1],
        results=tuple(results),
        bounds=tuple(bounds),
        measures={
            f"{what}.{name}": value
            for what, shares in (("error", results[1].error), ("std", results[1].std))
            for name, value in zip(estimator.parameters, shares, strict=True)
        },
    )
    return outcome_of(
        findings,
        true.mesh,
        sum(entry.runs for entry in results),
        (entry.reason for entry in results if entry.status != "converged"),
        gate_of(values),
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
            answer=answer_of_main(chord_answer),
        ),
    ),
)
