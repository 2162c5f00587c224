"""Joins data, model and filter: takes a problem and an observation, returns an estimate.

The truth of a synthetic study stays separate. ``estimate`` never sees it; only a finished
``StudyResult`` is compared with it (``StudyResult.against``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtri

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate, OnIterate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.information.identifiability import Identifiability, identifiability
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.run import Filter
from mvest.estimation.transform import Transform
from mvest.mechanics.settings import TissueSettings
from mvest.problem.registration import unit_of
from mvest.problem.synthetic import Truth
from mvest.typing import FloatArray


class Observed(Protocol):
    """What an estimation needs of an observation of any kind."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames, the closed one last."""

    @property
    def y(self) -> FloatArray:
        """The observation ``(k,)``."""

    @property
    def R(self) -> NoiseCovariance:
        """Covariance of ``y``."""

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """Turn a model of all stacked frames into a model of this observation.

        The ``aux`` of its predictions are the observed frames ``(f, n, 3)`` mm, all vertices.
        """

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) between the last observed frame and fitted frames ``(f, n, 3)``."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything an estimation needs except the observation."""

    parameters: tuple[str, ...]  #: (p,), names of the unknowns, for example ``E_f.anterior``
    model: ObservationModel  #: predicts all frames, stacked
    prior: Gaussian  #: of the parameters themselves, in their units
    filter: Filter
    transform: Transform
    tissue: Mapping[str, TissueSettings]  #: region -> fixed ratios that give its other moduli

    def __post_init__(self) -> None:
        if self.prior.size != len(self.parameters):
            raise InputError(
                f"the prior has {self.prior.size} parameters, the problem names "
                f"{len(self.parameters)}: {', '.join(self.parameters)}"
            )

    @property
    def start(self) -> FloatArray:
        """Starting point ``(p,)`` of the filters: the prior's mean up to rounding."""
        return self.transform.inverse(self.transform.forward(self.prior.mean))


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """An estimate from an observation, or the reason for its absence."""

    parameters: tuple[str, ...]  #: (p,)
    tissue: Mapping[str, TissueSettings]  #: region -> fixed ratios; empty for models without tissue
    observation: Observed | None  #: None if it could not be simulated
    filtered: Estimate | None  #: what the filter returned; None if it never ran
    #: Cramér-Rao bound and flat directions of the data alone, at the estimate.
    identifiability: Identifiability | None
    reason: str
    detail: str
    converged: bool
    seconds: float  #: wall-clock time of the estimation
    #: (f, n, 3) mm, observed frames as predicted at the estimate, with unobserved vertices.
    fitted: FloatArray | None = None
    truth: Truth | None = None  #: added by ``against``, after the estimation

    def __str__(self) -> str:
        if self.filtered is None or self.estimate is None:
            return f"no estimate: {self.reason}" + (f" ({self.detail})" if self.detail else "")
        lines = [f"{self.filtered.summary(list(map(unit_of, self.parameters)))}, "
                 f"{self.seconds:.1f} s"]  # fmt: skip
        if self.distance is not None:
            lines.append(f"fitted to observed: {np.nanmean(self.distance):.2f} mm on average")
        if self.truth is not None:
            true = zip(self.parameters, self.truth.values, strict=True)
            lines.append("truth: " + ", ".join(f"{name} {v:.4g}" for name, v in true))
        return "\n".join(lines)

    @classmethod
    def failed(cls, problem: Problem, reason: str) -> StudyResult:
        """The result of a study without an observation."""
        return cls(problem.parameters, problem.tissue, None, None, None, reason, "", False, 0.0)

    def against(self, truth: Truth | None) -> StudyResult:
        """The same result with the truth for comparison."""
        if truth is not None and truth.parameters != self.parameters:
            raise InputError(f"the truth is of {truth.parameters}, not of {self.parameters}")
        return replace(self, truth=truth)

    @property
    def estimate(self) -> FloatArray | None:
        """Estimated parameters ``(p,)``; None if the model made no prediction there."""
        if self.filtered is None or self.filtered.prediction is None:
            return None
        return self.filtered.mean

    @property
    def std(self) -> FloatArray | None:
        """Standard deviations ``(p,)`` of the estimate according to the filter."""
        return None if self.filtered is None or self.estimate is None else self.filtered.std

    @property
    def residual(self) -> FloatArray | None:
        """Observed minus predicted ``(k,)`` at the estimate; None if there is none."""
        if self.filtered is None or self.filtered.prediction is None or self.observation is None:
            return None
        return self.observation.y - self.filtered.prediction.y

    @property
    def distance(self) -> FloatArray | None:
        """Distance (mm) from fitted to observed in the last observed frame.

        Of each vertex ``(n,)``, NaN if unobserved; without correspondence of each point ``(q,)``.
        """
        if self.fitted is None or self.observation is None:
            return None
        return self.observation.distance(self.fitted)

    @property
    def distance_to_truth(self) -> FloatArray | None:
        """Distance (mm) of every vertex ``(n,)`` from its position without observation error."""
        if self.fitted is None or self.truth is None:
            return None
        return np.linalg.norm(self.fitted[-1] - self.truth.positions[-1], axis=1)


def expected_intervals(
    names: Sequence[str],
    transform: Transform,
    generic: FloatArray,
    before: FloatArray,
    after: FloatArray,
) -> list[dict[str, Any]]:
    """The 95 % interval of each unknown around its generic value, before and after an estimation.

    Returns a list of dicts: ``name``, ``unit``, ``generic``, ``low_before``, ``high_before``,
    ``low``, ``high``, and ``width``: ``after / before``.

    Parameters
    ----------
    names : sequence of str, (p,)
    generic : (p,)
    before, after : (p,)
        Standard deviations in filter coordinates.
    """
    z, reach = transform.forward(generic), float(ndtri(0.975))
    columns = {"name": list(names), "unit": list(map(unit_of, names)), "generic": generic.tolist()}
    for when, std in (("_before", before), ("", after)):
        for end, sign in (("low", -1.0), ("high", 1.0)):
            columns[end + when] = transform.inverse(z + sign * reach * std).tolist()
    columns["width"] = np.divide(after, before, out=np.ones_like(after), where=before > 0).tolist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def estimate(
    problem: Problem, observation: Observed, *, on_iterate: OnIterate | None = None
) -> StudyResult:
    """Estimate the parameters of a problem from an observation.

    A numerical failure is a result with its reason; only inadmissible input raises.
    """
    started = time.perf_counter()
    filtered = problem.filter(
        observation.of(problem.model),
        problem.prior,
        observation.y,
        observation.R,
        names=problem.parameters,
        transform=problem.transform,
        on_iterate=on_iterate,
    )
    bound = fitted = None
    if filtered.prediction is not None:
        aux = filtered.prediction.aux
        fitted = aux if isinstance(aux, np.ndarray) else None
        # Parameters near zero are scaled by their prior.
        bound = identifiability(
            filtered.prediction.jacobian,
            observation.R if filtered.learned is None else filtered.learned.noise,
            np.maximum(np.abs(filtered.mean), problem.prior.std),
            names=problem.parameters,
        )
    return StudyResult(
        problem.parameters,
        problem.tissue,
        observation,
        filtered,
        bound,
        reason=filtered.why,
        detail=filtered.detail,
        converged=filtered.converged,
        seconds=time.perf_counter() - started,
        fitted=fitted,
    )
