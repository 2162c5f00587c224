"""The chain of one case: observation, generic valve, estimation, held-out frames, intervals."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.frames import SCALE, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError, InputError
from mvest.estimation.estimate import Estimate, Filter, OnIterate
from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.filters.considered import SchmidtFilter
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.design import Design
from mvest.estimation.noise import ObservationNoise, low_rank_noise, observation_noise
from mvest.estimation.noise_family import ErrorColumns, NoiseFamily
from mvest.estimation.prediction import Predicted, predict
from mvest.estimation.sampled import SampledErrors, SampledPosterior
from mvest.estimation.transform import Log, to_filter
from mvest.estimation.update import kalman_update
from mvest.estimation.wrappers import SharedStart, of_some
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.learned import error_family
from mvest.observation.surfaces import (
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
    surface_distance,
)
from mvest.observation.vertices import Observation
from mvest.personalise.considered_geometry import geometry_columns
from mvest.personalise.considered_law import law_columns
from mvest.personalise.design import SHARES, FrameDesigns, StatedErrors
from mvest.personalise.error_budget import BudgetRow, budget_rows, sample_parts
from mvest.personalise.geometry_errors import (
    GeometryErrors,
    WeighedObservation,
    errors_of,
    sample_geometry,
)
from mvest.personalise.model import build_model, frames_model, held_state, with_pressures
from mvest.personalise.result import FrameDistance, Personalised
from mvest.personalise.settings import (
    PaperSettings,
    PersonaliseSettings,
    PressureErrors,
    Treatment,
)
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.expectation import Expectation, expect
from mvest.problem.problem import Observed, Problem
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.triangles import directed_edges

__all__ = ["design_case", "expect_case", "foresee_case", "personalise_case"]

BORDER = 3.0
"""Standard deviations from the border of the leaflets within which points are not compared."""

MAX_VERTICES = 2000
"""Vertices of a frame that are compared: more, nearer to each other than errors are alike, say
nothing new, and their correlation is factorised."""

DRAWN, WIDTH = 0.3, 0.5
"""mm, edges of the predicted surface that points are compared with, and over which it is smoothed.
Facets as they are predicted are up to 0.1 mm off where leaflets bend, and their normals jump."""

BLUR, BLURRED_MM = 1.5, 0.5
"""Width for a first estimate, and standard deviation below which no point is then believed (mm): a
leaflet that is some millimetres away attracts smoothly, and what is beside it does not."""

SURFACE_MM = 0.1
"""mm, standard deviation below which no single point of a surface is believed where vertices do not
correspond: between them both surfaces are only drawn. Where a case states less, surfaces are
compared facet by facet as they are."""

BETTER = 5.0
"""How many times as well as beforehand a nuisance may be measured."""

ROUGH = 0.05
"""Relative tolerance of an estimate about which the geometry is linearised."""

KNOWN = "what is considered"
"""Name of all columns whose size is not learned."""

LEARNED = 4
"""Iterates at which errors are learned beside what is considered, from an estimate without it."""

OnStep = Callable[[float, int], None]


def personalise_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
    on_iterate: OnIterate | None = None,
) -> Personalised:
    """Estimate the unknowns of a case.

    Numerical failure is part of the result, with its reason; only inadmissible input raises.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Where an unstructured mesh is kept.
    on_step : callable, optional
        Progress, see :class:`mvest.closure.model.ClosureModel`.
    on_iterate : callable, optional
        Called after each iterate of every filter.
    """
    chain = _Chain(case, settings, store, on_step, on_iterate)
    started = time.perf_counter()
    # Not the prior's mean, which may differ from where filters start by its last bit.
    start = chain.shared.start
    generic = chain.shared(start)
    seconds = {"generic": time.perf_counter() - started}
    if generic.converged and case.error_samples is not None:
        began = time.perf_counter()
        chain.sample_geometry(start, generic.y)
        seconds["geometry"] = time.perf_counter() - began

    def timed(part: str, began: float) -> None:
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - began

    # Held-out frames are gone to from the closed valve that was found last.
    began = time.perf_counter()
    before = chain.closed_frames(start, generic.y) if generic.converged else {}
    timed("held_out", began)
    result = chain.estimate_all()
    seconds["estimate"] = result.seconds
    frames = _Frames({}, {}, {}, ())
    narrower: Mapping[str, FloatArray] = {}
    if before and result.estimate is not None and result.fitted is not None:
        began = time.perf_counter()
        frames = chain.compared(before, chain.closed_frames(result.estimate, result.fitted))
        timed("held_out", began)
        narrower = chain.narrower(result)
    image_share = chain.image_share(result)
    budget = chain.budget(result)
    moduli_only = paper = confirmed = None
    # With everything else known.
    chain.considered = ()
    if settings.moduli_only:
        moduli_only = chain.estimate_moduli(
            IteratedFilter(settings.tolerance, max_iterations=settings.max_iterations),
            chain.observation(),
            log=True,
        )
        seconds["moduli_only"] = moduli_only.seconds
    if settings.paper is not None:
        paper = chain.estimate_as_paper(settings.paper)
        seconds["paper"] = paper.seconds
    if settings.confirm and frames.distances:
        began = time.perf_counter()
        confirmed = chain.confirm(result)
        timed("confirm", began)
    return Personalised(
        case,
        chain.settings,
        chain.model.mesh,
        chain.names,
        chain.prior,
        result,
        moduli_only,
        paper,
        frames.distances,
        frames.generic,
        frames.registered,
        frames.fitted,
        narrower,
        confirmed,
        seconds,
        chain.geometry,
        image_share,
        chain.unconsidered,
        budget,
    )


def expect_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> Expectation:
    """What the frames of a case will tell, found out with one closure; see `personalise`.

    Errors that samples of the frames tell of are left out: each sample would be a closure.
    """
    return _expected(_Chain(case, settings, store, on_step))


def _expected(chain: _Chain) -> Expectation:
    generic = chain.shared(chain.shared.start)
    if generic.converged:
        chain.consider(chain.shared.start, generic.y)
    return expect(chain.problem(chain.filter), chain.observation())


def foresee_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> tuple[Expectation, FrameDesigns | str]:
    """`expect_case` and `design_case` together, with one closure."""
    chain = _Chain(case, settings, store, on_step)
    return _expected(chain), _designed(case, settings, chain.model)


def design_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> FrameDesigns | str:
    """What several closed frames of a case would tell, or why that is not known.

    The frames are held and seen as the closed one, under shares of its pressure (`SHARES`): one
    closure, and an equilibrium with its derivatives for each. Errors of which samples tell are left
    out.
    """
    model = build_model(case, settings, store)
    model.on_step = on_step
    return _designed(case, settings, model)


def _designed(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel
) -> FrameDesigns | str:
    closed = case.frame(Role.CLOSED)
    pressures = tuple(share * closed.pressure_mmHg for share in SHARES)
    frames = [
        replace(
            closed,
            name=str(k),
            time=closed.time + k,
            role=Role.FITTED if k else Role.CLOSED,
            pressure_mmHg=pressure,
        )
        for k, pressure in enumerate(pressures)
    ]
    case = replace(case, frames=(case.frame(Role.REFERENCE), *frames), error_samples=None)
    stated = settings.pressures or PressureErrors(0.0, 0.0)
    # As unknowns they are differentiated by; how large they are is for the designs to say.
    free = [u.name for u in settings.unknowns if u.treatment is not Treatment.FIXED]
    differentiated = PressureErrors(1.0, 1.0) if SCALE in free else None
    chain = _Chain(case, replace(settings, pressures=differentiated), None, None, model=model)
    start = chain.shared.start
    generic = chain.registered(start)
    if not generic.converged:
        return generic.reason
    chain.consider(start, generic.y)
    return FrameDesigns(
        pressures,
        chain.designs(start, generic),
        chain.knowledge(),
        StatedErrors(chain.knowledge().get(SCALE, 0.0), stated.offset_mmHg, stated.each_mmHg),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    distances: tuple[FrameDistance, ...]


class _Chain:
    """The objects that the parts of one personalisation share."""

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
        self.model = model
        self.frames = frames_model(case, settings, self.model)
        self.on_iterate = on_iterate
        free = [u for u in settings.unknowns if u.treatment is not Treatment.FIXED]
        # Those of the closure first, in its order; then the displacement.
        own = [u for u in free if u.name not in REGISTRATION]
        rigid = [u for u in free if u.name in REGISTRATION]
        self.unknowns = (*own, *rigid)
        self.names = tuple(u.name for u in self.unknowns)
        self.registered = RegisteredModel(self.frames or self.model, self.names)
        self.prior = Gaussian.from_variance(
            np.array([u.mean for u in self.unknowns]),
            np.array([u.std for u in self.unknowns]) ** 2,
        )
        self.transform = Log(tuple(u.is_positive for u in self.unknowns))
        start = self.transform.inverse(self.transform.forward(self.prior.mean))
        self.shared = SharedStart(self.registered, start)
        self._held = tuple(u.name for u in free if u.treatment is Treatment.CONSIDERED)
        self.filter = self._filter(settings.tolerance)
        self.estimated = np.array([name not in self._held for name in self.names])
        self.geometry: GeometryErrors | None = None
        self.errors: SampledErrors | None = None
        self.considered: tuple[ErrorColumns, ...] = ()
        self.unconsidered: tuple[str, ...] = ()
        self._family: NoiseFamily | None = None

    def _filter(self, tolerance: float, start: tuple[float, ...] | None = None) -> Filter:
        """The filter of all unknowns, to a relative tolerance; where it starts, if it iterates."""
        inner = IteratedFilter(tolerance, max_iterations=self.settings.max_iterations)
        if self._held:
            return SchmidtFilter(inner, self._held)
        if start is None:
            return inner
        # Of error samples the covariance is found otherwise.
        second_order = self.errors is None
        return replace(inner, start=start, max_learned=LEARNED, second_order=second_order)

    @property
    def _kinds(self) -> tuple[str, ...]:
        """Names of what is considered."""
        return tuple(own.name for own in self.considered)

    @property
    def considers(self) -> bool:
        """Whether anything that is not among the unknowns widens the intervals."""
        return self.settings.considered_geometry is not None or bool(self.settings.considered_law)

    def consider(self, m: FloatArray, predicted: FloatArray) -> None:
        """Find out what geometry and law, as far as not known, do to the observation at ``m``.

        Parameters
        ----------
        m : (p,)
        predicted : array
            Both frames there, stacked.
        """
        settings, observation = self.settings, self.plain_observation()
        if self.considers and not settings.mechanics.protocol.equilibrium:
            self.unconsidered = ("the closure does not end in an equilibrium",)
            return
        found: list[tuple[ErrorColumns, ...] | str] = []
        if settings.considered_geometry is not None:
            noise = self.noise(without=self._kinds)
            found.append(
                geometry_columns(
                    self.case,
                    settings.considered_geometry,
                    self.registered,
                    observation,
                    noise,
                    m,
                    predicted,
                )
            )
        if settings.considered_law:
            found.append(
                law_columns(settings.considered_law, self.registered, observation, m, predicted)
            )
        self.unconsidered = tuple(reason for reason in found if isinstance(reason, str))
        known = [columns for columns in found if not isinstance(columns, str)]
        if not known:
            return  # what was found out elsewhere serves
        self.considered = tuple(own for columns in known for own in columns)
        if self.errors is not None:
            self.errors = replace(self.errors, base=self.noise())

    def designs(self, m: FloatArray, predicted: Predicted) -> tuple[Design, ...]:
        """What each fitted frame says of all unknowns and of what is considered, by its number."""
        observation = self.plain_observation()
        H = predict(observation.of(lambda _: predicted), m, derivatives=True).jacobian
        H = np.concatenate([H, *(own.columns for own in self.considered)], axis=1)
        values = np.array([u.mean if u.is_positive else 1.0 for u in self.unknowns])
        names = (*self.names, *self.modes)
        values = np.concatenate([values, np.ones(len(self.modes))])
        noise = self.noise(without=self._kinds)
        # Errors of different frames are independent: without the others' rows a frame is by itself.
        of_frame = np.repeat([int(frame.name) for frame in self.fitted], observation.sizes)
        return tuple(
            Design.of(np.where(of_frame[:, None] == k, H, 0.0), noise, values, names)
            for k in range(len(self.fitted))
        )

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the columns of what is considered of the geometry."""
        return tuple(
            f"geometry.{k}" for k in range(sum(c.columns.shape[1] for c in self.considered))
        )

    def knowledge(self) -> dict[str, float]:
        """Prior standard deviations, relative of what is positive, but of pressures' errors."""
        own = {
            u.name: u.std / (u.mean if u.is_positive else 1.0)
            for u in self.unknowns
            if not is_frame_pressure(u.name)
        }
        return own | dict.fromkeys(self.modes, 1.0)

    def estimate_all(self) -> StudyResult:
        """All unknowns, with what is considered about an estimate without it.

        What its errors do depends on the moduli: with a modulus half as large the derivatives are
        off by a quarter. So all unknowns are estimated without them first, roughly.
        """
        if not self.considers:
            return self.estimate(self.filter, self.observation())
        rough = self.estimate(
            self._filter(max(ROUGH, self.settings.tolerance)), self.rough_observation()
        )
        at = self.shared.start if rough.estimate is None else rough.estimate
        prediction = self.shared(at)
        if not prediction.converged:
            self.unconsidered = (prediction.reason,)
            return rough
        self.consider(at, prediction.y)
        if self.errors is not None:
            self.sample_geometry(at, prediction.y)
        result = self.estimate(
            self._filter(self.settings.tolerance, tuple(at.tolist())), self.observation()
        )
        return replace(result, seconds=rough.seconds + result.seconds)

    def noise(
        self,
        learned: LearnedNoise | None = None,
        *,
        considered: float = 1.0,
        without: Collection[str] = (),
        stated: bool = False,
    ) -> ObservationNoise:
        """Noise of the observation without that of error samples.

        Parameters
        ----------
        learned : LearnedNoise, optional
            By which it is known, and not as it is stated.
        considered : float
            Factor on what is added by all that is considered.
        without : collection of str
            Kinds of it that are left out.
        stated : bool
            See `plain_observation`.
        """
        family = self.single_errors
        scales: dict[str, float] = {}
        if family is None:
            observation = self.plain_observation(stated=stated)
            base = observation_noise(observation.R, len(observation.y))
        else:
            log = (family.prior if learned is None else learned.posterior).mean[: len(family.names)]
            first = len(family.names) - len(family.columns)
            base = family.without_columns().at(log[:first])
            scales = {
                own.name: float(np.exp(one))
                for own, one in zip(family.columns, log[first:], strict=True)
            }
        columns = [
            considered * scales.get(own.name, 1.0) * own.columns
            for own in self.considered
            if own.name not in without
        ]
        return low_rank_noise(base, np.concatenate(columns, axis=1)) if columns else base

    def sample_geometry(self, m: FloatArray, predicted: FloatArray) -> None:
        """Find out what errors of the case's frames do to the observation at ``m``.

        Parameters
        ----------
        m : (p,)
        predicted : array
            Both frames there, stacked.
        """
        geometry = sample_geometry(self.case, self.registered, m)
        if isinstance(geometry, str):
            raise GeometryError(f"case {self.case.name}: what its error samples do: {geometry}")
        self.geometry = geometry
        errors = errors_of(self.plain_observation(), self.closed, predicted, geometry)
        samples = self.case.error_samples
        assert samples is not None
        self.errors = SampledErrors(self.noise(), errors, samples.source)

    def observation(self) -> Observed:
        """The closed frame, with its uncertainty and what errors of the geometry add to it."""
        plain, single = self.plain_observation(), self.single_errors
        if single is not None:
            if self.errors is not None:
                columns = self.errors.samples / np.sqrt(self.errors.count)
                single = single.plus(ErrorColumns("geometry", columns))
            return WeighedObservation(plain, single)
        if self.errors is not None:
            return WeighedObservation(plain, self.errors.noise)
        return WeighedObservation(plain, self.noise()) if self.considered else plain

    def rough_observation(self) -> Observed:
        """The same, of which surfaces are seen through a blur; see `BLUR`."""
        plain, observation = self.plain_observation(), self.observation()
        if not self._smooth:
            return observation
        assert isinstance(plain, SurfaceObservation)
        blurred = replace(plain, surface=self._surface(0.5 * BLUR, BLUR))
        noise = observation.R
        if isinstance(noise, NoiseFamily):
            noise = replace(noise, resolution=max(noise.resolution, BLURRED_MM))
        return WeighedObservation(blurred, noise)

    @property
    def single_errors(self) -> NoiseFamily | None:
        """What is believed of the errors of single observations, where they are learned.

        What is considered is added; all of it whose size is known at once, which saves quantities.
        """
        if self.settings.errors is None:
            return None
        if self._family is None:
            self._family = error_family(
                self.plain_observation(),
                self.settings.errors,
                self.length(),
                self.case.surface.vertices,
            )
            if self._smooth:
                resolution = max(self._family.resolution, SURFACE_MM)
                self._family = replace(self._family, resolution=resolution)
        learned = [own for own in self.considered if own.factor > 1.0]
        known = [own.columns for own in self.considered if own.factor == 1.0]
        if known:
            learned.append(ErrorColumns(KNOWN, np.concatenate(known, axis=1)))
        return replace(self._family, columns=tuple(learned))

    def length(self, *, stated: bool = False) -> float:
        """Over how many mm errors are alike: as the case states, always so if ``stated``.

        Where samples tell how errors are alike, what is beside them is taken for independent. Were
        it smooth too, the filter would trust the finest detail of a closed leaflet most, which no
        mesh and no image have right: moduli of two simulated patients then came out two to four
        times too high, and the fitted valve farther from the frame than the generic one.
        """
        sampled = self.case.error_samples is not None and not stated
        return 0.0 if sampled else self.case.uncertainty.correlation_length_mm

    def plain_observation(self, *, stated: bool = False) -> Observation | SurfaceObservation:
        """The frames that are fitted, with the uncertainty of single observations.

        That is what the case states (see `length`); independent where it is to be learned.
        """
        uncertainty = self.case.uncertainty
        std = uncertainty.typical_mm
        learned = self.settings.errors is not None
        length = 0.0 if learned else self.length(stated=stated)
        scale = uncertainty.std_mm / std if isinstance(uncertainty.std_mm, np.ndarray) else None
        names = ("closed",) if self.frames is None else self.frames.frames
        predicted = ("open", *names)
        if self.corresponding:
            correlation = (
                SpatialCorrelation(self.case.surface.vertices, length) if length > 0 else None
            )
            kept = _thinned(len(self.closed.vertices))[:, None]
            seen = np.stack([np.where(kept, frame.vertices, np.nan) for frame in self.fitted])
            return Observation(names, seen, np.array(std**2), correlation, scale, predicted)
        points = tuple(
            self._points(name, frame, scale) for name, frame in zip(names, self.fitted, strict=True)
        )
        return SurfaceObservation(points, self._surface(DRAWN, WIDTH), std, std, length, predicted)

    def _surface(self, edge: float, width: float) -> PredictedSurface:
        """The predicted surface that points are compared with; see `PredictedSurface.finer`."""
        valve = self.model.valve
        surface = replace(PredictedSurface.of_valve(valve), annulus=None)
        if not self._smooth:
            return surface
        return surface.finer(valve.surface.vertices, edge, width)

    @property
    def _smooth(self) -> bool:
        """Whether surfaces are compared, and not known better than they can be drawn."""
        return not self.corresponding and self.case.uncertainty.typical_mm >= SURFACE_MM

    def _points(self, name: str, frame: Frame, scale: FloatArray | None) -> ObservedSurface:
        """What is compared of a frame whose vertices are not known again."""
        uncertainty, region = self.case.uncertainty, _vertex_region(frame)
        border, kept = BORDER * uncertainty.typical_mm, _thinned(len(frame.vertices))
        points = ObservedSurface(
            name,
            frame.vertices[kept],
            region[kept],
            frame.free_edge,
            scale=None if scale is None else scale[kept],
        )
        far = 1.0 if points.scale is None else points.scale
        alike = self.settings.errors is not None or uncertainty.correlation_length_mm > 0
        if self._smooth:
            if alike:
                # Beyond its border the surface goes on, but where it bends not as it does here.
                points = points.beyond(_rim(frame), frame.vertices, border * far)
            return replace(points, free_edge_region=_edge_region(frame, region, border))
        if alike:
            # Beyond a border a distance changes its sign, which correlated errors do not.
            near = replace(points, annulus=frame.annulus).inner(border * far)
            points = replace(near, annulus=None)
        return points

    @property
    def fitted(self) -> tuple[Frame, ...]:
        """The frames that are fitted, in the order in which they are predicted, the closed last."""
        if self.frames is None:
            return (self.closed,)
        by_name = {frame.name: frame for frame in self.case.frames}
        return tuple(by_name[name] for name in self.frames.frames)

    @property
    def corresponding(self) -> bool:
        """Whether vertices are compared one by one."""
        return self.settings.correspondence and all(one.corresponds for one in self.fitted)

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

    def _widened(self, result: StudyResult, observation: Observed) -> StudyResult:
        """The result with the covariance that the error samples give it, if there are any."""
        filtered = result.filtered
        weighed = self.errors is not None and isinstance(observation, WeighedObservation)
        if not weighed or filtered is None or filtered.prediction is None:
            return result
        covariances = np.array(filtered.transformed_iterate_covariances)
        covariances[-1] = self.sampled_posterior(filtered).covariance
        widened = replace(filtered, transformed_iterate_covariances=covariances)
        return replace(result, filtered=widened)

    def sampled_posterior(self, filtered: Estimate) -> SampledPosterior:
        """Covariance of an estimate in filter coordinates, from the error samples."""
        assert self.errors is not None
        assert filtered.prediction is not None
        z = filtered.transformed_iterates[-1]
        H = filtered.prediction.jacobian * filtered.transform.derivative(z)
        prior = to_filter(filtered.transform, filtered.prior)
        estimated = np.isin(filtered.names, np.array(self.names)[self.estimated])
        learned = filtered.learned
        if learned is None:
            return self.errors.posterior(H, prior.covariance, estimated)
        errors = replace(self.errors, base=self.noise(learned))
        posterior = errors.posterior(H, prior.covariance, estimated)
        covariance = np.array(posterior.covariance)
        covariance[np.ix_(estimated, estimated)] += learned.covariance
        return replace(posterior, covariance=covariance)

    def image_share(self, result: StudyResult) -> FloatArray | None:
        """Share of the variance of each modulus' logarithm that errors of the image account for."""
        filtered = result.filtered
        if self.errors is None or filtered is None or filtered.prediction is None:
            return None
        posterior = self.sampled_posterior(filtered)
        share = np.diag(posterior.from_samples) / np.diag(posterior.covariance)
        return share[[u.is_modulus for u in self.unknowns]]

    def budget(self, result: StudyResult) -> tuple[BudgetRow, ...]:
        """What each part of what is not known costs the moduli; of error samples alone."""
        filtered, observation = result.filtered, self.plain_observation()
        if self.errors is None or filtered is None or filtered.prediction is None:
            return ()
        m = filtered.mean
        predicted = self.shared(m)
        parts, frames = sample_parts(self.case)
        # One factorisation for all of them.
        vertices, tips = (
            np.concatenate(each) for each in zip(*parts.values(), *frames, strict=True)
        )
        joined = sample_geometry(self.case, self.registered, m, vertices, tips)
        if not predicted.converged or isinstance(joined, str):
            return ()
        columns = errors_of(observation, self.closed, predicted.y, joined)
        each = np.split(columns / np.sqrt(self.errors.count), len(parts) + len(frames), axis=1)
        z = filtered.transformed_iterates[-1]
        return budget_rows(
            filtered.names,
            filtered.prediction.jacobian * filtered.transform.derivative(z),
            to_filter(filtered.transform, filtered.prior).covariance,
            self.noise(filtered.learned, without=self._kinds),
            dict(zip(parts, each, strict=False)),
            each[len(parts) :],
            {own.name: own.columns for own in self.considered},
        )

    def estimate_moduli(
        self, filter_: Filter, observation: Observed, *, log: bool, variance: float | None = None
    ) -> StudyResult:
        """The moduli alone, everything else at its prior mean."""
        moduli = np.array([k for k, u in enumerate(self.unknowns) if u.is_modulus])
        prior = Gaussian(self.prior.mean[moduli], self.prior.covariance[np.ix_(moduli, moduli)])
        if variance is not None:
            prior = Gaussian.from_variance(prior.mean, variance)
        problem = Problem(
            tuple(self.names[k] for k in moduli),
            of_some(self.shared, self.shared.start, moduli, snap=1e-14),
            prior,
            filter_,
            Log() if log else Log((False,) * len(moduli)),
            self.settings.mechanics.tissue,
        )
        result = estimate(problem, observation, on_iterate=self.on_iterate)
        return self._widened(result, observation)

    def estimate_as_paper(self, paper: PaperSettings) -> StudyResult:
        """The moduli alone, with the paper's filter and its independent R."""
        observation: Observed
        if self.corresponding:
            seen = self.plain_observation()
            assert isinstance(seen, Observation)
            observation = replace(
                seen,
                positions=np.stack([frame.vertices for frame in self.fitted]),
                variance=np.array(paper.R),
                correlation=None,
                scale=None,
            )
        else:
            points = self.plain_observation()
            assert isinstance(points, SurfaceObservation)
            std = float(np.sqrt(paper.R))
            observation = replace(
                points,
                seen=tuple(replace(each, scale=None) for each in points.seen),
                std_mm=std,
                curve_std_mm=std,
                correlation_length_mm=0.0,
            )
        filter_ = PaperFilter(paper.Q, max_iterations=paper.max_iterations)
        return self.estimate_moduli(filter_, observation, log=False, variance=paper.P0)

    def closed_frames(self, m: FloatArray, closed: FloatArray) -> dict[str, FloatArray]:
        """All frames of the closed valve as they are predicted to be seen, ``(n, 3)`` mm each.

        Parameters
        ----------
        m : (p,)
        closed : array
            Predicted frames at ``m``, stacked, the closed one last.
        """
        n = len(self.case.surface.vertices)
        shown = closed.reshape(-1, n, 3)[-len(self.fitted) :]
        frames = {frame.name: points for frame, points in zip(self.fitted, shown, strict=True)}
        further = {frame.name: held_state(self.model, frame) for frame in self.case.held_out}
        states = list(further.values())
        if states:
            if self.frames is not None:
                states = self.frames.under(self.registered.own(m), further)
            held = self.model.held(self.registered.mechanical(m), states)
            for frame, points in zip(self.case.held_out, held, strict=True):
                if points is not None:
                    frames[frame.name] = self.registered.seen(points, m)
        return frames

    def compared(
        self, generic: Mapping[str, FloatArray], fitted: Mapping[str, FloatArray]
    ) -> _Frames:
        """How far the frames that both valves have are from where they were seen."""
        turn, origin, target = self._alignment(generic[self.closed.name])
        registered = {name: (points - origin) @ turn.T + target for name, points in generic.items()}
        # The closed frame first, wherever others are fitted with it.
        shown = sorted(
            self.case.frames, key=lambda f: bool(self.case.fitted) and f is not self.closed
        )
        distances = [
            FrameDistance(
                frame.name,
                frame.role in (Role.CLOSED, Role.FITTED),
                *(
                    self._distance(frame, positions[frame.name])
                    for positions in (generic, registered, fitted)
                ),
            )
            for frame in shown
            if frame.name in generic and frame.name in fitted
        ]
        return _Frames(generic, registered, fitted, tuple(distances))

    def _alignment(self, generic: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Turn, origin and its target that lay the generic closed valve on the closed frame."""
        if not self.corresponding:
            # Without correspondence: the displacement is that of the prior, none.
            return np.eye(3), np.zeros(3), np.zeros(3)
        origin, target = generic.mean(axis=0), self.closed.vertices.mean(axis=0)
        turn, _ = Rotation.align_vectors(self.closed.vertices - target, generic - origin)
        return turn.as_matrix(), origin, target

    def _distance(self, frame: Frame, positions: FloatArray) -> FloatArray:
        if self.settings.correspondence and frame.corresponds:
            return np.asarray(np.linalg.norm(positions - frame.vertices, axis=1))
        return surface_distance(frame.vertices, positions, self.case.surface.triangles)

    def narrower(self, result: StudyResult) -> Mapping[str, FloatArray]:
        """Standard deviations of the moduli's logarithms if something more were measured.

        From the linear model at the estimate, all unknowns estimated. Whatever else is measured is
        then known ``BETTER`` times as well as beforehand.
        """
        filtered = result.filtered
        assert filtered is not None
        assert filtered.prediction is not None
        moduli = [k for k, u in enumerate(self.unknowns) if u.is_modulus]
        prior = to_filter(self.transform, self.prior)
        z = filtered.transformed_iterates[-1]
        H = filtered.prediction.jacobian * self.transform.derivative(z)
        errors, learned = self.errors, filtered.learned
        doubt = np.zeros_like(prior.covariance)
        if learned is not None:
            errors = errors and replace(errors, base=self.noise(learned))
            doubt[np.ix_(self.estimated, self.estimated)] = learned.covariance
        groups = self._measurable()

        def widened(covariance: FloatArray, scale: float) -> FloatArray:
            own, more = np.diag(covariance), np.diag(doubt) / scale**2
            # The doubt of now: of less it may take more away than there is.
            return np.sqrt(np.where(own + more > 0.0, own + more, own))[moduli]

        def linear(P: FloatArray, scale: float = 1.0, without: Collection[str] = ()) -> FloatArray:
            # What is considered stays what it is where the frame is seen better.
            plain = self.noise(learned, considered=scale, without=without, stated=True)
            update = kalman_update(Gaussian(z, P), np.zeros(len(H)), H * scale, plain)
            return widened(update.posterior.covariance, scale)

        def std(P: FloatArray, scale: float = 1.0) -> FloatArray:
            if errors is None:
                return linear(P, scale)
            return widened(errors.posterior(H * scale, P).covariance, scale)

        stds = {"now": std(prior.covariance)}
        for words, members in groups.items():
            known = np.isin(self.names, members)
            if known.any():
                share = np.where(known, 1 / BETTER, 1.0)
                stds[words] = std(prior.covariance * np.outer(share, share))
        stds["4 beats averaged"] = std(prior.covariance, 2.0)
        stds["any number of beats averaged"] = std(prior.covariance, 1e3)
        if self.errors is not None:
            stds["geometry known exactly"] = linear(prior.covariance, without=self._kinds)
            return stds
        for kind in self._kinds:
            stds[f"{kind} known exactly"] = linear(prior.covariance, without=(kind,))
        return stds

    def _measurable(self) -> dict[str, tuple[str, ...]]:
        """What else could be measured and how well, in words -> the nuisances that it tells of."""
        std = {u.name: u.std / BETTER for u in self.unknowns}
        words: dict[str, tuple[str, ...]] = {}
        # A scale is of the closed frame's pressure, errors of several frames are in mmHg.
        errors = {
            name: error * (1.0 if is_frame_pressure(name) else self.closed.pressure_mmHg)
            for name, error in std.items()
            if name == "pressure_scale" or is_frame_pressure(name)
        }
        if errors:
            words[f"pressure measured to ±{max(errors.values()):.2g} mmHg"] = tuple(errors)
        for name, what in (
            ("chord_rest_length", "rest lengths"),
            ("chord_stiffness", "stiffness"),
        ):
            if name in std:
                words[f"{what} of the chordae measured to ±{100 * std[name]:.2g} %"] = (name,)
        if any(name in std for name in REGISTRATION):
            words[f"annulus placed {BETTER:g} times as well"] = REGISTRATION
        others = tuple(n for n in self.names if not n.startswith("E_f."))
        return {**words, f"all of these measured {BETTER:g} times as well": others}

    def confirm(self, result: StudyResult) -> float | None:
        """Largest distance (mm) of the fitted closed valve from one closed from the open state."""
        assert result.estimate is not None
        assert result.fitted is not None
        anew = replace(self.model, continuation=False, guide=None, repeat=True)
        frames = frames_model(self.case, self.settings, anew)
        prediction = RegisteredModel(frames or anew, self.names)(result.estimate)
        if not prediction.converged:
            return None
        closed = prediction.y.reshape(1 + len(self.fitted), -1, 3)[-1]
        return float(np.linalg.norm(closed - result.fitted[-1], axis=1).max())


def _thinned(n: int) -> BoolArray:
    """Which of n vertices are compared: all, or evenly spread ones if there are very many."""
    kept = np.zeros(n, dtype=np.bool_)
    kept[:: -(-n // MAX_VERTICES)] = True
    return kept


def _vertex_region(frame: Frame) -> IntArray:
    """The leaflet of each vertex of a frame ``(q,)``, ``UNKNOWN`` on the line between two."""
    n = len(frame.vertices)
    low, high = np.full(n, np.iinfo(np.int64).max), np.full(n, -1)
    np.minimum.at(low, frame.triangles.ravel(), np.repeat(frame.region, 3))
    np.maximum.at(high, frame.triangles.ravel(), np.repeat(frame.region, 3))
    return np.where(low == high, low, UNKNOWN)


def _edge_region(frame: Frame, region: IntArray, border: float) -> IntArray:
    """The leaflet of each point of the free edge ``(j,)``, ``UNKNOWN`` near to where two meet.

    ``border`` is how near, in mm, and ``region (q,)`` that of the vertices.
    """
    own = region[cKDTree(frame.vertices).query(frame.free_edge)[1]]
    between = cKDTree(frame.vertices[region == UNKNOWN]).query(frame.free_edge)[0]
    return np.where(between < border, UNKNOWN, own)


def _rim(frame: Frame) -> IntArray:
    """The border of a frame's surface, as triangles without area ``(e, 3)``."""
    edges = np.sort(directed_edges(frame.triangles), axis=1)
    once, count = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(once[count == 1][:, [0, 1, 1]])
