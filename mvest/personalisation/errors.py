"""What makes the frames of a case differ from a model's prediction, beside its unknowns.

Three kinds of error add up, and each enters the filter as noise of the observation: errors of
single observations, which are stated or learned; errors of what the model is built from, its
geometry and its law, as low-rank columns; and samples of how all frames of one volume may be in
error. The second and the third are linearised about one closed valve (`linearise`,
`with_samples`). Nothing here changes once it is made: a linearisation about another valve is
another `FrameErrors`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mvest.cases.case import Role
from mvest.closure.model import ClosureModel
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
from mvest.personalisation.fitted_frames import BLURRED_MM, SURFACE_MM, FittedFrames
from mvest.personalisation.geometry import GeometryModes, geometry_modes
from mvest.personalisation.samples import FrameSamples, errors_of_samples, sample_frames
from mvest.personalisation.sources import (
    ErrorSource,
    closure_at,
    geometry_sources,
    law_and_mesh_sources,
    of_low_rank,
)
from mvest.problem.estimate import Observed
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray

KNOWN = "errors of known size"
"""Name of all columns whose size is not learned."""


@dataclass(frozen=True, slots=True, eq=False)
class WeighedObservation:
    """An observation with another noise, compared with a prediction that is off by a known amount.

    Attributes
    ----------
    plain : Observed
    R : NoiseCovariance
    offset : (k,) or float
        Added to the observation: what the model's displaced geometry does to its prediction.
    """

    plain: Observed
    R: NoiseCovariance
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
        """What a model predicts of this observation."""
        return self.plain.of(model)

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) of what was seen in the last frame to fitted ``(f, n, 3)``."""
        return self.plain.distance(fitted)


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """All errors of the fitted frames beside the unknowns, about one closed valve.

    Attributes
    ----------
    fitted : FittedFrames
    modes : tuple of GeometryModes or None
        What is not known of the geometry as it was seen; None before the first linearisation.
    displaced_by : tuple of (q,)
        Modes of each kind by which the model's geometry is displaced; empty: it is as it was seen.
    sources : tuple of ErrorSource
        Errors of the geometry and of the law.
    frame_samples : FrameSamples or None
        What the case's error samples do to the predicted and to the observed closed frame.
    samples : SampledErrors or None
        The same, to the innovation.
    unaccounted : tuple of str
        Why some of it could not be linearised.
    """

    fitted: FittedFrames
    modes: tuple[GeometryModes, ...] | None = None
    displaced_by: tuple[FloatArray, ...] = ()
    sources: tuple[ErrorSource, ...] = ()
    frame_samples: FrameSamples | None = None
    samples: SampledErrors | None = None
    unaccounted: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sources."""
        return tuple(source.name for source in self.sources)

    @property
    def geometry(self) -> tuple[ErrorSource, ...]:
        """Those sources that are errors of the geometry."""
        return tuple(source for source in self.sources if source.modes is not None)

    def columns(self, learned: LearnedNoise | None = None) -> dict[str, FloatArray]:
        """Source -> its columns ``(k, q)``, as large as was learned."""
        sizes = self.source_sizes(learned)
        return {own.name: sizes[own.name] * own.columns.columns for own in self.sources}

    @property
    def has_floor(self) -> bool:
        """Whether there is an error of single points that no number of beats averages away."""
        return self.family is not None and self.family.resolution > 0.0

    def single_noise(
        self, learned: LearnedNoise | None = None, *, beats: float = 1.0, stated: bool = False
    ) -> ObservationNoise:
        """Noise of single observations alone.

        Parameters
        ----------
        learned : LearnedNoise, optional
            By which it is known, and not as it is stated.
        beats : float
            Whose mean is observed, infinity included: errors of the images fall by its root, the
            resolution, which is of the method, stays.
        stated : bool
            See `FittedFrames.observation`.
        """
        family = self.family
        if family is None:
            observation = self.fitted.observation(stated=stated)
            noise = observation_noise(observation.R, len(observation.y))
            return noise if beats == 1.0 else scaled_noise(noise, np.full(noise.size, beats**-0.5))
        belief = family.prior if learned is None else learned.posterior
        log = belief.mean[: len(family.names) - len(family.columns)]
        return family.without_columns().at(log, beats)

    def noise(
        self,
        learned: LearnedNoise | None = None,
        *,
        without: Collection[str] = (),
        beside: FloatArray | None = None,
        stated: bool = False,
    ) -> ObservationNoise:
        """Noise of the observation without that of error samples.

        Parameters
        ----------
        learned : LearnedNoise, optional
            By which it is known, and not as it is stated.
        without : collection of str
            Sources that are left out.
        beside : (k, q), optional
            Further columns.
        stated : bool
            See `FittedFrames.observation`.
        """
        base = self.single_noise(learned, stated=stated)
        columns = [own for name, own in self.columns(learned).items() if name not in without]
        if beside is not None:
            columns.append(beside)
        return low_rank_noise(base, np.concatenate(columns, axis=1)) if columns else base

    def weighing(
        self, samples: SampledErrors, learned: LearnedNoise | None = None
    ) -> SampledErrors:
        """Samples with the noise of all other errors, see `noise`."""
        columns = list(self.columns(learned).values())
        return replace(
            samples,
            base=self.noise(learned),
            beside=np.concatenate(columns, axis=1) if columns else None,
        )

    def source_sizes(self, learned: LearnedNoise | None) -> dict[str, float]:
        """Factor on each source, 1 where its size is not learned."""
        family, sizes = self.family, dict.fromkeys(self.names, 1.0)
        if family is not None and family.columns:
            log = (family.prior if learned is None else learned.posterior).mean
            first = len(family.names) - len(family.columns)
            factors = np.exp(log[first : len(family.names)]).tolist()
            found = {own.name: f for own, f in zip(family.columns, factors, strict=True)}
            sizes |= {name: found[name] for name in sizes if name in found}
        return sizes

    def geometry_sizes(self, learned: LearnedNoise | None) -> tuple[float, ...]:
        """Those of the geometry."""
        sizes = self.source_sizes(learned)
        return tuple(sizes[own.name] for own in self.geometry)

    def offset(self, modes: Sequence[FloatArray]) -> FloatArray:
        """What modes ``(q,)`` of each kind of geometry do to the observation ``(k,)``."""
        return np.sum([s.rows @ z for s, z in zip(self.geometry, modes, strict=True)], axis=0)

    def observation(self) -> Observed:
        """The fitted frames with the noise of all errors."""
        plain, family = self.fitted.observation(), self.family
        if self.displaced_by and self.geometry:
            noise = self.noise() if family is None else family
            return WeighedObservation(plain, noise, self.offset(self.displaced_by))
        if family is not None:
            if self.samples is not None:
                columns = of_low_rank(self.samples.columns, self.samples.base)
                family = family.plus(ErrorColumns("error samples", columns))
            return WeighedObservation(plain, family)
        if self.samples is not None:
            return WeighedObservation(plain, self.samples.noise)
        return WeighedObservation(plain, self.noise()) if self.sources else plain

    def rough_observation(self) -> Observed:
        """The same, of which surfaces are seen through a blur."""
        observation = self.observation()
        if self.fitted.corresponding:
            return observation
        noise = observation.R
        if isinstance(noise, NoiseFamily):
            noise = replace(noise, resolution=max(noise.resolution, BLURRED_MM))
        return WeighedObservation(self.fitted.blurred(), noise)

    @cached_property
    def family(self) -> NoiseFamily | None:
        """The noise to be learned, all sources included; None where errors are as stated.

        Sources of known size are one source: fewer quantities are learned.
        """
        fitted = self.fitted
        if fitted.settings.errors is None:
            return None
        family = error_family(
            fitted.observation(),
            fitted.settings.errors,
            fitted.length(),
            fitted.case.surface.vertices,
        )
        if not fitted.corresponding:
            family = replace(family, resolution=max(family.resolution, SURFACE_MM))
        columns = [source.columns for source in self.sources]
        learned = [own for own in columns if own.factor > 1.0]
        known = [own.columns for own in columns if own.factor == 1.0]
        if known:
            learned.append(ErrorColumns(KNOWN, np.concatenate(known, axis=1)))
        return replace(family, columns=tuple(learned))

    def displaced(self, modes: tuple[FloatArray, ...]) -> FrameErrors:
        """Errors about a valve whose geometry is displaced by modes, before it is linearised."""
        kept = tuple(source for source in self.sources if source.modes is None)
        return FrameErrors(self.fitted, self.modes, modes, kept)

    def as_stated(self) -> FrameErrors:
        """The same where geometry and law are known: error samples of the frames remain."""
        plain = FrameErrors(self.fitted, self.modes)
        if self.samples is None:
            return plain
        samples = plain.weighing(self.samples)
        return replace(plain, frame_samples=self.frame_samples, samples=samples)


def linearise(
    errors: FrameErrors,
    registered: RegisteredModel,
    m: FloatArray,
    predicted: FloatArray,
    seen: ClosureModel | None = None,
) -> FrameErrors:
    """Errors of the geometry about a closed valve, and of law and mesh unless they are known.

    What law and mesh do hardly differs from one place to the next, and takes as long to find as
    what the geometry does.

    Parameters
    ----------
    errors : FrameErrors
        Those of another closed valve, or without sources.
    registered : RegisteredModel
        Its last closed state is gone on from.
    m : (p,)
        Parameters at which it is closed.
    predicted : array
        All frames there, stacked.
    seen : ClosureModel, optional
        Of the valve as it was seen, if the geometry of ``registered`` is displaced.
    """
    settings, observation = errors.fitted.settings, errors.fitted.observation()
    geometry, laws = settings.nuisance_geometry, settings.nuisance_law
    mesh = settings.mesh.error_share
    if geometry is None and not laws:
        return errors
    if not settings.mechanics.protocol.equilibrium:
        return replace(errors, unaccounted=("the closure does not end in an equilibrium",))
    known = tuple(source for source in errors.sources if source.modes is None)
    found: list[tuple[ErrorSource, ...] | str] = []
    if geometry is not None:
        if errors.modes is None:
            modes = geometry_modes(errors.fitted.case, geometry, closure_at(registered, m)[0])
            errors = replace(errors, modes=modes)
        assert errors.modes is not None
        found.append(
            geometry_sources(
                errors.modes, registered, observation, errors.single_noise(), m, predicted, seen
            )
        )
    if known:
        found.append(known)
    elif laws or mesh:
        found.append(law_and_mesh_sources(laws, mesh, registered, observation, m, predicted))
    return replace(
        errors,
        sources=tuple(own for part in found if not isinstance(part, str) for own in part),
        unaccounted=tuple(reason for reason in found if isinstance(reason, str)),
    )


def with_samples(
    errors: FrameErrors, registered: RegisteredModel, m: FloatArray, predicted: FloatArray
) -> FrameErrors:
    """The errors with what the case's error samples do, about a closed valve.

    Parameters are those of `linearise`.

    Raises
    ------
    GeometryError
        If that is not known.
    """
    case = errors.fitted.case
    samples = case.error_samples
    assert samples is not None
    found = sample_frames(case, *closure_at(registered, m), samples.vertices, samples.tips)
    if isinstance(found, str):
        raise GeometryError(f"case {case.name}: what its error samples do: {found}")
    innovation = errors_of_samples(
        errors.fitted.observation(), case.frame(Role.CLOSED), predicted, found
    )
    own = errors.weighing(SampledErrors(errors.noise(), innovation, samples.source))
    return replace(errors, frame_samples=found, samples=own)
