"""What the accuracy of an estimate is due to, and what would make it better, to first order."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from mvest.closure.frames import is_frame_pressure
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.personalisation.error_budget import BudgetRow, budget_rows, sample_parts
from mvest.personalisation.estimation import CaseEstimation
from mvest.problem.estimate import StudyResult
from mvest.problem.registration import REGISTRATION
from mvest.typing import FloatArray

BETTER = 5.0
"""How many times as well as beforehand a nuisance may be measured."""


def image_share(estimation: CaseEstimation, result: StudyResult) -> FloatArray | None:
    """Share of the variance of each modulus' logarithm that errors of the image account for."""
    filtered = result.filtered
    if estimation.errors.samples is None or filtered is None or filtered.prediction is None:
        return None
    posterior = estimation.sampled_posterior(filtered)
    share = np.diag(posterior.from_samples) / np.diag(posterior.covariance)
    return share[[u.is_modulus for u in estimation.unknowns]]


def error_budget(estimation: CaseEstimation, result: StudyResult) -> tuple[BudgetRow, ...]:
    """What each part of what is not known costs the moduli; of error samples alone."""
    filtered, errors = result.filtered, estimation.errors
    if errors.samples is None or filtered is None or filtered.prediction is None:
        return ()
    m = filtered.mean
    predicted = estimation.shared(m)
    if not predicted.converged:
        return ()
    parts, motion = sample_parts(estimation.case)
    # One factorisation for all of them.
    vertices, tips = (np.concatenate(each) for each in zip(*parts.values(), motion, strict=True))
    sampled = errors.sampled(m, predicted.y, vertices, tips)
    if isinstance(sampled, str):
        return ()
    *each, differ = np.split(sampled[1], len(parts) + 1, axis=1)
    z = filtered.transformed_iterates[-1]
    return budget_rows(
        filtered.names,
        filtered.prediction.jacobian * filtered.transform.derivative(z),
        to_filter(filtered.transform, filtered.prior).covariance,
        errors.noise(filtered.learned, without=errors.kinds),
        dict(zip(parts, each, strict=True)),
        differ,
        errors.samples.source,
        {own.name: own.columns for own in errors.considered},
    )


def narrower(estimation: CaseEstimation, result: StudyResult) -> Mapping[str, FloatArray]:
    """Standard deviations of the moduli's logarithms if something more were measured.

    From the linear model at the estimate, all unknowns estimated. Whatever else is measured is
    then known ``BETTER`` times as well as beforehand.
    """
    filtered = result.filtered
    assert filtered is not None
    assert filtered.prediction is not None
    moduli = [k for k, u in enumerate(estimation.unknowns) if u.is_modulus]
    prior = to_filter(estimation.transform, estimation.prior)
    z = filtered.transformed_iterates[-1]
    H = filtered.prediction.jacobian * estimation.transform.derivative(z)
    errors, learned = estimation.errors.samples, filtered.learned
    doubt = np.zeros_like(prior.covariance) if learned is None else learned.covariance
    groups = _measurable(estimation)

    def widened(covariance: FloatArray, scale: float) -> FloatArray:
        own, more = np.diag(covariance), np.diag(doubt) / scale**2
        # The doubt of now: of less it may take more away than there is.
        return np.sqrt(np.where(own + more > 0.0, own + more, own))[moduli]

    def linear(P: FloatArray, scale: float = 1.0, without: Collection[str] = ()) -> FloatArray:
        # What is considered stays what it is where the frame is seen better.
        plain = estimation.errors.noise(learned, considered=scale, without=without, stated=True)
        update = kalman_update(Gaussian(z, P), np.zeros(len(H)), H * scale, plain)
        return widened(update.posterior.covariance, scale)

    def std(P: FloatArray, scale: float = 1.0) -> FloatArray:
        if errors is None:
            return linear(P, scale)
        own = estimation.errors.weighing(errors, learned, considered=scale)
        return widened(own.posterior(H * scale, P).covariance, scale)

    stds = {"now": std(prior.covariance)}
    for words, members in groups.items():
        known = np.isin(estimation.names, members)
        if known.any():
            share = np.where(known, 1 / BETTER, 1.0)
            stds[words] = std(prior.covariance * np.outer(share, share))
    stds["4 beats averaged"] = std(prior.covariance, 2.0)
    stds["any number of beats averaged"] = std(prior.covariance, 1e3)
    if errors is not None:
        stds["geometry known exactly"] = linear(prior.covariance, without=estimation.errors.kinds)
        return stds
    for kind in estimation.errors.kinds:
        stds[f"{kind} known exactly"] = linear(prior.covariance, without=(kind,))
    return stds


def _measurable(estimation: CaseEstimation) -> dict[str, tuple[str, ...]]:
    """What else could be measured and how well, in words -> the nuisances that it tells of."""
    std = {u.name: u.std / BETTER for u in estimation.unknowns}
    words: dict[str, tuple[str, ...]] = {}
    # A scale is of the closed frame's pressure, errors of several frames are in mmHg.
    errors = {
        name: error * (1.0 if is_frame_pressure(name) else estimation.closed.pressure_mmHg)
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
    others = tuple(n for n in estimation.names if not n.startswith("E_f."))
    return {**words, f"all of these measured {BETTER:g} times as well": others}
