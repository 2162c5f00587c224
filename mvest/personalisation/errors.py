"""Errors that separate the frames of a case from a model's prediction, besides its unknowns.

Three kinds add up as noise of the observation: errors of single observations, stated or learned;
errors of the model's geometry, law and mesh, as low-rank columns; and samples of the errors of all
frames of one volume. The last two are linearised about one closed valve (`linearise`,
`with_samples`); another linearisation is another `FrameErrors`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mvest.errors import GeometryError
from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.noise import (
    ErrorColumns,
    NoiseCovariance,
    NoiseFamily,
    ObservationNoise,
    low_rank_noise,
    observation_noise,
    scaled_noise,
)
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.sampled import SampledErrors
from mvest.observation.learned import error_family
from mvest.observation.vertices import Observation
from mvest.personalisation.fitted_frames import BLURRED_MM, SURFACE_MM, FittedFrames
from mvest.personalisation.geometry import GeometryModes, geometry_modes
from mvest.personalisation.sources import (
    ClosedValve,
    ErrorSource,
    FrameSamples,
    geometry_sources,
    law_and_mesh_sources,
    of_low_rank,
    sample_frames,
)
from mvest.problem.estimate import Observed
from mvest.typing import FloatArray

KNOWN = "errors of known size"
"""Joint name of all columns whose size is not learned."""


@dataclass(frozen=True, slots=True, eq=False)
class WeighedObservation:
    """An observation with another noise and an offset; see `Observed` for its members."""

    plain: Observed
    R: NoiseCovariance
    #: ``(k,)``, added to the observation: the prediction's expected error.
    offset: FloatArray | float = 0.0

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames, the closed one last."""
        return self.plain.frames

    @property
    def y(self) -> FloatArray:
        """The observation ``(k,)``."""
        return self.plain.y + self.offset

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """Turn a model of all frames into a model of this observation."""
        return self.plain.of(model)

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) between the last observed frame and fitted frames ``(f, n, 3)``."""
        return self.plain.distance(fitted)


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """All errors of the fitted frames besides the unknowns, about one closed valve."""

    fitted: FittedFrames
    #: Uncertain geometry; None before the first linearisation.
    modes: tuple[GeometryModes, ...] | None = None
    sources: tuple[ErrorSource, ...] = ()  #: errors of geometry, law and mesh
    #: Effect of the case's error samples on the predicted and the observed closed frame.
    frame_samples: FrameSamples | None = None
    samples: SampledErrors | None = None  #: effect of the error samples on the innovation
    unaccounted: tuple[str, ...] = ()  #: why some errors could not be linearised

    @property
    def geometry(self) -> tuple[ErrorSource, ...]:
        """The sources that are errors of the geometry."""
        return tuple(source for source in self.sources if source.modes is not None)

    def columns(self, learned: LearnedNoise | None = None) -> dict[str, FloatArray]:
        """Source -> its columns ``(k, q)`` of stated or learned size."""
        sizes = self.source_sizes(learned)
        return {own.name: sizes[own.name] * own.columns.columns for own in self.sources}

    def single_noise(
        self, learned: LearnedNoise | None = None, *, beats: float = 1.0
    ) -> ObservationNoise:
        """Noise of single observations alone.

        Parameters
        ----------
        learned : LearnedNoise, optional
            Default: as stated.
        beats : float
            Number of averaged beats, possibly infinite. Errors of the images fall with its square
            root; the resolution of the method stays.
        """
        family = self.family
        if family is None:
            observation = self.fitted.observation()
            noise = observation_noise(observation.R, len(observation.y))
            return noise if beats == 1.0 else scaled_noise(noise, np.full(noise.size, beats**-0.5))
        belief = family.prior if learned is None else learned.posterior
        log = belief.mean[: len(family.names) - len(family.columns)]
        return family.without_columns().at(log, beats)

    def noise(
        self, learned: LearnedNoise | None = None, *, without: Collection[str] = ()
    ) -> ObservationNoise:
        """Noise of the observation except for error samples and the sources ``without``."""
        base = self.single_noise(learned)
        columns = [own for name, own in self.columns(learned).items() if name not in without]
        return low_rank_noise(base, np.concatenate(columns, axis=1)) if columns else base

    def weighing(
        self, samples: SampledErrors, learned: LearnedNoise | None = None
    ) -> SampledErrors:
        """Samples together with the noise of all other errors, see `noise`."""
        columns = list(self.columns(learned).values())
        beside = np.concatenate(columns, axis=1) if columns else None
        return replace(samples, base=self.noise(learned), beside=beside)

    def source_sizes(self, learned: LearnedNoise | None) -> dict[str, float]:
        """Source -> factor on its size; 1 if that is not learned."""
        family, sizes = self.family, {source.name: 1.0 for source in self.sources}
        if family is not None and family.columns:
            log = (family.prior if learned is None else learned.posterior).mean
            first = len(family.names) - len(family.columns)
            factors = np.exp(log[first : len(family.names)]).tolist()
            found = {own.name: f for own, f in zip(family.columns, factors, strict=True)}
            sizes |= {name: found[name] for name in sizes if name in found}
        return sizes

    def geometry_sizes(self, learned: LearnedNoise | None) -> tuple[float, ...]:
        """The factors of the sources of geometry."""
        sizes = self.source_sizes(learned)
        return tuple(sizes[own.name] for own in self.geometry)

    def observation(self) -> Observed:
        """The fitted frames with the noise of all errors."""
        plain, family, offset = self.fitted.observation(), self.family, self.expected
        if self.samples is not None:
            if family is None:
                return WeighedObservation(plain, self.samples.noise, offset)
            columns = of_low_rank(self.samples.columns, self.samples.base)
            family = family.plus(ErrorColumns("error samples", columns))
        if family is not None:
            return WeighedObservation(plain, family, offset)
        return WeighedObservation(plain, self.noise(), offset) if self.sources else plain

    @property
    def expected(self) -> FloatArray | float:
        """Expected error ``(k,)`` of the prediction by law and mesh."""
        return sum((source.expected for source in self.sources), start=0.0)

    def rough_observation(self) -> Observed:
        """The same with blurred surfaces, for a first estimate."""
        observation = self.observation()
        if self.fitted.corresponding:
            return observation
        noise = observation.R
        if isinstance(noise, NoiseFamily):
            noise = replace(noise, resolution=max(noise.resolution, BLURRED_MM))
        return WeighedObservation(self.fitted.blurred(), noise)

    @cached_property
    def family(self) -> NoiseFamily | None:
        """The noise to be learned, with all sources; None if errors are as stated.

        Sources of known size are joined, so that fewer quantities are learned.
        """
        fitted = self.fitted
        if fitted.settings.errors is None:
            return None
        family = error_family(
            fitted.observation(),
            fitted.settings.errors,
            fitted.length,
            fitted.case.surface.vertices if fitted.corresponding else fitted.near,
        )
        if not fitted.corresponding:
            family = replace(family, resolution=max(family.resolution, SURFACE_MM))
        columns = [source.columns for source in self.sources]
        learned = [own for own in columns if own.factor > 1.0]
        known = [own.columns for own in columns if own.factor == 1.0]
        if known:
            learned.append(ErrorColumns(KNOWN, np.concatenate(known, axis=1)))
        return replace(family, columns=tuple(learned))

    def as_stated(self) -> FrameErrors:
        """The errors if geometry and law were known: only error samples remain."""
        plain = FrameErrors(self.fitted, self.modes)
        if self.samples is None:
            return plain
        samples = plain.weighing(self.samples)
        return replace(plain, frame_samples=self.frame_samples, samples=samples)


def linearise(errors: FrameErrors, valve: ClosedValve) -> FrameErrors:
    """Errors of the geometry about a closed valve, and those of law and mesh if still unknown.

    Effects of law and mesh hardly depend on the linearisation point, and take as long to compute
    as those of the geometry. ``errors`` are those about another closed valve, or without sources.
    """
    settings, observation = errors.fitted.settings, errors.fitted.observation()
    geometry, laws = settings.nuisance_geometry, settings.nuisance_law
    if geometry is None and not laws:
        return errors
    if not settings.mechanics.protocol.equilibrium:
        return replace(errors, unaccounted=("the closure does not end in an equilibrium",))
    others = tuple(source for source in errors.sources if source.modes is None)
    found: list[tuple[ErrorSource, ...] | str] = []
    if geometry is not None:
        modes = errors.modes
        if modes is None:
            modes = geometry_modes(errors.fitted.case, geometry, valve.closure()[0])
            errors = replace(errors, modes=modes)
        found.append(geometry_sources(modes, valve, observation, errors.single_noise()))
    if others:
        found.append(others)
    elif laws or settings.mesh.error_std:
        found.append(law_and_mesh_sources(laws, settings.mesh, valve, observation))
    return replace(
        errors,
        sources=tuple(own for part in found if not isinstance(part, str) for own in part),
        unaccounted=tuple(reason for reason in found if isinstance(reason, str)),
    )


def with_samples(errors: FrameErrors, valve: ClosedValve) -> FrameErrors:
    """The errors with the effect of the case's error samples about a closed valve.

    GeometryError if that cannot be computed.
    """
    case = errors.fitted.case
    found = sample_frames(case, valve)
    if isinstance(found, str):
        raise GeometryError(f"case {case.name}: effect of its error samples: {found}")
    observation = errors.fitted.observation()
    assert isinstance(observation, Observation)  # frames with samples correspond
    moved = (found.predicted - found.seen)[:, observation.seen[0]]
    innovation = moved.reshape(len(found), -1).T
    assert case.error_samples is not None
    samples = SampledErrors(errors.noise(), innovation, case.error_samples.source)
    return replace(errors, frame_samples=found, samples=errors.weighing(samples))
