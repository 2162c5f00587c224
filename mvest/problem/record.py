"""The record of one estimate: runs write it; tables, MLflow and sweeps read it.

Pydantic converts it (``record.model_dump(mode="json")``, ``EstimateRecord.model_validate(data)``).
Infinite and unknown numbers are None, since JSON has neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict

from mvest.errors import InputError
from mvest.estimation.estimate import InnovationSummary
from mvest.estimation.information.identifiability import TradeOff
from mvest.mechanics.parameters import is_positive
from mvest.problem.estimate import StudyResult
from mvest.problem.registration import REGISTRATION, label_of, unit_of
from mvest.problem.verdict import NONE, Verdict
from mvest.typing import FloatArray

Numbers = tuple[float | None, ...]
Row = Mapping[str, Any]

LEVEL = 0.95
"""Probability of the intervals."""

UNCALIBRATED = "uncalibrated"
"""Name of the alternative with the moduli before their calibration."""


class Frozen(BaseModel):
    """Part of a record: immutable, with no extra fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Spread(Frozen):
    """Mean, standard deviation and maximum of some values."""

    mean: float
    std: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> Spread:
        """Of the finite values; InputError if there is none."""
        known = values[np.isfinite(values)]
        if not known.size:
            raise InputError("a field of distances without a single value")
        return cls(mean=float(known.mean()), std=float(known.std()), max=float(known.max()))

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.std:.2f}"


class Unknown(Frozen):
    """One unknown before and after the estimation, in its unit."""

    name: str  #: for example ``E_f.anterior``
    label: str = ""  #: readable name
    unit: str = ""  #: empty for a factor
    #: A derived modulus follows from an estimated one by a fixed ratio; a quantity is a ratio of
    #: moduli or a strain (%).
    kind: Literal["modulus", "nuisance", "derived", "quantity"] = "modulus"
    treatment: Literal["estimated", "fixed"] = "estimated"
    prior_mean: float | None = None
    prior_std: float | None = None
    estimate: float | None = None
    std: float | None = None
    low: float | None = None  #: end of the 95 % interval
    high: float | None = None  #: end of the 95 % interval
    #: Cramér-Rao standard deviation of the data alone; None if they do not determine it.
    bound: float | None = None
    truth: float | None = None  #: of simulated valves; added after the estimation

    @property
    def region(self) -> str:
        """The leaflet of a modulus: ``anterior`` for ``E_f.anterior``."""
        return self.name.partition(".")[2]

    @property
    def is_modulus(self) -> bool:
        """Whether it is the estimated modulus of a leaflet."""
        return self.kind == "modulus"

    @property
    def is_positive(self) -> bool:
        """Whether its logarithm is estimated."""
        if self.kind == "quantity":
            return self.unit != "%"
        return self.name not in REGISTRATION and is_positive(self.name)

    @property
    def relative_error(self) -> float | None:
        """(estimate - truth) / truth."""
        if self.estimate is None or not self.truth:
            return None
        return (self.estimate - self.truth) / self.truth

    @property
    def inside(self) -> bool | None:
        """Whether the interval contains the truth; None if one of them is unknown."""
        if self.low is None or self.high is None or self.truth is None:
            return None
        return self.low <= self.truth <= self.high


class FrameFit(Frozen):
    """Distances (mm) of the models from an observed frame and, if simulated, from the true one."""

    frame: str
    seen: bool  #: whether the filter received this frame
    generic: Spread  #: models as in `mvest.personalisation.result.FrameComparison`
    registered: Spread
    personalised: Spread
    generic_to_truth: Spread | None = None
    registered_to_truth: Spread | None = None
    personalised_to_truth: Spread | None = None


class EstimateRecord(Frozen):
    """One estimate, or the reason for its absence."""

    case: str = ""  #: name of the case; empty for a synthetic study
    seed: int | None = None  #: of the observation errors
    simulated: bool | None = None  #: whether the observation is stated as simulated
    status: Literal["converged", "failed"]
    reason: str  #: why the estimation ended
    detail: str = ""  #: why the estimation ended
    verdict: Verdict | None = None  #: None if nothing was judged
    unknowns: tuple[Unknown, ...] = ()
    #: (p, p), posterior correlation of the unknowns in filter coordinates; may be empty.
    correlation: tuple[Numbers, ...] = ()
    #: From the fitted vertices of the last observed frame to the observed and the true ones.
    distance_mm: Spread | None = None
    distance_to_truth_mm: Spread | None = None
    frames: tuple[FrameFit, ...] = ()
    innovation: InnovationSummary | None = None
    condition_number: float | None = None  #: of the information of the data alone
    flat: tuple[str, ...] = ()  #: combinations of unknowns that the data hardly determine
    confounded: tuple[TradeOff, ...] = ()  #: parameters that the data hardly distinguish
    iterations: int | None = None
    forward_solves: int | None = None
    iterates: tuple[Numbers, ...] = ()  #: (i, p)
    iterate_std: tuple[Numbers, ...] = ()  #: (i, p)
    objective: Numbers = ()  #: (i,)
    seconds: float | None = None  #: wall-clock time of the estimation
    #: Name -> another estimate from the same data: ``moduli_only`` with all nuisances fixed,
    #: ``paper`` by the paper's method, `UNCALIBRATED`.
    alternatives: Mapping[str, EstimateRecord] = {}
    #: Name -> rows of plain data for reports (see `mvest.personalisation.record`).
    details: Mapping[str, tuple[Row, ...]] = {}

    @property
    def converged(self) -> bool:
        """Whether there is an estimate."""
        return self.status == "converged"

    @property
    def is_stated(self) -> bool:
        """Whether its numbers may be stated: it converged and the verdict is not ``none``."""
        return self.converged and (self.verdict is None or self.verdict.trust != NONE)

    @property
    def moduli(self) -> tuple[Unknown, ...]:
        """The estimated moduli."""
        return tuple(unknown for unknown in self.unknowns if unknown.is_modulus)

    @property
    def parameters(self) -> tuple[Unknown, ...]:
        """The unknowns of the filter, without derived moduli."""
        return tuple(unknown for unknown in self.unknowns if unknown.kind != "derived")

    def unknown(self, name: str) -> Unknown:
        """The unknown of that name; KeyError if there is none."""
        return {unknown.name: unknown for unknown in self.unknowns}[name]

    def detail_rows(self, name: str) -> tuple[Row, ...]:
        """The rows of a detail; empty if it was not computed."""
        return self.details.get(name, ())

    def without_details(self, *kept: str) -> EstimateRecord:
        """A copy without iterates, correlations, trade-offs and details, except those ``kept``."""
        nothing: dict[str, Any] = dict.fromkeys(
            ("correlation", "iterates", "iterate_std", "objective", "flat", "confounded"), ()
        )
        details = {name: rows for name, rows in self.details.items() if name in kept}
        others = {name: other.without_details() for name, other in self.alternatives.items()}
        return self.model_copy(update={**nothing, "details": details, "alternatives": others})

    def with_truth(self, truth: Mapping[str, float]) -> EstimateRecord:
        """A copy with true values by name, also for derived moduli and the alternatives.

        Unknowns without an entry stay as they are.
        """
        known = dict(truth)
        for unknown in self.unknowns:
            own = f"E_f.{unknown.region}"
            if unknown.kind == "derived" and own in truth and unknown.estimate is not None:
                fibre = self.unknown(own).estimate
                if fibre:
                    known[unknown.name] = unknown.estimate / fibre * truth[own]
        unknowns = tuple(
            one.model_copy(update={"truth": known.get(one.name, one.truth)})
            for one in self.unknowns
        )
        others = {name: other.with_truth(truth) for name, other in self.alternatives.items()}
        return self.model_copy(update={"unknowns": unknowns, "alternatives": others})

    def rows(self) -> list[dict[str, Any]]:
        """A tidy table: one row for each unknown, with the columns of the whole estimate."""

        def columns(name: str, part: Spread | None) -> dict[str, float]:
            return {f"{name}_{k}": v for k, v in part or ()}

        whole = {
            **{k: getattr(self, k) for k in ("case", "seed", "simulated", "status", "reason")},
            "verdict": None if self.verdict is None else self.verdict.trust,
            **columns("distance", self.distance_mm),
            **columns("distance_to_truth", self.distance_to_truth_mm),
            "nis": None if self.innovation is None else self.innovation.nis,
            **{k: getattr(self, k) for k in ("iterations", "forward_solves", "seconds")},
        }
        rows = [
            {
                **whole,
                "parameter": unknown.name,
                **unknown.model_dump(exclude={"name", "label"}),
                "relative_error": unknown.relative_error,
                "inside": unknown.inside,
            }
            for unknown in self.unknowns
        ]
        return rows or [whole]


def record_of(
    result: StudyResult, *, seed: int | None = None, case: str = "", simulated: bool | None = None
) -> EstimateRecord:
    """The record of a result, or of the reason for its failure.

    Its truth is recorded if the result has one (`StudyResult.against`). ``seed``, ``case`` and
    ``simulated`` are as in `EstimateRecord`.
    """
    filtered, known = result.filtered, result.identifiability
    about: dict[str, Any] = {}
    if filtered is not None:
        about |= {
            "innovation": filtered.innovation,
            "iterations": filtered.iterations,
            "forward_solves": filtered.forward_solves,
            "iterates": tuple(map(_numbers, filtered.iterates)),
            "iterate_std": tuple(map(_numbers, filtered.iterate_std)),
            "objective": _numbers(filtered.objective),
        }
    if known is not None:
        about |= {
            "condition_number": finite(known.condition_number),
            "flat": tuple(known.flat()),
            "confounded": known.confounded(),
        }
    for name in ("distance", "distance_to_truth"):
        values = getattr(result, name)
        if values is not None and np.isfinite(values).any():
            about[f"{name}_mm"] = Spread.of(values)
    return EstimateRecord(
        case=case,
        seed=seed,
        simulated=simulated,
        status="converged" if result.converged else "failed",
        reason=result.reason,
        detail=result.detail,
        unknowns=_unknowns(result),
        seconds=result.seconds,
        **about,
    )


def finite(value: float) -> float | None:
    """None for a number that is infinite or not known."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Numbers:
    return tuple(map(finite, np.asarray(values, dtype=np.float64).tolist()))


def _unknowns(result: StudyResult) -> tuple[Unknown, ...]:
    """The parameters of a result and the derived moduli."""
    filtered = result.filtered
    columns: dict[str, FloatArray | None] = {"estimate": result.estimate, "std": result.std}
    if filtered is not None:
        columns |= {"prior_mean": filtered.prior.mean, "prior_std": filtered.prior.std}
        if result.estimate is not None:
            columns |= zip(("low", "high"), filtered.interval(LEVEL), strict=True)
    columns["bound"] = None if result.identifiability is None else result.identifiability.std
    columns["truth"] = None if result.truth is None else result.truth.values
    known = {key: values for key, values in columns.items() if values is not None}
    own: list[Unknown] = []
    derived: list[Unknown] = []
    for k, name in enumerate(result.parameters):
        numbers: dict[str, Any] = {key: finite(values[k]) for key, values in known.items()}
        kind: Any = "modulus" if name.startswith("E_f.") else "nuisance"
        one = Unknown(name=name, label=label_of(name), unit=unit_of(name), kind=kind, **numbers)
        own.append(one)
        if not (one.is_modulus and one.region in result.tissue and one.estimate):
            continue
        unit = result.tissue[one.region].material(1.0)
        for other, share in (("E_perp", unit.E_p), ("G", unit.G)):
            scaled: dict[str, Any] = {
                key: None if (value := numbers.get(key)) is None else share * value
                for key in ("estimate", "std", "low", "high", "truth")
            }
            name, label = f"{other}.{one.region}", f"{other} {one.region}"
            derived.append(Unknown(name=name, label=label, unit=one.unit, kind="derived", **scaled))
    return (*own, *derived)
