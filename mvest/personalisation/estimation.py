"""The estimation of a case: model, unknowns, prior and filter, and the estimates made with them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import GeometryError, InputError
from mvest.estimation.estimate import Estimate, OnIterate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction, SharedStart, of_some, predict
from mvest.estimation.run import Filter
from mvest.estimation.sampled import SampledPosterior
from mvest.estimation.transform import Log, to_filter
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation.considered_geometry import displacement
from mvest.personalisation.fitted_frames import FittedFrames
from mvest.personalisation.geometry_errors import WeighedObservation
from mvest.personalisation.joint import JointPosterior, damped_step
from mvest.personalisation.model import build_model, frames_model, held_state, with_pressures
from mvest.personalisation.observation_errors import ObservationErrors
from mvest.personalisation.settings import PaperSettings, PersonaliseSettings, Treatment
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.problem import Observed, Problem
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CaseClosure:
    """The closure of a case's valve, in the forms in which the parts of an estimation take it.

    Attributes
    ----------
    model : ClosureModel
    frames : FramesModel or None
        All closed frames that are fitted, if they are several.
    registered : RegisteredModel
        The same, displaced as a whole before it is seen.
    shared : SharedStart
        The same, for many estimations.
    displacement : mapping
        Part -> by what the geometry differs from the one that was seen; see
        `RestGeometry.displaced`.
    """

    model: ClosureModel
    frames: FramesModel | None
    registered: RegisteredModel
    shared: SharedStart
    displacement: Mapping[str, FloatArray]

    @classmethod
    def of(
        cls,
        model: ClosureModel,
        frames: FramesModel | None,
        names: tuple[str, ...],
        start: FloatArray,
        displacement: Mapping[str, FloatArray] | None = None,
    ) -> CaseClosure:
        """The closure of a valve, gone on from ``start (p,)`` in the order of ``names``."""
        registered = RegisteredModel(frames or model, names)
        return cls(model, frames, registered, SharedStart(registered, start), displacement or {})

    def displaced(self, parts: Mapping[str, FloatArray], start: FloatArray) -> CaseClosure:
        """Of the valve with another geometry, see `RestGeometry.displaced`.

        All closed frames have the same errors of annulus and tips, as their derivatives say.
        """
        model = RestGeometry(self.model).displaced(parts)
        closure = self.of(model, self.frames, self.registered.names, start, parts)
        if self.frames is None:
            return closure
        states = {name: closure.held(state) for name, state in self.frames.states.items()}
        frames = replace(self.frames, model=model, states=states)
        return self.of(model, frames, self.registered.names, start, parts)

    def held(self, state: HeldState) -> HeldState:
        """A state as it was seen, whose annulus and tips are off as those of this valve."""
        return replace(
            state,
            annulus=state.annulus + self.displacement.get("annulus", 0.0),
            papillary_tips=state.papillary_tips + self.displacement.get("tips", 0.0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Moduli and geometry at which a valve was closed, and about which errors are linearised."""

    closure: CaseClosure
    errors: ObservationErrors
    m: FloatArray
    prediction: Prediction


ROUGH = 0.05
"""Relative tolerance of an estimate about which the geometry is linearised."""

LEARNED = 4
"""Iterates at which errors are learned beside what is considered, from an estimate without it."""

SETTLED = 0.25
"""Standard deviations of a modulus within which an estimate is where the geometry is linearised."""

OnStep = Callable[[float, int], None]


class CaseEstimation:
    """The objects that the parts of one personalisation share.

    Attributes
    ----------
    moved : float or None
        Standard deviations of a modulus, at most, by which the estimate about the last renewed
        linearisation of the geometry is away from there; None without one.
    """

    def __init__(
        self,
        case: ValveCase,
        settings: PersonaliseSettings,
        store: Path | None,
        on_step: OnStep | None,
        on_iterate: OnIterate | None = None,
        model: ClosureModel | None = None,
    ) -> None:
        self.case, self.settings = case, with_pressures(case, settings)
        settings = self.settings
        self.closed = case.frame(Role.CLOSED)
        if case.fitted and case.error_samples is not None:
            raise InputError(
                f"case {case.name}: error samples and several fitted frames; expected one closed "
                "frame, or no samples"
            )
        if model is None:
            model = build_model(case, settings, store)
            model.on_step = on_step
        self.on_iterate = on_iterate
        free = [u for u in settings.unknowns if u.treatment is not Treatment.FIXED]
        # Those of the closure first, in its order; then the displacement.
        own = [u for u in free if u.name not in REGISTRATION]
        rigid = [u for u in free if u.name in REGISTRATION]
        self.unknowns = (*own, *rigid)
        self.names = tuple(u.name for u in self.unknowns)
        self.prior = Gaussian.from_variance(
            np.array([u.mean for u in self.unknowns]),
            np.array([u.std for u in self.unknowns]) ** 2,
        )
        self.transform = Log(tuple(u.is_positive for u in self.unknowns))
        start = self.transform.inverse(self.transform.forward(self.prior.mean))
        several = frames_model(case, settings, model)
        self._stated = CaseClosure.of(model, several, self.names, start)
        self._closure = self._stated
        names = None if several is None else several.frames
        self.fitted = FittedFrames(case, settings, model.valve, names)
        self.errors = ObservationErrors(self.fitted, self.registered)
        self.filter = self._filter(settings.tolerance)
        self.moved: float | None = None

    def _filter(
        self, tolerance: float, start: tuple[float, ...] | None = None, *, final: bool = True
    ) -> Filter:
        """The filter of all unknowns, to a relative tolerance; where it starts, if it iterates.

        ``final``: something is read from its covariance, which is to be that of the posterior.
        """
        plain = IteratedFilter(tolerance, max_iterations=self.settings.max_iterations)
        if start is None:
            return plain
        return replace(plain, start=start, max_learned=LEARNED, second_order=final)

    def knowledge(self) -> dict[str, float]:
        """Prior standard deviations, relative of what is positive, but of pressures' errors."""
        own = {
            u.name: u.std / (u.mean if u.is_positive else 1.0)
            for u in self.unknowns
            if not is_frame_pressure(u.name)
        }
        return own | dict.fromkeys(self.errors.modes, 1.0)

    def estimate_all(self) -> StudyResult:
        """All unknowns, with what is considered about an estimate without it.

        What its errors do depends on the moduli: with a modulus half as large the derivatives are
        off by a quarter. So all unknowns are estimated without them first, roughly.
        """
        if not self.errors.considers:
            return self.estimate(self.filter, self.errors.observation())
        began = time.perf_counter()
        rough = self.estimate(
            self._filter(max(ROUGH, self.settings.tolerance)), self.errors.rough_observation()
        )
        at = self.shared.start if rough.estimate is None else rough.estimate
        prediction = self.shared(at)
        if not prediction.converged:
            self.errors.unconsidered = (prediction.reason,)
            return rough
        self.errors.consider(at, prediction.y)
        place = Place(self._closure, self.errors, at, prediction)
        if self.errors.samples is not None:
            # They say what is likely of the geometry; nothing is expected of it.
            self.errors.sample_geometry(at, prediction.y)
        elif self.errors.known is not None and self.errors.known.modes:
            place = self._expected(place)
        return replace(self._estimate_about(place), seconds=time.perf_counter() - began)

    def _estimate_about(self, place: Place, *, final: bool = True) -> StudyResult:
        """All unknowns from ``place`` on, where closure and errors are linearised."""
        tolerance = self.settings.tolerance if final else max(ROUGH, self.settings.tolerance)
        filter_ = self._filter(tolerance, tuple(place.m.tolist()), final=final)
        return self.estimate(filter_, self.errors.observation())

    def _expected(self, place: Place) -> Place:
        """Where estimate and geometry are expected: from now on all is linearised there.

        Steps of Gauss and Newton for parameters and geometry together: the closure is that of a
        displaced valve, and the prior of the geometry's errors stays about what was seen.
        """
        assert self.settings.considered_geometry is not None
        result = None
        for _ in range(self.settings.considered_geometry.renewals):
            before = result or self._estimate_about(place, final=False)
            found = self._nearer(before, place)
            if found is place:
                self.moved = self._step(before, place)
                break
            renewed = found if isinstance(found, str) else self._renewed(found)
            if isinstance(found, str) or isinstance(renewed, str):
                self._use(place)
                self.errors.unconsidered += (f"about the geometry that is expected: {renewed}",)
                break
            place, result = found, renewed
            self.moved = self._step(renewed, place)
            if self.moved < SETTLED:
                break
        return place

    def _step(self, result: StudyResult, place: Place) -> float:
        """Standard deviations of a modulus, at most, from a place to the estimate about it."""
        assert result.filtered is not None
        found, z = result.filtered.transformed, self.transform.forward(place.m)
        moduli = [name.startswith("E_f.") for name in result.filtered.names]
        return float(np.max(np.abs(found.mean - z)[moduli] / found.std[moduli]))

    def _renewed(self, place: Place) -> StudyResult | str:
        """A rough estimate about a place, with its closure and errors, or why there is none."""
        self._use(place)
        self.errors.consider(place.m, place.prediction.y)
        if self.errors.unconsidered:
            return "; ".join(self.errors.unconsidered)
        result = self._estimate_about(place, final=False)
        return f"{result.reason} ({result.detail})" if result.estimate is None else result

    def _nearer(self, result: StudyResult, place: Place) -> Place | str:
        """Where estimate and expected geometry are more probable than at ``place``, or why nowhere.

        On the way from ``place`` to them (`damped_step`); ``place`` itself, if it is as good.
        """
        filtered, observation, known = result.filtered, result.observation, place.errors.known
        posterior = self.joint(result, place.errors)
        if posterior is None or known is None or observation is None:
            return result.reason
        assert filtered is not None
        assert filtered.prediction is not None

        def improbability(there: Place) -> float:
            modes = there.errors.displaced_by
            return posterior.improbability_of(there.m, there.prediction, modes)

        z = filtered.transformed.mean
        H = filtered.prediction.jacobian * self.transform.derivative(z)
        end, residual = posterior.stepped(z, observation.y - filtered.prediction.y, H)
        modes = posterior.expected(residual)
        begin = self.transform.forward(place.m)
        was = place.errors.displaced_by or tuple(np.zeros_like(one) for one in modes)
        here = improbability(place)
        promised = here - posterior.improbability(end, residual - known.offset(modes), modes)

        def trial(share: float) -> tuple[float, Place] | str:
            there = self._displaced(
                tuple(a + share * (b - a) for a, b in zip(was, modes, strict=True)),
                self.transform.inverse(begin + share * (end - begin)),
                posterior,
            )
            return there if isinstance(there, str) else (improbability(there), there)

        found = damped_step(trial, here, promised)
        if found == "" and promised < SETTLED**2:
            # To first order a gain is the square of a distance in standard deviations.
            return place
        return found or "no step to it makes what was seen more probable"

    def joint(self, result: StudyResult, errors: ObservationErrors) -> JointPosterior | None:
        """Of the parameters and the geometry, to first order about an estimate made with errors.

        None without an estimate, or where nothing of the geometry is considered.
        """
        filtered = result.filtered
        known = errors.known
        if filtered is None or filtered.prediction is None or known is None or not known.modes:
            return None
        return JointPosterior(
            to_filter(self.transform, self.prior),
            self.transform,
            self.fitted.observation(),
            errors,
            filtered.learned,
        )

    def _displaced(
        self, modes: tuple[FloatArray, ...], m: FloatArray, posterior: JointPosterior
    ) -> Place | str:
        """The valve with a geometry displaced by modes, or why it does not close.

        It is closed at ``m (p,)``, and from there with what fits best to this geometry.
        """
        known = posterior.errors.known
        assert known is not None
        try:
            closure = self._stated.displaced(displacement(known.modes, modes), m)
        except GeometryError as error:  # a leaflet without thickness, a mesh that is torn
            return str(error)
        first = closure.shared(m)
        if not first.converged:
            return first.reason
        errors = self.errors.about(closure.registered, modes, self._stated.model)
        better = posterior.refitted(m, first)
        again = predict(closure.shared, better)
        found = [Place(closure, errors, m, first)]
        if again.converged:
            found.append(Place(closure, errors, better, again))
        return min(found, key=lambda one: posterior.improbability_of(one.m, one.prediction, modes))

    def take_as_stated(self) -> None:
        """From now on with geometry and law as they are stated, known exactly."""
        self._closure = self._stated
        self.errors = self.errors.as_stated(self.registered)

    def _use(self, place: Place) -> None:
        self._closure, self.errors = place.closure, place.errors

    @property
    def model(self) -> ClosureModel:
        """The closure of the valve, displaced to the geometry that is expected if there is one."""
        return self._closure.model

    @property
    def frames(self) -> FramesModel | None:
        """All closed frames that are fitted, if they are several."""
        return self._closure.frames

    def held_out(self) -> dict[str, HeldState]:
        """The loads of frames that are not fitted, their annulus and tips off as those fitted."""
        return {
            frame.name: self._closure.held(held_state(self._stated.model, frame))
            for frame in self.case.held_out
        }

    @property
    def registered(self) -> RegisteredModel:
        """The same, displaced as a whole before it is seen."""
        return self._closure.registered

    @property
    def shared(self) -> SharedStart:
        """The same, for many estimations."""
        return self._closure.shared

    def estimate(self, filter_: Filter, observation: Observed) -> StudyResult:
        """All unknowns."""
        result = estimate(self.problem(filter_), observation, on_iterate=self.on_iterate)
        return self._widened(result, observation)

    def problem(self, filter_: Filter) -> Problem:
        """The estimation of all unknowns, without its observation."""
        return Problem(
            self.names,
            self.shared,
            self.prior,
            filter_,
            self.transform,
            self.settings.mechanics.tissue,
        )

    def estimate_moduli(
        self, filter_: Filter, observation: Observed, *, log: bool, variance: float | None = None
    ) -> StudyResult:
        """The moduli alone, everything else at its prior mean, and no tissue that stiffens."""
        moduli = np.array([k for k, u in enumerate(self.unknowns) if u.is_modulus])
        stiffens = [u.name.startswith("stiffening.") for u in self.unknowns]
        known = np.where(stiffens, 0.0, self.shared.start)
        prior = Gaussian(self.prior.mean[moduli], self.prior.covariance[np.ix_(moduli, moduli)])
        if variance is not None:
            prior = Gaussian.from_variance(prior.mean, variance)
        problem = Problem(
            tuple(self.names[k] for k in moduli),
            of_some(self.shared, known, moduli, snap=1e-14),
            prior,
            filter_,
            Log() if log else Log((False,) * len(moduli)),
            self.settings.mechanics.tissue,
        )
        result = estimate(problem, observation, on_iterate=self.on_iterate)
        return self._widened(result, observation)

    def estimate_as_paper(self, paper: PaperSettings) -> StudyResult:
        """The moduli alone, with the paper's filter and its independent R."""
        filter_ = PaperFilter(paper.Q, max_iterations=paper.max_iterations)
        observation = self.fitted.as_in_paper(paper)
        return self.estimate_moduli(filter_, observation, log=False, variance=paper.P0)

    def _widened(self, result: StudyResult, observation: Observed) -> StudyResult:
        """The result with the covariance that the error samples give it, if there are any."""
        filtered = result.filtered
        weighed = self.errors.samples is not None and isinstance(observation, WeighedObservation)
        if not weighed or filtered is None or filtered.prediction is None:
            return result
        covariances = np.array(filtered.transformed_iterate_covariances)
        covariances[-1] = self.sampled_posterior(filtered).covariance
        widened = replace(filtered, transformed_iterate_covariances=covariances)
        return replace(result, filtered=widened)

    def sampled_posterior(self, filtered: Estimate) -> SampledPosterior:
        """Covariance of an estimate in filter coordinates, from the error samples."""
        samples = self.errors.samples
        assert samples is not None
        assert filtered.prediction is not None
        z = filtered.transformed_iterates[-1]
        H = filtered.prediction.jacobian * filtered.transform.derivative(z)
        prior = to_filter(filtered.transform, filtered.prior)
        learned = filtered.learned
        if learned is None:
            return samples.posterior(H, prior.covariance, filtered.curvature)
        errors = self.errors.weighing(samples, learned)
        posterior = errors.posterior(H, prior.covariance, filtered.curvature)
        return replace(posterior, covariance=posterior.covariance + learned.covariance)
