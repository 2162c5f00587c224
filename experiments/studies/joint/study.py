"""Chordal length and leaflet moduli, estimated together from a whole cycle."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.common.build import build_filter
from experiments.common.cycle_settings import CycleSettings
from experiments.common.expectation import expect_cycle
from experiments.common.forward import outcome_of
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.record import Outcome
from experiments.common.report import write_each
from experiments.common.study import Job, Section, Study
from experiments.common.whole_cycle import (
    Bound,
    closed_frame,
    cycle_model,
    frames_on_mesh,
    shift_by_check_mesh,
    stored_cycle,
)
from experiments.studies.joint.findings import (
    Findings,
    Fit,
    Frame,
    MeshError,
    OtherMesh,
    Pass,
    measures_of,
)
from experiments.studies.joint.report import joint_figure, joint_table, joint_words
from experiments.studies.joint.settings import Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.sequential import SequentialEstimate, SequentialFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.consistency import nees
from mvest.estimation.prediction import ObservationModel
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
    parameters = tuple(values["parameters"])
    _, transform, prior = build_filter(values["filter"], parameters)
    truth = np.array(values["truth"]["values"], dtype=float)
    # The truth is made by an object of its own; the estimator gets the observation alone.
    maker, model = (cycle_model(values, settings.protocol) for _ in range(2))
    at_truth = stored_cycle(values, maker)(truth)
    if not at_truth.converged:
        raise ConfigurationError(f"the truth has no cycle: {at_truth.reason}")
    frames = at_truth.y.reshape(len(settings.protocol.times), -1, 3)
    jacobian = at_truth.jacobian.reshape(*frames.shape, -1)
    noise = settings.noise_mm
    seen = CycleObservation(frames, np.full(len(frames), noise)).of(stored_cycle(values, model))
    estimator = _Estimator(
        model, parameters, transform, prior, seen, truth, settings.objective_tolerance
    )

    def observed(frames: FloatArray, seed: int) -> CycleObservation:
        return CycleObservation.simulated(frames, noise, _rng(values, seed))

    bounds = (
        Bound.of("open and closed", [0, closed_frame(settings.protocol)], jacobian, noise, truth),
        Bound.of("whole cycle", list(range(len(frames))), jacobian, noise, truth),
    )

    seen_exactly = CycleObservation.simulated(
        frames, 0.0, _rng(values, 0), settings.exact_assumed_mm
    )
    exact = estimator.sequential(seen_exactly)
    _say("no noise", exact.estimate, truth)
    observations = [observed(frames, k) for k in range(settings.seeds)]
    first = estimator.sequential(observations[0])
    seeds = [first.estimate]
    _say("seed 0", first.estimate, truth)
    for k, observation in enumerate(observations[1:], 1):
        # The mode does not depend on where its search starts.
        seeds.append(estimator.batch(observation, seeds[0].mean))
        _say(f"seed {k}", seeds[-1], truth)
    finer = frames_on_mesh(values, settings, truth, "finer")
    seen_finer = observed(finer, 0)
    other = estimator.batch(seen_finer, seeds[0].mean)
    _say("finer truth", other, truth)

    errors = np.array([e.mean / truth - 1 for e in seeds if e.converged])
    rms_over_bound = tuple(
        (np.sqrt(np.mean(errors**2, axis=0)) / np.array(bounds[1].std, dtype=float)).tolist()
    )
    runs = [exact.estimate, *seeds, other]
    exact_fit, other_fit = (
        Fit.of(exact.estimate, truth, seen_exactly),
        Fit.of(other, truth, seen_finer),
    )
    findings = Findings(
        truth=tuple(truth.tolist()),
        start=tuple(prior.mean.tolist()),
        times=settings.protocol.times,
        noise_mm=noise,
        assumed_mm=settings.exact_assumed_mm,
        vertices=frames.shape[1],
        bounds=bounds,
        exact=exact_fit,
        exact_frames=estimator.path(exact),
        seeds=tuple(
            Fit.of(e, truth, observation)
            for e, observation in zip(seeds, observations, strict=True)
        ),
        first=estimator.path(first),
        passes=_passes(first.estimate, truth),
        rms_over_bound=rms_over_bound,
        finer=OtherMesh(
            other_fit,
            (settings.finer_columns, settings.finer_rows),
            float(np.linalg.norm(finer - frames, axis=2).mean()),
        ),
        mesh_error=_mesh_error(values, settings, estimator, other, seen_finer),
        measures=measures_of(parameters, exact_fit, rms_over_bound, other_fit),
    )
    return outcome_of(
        findings,
        model.closure.mesh,
        sum(e.forward_solves for e in runs),
        (e.reason.value for e in runs if not e.converged),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimator:
    """What all estimates of the study share."""

    model: CycleModel
    parameters: tuple[str, ...]
    transform: Transform
    prior: Gaussian
    seen: ObservationModel
    truth: FloatArray
    tolerance: float

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

    def path(self, found: SequentialEstimate) -> tuple[Frame, ...]:
        """Relative error and relative standard deviation after each frame of the first pass."""
        return tuple(
            Frame(
                _of(self.transform.inverse(extended.filtered.mean) / self.truth - 1),
                _of(extended.filtered.std),
                final.nis,
                final.nis_band,
                final.information_gain,
            )
            for extended, final in zip(found.extended, found.final, strict=True)
        )


def _mesh_error(
    values: Values,
    settings: CycleSettings,
    estimator: _Estimator,
    found: Estimate,
    observation: CycleObservation,
) -> MeshError | str:
    """How far its mesh may have moved the estimate, each parameter for itself."""
    by = shift_by_check_mesh(values, settings, found, estimator.seen, estimator.prior, observation)
    if isinstance(by, str):
        return by
    transform, truth = estimator.transform, estimator.truth
    scale = transform.derivative(transform.forward(found.mean)) / truth
    covariance = found.transformed.covariance + np.diag(by.shift**2)
    return MeshError(
        _of(by.shift * scale),
        _of(np.sqrt(np.diag(covariance)) * scale),
        nees(found.transformed.mean - transform.forward(truth), covariance),
        by.distance_mm,
        (settings.check_columns, settings.check_rows),
    )


def _passes(found: Estimate, truth: FloatArray) -> tuple[Pass, ...]:
    """Relative error and standard deviation at the end of each pass over all frames."""
    pairs = zip(found.iterates[1:], found.iterate_std[1:], strict=True)
    return tuple(Pass(_of(m / truth - 1), _of(std / truth)) for m, std in pairs)


def _of(values: FloatArray) -> tuple[float, ...]:
    return tuple(values.tolist())


def _rng(values: Values, k: int) -> np.random.Generator:
    return np.random.default_rng(values["seed"] + k)


def _say(label: str, found: Estimate, truth: FloatArray) -> None:
    errors = ", ".join(f"{100 * e:+.2f} %" for e in found.mean / truth - 1)
    print(f"{label}: {errors} ({found.forward_solves} runs)", file=sys.stderr, flush=True)


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
        ),
        Section(
            "joint_open",
            {"joint_open": "As the figure before, of a valve that opens fully. Simulated."},
        ),
    ),
)
