"""The record of one estimate: a run writes it, tables read it, MLflow logs it, sweeps join it.

There is no second form of these numbers. Plain data go in and out by pydantic
(``record.model_dump(mode="json")``, ``EstimateRecord.model_validate(data)``); a number that is
infinite or unknown is None, as JSON has neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
"""Probability that an interval holds."""


class Frozen(BaseModel):
    """A part of a record: immutable, and without fields that it does not name."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Spread(Frozen):
    """Mean, standard deviation and maximum of some values."""

    mean: float
    std: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> Spread:
        """Of the finite values: a vertex that is not seen has no distance.

        Raises
        ------
        InputError
            If no value is finite.
        """
        known = values[np.isfinite(values)]
        if not known.size:
            raise InputError("a field of distances without a single value")
        return cls(mean=float(known.mean()), std=float(known.std()), max=float(known.max()))

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.std:.2f}"


def spread(values: FloatArray | None) -> Spread | None:
    """The same; None where no value is finite."""
    return None if values is None or not np.isfinite(values).any() else Spread.of(values)


class Unknown(Frozen):
    """One unknown before and after the estimation, in its unit.

    Attributes
    ----------
    name, label, unit : str
        ``E_f.anterior``; what a reader calls it; empty for a factor.
    kind : {"modulus", "nuisance", "derived", "quantity"}
        A derived modulus follows from an estimated one through a fixed ratio; a quantity is a ratio
        of moduli or a strain (%).
    treatment : {"estimated", "fixed"}
    prior_mean, prior_std : float or None
    estimate, std : float or None
        None where the run did not get so far.
    low, high : float or None
        Ends of the 95 % interval.
    bound : float or None
        Cramér-Rao standard deviation of the data alone; None if they do not determine it.
    truth : float or None
        Known for simulated valves; never known to the estimator.
    """

    name: str
    label: str = ""
    unit: str = ""
    kind: Literal["modulus", "nuisance", "derived", "quantity"] = "modulus"
    treatment: Literal["estimated", "fixed"] = "estimated"
    prior_mean: float | None = None
    prior_std: float | None = None
    estimate: float | None = None
    std: float | None = None
    low: float | None = None
    high: float | None = None
    bound: float | None = None
    truth: float | None = None

    @property
    def region(self) -> str:
        """The leaflet of a modulus: ``anterior`` for ``E_f.anterior``."""
        return self.name.partition(".")[2]

    @property
    def is_modulus(self) -> bool:
        """Whether it is an estimated modulus of a leaflet."""
        return self.kind == "modulus"

    @property
    def is_positive(self) -> bool:
        """Whether its interval is that of its logarithm."""
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
        """Whether the interval contains the truth; None where one of them is not known."""
        if self.low is None or self.high is None or self.truth is None:
            return None
        return self.low <= self.truth <= self.high


class FrameFit(Frozen):
    """Distances (mm) of the models from an observed frame, and from a simulated valve's true one.

    Attributes
    ----------
    frame : str
    seen : bool
        Whether the filter was given this frame.
    generic, registered, personalised : Spread
        Models as in `mvest.personalisation.result.FrameDistance`.
    generic_to_truth, registered_to_truth, personalised_to_truth : Spread or None
    """

    frame: str
    seen: bool
    generic: Spread
    registered: Spread
    personalised: Spread
    generic_to_truth: Spread | None = None
    registered_to_truth: Spread | None = None
    personalised_to_truth: Spread | None = None


class EstimateRecord(Frozen):
    """One estimate, or the reason why there is none.

    Attributes
    ----------
    case : str
        Name of the case; empty for a synthetic study.
    seed : int or None
        Of the errors of the observation.
    simulated : bool or None
        Whether the observation is stated as simulated.
    status : {"converged", "failed"}
    reason, detail : str
        Why the estimation ended.
    verdict : Verdict or None
        How far the estimate may be believed; None where it was not judged.
    unknowns : tuple of Unknown
    correlation : (p, p)
        Of the errors of the unknowns in filter coordinates; empty if not kept.
    distance_mm, distance_to_truth_mm : Spread or None
        Of the fitted vertices of the last observed frame from the observed and the true ones.
    frames : tuple of FrameFit
    innovation : InnovationSummary or None
    condition_number : float or None
        Of the information of the data alone.
    flat : tuple of str
        Combinations of unknowns that the data hardly determine.
    confounded : tuple of TradeOff
        Parameters that the data hardly tell apart.
    iterations, forward_solves : int or None
    iterates, iterate_std : (i, p)
    objective : (i,)
    seconds : float or None
        Wall-clock time of the estimation.
    alternatives : mapping
        Name -> another estimate from the same data: ``moduli_only`` with everything else taken as
        known, ``paper`` as the paper does it.
    details : mapping
        Name -> rows of plain data, for reports (see `mvest.personalisation.record`).
    """

    case: str = ""
    seed: int | None = None
    simulated: bool | None = None
    status: Literal["converged", "failed"]
    reason: str
    detail: str = ""
    verdict: Verdict | None = None
    unknowns: tuple[Unknown, ...] = ()
    correlation: tuple[Numbers, ...] = ()
    distance_mm: Spread | None = None
    distance_to_truth_mm: Spread | None = None
    frames: tuple[FrameFit, ...] = ()
    innovation: InnovationSummary | None = None
    condition_number: float | None = None
    flat: tuple[str, ...] = ()
    confounded: tuple[TradeOff, ...] = ()
    iterations: int | None = None
    forward_solves: int | None = None
    iterates: tuple[Numbers, ...] = ()
    iterate_std: tuple[Numbers, ...] = ()
    objective: Numbers = ()
    seconds: float | None = None
    alternatives: Mapping[str, EstimateRecord] = {}
    details: Mapping[str, tuple[Row, ...]] = {}

    @property
    def converged(self) -> bool:
        """Whether there is an estimate."""
        return self.status == "converged"

    @property
    def is_stated(self) -> bool:
        """Whether its numbers may be stated: the verdict is not that there is no estimate."""
        return self.converged and (self.verdict is None or self.verdict.trust != NONE)

    @property
    def moduli(self) -> tuple[Unknown, ...]:
        """The estimated moduli."""
        return tuple(unknown for unknown in self.unknowns if unknown.is_modulus)

    @property
    def parameters(self) -> tuple[Unknown, ...]:
        """The unknowns of the filter, without the moduli that follow from them."""
        return tuple(unknown for unknown in self.unknowns if unknown.kind != "derived")

    def unknown(self, name: str) -> Unknown:
        """The unknown of that name.

        Raises
        ------
        KeyError
            If there is none.
        """
        for unknown in self.unknowns:
            if unknown.name == name:
                return unknown
        raise KeyError(name)

    def detail_rows(self, name: str) -> tuple[Row, ...]:
        """The rows of a detail; none where it was not computed."""
        return self.details.get(name, ())

    def without_details(self, *kept: str) -> EstimateRecord:
        """The same without how it came about: iterates, correlations, details but those kept."""
        nothing: dict[str, Any] = dict.fromkeys(
            ("correlation", "iterates", "iterate_std", "objective", "flat", "confounded"), ()
        )
        details = {name: rows for name, rows in self.details.items() if name in kept}
        others = {name: other.without_details() for name, other in self.alternatives.items()}
        return self.model_copy(update={**nothing, "details": details, "alternatives": others})

    def with_truth(self, truth: Mapping[str, float]) -> EstimateRecord:
        """The same with the true values of its unknowns, for a simulated valve.

        Derived moduli, and the alternatives, are given theirs as well.

        Parameters
        ----------
        truth : mapping
            Name -> value; an unknown that it does not name keeps what it has.
        """
        known = dict(truth)
        for unknown in self.unknowns:
            own = f"E_f.{unknown.region}"
            if unknown.kind == "derived" and own in truth and unknown.estimate is not None:
                fibre = self.unknown(own).estimate
                if fibre:
                    known[unknown.name] = unknown.estimate / fibre * truth[own]
        return self.model_copy(
            update={
                "unknowns": tuple(
                    one.model_copy(update={"truth": known.get(one.name, one.truth)})
                    for one in self.unknowns
                ),
                "alternatives": {
                    name: other.with_truth(truth) for name, other in self.alternatives.items()
                },
            }
        )

    def rows(self) -> list[dict[str, Any]]:
        """A row for each unknown, with what is true of the whole estimate in each: a tidy table."""
        whole = {
            "case": self.case,
            "seed": self.seed,
            "simulated": self.simulated,
            "status": self.status,
            "reason": self.reason,
            "verdict": None if self.verdict is None else self.verdict.trust,
            **{f"distance_{k}": v for k, v in _plain(self.distance_mm).items()},
            **{f"distance_to_truth_{k}": v for k, v in _plain(self.distance_to_truth_mm).items()},
            "nis": None if self.innovation is None else self.innovation.nis,
            "iterations": self.iterations,
            "forward_solves": self.forward_solves,
            "seconds": self.seconds,
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


def _plain(part: Spread | None) -> dict[str, float]:
    return {} if part is None else part.model_dump()


def record_of(
    result: StudyResult, *, seed: int | None = None, case: str = "", simulated: bool | None = None
) -> EstimateRecord:
    """The record of a result; of a failed one the reason.

    Parameters
    ----------
    result : StudyResult
        Compared with its truth, if that may be known (`StudyResult.against`).
    seed : int or None
    case : str
    simulated : bool or None
    """
    filtered, known = result.filtered, result.identifiability
    return EstimateRecord(
        case=case,
        seed=seed,
        simulated=simulated,
        status="converged" if result.converged else "failed",
        reason=result.reason,
        detail=result.detail,
        unknowns=_unknowns(result),
        distance_mm=spread(result.distance),
        distance_to_truth_mm=spread(result.distance_to_truth),
        innovation=None if filtered is None else filtered.innovation,
        condition_number=None if known is None else finite(known.condition_number),
        flat=() if known is None else tuple(known.flat()),
        confounded=() if known is None else known.confounded(),
        iterations=None if filtered is None else filtered.iterations,
        forward_solves=None if filtered is None else filtered.forward_solves,
        iterates=() if filtered is None else _rows(filtered.iterates),
        iterate_std=() if filtered is None else _rows(filtered.iterate_std),
        objective=() if filtered is None else _numbers(filtered.objective),
        seconds=result.seconds,
    )


def finite(value: float) -> float | None:
    """None for a number that is infinite or not known."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Numbers:
    return tuple(map(finite, np.asarray(values, dtype=np.float64).tolist()))


def _rows(values: ArrayLike) -> tuple[Numbers, ...]:
    return tuple(map(_numbers, np.asarray(values)))


def _unknowns(result: StudyResult) -> tuple[Unknown, ...]:
    """The parameters of a result, and the moduli that follow through fixed ratios."""
    filtered = result.filtered
    columns: dict[str, FloatArray | None] = {"estimate": result.estimate, "std": result.std}
    if filtered is not None:
        columns |= {"prior_mean": filtered.prior.mean, "prior_std": filtered.prior.std}
        if result.estimate is not None:
            columns |= zip(("low", "high"), filtered.interval(LEVEL), strict=True)
    columns["bound"] = None if result.identifiability is None else result.identifiability.std
    columns["truth"] = None if result.truth is None else result.truth.values
    known = {key: values for key, values in columns.items() if values is not None}
    own = [
        Unknown(
            name=name,
            label=label_of(name),
            unit=unit_of(name),
            kind="modulus" if name.startswith("E_f.") else "nuisance",
        ).model_copy(update={key: finite(values[k]) for key, values in known.items()})
        for k, name in enumerate(result.parameters)
    ]
    return (*own, *_derived_moduli(result, own))


def _derived_moduli(result: StudyResult, unknowns: Sequence[Unknown]) -> list[Unknown]:
    """The moduli that follow from the estimated ones through the fixed ratios of the tissue."""
    rows = []
    for own in unknowns:
        if not (own.is_modulus and own.region in result.tissue and own.estimate):
            continue
        unit = result.tissue[own.region].material(1.0)
        for name, share in (("E_perp", unit.E_p), ("G", unit.G)):
            values = {key: getattr(own, key) for key in ("estimate", "std", "low", "high", "truth")}
            scaled = {key: v if v is None else share * v for key, v in values.items()}
            about = {
                "name": f"{name}.{own.region}",
                "label": f"{name} {own.region}",
                "kind": "derived",
            }
            nothing = dict.fromkeys(("prior_mean", "prior_std", "bound"))
            rows.append(own.model_copy(update=about | scaled | nothing))
    return rows
