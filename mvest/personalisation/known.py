"""What an estimate of a case determines, where its variance comes from, and what would reduce it.

All of it follows from one linear model about the estimate, H z + C g + e, with unknowns z, modes g
of all other errors, and errors e of single observations. z and g have independent priors, so only
small matrices are needed. Results are plain rows, as in `mvest.personalisation.record`.
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
from mvest.estimation.update import kalman_update
from mvest.personalisation.errors import FrameErrors
from mvest.personalisation.estimation import CaseEstimate, CaseProblem, slopes
from mvest.personalisation.geometry import displacement
from mvest.personalisation.sources import LAW
from mvest.problem.record import Row
from mvest.problem.registration import REGISTRATION, label_of
from mvest.typing import FloatArray
from mvest.valve.measure.strain import mean_strains

REACH = 1.959963984540054
"""Standard deviations from the mean of a normal distribution to the ends of its 95 % interval."""

IMAGES, SINGLE = "errors of the images", "errors of single points"
SIZE, MODULI = "size of the errors", "prior of the moduli"
"""Sources of variance besides the unknowns and the errors of geometry and law."""

STEP = 1e-3
"""Finite difference step of strains, in standard deviations."""

UNITS = {
    **dict.fromkeys(("shape", "annulus", "tips", "insertions"), ("mm", 1.0)),
    **dict.fromkeys(("rest_lengths", "thickness"), ("%", 100.0)),
    "fibres": ("degrees", 180.0 / np.pi),
}
"""Part of a geometry -> unit of its errors, and its conversion factor."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The observation to first order about a closed valve."""

    names: tuple[str, ...]  #: (p,), of the unknowns
    prior: FloatArray  #: (p, p), covariance of the unknowns, in filter coordinates
    H: FloatArray  #: (k, p), derivatives of the observation in these
    errors: FrameErrors
    learned: LearnedNoise | None = None  #: None: errors as stated

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
        """Source -> effect ``(k, q)`` of its modes of unit variance on the observation."""
        errors = self.errors
        sizes = errors.source_sizes(self.learned)
        own = {source.name: sizes[source.name] * source.rows for source in errors.sources}
        return own if errors.samples is None else own | {IMAGES: errors.samples.columns}

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Source of each unknown (itself) and of each mode, ``(p + q,)``."""
        modes = [name for name, own in self.columns.items() for _ in range(own.shape[1])]
        return (*self.names, *modes)

    def information(self, beats: float = 1.0) -> FloatArray:
        """Information ``(p + q, p + q)`` of averaged beats about unknowns and modes."""
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
        """Posterior covariance ``(p + q, p + q)`` of unknowns and modes.

        Parameters
        ----------
        sizes : mapping, optional
            Source -> factor on its prior standard deviation; 0: known exactly.
        beats : float
            Number of averaged beats.
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
        """The same of the unknowns from error samples, with leave-one-out gains; None without.

        A gain that includes a sample avoids its direction, and treats nearly all of it as known.
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
        """Variances ``(p,)`` of the unknowns, including the uncertain size of the errors."""
        found = self.sampled(sizes, beats)
        covariance = self.covariance(sizes, beats) if found is None else found.covariance
        own, learned = np.diag(covariance)[: len(self.names)], self.learned
        # The uncertainty of the errors' size falls with the errors.
        return own if learned is None else own + np.diag(learned.covariance) / beats

    def variance_of(self, slopes_: FloatArray) -> FloatArray:
        """Variances ``(...)`` of functions of unknowns and modes with slopes ``(..., p + q)``."""
        p, covariance = len(self.names), self.covariance()
        if self.learned is not None:
            covariance[:p, :p] += self.learned.covariance
        if self._sampled is None:
            return np.einsum("...j,jk,...k->...", slopes_, covariance, slopes_)
        images = np.array(self.sources) == IMAGES
        rest = slopes_[..., ~images]
        # With unit priors, the covariance with the samples is minus their effect on the estimate.
        effect = -covariance[~images][:, images]
        others = covariance[~images][:, ~images] - effect @ effect.T
        # A sample moves the valve directly, and the estimate through the gain.
        effect[:p] = self._sampled.moved
        moved = rest @ effect - slopes_[..., images]
        return np.einsum("...j,jk,...k->...", rest, others, rest) + np.sum(moved**2, axis=-1)

    @cached_property
    def parts(self) -> dict[str, FloatArray]:
        """Source -> its part ``(p,)`` of the unknowns' variances.

        With the gain K the error of the estimate is K (C g + e) minus the error of the prior mean,
        in Joseph's form (`mvest.estimation.sampled`): one term for each independent part.
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
            parts[SIZE] = np.diag(self.learned.covariance)
        return parts


def known_of(problem: CaseProblem, estimate: CaseEstimate) -> dict[str, tuple[Row, ...]]:
    """Details of an estimate to first order: derived quantities, sources of variance, advice."""
    filtered = estimate.result.filtered
    assert filtered is not None
    model = LinearModel.of(filtered, estimate.point.errors)
    return {
        "geometry": tuple(geometry_shifts(problem, estimate)),
        "known": (*derived_quantities(filtered), *strains(problem, estimate, model)),
        "data_alone": tuple(data_alone(filtered)),
        "narrower": tuple(narrower(problem, model)),
        "shares": tuple(variance_shares(model)),
    }


def variance_shares(model: LinearModel) -> Iterator[Row]:
    """Sources of the variance of each modulus' logarithm; the shares of a modulus add up to 1."""
    total = np.sum(list(model.parts.values()), axis=0)
    for source, part in model.parts.items():
        for k in model.moduli:
            share = float(part[k] / total[k])
            yield {"source": label_of(source), "parameter": model.names[k], "share": share}


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
"""Source of error -> a possible measurement, and the share of the error that it leaves."""

PRESSURE_MMHG, LENGTHS, STIFFNESS = 3.0, 0.005, 0.05
"""Errors of a catheter's pressure, and relative errors of measured lengths and stiffness of the
chordae. They are choices: no method's error is known in a living valve."""

BEATS = 4
EXACTLY = "all that can be measured, known exactly"


def narrower(problem: CaseProblem, model: LinearModel) -> Iterator[Row]:
    """Possible measurements and the standard deviation of each modulus' logarithm with them.

    The last is the limit of all measuring (`EXACTLY`). Errors of mesh and linearisation and the law
    of the tissue stay, since no measurement removes them.
    """
    measured = dict(_measurable(problem, model))
    exact = {source: 0.0 for sizes in measured.values() for source in sizes}

    def std(sizes: Mapping[str, float] | None = None, beats: float = 1.0) -> FloatArray:
        return np.sqrt(model.variances(sizes, beats))

    now, then = std(), {what: std(sizes) for what, sizes in measured.items()}
    then[f"mean of {BEATS} beats"] = std(beats=BEATS)
    family = model.errors.family
    has_floor = family is not None and family.resolution > 0.0
    if has_floor:  # errors that no averaging removes
        then["mean of any number of beats"] = std(beats=np.inf)
    then[EXACTLY] = std(exact, np.inf if has_floor else BEATS)
    for what, stds in then.items():
        for k in model.moduli:
            name = model.names[k]
            row = {"what": f"{label_of(name)}, {what}", "parameter": name}
            yield {**row, "std_now": float(now[k]), "std_if_known": float(stds[k])}


def _measurable(problem: CaseProblem, model: LinearModel) -> Iterator[tuple[str, dict[str, float]]]:
    """Possible measurements -> factors on the errors of their sources."""
    stds = {u.name: u.std for u in problem.unknowns}
    pressure = problem.fitted.frames[-1].pressure_mmHg
    # A scale is relative to the closed frame's pressure, errors of several frames are in mmHg.
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


def data_alone(filtered: Estimate) -> Iterator[Row]:
    """Each modulus without its own prior, to first order about the estimate.

    Precisions add: 1 / v = 1 / v₀ + 1 / v_data for the variances of a modulus' logarithm. Moduli
    that the data do not determine are left out. ``prior_stds`` is the distance from the prior's
    mean in the prior's standard deviations.
    """
    prior, after = to_filter(filtered.transform, filtered.prior), filtered.transformed
    for k, name in enumerate(filtered.names):
        left = after.std[k] ** 2 / prior.std[k] ** 2
        if not name.startswith("E_f.") or left >= 1.0:
            continue
        step = (after.mean[k] - prior.mean[k]) / (1.0 - left)
        std = after.std[k] / np.sqrt(1.0 - left)
        interval = _interval(prior.mean[k] + step, REACH * std)
        yield {"parameter": name, **interval, "prior_stds": float(step / prior.std[k])}


def _interval(log: float, reach: float) -> dict[str, float]:
    values = np.exp([log, log - reach, log + reach]).tolist()
    return dict(zip(("estimate", "low", "high"), values, strict=True))


def derived_quantities(filtered: Estimate) -> Iterator[Row]:
    """Quantities known better than the moduli: their ratio, and each at the stated pressure.

    Errors of pressure and thickness move all moduli together and leave their ratio. A modulus over
    the factor on the pressure follows from the closed shape if the stated pressure is right.
    """
    names = filtered.names
    after, prior = filtered.transformed, to_filter(filtered.transform, filtered.prior)

    def quantity(name: str, unit: str, direction: Mapping[int, float]) -> Row:
        d = np.zeros(len(after.mean))
        d[list(direction)] = list(direction.values())
        reach = REACH * float(np.sqrt(d @ after.covariance @ d))
        generic = float(np.exp(d @ prior.mean))
        interval = _interval(float(d @ after.mean), reach)
        return {"name": name, "unit": unit, **interval, "generic": generic}

    regions = {k: name[4:] for k, name in enumerate(names) if name.startswith("E_f.")}
    first = min(regions)
    for k, region in regions.items():
        if k != first:
            name = f"ratio of E_f {regions[first]} to {region}"
            yield quantity(name, "", {first: 1.0, k: -1.0})
    if SCALE in names:
        at = names.index(SCALE)
        for k, region in regions.items():
            name = f"E_f {region} if the stated pressure is right"
            yield quantity(name, "MPa", {k: 1.0, at: -1.0})


def strains(problem: CaseProblem, estimate: CaseEstimate, model: LinearModel) -> Iterator[Row]:
    """Mean membrane strain (%) of each leaflet from the open to the closed valve.

    It depends on the two shapes alone. Its variance is that of the fitted valve under the joint
    posterior of unknowns and modes.
    """
    surface, point, errors = problem.case.surface, estimate.point, estimate.point.errors
    fitted = estimate.result.fitted
    assert fitted is not None
    n = len(surface.vertices)
    frames = point.prediction.y.reshape(-1, n, 3)
    shapes = np.stack([frames[0], fitted[-1]])
    # Effect (f, n, 3, p + q) mm of unknowns and modes on the valve, the open frame first.
    z = problem.transform.forward(point.m)
    jacobian = point.prediction.jacobian * problem.transform.derivative(z)
    sizes = errors.source_sizes(model.learned)
    moves = [jacobian.reshape(-1, n, 3, len(z))]
    moves += [sizes[source.name] * source.moves for source in errors.sources]
    if (own := errors.frame_samples) is not None:
        moved = np.stack([own.opened, own.predicted]) / np.sqrt(len(own))
        moves.append(np.moveaxis(moved, 1, -1))
    by = np.concatenate(moves, axis=-1)[[0, -1]]

    def of(x: FloatArray) -> FloatArray:
        return mean_strains(x[0], x[1], surface)

    slopes_ = np.stack(
        [(of(shapes + STEP * by[..., j]) - of(shapes - STEP * by[..., j])) / (2.0 * STEP)
         for j in range(by.shape[-1])],
        axis=-1,
    )  # fmt: skip
    values = 100.0 * of(shapes)
    reach = 100.0 * REACH * np.sqrt(model.variance_of(slopes_))
    for r, region in enumerate(surface.region_names):
        for d, way in enumerate(("along its fibres", "across its fibres")):
            mean, half = float(values[r, d]), float(reach[r, d])
            about = {"name": f"strain of the {region} leaflet {way}", "unit": "%"}
            ends = {"estimate": mean, "low": mean - half, "high": mean + half}
            yield {**about, **ends, "generic": None}


def geometry_shifts(problem: CaseProblem, estimate: CaseEstimate) -> Iterator[Row]:
    """Posterior mean of each kind of geometry error, to first order about the estimate.

    ``size`` is the root mean square over points (distances), chords or leaflets; ``stretch`` is the
    largest amplitude of a mode in standard deviations, as learned. Nothing if the geometry is
    known, or described by error samples.
    """
    errors, result = estimate.point.errors, estimate.result
    residual, filtered = result.residual, result.filtered
    if residual is None or filtered is None or errors.samples is not None:
        return
    expected = expected_modes(errors, filtered.learned, residual)
    scales = errors.geometry_sizes(filtered.learned)
    for source, modes, scale in zip(errors.geometry, expected, scales, strict=True):
        assert source.modes is not None
        # Later parts follow from the first, as rest lengths follow from the tips.
        part = next(iter(source.modes.parts))
        moved = displacement((source.modes,), (modes,))[part]
        unit, factor = UNITS[part]
        square = np.sum(moved**2, axis=-1) if moved.ndim > 1 else moved**2
        size = factor * float(np.sqrt(np.mean(square)))
        stretch = float(np.max(np.abs(modes)) / scale)
        yield {"name": source.name, "unit": unit, "size": size, "stretch": stretch}


def expected_modes(
    errors: FrameErrors, learned: LearnedNoise | None, residual: FloatArray
) -> tuple[FloatArray, ...]:
    """Most probable amplitudes ``(q,)`` of the geometry's modes by kind, for known parameters.

    For the residual ``(k,)`` there, with s the learned size of a kind: ``s² Cᵀ S⁻¹ r`` with the
    covariance S of all errors.
    """
    noise = errors.noise(learned)
    white, sizes = noise.whiten(residual), errors.geometry_sizes(learned)
    return tuple(
        s**2 * (noise.whiten(own.rows).T @ white)
        for s, own in zip(sizes, errors.geometry, strict=True)
    )


def law_share(estimate: CaseEstimate) -> float | None:
    """Most probable position of the tissue between the linear law (0) and the other (1).

    To first order about the estimate, with its errors and priors. None without another law or
    without an estimate.
    """
    errors, result = estimate.point.errors, estimate.result
    filtered, residual = result.filtered, result.residual
    rows = [source.rows for source in errors.sources if source.name == LAW]
    if not rows or filtered is None or residual is None:
        return None
    way = rows[0].sum(axis=1)
    noise = errors.noise(filtered.learned, without=(LAW,))
    if errors.samples is not None:
        noise = low_rank_noise(noise, errors.samples.columns)
    prior, z = to_filter(filtered.transform, filtered.prior), filtered.transformed.mean
    H = slopes(filtered)
    innovation = residual + H @ (z - prior.mean)

    def misfit(e: FloatArray) -> float:
        return kalman_update(prior, e, H, noise).nis

    whole = misfit(way)
    # A parabola through its values with either law.
    return 0.5 + 0.5 * (misfit(innovation) - misfit(innovation - way)) / whole if whole else None
