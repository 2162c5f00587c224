"""What an estimate of a case knows, what its intervals rest on, and what would narrow them.

Everything here follows from one linear model about the estimate: the observation is H z + C g + e
with unknowns z, modes g of everything else that is in doubt, and errors e of single observations,
learned with the unknowns. z and g have independent priors: all of it is a few small matrices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mvest.closure.frames import SCALE, is_frame_pressure
from mvest.estimation.estimate import Estimate
from mvest.estimation.evidence import LearnedNoise
from mvest.estimation.noise import low_rank_noise
from mvest.estimation.sampled import SampledPosterior
from mvest.estimation.transform import to_filter
from mvest.personalisation.errors import FrameErrors
from mvest.personalisation.estimation import CaseEstimate, CaseProblem, slopes
from mvest.problem.registration import REGISTRATION
from mvest.typing import FloatArray
from mvest.valve.measure.strain import mean_strains

REACH = 1.959963984540054
"""Standard deviations of a normal distribution to the ends of its 95 % interval."""

IMAGES, SINGLE, DOUBT, MODULI = (
    "errors of the images",
    "errors of single points",
    "size of the errors",
    "prior of the moduli",
)
"""Sources of variance beside the unknowns and the errors of geometry and law."""

STEP = 1e-3
"""Of a standard deviation: finite differences of strains."""


@dataclass(frozen=True, slots=True)
class VarianceShare:
    """Part of the variance of a modulus' logarithm that one source accounts for."""

    source: str
    parameter: str
    share: float


@dataclass(frozen=True, slots=True)
class Narrower:
    """Standard deviation of a modulus' logarithm now, and if something more were measured.

    Attributes
    ----------
    what : str
        What is measured and how well; `EXACTLY` is the end of all measuring.
    parameter : str
    std_now, std_if_known : float
    """

    what: str
    parameter: str
    std_now: float
    std_if_known: float


EXACTLY = "all that can be measured, known exactly"


@dataclass(frozen=True, slots=True)
class Quantity:
    """Something that follows from an estimate, with its 95 % interval.

    Attributes
    ----------
    name, unit : str
    estimate, low, high : float
    generic : float or None
        The same of the generic valve.
    """

    name: str
    unit: str
    estimate: float
    low: float
    high: float
    generic: float | None = None


@dataclass(frozen=True, slots=True)
class DataAlone:
    """A modulus (MPa) as the data alone have it, all other priors as they are, to first order.

    Attributes
    ----------
    parameter : str
    estimate, low, high : float
    prior_stds : float
        From the mean of its prior, in the prior's standard deviations.
    """

    parameter: str
    estimate: float
    low: float
    high: float
    prior_stds: float


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The observation to first order about a closed valve.

    Attributes
    ----------
    names : tuple of str, (p,)
        Of the unknowns.
    prior : (p, p)
        Covariance of the unknowns beforehand, in filter coordinates.
    H : (k, p)
        Derivatives of the observation in these.
    errors : FrameErrors
        Of the fitted frames beside the unknowns.
    learned : LearnedNoise or None
        Size of the errors as it was learned; None: as it is stated.
    """

    names: tuple[str, ...]
    prior: FloatArray
    H: FloatArray
    errors: FrameErrors
    learned: LearnedNoise | None = None

    @classmethod
    def of(cls, filtered: Estimate, errors: FrameErrors) -> LinearModel:
        """About an estimate."""
        prior = to_filter(filtered.transform, filtered.prior).covariance
        return cls(filtered.names, prior, slopes(filtered), errors, filtered.learned)

    @property
    def moduli(self) -> list[int]:
        """Which unknowns are moduli."""
        return [k for k, name in enumerate(self.names) if name.startswith("E_f.")]

    @cached_property
    def columns(self) -> Mapping[str, FloatArray]:
        """Source -> what its modes of unit variance do to the observation ``(k, q)``."""
        errors = self.errors
        sizes = errors.source_sizes(self.learned)
        own = {source.name: sizes[source.name] * source.rows for source in errors.sources}
        return own if errors.samples is None else own | {IMAGES: errors.samples.columns}

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Source of each unknown and mode, ``(p + q,)``; unknowns are their own."""
        modes = [name for name, own in self.columns.items() for _ in range(own.shape[1])]
        return (*self.names, *modes)

    def information(self, beats: float = 1.0) -> FloatArray:
        """What the mean of several beats says of unknowns and modes, ``(p + q, p + q)``."""
        noise = self.errors.single_noise(self.learned, beats=beats)
        A = noise.whiten(np.concatenate([self.H, *self.columns.values()], axis=1))
        return np.asarray(A.T @ A)

    @cached_property
    def _of_one_beat(self) -> FloatArray:
        return self.information()

    @cached_property
    def _sampled(self) -> SampledPosterior | None:
        return self.sampled()

    def covariance(
        self, sizes: Mapping[str, float] | None = None, beats: float = 1.0
    ) -> FloatArray:
        """Covariance ``(p + q, p + q)`` of unknowns and modes after the observation.

        Parameters
        ----------
        sizes : mapping, optional
            Source -> factor on its standard deviation beforehand; 0: known exactly.
        beats : float
            Whose mean is observed.
        """
        J = self._of_one_beat if beats == 1.0 else self.information(beats)
        p = len(self.names)
        scale = np.array([(sizes or {}).get(source, 1.0) for source in self.sources])
        P = np.eye(len(J))
        P[:p, :p] = self.prior
        root = np.linalg.cholesky(P) * scale[:, None]
        inner = np.eye(len(J)) + root.T @ J @ root
        return np.asarray(root @ np.linalg.solve(inner, root.T))

    def sampled(
        self, sizes: Mapping[str, float] | None = None, beats: float = 1.0
    ) -> SampledPosterior | None:
        """The same of the unknowns, with gains that have not seen a sample; None without samples.

        A gain that has seen one avoids its direction, and takes nearly all of it for known.
        """
        samples, sizes = self.errors.samples, sizes or {}
        if samples is None:
            return None
        columns = [sizes.get(k, 1.0) * own for k, own in self.columns.items() if k != IMAGES]
        beside = np.concatenate(columns, axis=1) if columns else None
        base = self.errors.single_noise(self.learned, beats=beats)
        own = replace(
            samples,
            base=base if beside is None else low_rank_noise(base, beside),
            samples=sizes.get(IMAGES, 1.0) * samples.samples,
            beside=beside,
        )
        scale = np.array([sizes.get(name, 1.0) for name in self.names])
        return own.posterior(self.H, self.prior * np.outer(scale, scale))

    def variances(self, sizes: Mapping[str, float] | None = None, beats: float = 1.0) -> FloatArray:
        """Variances ``(p,)`` of the unknowns, what is not known of the errors' size included."""
        found = self.sampled(sizes, beats)
        covariance = self.covariance(sizes, beats) if found is None else found.covariance
        own, learned = np.diag(covariance)[: len(self.names)], self.learned
        # That doubt is of the errors of now; of smaller ones it is as much smaller.
        return own if learned is None else own + np.diag(learned.covariance) / beats

    def variance_of(self, slopes_: FloatArray) -> FloatArray:
        """Variances ``(...)`` of what depends on unknowns and modes by slopes ``(..., p + q)``."""
        p, covariance = len(self.names), self.covariance()
        if self.learned is not None:
            covariance[:p, :p] += self.learned.covariance
        if self._sampled is None:
            return np.einsum("...j,jk,...k->...", slopes_, covariance, slopes_)
        images = np.array(self.sources) == IMAGES
        rest = slopes_[..., ~images]
        variance = np.einsum("...j,jk,...k->...", rest, covariance[~images][:, ~images], rest)
        # A sample moves the estimate by as much as the gain has it, and the valve as it says.
        moved = slopes_[..., :p] @ self._sampled.moved - slopes_[..., images]
        return np.asarray(variance + np.sum(moved**2, axis=-1))

    @cached_property
    def shares(self) -> dict[str, FloatArray]:
        """Source -> the part ``(p,)`` of the unknowns' variances that it accounts for.

        With the gain K of the estimate its error is K (C g + e) less what the priors are off, in
        the form of Joseph (`mvest.estimation.sampled`): one term for each independent part.
        """
        p, J = len(self.names), self._of_one_beat
        own, mixed, modes = J[:p, :p], J[:p, p:], J[p:, p:]
        S = np.linalg.inv(np.eye(len(modes)) + modes)
        precision = np.linalg.inv(self.prior)
        M = np.linalg.inv(precision + own - mixed @ S @ mixed.T)
        by_mode = M @ mixed @ S
        by_prior = M @ precision
        single = own - 2 * mixed @ S @ mixed.T + mixed @ S @ modes @ S @ mixed.T
        parts = {SINGLE: np.diag(M @ single @ M.T)}
        kinds = np.array(self.sources[p:])
        for name in self.columns:
            parts[name] = np.sum(by_mode[:, kinds == name] ** 2, axis=1)
        variances = np.diag(self.prior)
        for k, name in enumerate(self.names):
            source = MODULI if name.startswith("E_f.") else name
            parts[source] = parts.get(source, 0.0) + by_prior[:, k] ** 2 * variances[k]
        if self._sampled is not None:
            parts[IMAGES] = np.diag(self._sampled.from_samples)
        if self.learned is not None:
            parts[DOUBT] = np.diag(self.learned.covariance)
        return parts


def variance_shares(model: LinearModel) -> tuple[VarianceShare, ...]:
    """Where the variance of each modulus comes from; the shares of a modulus add up to 1."""
    total = np.sum(list(model.shares.values()), axis=0)
    return tuple(
        VarianceShare(source, name, float(part[k] / total[k]))
        for source, part in model.shares.items()
        for k, name in enumerate(model.names)
        if k in model.moduli
    )


SOURCES = {
    "open shape": ("open frame seen twice as sharply", 0.5),
    "annulus": ("annulus seen twice as sharply", 0.5),
    "papillary tips": ("papillary tips seen twice as sharply", 0.5),
    "leaflet scale": ("size of the open leaflets measured twice as well", 0.5),
    "insertions": ("ends of the chordae seen twice as sharply", 0.5),
    "rest lengths": ("length of each chord measured to a third of its error now", 1 / 3),
    "thickness": ("thickness of the leaflets measured to a third of its error now", 1 / 3),
    "fibres": ("direction of the fibres measured to a third of its error now", 1 / 3),
    IMAGES: ("all frames seen twice as sharply", 0.5),
}
"""Source of error -> what may be measured of it, and what is then left of its error."""

PRESSURE_MMHG, LENGTHS, STIFFNESS = 3.0, 0.005, 0.05
"""Errors of a catheter's pressure, and relative ones of the chordae's lengths and stiffness, where
they are measured. They are choices: the method's own error is not known for a living valve."""

BEATS = 4


def narrower(problem: CaseProblem, model: LinearModel) -> tuple[Narrower, ...]:
    """What may be measured besides, and what it gains; last what measuring can gain at all.

    Errors of mesh and linearisation, which no measurement takes away, and the law of the tissue
    stay as they are.
    """
    moduli = model.moduli
    measured = dict(_measurable(problem, model))
    exact = {source: 0.0 for sizes in measured.values() for source in sizes}

    def std(sizes: Mapping[str, float] | None = None, beats: float = 1.0) -> FloatArray:
        return np.sqrt(model.variances(sizes, beats))[moduli]

    now = std()
    then = {what: std(sizes) for what, sizes in measured.items()}
    then[f"mean of {BEATS} beats"] = std(beats=BEATS)
    end = np.inf if model.errors.has_floor else BEATS
    if end == np.inf:
        then["mean of any number of beats"] = std(beats=end)
    then[EXACTLY] = std(exact, end)
    return tuple(
        Narrower(what, model.names[k], float(now[j]), float(stds[j]))
        for what, stds in then.items()
        for j, k in enumerate(moduli)
    )


def _measurable(problem: CaseProblem, model: LinearModel) -> Iterator[tuple[str, dict[str, float]]]:
    """What may be measured and how well, in words -> factors on the errors of its sources."""
    stds = {u.name: u.std for u in problem.unknowns}
    pressure = problem.fitted.frames[-1].pressure_mmHg
    # A scale is of the closed frame's pressure, errors of several frames are in mmHg.
    now = {
        name: std * (1.0 if is_frame_pressure(name) else pressure)
        for name, std in stds.items()
        if name == SCALE or is_frame_pressure(name)
    }
    if any(std > PRESSURE_MMHG for std in now.values()):
        factors = {name: min(1.0, PRESSURE_MMHG / std) for name, std in now.items()}
        yield f"pressure measured to ±{PRESSURE_MMHG:g} mmHg", factors
    for name, least, words in (
        ("chord_rest_length", LENGTHS, "lengths of the chordae"),
        ("chord_stiffness", STIFFNESS, "stiffness of the chordae"),
    ):
        if stds.get(name, 0.0) > least:
            yield f"{words} measured to ±{100 * least:g} %", {name: least / stds[name]}
    placed = [name for name in stds if name in REGISTRATION]
    if placed:
        yield "leaflets and annulus placed twice as well", dict.fromkeys(placed, 0.5)
    for source in model.columns:
        if source in SOURCES:
            words, factor = SOURCES[source]
            yield words, {source: factor}


def data_alone(filtered: Estimate) -> tuple[DataAlone, ...]:
    """Each modulus without its own prior, to first order about the estimate.

    Precisions add up: 1 / v = 1 / v₀ + 1 / v_data of the variances of a modulus' logarithm. Empty
    for a modulus of which the data say nothing.
    """
    prior = to_filter(filtered.transform, filtered.prior)
    after = filtered.transformed
    found = []
    for k, name in enumerate(filtered.names):
        left = after.std[k] ** 2 / prior.std[k] ** 2
        if not name.startswith("E_f.") or left >= 1.0:
            continue
        step = (after.mean[k] - prior.mean[k]) / (1.0 - left)
        std = after.std[k] / np.sqrt(1.0 - left)
        middle, reach = prior.mean[k] + step, REACH * std
        estimate, low, high = np.exp([middle, middle - reach, middle + reach]).tolist()
        found.append(DataAlone(name, estimate, low, high, float(step / prior.std[k])))
    return tuple(found)


def derived_quantities(filtered: Estimate) -> tuple[Quantity, ...]:
    """What is known better than the moduli: their ratio, and each for the stated pressure.

    An error of the pressure moves all moduli together, and so does one of the thickness: neither
    changes their ratio. A modulus over the factor on the pressure is what the closed shape tells
    if the stated pressure is right.
    """
    names = filtered.names
    after, prior = filtered.transformed, to_filter(filtered.transform, filtered.prior)
    moduli = [k for k, name in enumerate(names) if name.startswith("E_f.")]

    def quantity(name: str, unit: str, direction: Mapping[int, float]) -> Quantity:
        d = np.zeros(len(after.mean))
        d[list(direction)] = list(direction.values())
        middle, reach = float(d @ after.mean), REACH * float(np.sqrt(d @ after.covariance @ d))
        estimate, low, high = np.exp([middle, middle - reach, middle + reach]).tolist()
        return Quantity(name, unit, estimate, low, high, float(np.exp(d @ prior.mean)))

    regions = {k: names[k].partition(".")[2] for k in moduli}
    found = [
        quantity(
            f"ratio of E_f {regions[moduli[0]]} to {regions[k]}", "", {moduli[0]: 1.0, k: -1.0}
        )
        for k in moduli[1:]
    ]
    if SCALE in names:
        at = names.index(SCALE)
        found += [
            quantity(f"E_f {regions[k]} if the stated pressure is right", "MPa", {k: 1.0, at: -1.0})
            for k in moduli
        ]
    return tuple(found)


def strains(
    problem: CaseProblem, estimate: CaseEstimate, model: LinearModel
) -> tuple[Quantity, ...]:
    """Mean membrane strain (%) of each leaflet from the open to the closed valve.

    It needs no modulus: what is known of it is what is known of the two shapes. Its variance is
    that of the fitted valve under the posterior of unknowns and modes together.
    """
    surface, place = problem.case.surface, estimate.place
    fitted = estimate.result.fitted
    assert fitted is not None
    n = len(surface.vertices)
    frames = place.prediction.y.reshape(-1, n, 3)
    shapes = np.stack([frames[0], fitted[-1]])
    by = _moves(problem, estimate, model)[[0, -1]]

    def of(x: FloatArray) -> FloatArray:
        return mean_strains(x[0], x[1], surface)

    slopes_ = np.stack(
        [(of(shapes + STEP * by[..., j]) - of(shapes - STEP * by[..., j])) / (2.0 * STEP)
         for j in range(by.shape[-1])],
        axis=-1,
    )  # fmt: skip
    values = 100.0 * of(shapes)
    reach = 100.0 * REACH * np.sqrt(model.variance_of(slopes_))
    return tuple(
        Quantity(
            f"strain of the {region} leaflet {way}",
            "%",
            float(values[r, d]),
            float(values[r, d] - reach[r, d]),
            float(values[r, d] + reach[r, d]),
        )
        for r, region in enumerate(surface.region_names)
        for d, way in enumerate(("along its fibres", "across its fibres"))
    )


def _moves(problem: CaseProblem, estimate: CaseEstimate, model: LinearModel) -> FloatArray:
    """What unknowns and modes do to the valve, ``(f, n, 3, p + q)`` mm, the open frame first."""
    place, errors = estimate.place, estimate.errors
    n = len(problem.case.surface.vertices)
    z = problem.transform.forward(place.m)
    jacobian = place.prediction.jacobian * problem.transform.derivative(z)
    parts = [jacobian.reshape(-1, n, 3, len(z))]
    sizes = errors.source_sizes(model.learned)
    parts += [sizes[source.name] * source.moves for source in errors.sources]
    if errors.frame_samples is not None:
        own = errors.frame_samples
        moved = np.stack([own.opened, own.predicted]) / np.sqrt(len(own))
        parts.append(np.moveaxis(moved, 1, -1))
    return np.concatenate(parts, axis=-1)
