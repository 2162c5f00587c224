"""What is not known of the fitted frames of a case, and the noise that this is to a filter.

Three things add up: errors of single points, as the case states them or as they are learned; errors
of the frames of which the case has samples; and what is considered of geometry and law.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import cached_property

import numpy as np

from mvest.cases.case import Role
from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError
from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.noise import (
    ErrorColumns,
    NoiseFamily,
    ObservationNoise,
    low_rank_noise,
    observation_noise,
    scaled_noise,
)
from mvest.estimation.sampled import SampledErrors
from mvest.observation.learned import error_family
from mvest.personalisation.considered_geometry import (
    GeometryColumns,
    GeometryModes,
    closure_at,
    geometry_columns,
    geometry_modes,
    of_low_rank,
)
from mvest.personalisation.considered_law import law_columns
from mvest.personalisation.fitted_frames import BLURRED_MM, SURFACE_MM, FittedFrames
from mvest.personalisation.geometry_errors import (
    GeometryErrors,
    WeighedObservation,
    errors_of,
    sample_geometry,
)
from mvest.problem.problem import Observed
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray

KNOWN = "what is considered"
"""Name of all columns whose size is not learned."""


class ObservationErrors:
    """What is not known of fitted frames, as far as it is found out.

    Attributes
    ----------
    fitted : FittedFrames
    registered : RegisteredModel
        By which it is found out.
    geometry : GeometryErrors or None
        What the case's error samples do to the prediction.
    samples : SampledErrors or None
        The same, to the innovation.
    considered : tuple of ErrorColumns
        What geometry and law, as far as not known, do to the observation.
    unconsidered : tuple of str
        Why it is not known what some of it does.
    known : GeometryColumns or None
        What modes of the geometry's error do to the observation.
    geometry_modes : tuple of GeometryModes or None
        What is not known of the geometry as it was seen, once it was asked for.
    displaced_by : tuple of (q,)
        Modes of each kind by which the geometry of the model is displaced; empty: it is as seen.
    seen : ClosureModel or None
        The closure of the valve as it was seen, if it is displaced.
    """

    def __init__(
        self,
        fitted: FittedFrames,
        registered: RegisteredModel,
        geometry_modes: tuple[GeometryModes, ...] | None = None,
        displaced_by: tuple[FloatArray, ...] = (),
        seen: ClosureModel | None = None,
    ) -> None:
        self.fitted, self.registered = fitted, registered
        self.geometry_modes, self.displaced_by = geometry_modes, displaced_by
        self.seen = seen
        self.geometry: GeometryErrors | None = None
        self.samples: SampledErrors | None = None
        self.considered: tuple[ErrorColumns, ...] = ()
        self.unconsidered: tuple[str, ...] = ()
        self.known: GeometryColumns | None = None

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of what is considered."""
        return tuple(own.name for own in self.considered)

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the columns of what is considered of the geometry."""
        return tuple(
            f"geometry.{k}" for k in range(sum(c.columns.shape[1] for c in self.considered))
        )

    @property
    def considers(self) -> bool:
        """Whether anything that is not among the unknowns widens the intervals."""
        settings = self.fitted.settings
        return settings.considered_geometry is not None or bool(settings.considered_law)

    def consider(self, m: FloatArray, predicted: FloatArray) -> None:
        """Find out what geometry and law, as far as not known, do to the observation at ``m``.

        Parameters
        ----------
        m : (p,)
        predicted : array
            Both frames there, stacked.
        """
        settings, observation = self.fitted.settings, self.fitted.observation()
        if self.considers and not settings.mechanics.protocol.equilibrium:
            self.unconsidered = ("the closure does not end in an equilibrium",)
            return
        found: list[tuple[ErrorColumns, ...] | str] = []
        if settings.considered_geometry is not None:
            if self.geometry_modes is None:
                model, _, _ = closure_at(self.registered, m)
                self.geometry_modes = geometry_modes(
                    self.fitted.case, settings.considered_geometry, model
                )
            noise = self.noise(without=self.kinds)
            geometry = geometry_columns(
                self.geometry_modes,
                self.registered,
                observation,
                noise,
                m,
                predicted,
                self.seen,
            )
            found.append(geometry if isinstance(geometry, str) else geometry.columns)
            self.known = None if isinstance(geometry, str) else geometry
        if settings.considered_law:
            found.append(
                law_columns(settings.considered_law, self.registered, observation, m, predicted)
            )
        self.unconsidered = tuple(reason for reason in found if isinstance(reason, str))
        known = [columns for columns in found if not isinstance(columns, str)]
        if not known:
            return  # what was found out elsewhere serves
        self.considered = tuple(own for columns in known for own in columns)
        if self.samples is not None:
            self.samples = self.weighing(self.samples)

    def sample_geometry(self, m: FloatArray, predicted: FloatArray) -> None:
        """Find out what errors of the case's frames do to the observation at ``m``.

        Parameters
        ----------
        m : (p,)
        predicted : array
            Both frames there, stacked.
        """
        case = self.fitted.case
        sampled = self.sampled(m, predicted)
        if isinstance(sampled, str):
            raise GeometryError(f"case {case.name}: what its error samples do: {sampled}")
        self.geometry, errors = sampled
        assert case.error_samples is not None
        self.samples = self.weighing(SampledErrors(self.noise(), errors, case.error_samples.source))

    def sampled(
        self,
        m: FloatArray,
        predicted: FloatArray,
        vertices: FloatArray | None = None,
        tips: FloatArray | None = None,
    ) -> tuple[GeometryErrors, FloatArray] | str:
        """What error samples do to the prediction at ``m`` and to the innovation ``(n, K)``.

        Parameters
        ----------
        m : (p,)
        predicted : array
            Both frames there, stacked.
        vertices : (K, f, n, 3) mm, optional
        tips : (K, f, t, 3) mm, optional
            Other samples than those of the case.
        """
        case = self.fitted.case
        geometry = sample_geometry(case, self.registered, m, vertices, tips)
        if isinstance(geometry, str):
            return geometry
        closed = case.frame(Role.CLOSED)
        return geometry, errors_of(self.fitted.observation(), closed, predicted, geometry)

    def noise(
        self,
        learned: LearnedNoise | None = None,
        *,
        beats: float = 1.0,
        without: Collection[str] = (),
        beside: FloatArray | None = None,
        stated: bool = False,
    ) -> ObservationNoise:
        """Noise of the observation without that of error samples.

        Parameters
        ----------
        learned : LearnedNoise, optional
            By which it is known, and not as it is stated.
        beats : float
            Heart beats whose mean is observed: errors of single observations are averaged, down to
            the resolution where they are learned; all others stay.
        without : collection of str
            Kinds of it that are left out.
        beside : (k, q), optional
            Further columns.
        stated : bool
            See `FittedFrames.observation`.
        """
        family = self.single_errors
        scales = self._learned_sizes(learned)
        if family is None:
            observation = self.fitted.observation(stated=stated)
            base = observation_noise(observation.R, len(observation.y))
            if beats != 1.0:
                base = scaled_noise(base, np.full(base.size, beats**-0.5))
        else:
            log = (family.prior if learned is None else learned.posterior).mean[: len(family.names)]
            first = len(family.names) - len(family.columns)
            base = family.without_columns().at(log[:first], beats)
        columns = [
            scales.get(own.name, 1.0) * own.columns
            for own in self.considered
            if own.name not in without
        ]
        if beside is not None:
            columns.append(beside)
        return low_rank_noise(base, np.concatenate(columns, axis=1)) if columns else base

    def weighing(
        self,
        samples: SampledErrors,
        learned: LearnedNoise | None = None,
        *,
        beats: float = 1.0,
    ) -> SampledErrors:
        """Samples with the noise of all other errors, see `noise`."""
        scales = self._learned_sizes(learned)
        columns = [scales.get(c.name, 1.0) * c.columns for c in self.considered]
        return replace(
            samples,
            base=self.noise(learned, beats=beats),
            beside=np.concatenate(columns, axis=1) if columns else None,
        )

    def about(
        self,
        registered: RegisteredModel,
        displaced_by: tuple[FloatArray, ...] = (),
        seen: ClosureModel | None = None,
    ) -> ObservationErrors:
        """The same errors, of which nothing is found out, about a valve with another geometry.

        Parameters
        ----------
        registered : RegisteredModel
            Of that valve.
        displaced_by : tuple of (q,)
            Modes of each kind by which it differs from the one that was seen.
        seen : ClosureModel, optional
            The closure of the one that was seen, if it does.
        """
        return ObservationErrors(self.fitted, registered, self.geometry_modes, displaced_by, seen)

    def as_stated(self, registered: RegisteredModel) -> ObservationErrors:
        """The same where geometry and law are known: error samples of the frames remain.

        Parameters
        ----------
        registered : RegisteredModel
            Of the valve as it was seen.
        """
        errors = self.about(registered)
        if self.samples is not None:
            errors.geometry = self.geometry
            errors.samples = errors.weighing(self.samples)
        return errors

    def _learned_sizes(self, learned: LearnedNoise | None) -> dict[str, float]:
        """Factor on each kind of what is considered whose size is learned."""
        family = self.single_errors
        if family is None or not family.columns:
            return {}
        log = (family.prior if learned is None else learned.posterior).mean[: len(family.names)]
        sizes = np.exp(log[-len(family.columns) :]).tolist()
        return {own.name: size for own, size in zip(family.columns, sizes, strict=True)}

    def sizes(self, learned: LearnedNoise | None) -> tuple[float, ...]:
        """Factor on each kind of the geometry's modes, where it is learned."""
        assert self.known is not None
        found = self._learned_sizes(learned)
        return tuple(found.get(own.name, 1.0) for own in self.known.modes)

    def observation(self) -> Observed:
        """The closed frame, with its uncertainty and what errors of the geometry add to it."""
        plain, single = self.fitted.observation(), self.single_errors
        if self.displaced_by and self.known is not None:
            noise = self.noise() if single is None else single
            return WeighedObservation(plain, noise, self.known.offset(self.displaced_by))
        if single is not None:
            if self.samples is not None:
                columns = of_low_rank(self.samples.columns, self.samples.base)
                single = single.plus(ErrorColumns("geometry", columns))
            return WeighedObservation(plain, single)
        if self.samples is not None:
            return WeighedObservation(plain, self.samples.noise)
        return WeighedObservation(plain, self.noise()) if self.considered else plain

    def rough_observation(self) -> Observed:
        """The same, of which surfaces are seen through a blur."""
        observation = self.observation()
        if not self.fitted.smooth:
            return observation
        noise = observation.R
        if isinstance(noise, NoiseFamily):
            noise = replace(noise, resolution=max(noise.resolution, BLURRED_MM))
        return WeighedObservation(self.fitted.blurred(), noise)

    @property
    def single_errors(self) -> NoiseFamily | None:
        """What is believed of the errors of single observations, where they are learned.

        What is considered is added; all of it whose size is known at once, which saves quantities.
        """
        if self._family is None:
            return None
        learned = [own for own in self.considered if own.factor > 1.0]
        known = [own.columns for own in self.considered if own.factor == 1.0]
        if known:
            learned.append(ErrorColumns(KNOWN, np.concatenate(known, axis=1)))
        return replace(self._family, columns=tuple(learned))

    @cached_property
    def _family(self) -> NoiseFamily | None:
        fitted = self.fitted
        if fitted.settings.errors is None:
            return None
        family = error_family(
            fitted.observation(),
            fitted.settings.errors,
            fitted.length(),
            fitted.case.surface.vertices,
        )
        if not fitted.smooth:
            return family
        return replace(family, resolution=max(family.resolution, SURFACE_MM))
