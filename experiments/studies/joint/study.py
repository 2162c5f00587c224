"""Chordal length and leaflet moduli, estimated together from a whole cycle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.common.building.gate import gate_of
from experiments.common.building.whole_cycle import (
    Bound,
    CycleEstimator,
    MeshShift,
    closed_frame,
    frames_on_mesh,
    shift_by_check_mesh,
    stored_cycle,
    true_cycle,
)
from experiments.common.expectation import expect_cycle
from experiments.common.progress import say
from experiments.common.records.findings import vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.joint.findings import (
    Findings,
    Fit,
    Frame,
    MeshError,
    OtherMesh,
    Pass,
    measures_of,
)
from experiments.studies.joint.report import joint_answer, joint_figure, joint_table, joint_words
from experiments.studies.joint.settings import Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.sequential import SequentialEstimate, SequentialFilter
from mvest.estimation.information.consistency import nees
from mvest.estimation.transform import Transform
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_joint"]

Values = Mapping[str, Any]


def run_joint(job: Job[Settings]) -> Outcome[Findings]:
    """Estimate from frames without noise, with noise, and of a finer model.

    Raises
    ------
    ConfigurationError
        If the truth has no cycle.
    InputError
        If the finer truth has none.
    """
    values, settings = job.values, job.settings.cycle
    truth, noise = np.array(values["truth"]["values"], dtype=float), settings.noise_mm
    true = true_cycle(values, settings.protocol, truth)
    frames, jacobian = true.frames, true.jacobian
    estimator = CycleEstimator.of(values, settings.protocol)
    model = stored_cycle(values, estimator.model)
    seen = CycleObservation(frames, np.full(len(frames), noise)).of(model)

    tolerance = settings.objective_tolerance

    def observed(frames: FloatArray, seed: int) -> CycleObservation:
        return CycleObservation.simulated(frames, noise, _rng(values, seed))

    def sequential(observation: CycleObservation) -> SequentialEstimate:
        filter_ = SequentialFilter(observation.sizes, relinearise=0.1)
        return estimator("frame by frame", filter_.run, seen, observation)

    def batch(observation: CycleObservation, start: FloatArray) -> Estimate:
        filter_ = IteratedFilter(tolerance=1e-3, objective_tolerance=tolerance, start=vector(start))
        return estimator("all frames at once", filter_, seen, observation)

    bounds = (
        Bound.of("open and closed", [0, closed_frame(settings.protocol)], jacobian, noise, truth),
        Bound.of("whole cycle", list(range(len(frames))), jacobian, noise, truth),
    )

    seen_exactly = CycleObservation.simulated(
        frames, 0.0, _rng(values, 0), settings.exact_assumed_mm
    )
    exact = sequential(seen_exactly)
    _say("no noise", exact.estimate, truth)
    observations = [observed(frames, k) for k in range(settings.seeds)]
    first = sequential(observations[0])
    seeds = [first.estimate]
    _say("seed 0", first.estimate, truth)
    for k, observation in enumerate(observations[1:], 1):
        # The mode does not depend on where its search starts.
        seeds.append(batch(observation, seeds[0].mean))
        _say(f"seed {k}", seeds[-1], truth)
    finer = frames_on_mesh(values, settings, truth, "finer")
    seen_finer = observed(finer, 0)
    other = batch(seen_finer, seeds[0].mean)
    _say("finer truth", other, truth)

    errors = np.array([e.mean / truth - 1 for e in seeds if e.converged])
    bound = np.array(bounds[1].std, dtype=float)
    rms_over_bound = vector(np.sqrt(np.mean(errors**2, axis=0)) / bound)
    runs = [exact.estimate, *seeds, other]
    exact_fit, other_fit = (
        Fit.of(exact.estimate, truth, seen_exactly),
        Fit.of(other, truth, seen_finer),
    )
    findings = Findings(
        truth=vector(truth),
        start=vector(estimator.prior.mean),
        times=settings.protocol.times,
        noise_mm=noise,
        assumed_mm=settings.exact_assumed_mm,
        vertices=frames.shape[1],
        bounds=bounds,
        exact=exact_fit,
        exact_frames=_path(exact, estimator.transform, truth),
        seeds=tuple(
            Fit.of(e, truth, observation)
            for e, observation in zip(seeds, observations, strict=True)
        ),
        first=_path(first, estimator.transform, truth),
        passes=_passes(first.estimate, truth),
        rms_over_bound=rms_over_bound,
        finer=OtherMesh(
            other_fit,
            (settings.finer_columns, settings.finer_rows),
            float(np.linalg.norm(finer - frames, axis=2).mean()),
        ),
        mesh_error=_mesh_error(
            shift_by_check_mesh(values, settings, other, seen, estimator.prior, seen_finer),
            other,
            truth,
            (settings.check_columns, settings.check_rows),
        ),
        measures=measures_of(estimator.parameters, exact_fit, rms_over_bound, other_fit),
    )
    return outcome_of(
        findings,
        true.mesh,
        sum(e.forward_solves for e in runs),
        (e.reason.value for e in runs if not e.converged),
        gate_of(values),
    )


def _path(found: SequentialEstimate, transform: Transform, truth: FloatArray) -> tuple[Frame, ...]:
    """Relative error and relative standard deviation after each frame of the first pass."""
    return tuple(
        Frame(
            vector(transform.inverse(extended.filtered.mean) / truth - 1),
            vector(extended.filtered.std),
            final.nis,
            final.nis_band,
            final.information_gain,
        )
        for extended, final in zip(found.extended, found.final, strict=True)
    )


def _mesh_error(
    by: MeshShift | str, found: Estimate, truth: FloatArray, cells: tuple[int, int]
) -> MeshError | str:
    """How far its mesh may have moved the estimate, each parameter for itself."""
    if isinstance(by, str):
        return by
    transform = found.transform
    scale = transform.derivative(transform.forward(found.mean)) / truth
    covariance = found.transformed.covariance + np.diag(by.shift**2)
    return MeshError(
        vector(by.shift * scale),
        vector(np.sqrt(np.diag(covariance)) * scale),
        nees(found.transformed.mean - transform.forward(truth), covariance),
        by.distance_mm,
        cells,
    )


def _passes(found: Estimate, truth: FloatArray) -> tuple[Pass, ...]:
    """Relative error and standard deviation at the end of each pass over all frames."""
    pairs = zip(found.iterates[1:], found.iterate_std[1:], strict=True)
    return tuple(Pass(vector(m / truth - 1), vector(std / truth)) for m, std in pairs)


def _rng(values: Values, k: int) -> np.random.Generator:
    return np.random.default_rng(values["seed"] + k)


def _say(label: str, found: Estimate, truth: FloatArray) -> None:
    errors = ", ".join(f"{100 * e:+.2f} %" for e in found.mean / truth - 1)
    say(f"{label}: {errors} ({found.forward_solves} runs)")


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_joint,
    words=joint_words,
    write=write_each(joint_table, joint_words, joint_figure),
    checks=lambda: (expect_cycle,),
    sections=(
        Section(
            "joint",
            {
                "joint": "Estimates as frames come in, errors over seeds, and what two frames and"
                " a whole cycle could tell. Simulated."
            },
            answer=answer_of_main(joint_answer),
        ),
        Section(
            "joint_open",
            {"joint_open": "As the figure before, of a valve that opens fully. Simulated."},
            answer=answer_of_main(joint_answer),
        ),
    ),
)
