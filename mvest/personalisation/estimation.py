"""Estimation of a case: what is estimated of it, and the steps from a generic valve to an estimate.

Read from `estimate_all` on. Each step takes a `Place`, a closed valve about which its errors are
linearised, and returns another one or an estimate; no object changes. Only the closures remember
something, where they were closed last: that saves time and changes no number.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import ValveCase
from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError, InputError
from mvest.estimation.estimate import Estimate, OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction, of_some, predict
from mvest.estimation.run import Filter
from mvest.estimation.sampled import SampledPosterior
from mvest.estimation.transform import Log, to_filter
from mvest.personalisation.errors import (
    FrameErrors,
    WeighedObservation,
    linearise,
    with_samples,
)
from mvest.personalisation.fitted_frames import FittedFrames
from mvest.personalisation.geometry import displacement
from mvest.personalisation.joint import JointPosterior, damped_step
from mvest.personalisation.model import (
    CaseClosure,
    build_model,
    frames_model,
    with_pressures,
)
from mvest.personalisation.settings import PaperSettings, PersonaliseSettings, Prior
from mvest.problem.estimate import Observed, Problem, StudyResult, estimate
from mvest.problem.registration import REGISTRATION
from mvest.typing import FloatArray

ROUGH = 0.05
"""Relative tolerance of an estimate about which the geometry is linearised."""

LEARNED = 4
"""Iterates at which errors are learned beside those of the geometry, from an estimate without."""

SETTLED = 0.25
"""Standard deviations of a modulus within which an estimate is where the geometry is linearised."""

OnStep = Callable[[float, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Moduli and geometry at which a valve was closed, and about which errors are linearised."""

    closure: CaseClosure
    errors: FrameErrors
    m: FloatArray
    prediction: Prediction


@dataclass(frozen=True, slots=True, eq=False)
class CaseEstimate:
    """The estimate of all unknowns of a case.

    Attributes
    ----------
    result : StudyResult
    place : Place
        About which the last estimate is linearised.
    moved : float or None
        Standard deviations of a modulus, at most, by which the estimate is away from there; None
        where the geometry was linearised about what was seen alone.
    unaccounted : tuple of str
        Why some errors of geometry or law are not in the intervals.
    """

    result: StudyResult
    place: Place
    moved: float | None = None
    unaccounted: tuple[str, ...] = ()

    @property
    def errors(self) -> FrameErrors:
        """Errors beside the unknowns."""
        return self.place.errors


@dataclass(frozen=True, slots=True, eq=False)
class CaseProblem:
    """What is estimated of a case.

    Attributes
    ----------
    case : ValveCase
    settings : PersonaliseSettings
        With the errors of the pressures of several frames among the unknowns.
    unknowns : tuple of Prior, (p,)
        Those that are estimated: those of the closure in its order, then the displacement.
    prior : Gaussian
        Of these.
    transform : Log
    fitted : FittedFrames
    stated : CaseClosure
        Of the valve as the case states it.
    on_iterate : callable or None
    """

    case: ValveCase
    settings: PersonaliseSettings
    unknowns: tuple[Prior, ...]
    prior: Gaussian
    transform: Log
    fitted: FittedFrames
    stated: CaseClosure
    on_iterate: OnIterate | None = None

    @classmethod
    def of(
        cls,
        case: ValveCase,
        settings: PersonaliseSettings,
        store: Path | None = None,
        on_step: OnStep | None = None,
        on_iterate: OnIterate | None = None,
        model: ClosureModel | None = None,
    ) -> CaseProblem:
        """The estimation of a case.

        Parameters
        ----------
        case : ValveCase
        settings : PersonaliseSettings
        store : Path, optional
            Where an unstructured mesh and closed states are kept.
        on_step, on_iterate : callable, optional
            See `personalise`.
        model : ClosureModel, optional
            As `build_model` makes it; one that has closed already need not do so again.

        Raises
        ------
        InputError
            If an unknown is not one of the case's, or error samples meet several fitted frames.
        """
        settings = with_pressures(case, settings)
        if case.fitted and case.error_samples is not None:
            raise InputError(
                f"case {case.name}: error samples and several fitted frames; expected one closed "
                "frame, or no samples"
            )
        if model is None:
            model = build_model(case, settings, store)
            model.on_step = on_step
        free = [u for u in settings.unknowns if not u.fixed]
        own = [u for u in free if u.name not in REGISTRATION]
        unknowns = (*own, *(u for u in free if u.name in REGISTRATION))
        prior = Gaussian.from_variance(
            np.array([u.mean for u in unknowns]), np.array([u.std for u in unknowns]) ** 2
        )
        transform = Log(tuple(u.is_positive for u in unknowns))
        # Not the prior's mean, which may differ from where filters start by its last bit.
        start = transform.inverse(transform.forward(prior.mean))
        several = frames_model(case, settings, model)
        names = tuple(u.name for u in unknowns)
        stated = CaseClosure.of(model, several, names, start)
        shown = None if several is None else several.frames
        fitted = FittedFrames(case, settings, model.valve, shown)
        return cls(case, settings, unknowns, prior, transform, fitted, stated, on_iterate)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns that are estimated, ``(p,)``."""
        return tuple(u.name for u in self.unknowns)

    @property
    def start(self) -> FloatArray:
        """Values ``(p,)`` of the generic valve, at which every estimation begins."""
        return self.stated.shared.start

    @property
    def moduli(self) -> list[int]:
        """Which unknowns are moduli."""
        return [k for k, u in enumerate(self.unknowns) if u.is_modulus]

    def generic(self) -> Place:
        """The generic valve, with the errors that are known before it is closed."""
        prediction = self.stated.shared(self.start)
        return Place(self.stated, FrameErrors(self.fitted), self.start, prediction)

    def filter(
        self, tolerance: float, start: FloatArray | None = None, *, final: bool = True
    ) -> IteratedFilter:
        """The filter of all unknowns, to a relative tolerance, from ``start (p,)`` if given.

        ``final``: something is read from its covariance, which is to be that of the posterior.
        """
        plain = IteratedFilter(tolerance, max_iterations=self.settings.max_iterations)
        if start is None:
            return plain
        return replace(plain, start=tuple(start.tolist()), max_learned=LEARNED, second_order=final)

    def problem(self, closure: CaseClosure, filter_: Filter) -> Problem:
        """The estimation of all unknowns, without its observation."""
        return Problem(
            self.names,
            closure.shared,
            self.prior,
            filter_,
            self.transform,
            self.settings.mechanics.tissue,
        )

    def estimate(self, place: Place, filter_: Filter, observation: Observed) -> StudyResult:
        """All unknowns by one run of a filter, with the closure and the errors of a place."""
        result = estimate(
            self.problem(place.closure, filter_), observation, on_iterate=self.on_iterate
        )
        return self._widened(result, observation, place.errors)

    def estimate_moduli(
        self,
        place: Place,
        filter_: Filter,
        observation: Observed,
        *,
        log: bool,
        variance: float | None = None,
    ) -> StudyResult:
        """The moduli alone, everything else at its prior mean, and no tissue that stiffens."""
        moduli, shared = np.array(self.moduli), place.closure.shared
        stiffens = [u.name.startswith("stiffening.") for u in self.unknowns]
        known = np.where(stiffens, 0.0, shared.start)
        prior = Gaussian(self.prior.mean[moduli], self.prior.covariance[np.ix_(moduli, moduli)])
        if variance is not None:
            prior = Gaussian.from_variance(prior.mean, variance)
        problem = Problem(
            tuple(self.names[k] for k in moduli),
            of_some(shared, known, moduli, snap=1e-14),
            prior,
            filter_,
            Log() if log else Log((False,) * len(moduli)),
            self.settings.mechanics.tissue,
        )
        result = estimate(problem, observation, on_iterate=self.on_iterate)
        return self._widened(result, observation, place.errors)

    def estimate_as_paper(self, place: Place, paper: PaperSettings) -> StudyResult:
        """The moduli alone, with the paper's filter and its independent R."""
        filter_ = PaperFilter(paper.Q, max_iterations=paper.max_iterations)
        observation = self.fitted.as_in_paper(paper)
        return self.estimate_moduli(place, filter_, observation, log=False, variance=paper.P0)

    def _widened(
        self, result: StudyResult, observation: Observed, errors: FrameErrors
    ) -> StudyResult:
        """The result with the covariance that the error samples give it, if there are any."""
        filtered = result.filtered
        weighed = errors.samples is not None and isinstance(observation, WeighedObservation)
        if not weighed or filtered is None or filtered.prediction is None:
            return result
        covariances = np.array(filtered.transformed_iterate_covariances)
        covariances[-1] = sampled_posterior(filtered, errors).covariance
        widened = replace(filtered, transformed_iterate_covariances=covariances)
        return replace(result, filtered=widened)


def sampled_posterior(filtered: Estimate, errors: FrameErrors) -> SampledPosterior:
    """Covariance of an estimate in filter coordinates, from the error samples."""
    samples, learned = errors.samples, filtered.learned
    assert samples is not None
    prior = to_filter(filtered.transform, filtered.prior)
    H = slopes(filtered)
    if learned is None:
        return samples.posterior(H, prior.covariance, filtered.curvature)
    posterior = errors.weighing(samples, learned).posterior(H, prior.covariance, filtered.curvature)
    return replace(posterior, covariance=posterior.covariance + learned.covariance)


def slopes(filtered: Estimate) -> FloatArray:
    """Derivatives ``(k, p)`` of the observation at an estimate, in filter coordinates."""
    assert filtered.prediction is not None
    z = filtered.transformed_iterates[-1]
    return np.asarray(filtered.prediction.jacobian * filtered.transform.derivative(z))


def estimate_all(problem: CaseProblem, generic: Place) -> CaseEstimate:
    """All unknowns, with the errors of geometry and law about an estimate without them.

    What these errors do depends on the moduli: with a modulus half as large the derivatives are off
    by a quarter. So all unknowns are estimated without them first, roughly.

    Parameters
    ----------
    problem : CaseProblem
    generic : Place
        With what error samples do, if the case has any.
    """
    settings = problem.settings
    if settings.nuisance_geometry is None and not settings.nuisance_law:
        plain = problem.filter(settings.tolerance)
        result = problem.estimate(generic, plain, generic.errors.observation())
        return CaseEstimate(result, generic)
    began = time.perf_counter()
    rough = problem.estimate(
        generic,
        problem.filter(max(ROUGH, settings.tolerance)),
        generic.errors.rough_observation(),
    )
    at = problem.start if rough.estimate is None else rough.estimate
    prediction = generic.closure.shared(at)
    if not prediction.converged:
        return CaseEstimate(rough, generic, unaccounted=(prediction.reason,))
    place = linearised(
        replace(generic, errors=FrameErrors(problem.fitted), m=at, prediction=prediction), problem
    )
    moved, unaccounted, seen = None, place.errors.unaccounted, place
    if problem.case.error_samples is not None:
        # They say what is likely of the geometry; nothing is expected of it.
        place = sampled(place)
    elif place.errors.geometry:
        place, moved, more = _expected(problem, place)
        unaccounted = place.errors.unaccounted + more
    result = _estimate_about(problem, place)
    if not result.converged and place.errors.displaced_by:
        reason = f"about the geometry that is expected: {result.reason} ({result.detail})"
        place, moved, unaccounted = seen, None, (*seen.errors.unaccounted, reason)
        result = _estimate_about(problem, place)
    result = replace(result, seconds=time.perf_counter() - began)
    return CaseEstimate(result, place, moved, unaccounted)


def linearised(place: Place, problem: CaseProblem) -> Place:
    """A place with its errors of geometry and law."""
    seen = problem.stated.model if place.errors.displaced_by else None
    errors = linearise(place.errors, place.closure.registered, place.m, place.prediction.y, seen)
    return replace(place, errors=errors)


def sampled(place: Place) -> Place:
    """A place with what the error samples of its case do."""
    errors = with_samples(place.errors, place.closure.registered, place.m, place.prediction.y)
    return replace(place, errors=errors)


def _estimate_about(problem: CaseProblem, place: Place, *, final: bool = True) -> StudyResult:
    """All unknowns from ``place`` on, where closure and errors are linearised."""
    tolerance = problem.settings.tolerance
    filter_ = problem.filter(tolerance if final else max(ROUGH, tolerance), place.m, final=final)
    return problem.estimate(place, filter_, place.errors.observation())


def _expected(problem: CaseProblem, place: Place) -> tuple[Place, float | None, tuple[str, ...]]:
    """Where estimate and geometry are expected, how far the estimate is from there, and doubts.

    Steps of Gauss and Newton for parameters and geometry together: the closure is that of a
    displaced valve, and the prior of the geometry's errors stays about what was seen.
    """
    considered = problem.settings.nuisance_geometry
    assert considered is not None
    result, moved = None, None
    for _ in range(considered.renewals):
        before = result or _estimate_about(problem, place, final=False)
        found = _nearer(problem, before, place)
        if found is place:
            return place, _step(problem, before, place), ()
        renewed = found if isinstance(found, str) else _renewed(problem, found)
        if isinstance(renewed, str):
            return place, moved, (f"about the geometry that is expected: {renewed}",)
        place, result = renewed
        moved = _step(problem, result, place)
        if moved < SETTLED:
            break
    return place, moved, ()


def _step(problem: CaseProblem, result: StudyResult, place: Place) -> float:
    """Standard deviations of a modulus, at most, from a place to the estimate about it."""
    assert result.filtered is not None
    found, z = result.filtered.transformed, problem.transform.forward(place.m)
    moduli = problem.moduli
    return float(np.max(np.abs(found.mean - z)[moduli] / found.std[moduli]))


def _renewed(problem: CaseProblem, place: Place) -> tuple[Place, StudyResult] | str:
    """A place with its errors and a rough estimate about it, or why there is none."""
    place = linearised(place, problem)
    if not place.errors.geometry:
        return "; ".join(place.errors.unaccounted)
    result = _estimate_about(problem, place, final=False)
    return (place, result) if result.converged else f"{result.reason} ({result.detail})"


def _nearer(problem: CaseProblem, result: StudyResult, place: Place) -> Place | str:
    """Where estimate and expected geometry are more probable than at ``place``, or why nowhere.

    On the way from ``place`` to them (`damped_step`); ``place`` itself, if it is as good.
    """
    filtered, observation = result.filtered, result.observation
    posterior = joint(problem, result, place.errors)
    if posterior is None or observation is None:
        return result.reason
    assert filtered is not None
    assert filtered.prediction is not None

    def improbability(there: Place) -> float:
        return posterior.improbability_of(there.m, there.prediction, there.errors.displaced_by)

    z = filtered.transformed.mean
    H = filtered.prediction.jacobian * problem.transform.derivative(z)
    end, residual = posterior.stepped(z, observation.y - filtered.prediction.y, H)
    modes = posterior.expected(residual)
    begin = problem.transform.forward(place.m)
    was = place.errors.displaced_by or tuple(np.zeros_like(one) for one in modes)
    here = improbability(place)
    offset = place.errors.offset(modes)
    promised = here - posterior.improbability(end, residual - offset, modes)

    def trial(share: float) -> tuple[float, Place] | str:
        there = _displaced(
            problem,
            tuple(a + share * (b - a) for a, b in zip(was, modes, strict=True)),
            problem.transform.inverse(begin + share * (end - begin)),
            posterior,
        )
        return there if isinstance(there, str) else (improbability(there), there)

    found = damped_step(trial, here, promised)
    if found == "" and promised < SETTLED**2:
        # To first order a gain is the square of a distance in standard deviations.
        return place
    return found or "no step to it makes what was seen more probable"


def joint(problem: CaseProblem, result: StudyResult, errors: FrameErrors) -> JointPosterior | None:
    """Of the parameters and the geometry, to first order about an estimate made with errors.

    None without an estimate, or where nothing of the geometry is in doubt.
    """
    filtered = result.filtered
    if filtered is None or filtered.prediction is None or not errors.geometry:
        return None
    return JointPosterior(
        to_filter(problem.transform, problem.prior),
        problem.transform,
        problem.fitted.observation(),
        errors,
        filtered.learned,
    )


def _displaced(
    problem: CaseProblem, modes: tuple[FloatArray, ...], m: FloatArray, posterior: JointPosterior
) -> Place | str:
    """The valve with a geometry displaced by modes, or why it does not close.

    It is closed at ``m (p,)``, and from there with what fits best to this geometry.
    """
    kinds = [source.modes for source in posterior.errors.geometry if source.modes is not None]
    try:
        closure = problem.stated.displaced(displacement(kinds, modes), m)
    except GeometryError as error:  # a leaflet without thickness, a mesh that is torn
        return str(error)
    first = closure.shared(m)
    if not first.converged:
        return first.reason
    errors = posterior.errors.displaced(modes)
    better = posterior.refitted(m, first)
    again = predict(closure.shared, better)
    found = [Place(closure, errors, m, first)]
    if again.converged:
        found.append(Place(closure, errors, better, again))
    return min(found, key=lambda one: posterior.improbability_of(one.m, one.prediction, modes))
