"""Calibration of the moduli of a case, measured through the whole chain on simulated patients.

Patients are drawn from the estimator's priors and estimated from what a user has, a volume say. The
regression of their true moduli on the estimates (`mvest.estimation.recalibration`) corrects later
estimates. It removes errors that no calibration of shapes can see: weights read directions in which
the calibrated shapes hardly vary.

Offset, slope and spread belong to single leaflets, since shapes are weighed leaflet by leaflet. The
pressure is a common factor of all moduli; it is drawn from its prior, so that its share of the
stated covariance is right, and stays in their correlation.

A calibration holds for the detectors and settings that it was measured for, and for no others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from mvest.cases.case import ValveCase
from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian, checked_covariance
from mvest.estimation.recalibration import Recalibration, recalibrate
from mvest.personalisation.settings import PACKAGE, PersonaliseSettings
from mvest.problem.record import EstimateRecord, Frozen, Row
from mvest.provenance import require_sealed, sealed, write_json
from mvest.reading.documents import read_mapping, validated
from mvest.typing import FloatArray

CALIBRATIONS = Path(__file__).with_name("calibrations")
"""Folder of the package's calibrations, ``WAY.json`` for a `mvest.cases.case.Arrival.way`."""

MIN_PATIENTS = 10

OF_NO_EFFECT = ("confirm", "moduli_only", "paper", "calibration", "pressures")
"""Settings that leave the estimate of a case with one closed frame as it is."""


class MeasuredFor(Frozen):
    """What decides the errors of a case's moduli, as far as a calibration must know it."""

    way: str  #: as `mvest.cases.case.Arrival`
    made_by: str  #: as `mvest.cases.case.Arrival`
    settings: str  #: `settings_digest`

    @classmethod
    def of(cls, case: ValveCase, settings: PersonaliseSettings) -> Self | None:
        """Of a case; None if it does not state by which way its geometry arrived."""
        if case.arrival is None:
            return None
        return cls(**asdict(case.arrival), settings=settings_digest(case, settings))

    def fault(self, case: MeasuredFor) -> str:
        """Why a calibration measured for this does not hold for a case; empty if it does."""
        if self.way != case.way:
            return f"measured for geometry from {self.way}, not from {case.way}"
        for name, what in (("made_by", "detectors"), ("settings", "settings of the estimation")):
            here, there = getattr(self, name), getattr(case, name)
            if here != there:
                return f"measured for other {what} (SHA-256 {here[:12]}) than these ({there[:12]})"
        return ""


def settings_digest(case: ValveCase, settings: PersonaliseSettings) -> str:
    """SHA-256 of the settings that affect an estimate and belong to no single case.

    The number of error samples counts, the pressure does not. Priors count, since a calibration is
    relative to them.
    """
    kept = {name: value for name, value in asdict(settings).items() if name not in OF_NO_EFFECT}
    kept["unknowns"] = {one["name"]: one for one in kept["unknowns"]}
    del kept["mechanics"]["protocol"]["pressure_mmHg"]
    kept["samples"] = 0 if case.error_samples is None else len(case.error_samples)
    alike = json.loads(json.dumps(kept), parse_int=float)  # 1 and 1.0 are one setting
    return hashlib.sha256(json.dumps(alike, sort_keys=True).encode()).hexdigest()


class Calibration(Frozen):
    """Offset, slope and spread of the logarithms of q moduli about their prior means."""

    format: Literal["mvest calibration"] = "mvest calibration"
    version: Literal[1] = 1
    measured_for: MeasuredFor
    parameters: tuple[str, ...]  #: (q,), such as ``E_f.anterior``
    offset: tuple[float, ...]  #: this and the next as in `Recalibration`
    slope: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    log_spread: tuple[float, ...]
    log_spread_covariance: tuple[tuple[float, ...], ...]
    simulated: int  #: number of patients
    patients: int  #: number of those whose estimate may be stated, and which were used
    seeds: tuple[int, ...] = ()
    #: Unknown -> estimate and standard deviation, uncalibrated, of the example volume then. A test
    #: compares them with what the code gives, so that another estimator needs a new calibration.
    example: Mapping[str, tuple[float, float]] = {}

    @model_validator(mode="after")
    def _check(self) -> Self:
        q = len(self.parameters)
        for name, shape in (
            ("offset", (q,)),
            ("slope", (q,)),
            ("log_spread", (q,)),
            ("covariance", (2 * q, 2 * q)),
            ("log_spread_covariance", (q, q)),
        ):
            try:
                given = np.shape(getattr(self, name))
            except ValueError:
                given = ()
            if given != shape or not q:
                raise ValueError(f"{name} has the shape {given}, expected {shape}")
            if len(shape) == 2:
                checked_covariance(np.array(getattr(self, name)), shape[0], name)
        return self

    @property
    def measured(self) -> Recalibration:
        """Its numbers."""
        names = ("offset", "slope", "covariance", "log_spread", "log_spread_covariance")
        return Recalibration(*(np.array(getattr(self, name)) for name in names))

    def applied(self, names: Sequence[str], after: Gaussian, prior: Gaussian) -> Gaussian:
        """The calibrated estimate of p unknowns; only moduli and their covariances change.

        Parameters
        ----------
        names : sequence of str, (p,)
        after, prior : Gaussian
            Estimate and prior, with the logarithms of the moduli.
        """
        at = [names.index(name) for name in self.parameters]
        order = at + [k for k in range(len(names)) if k not in at]
        own, mean = np.ix_(at, at), after.mean.copy()
        covariance = np.empty_like(after.covariance)
        covariance[np.ix_(order, order)] = self.measured.widening(len(names))
        covariance *= after.covariance
        x = after.mean[at] - prior.mean[at]
        found, covariance[own] = self.measured.predicted(x, after.covariance[own])
        mean[at] = prior.mean[at] + found
        return Gaussian(mean, covariance)


def read_calibration(path: Path) -> Calibration:
    """Read a calibration; InputError if the file is missing, none, or was changed."""
    data = read_mapping(path)
    known = {key: value for key, value in data.items() if key != "sha256"}
    calibration = validated(Calibration, known, str(path))
    require_sealed(data, str(path))
    return calibration


def write_calibration(path: Path, calibration: Calibration) -> Path:
    """Write a calibration as JSON with a digest of its content."""
    write_json(path, sealed(calibration.model_dump(mode="json")))
    return path


@dataclass(frozen=True, slots=True)
class FoundCalibration:
    """The calibration of a case, or why it has none."""

    calibration: Calibration | None = None
    case: MeasuredFor | None = None  #: what a calibration of the case must be measured for
    why: str = ""  #: why the requested calibration is missing
    stale: bool = False  #: whether it was measured for something else

    def row(self, names: Sequence[str], after: Gaussian, prior: Gaussian) -> Row | None:
        """The detail ``calibration`` of a record; None if the geometry's way is not stated.

        ``log_estimate (q,)`` is relative to the prior mean, ``log_covariance (q, q)`` as stated;
        both are uncalibrated.
        """
        if self.case is None:
            return None
        at = [k for k, name in enumerate(names) if name.startswith("E_f.")]
        used = self.calibration
        return {
            "measured_for": self.case.model_dump(),
            "patients": 0 if used is None else used.patients,
            "why": "" if self.stale else self.why,  # else the verdict says it
            "parameters": [names[k] for k in at],
            "log_estimate": (after.mean - prior.mean)[at].tolist(),
            "log_covariance": after.covariance[np.ix_(at, at)].tolist(),
        }


def calibration_for(case: ValveCase, settings: PersonaliseSettings) -> FoundCalibration:
    """The calibration that the settings request for a case.

    InputError if a requested file is no calibration, or was measured for something else. One of the
    package that was measured for something else is not used.
    """
    own, given = MeasuredFor.of(case, settings), settings.calibration
    if given is None or (own is None and given == PACKAGE):
        return FoundCalibration(case=own)
    if own is None:
        raise InputError(
            f"calibration {given}: case {case.name} does not state by which way its geometry "
            "arrived (arrival in case.yaml); expected a case made by a program, or no calibration"
        )
    path = CALIBRATIONS / f"{own.way}.json" if given == PACKAGE else Path(given)
    if given == PACKAGE and not path.is_file():
        return FoundCalibration(case=own, why=f"the package has none for geometry from {own.way}")
    calibration = read_calibration(path)
    fault = calibration.measured_for.fault(own)
    if fault and given != PACKAGE:
        raise InputError(f"{path}: {fault}; expected one for this case, or no calibration")
    return FoundCalibration(None if fault else calibration, own, fault, bool(fault))


class Pairs(NamedTuple):
    """Estimates and truths of n patients: logarithms of q moduli over their prior means."""

    estimates: tuple[EstimateRecord, ...]  #: (n,)
    row: Row  #: detail ``calibration`` of the first
    x: FloatArray  #: (n, q), uncalibrated
    V: FloatArray  #: (n, q, q), uncalibrated
    truth: FloatArray  #: (n, q)


def pairs_of(estimates: Sequence[EstimateRecord]) -> Pairs:
    """The patients whose estimate may be stated: no other number will be calibrated.

    InputError if there are fewer than `MIN_PATIENTS`, one has no truth or does not state what it
    was estimated with, or two were estimated with something else.
    """
    kept = tuple(one for one in estimates if one.is_stated)
    if len(kept) < MIN_PATIENTS:
        raise InputError(f"{len(kept)} estimates that may be stated, expected {MIN_PATIENTS}")
    rows, truths = [], []
    for one in kept:
        (row,) = one.detail_rows("calibration") or ({"parameters": ()},)
        known = {own.name: (own.truth, own.prior_mean) for own in one.moduli}
        pairs = np.array([known[name] for name in row["parameters"]], dtype=np.float64)
        if not (len(pairs) and (pairs > 0.0).all()):
            raise InputError(f"estimate of {one.case}: no detail calibration, or no true moduli")
        rows.append(row)
        truths.append(np.log(pairs[:, 0] / pairs[:, 1]))
        first, own = (MeasuredFor(**each["measured_for"]) for each in (rows[0], row))
        if fault := first.fault(own):
            raise InputError(f"estimates of {kept[0].case} and {one.case}: {fault}")
    x, V = (np.array([row[key] for row in rows]) for key in ("log_estimate", "log_covariance"))
    return Pairs(kept, rows[0], x, V, np.array(truths))


def calibrate(
    estimates: Sequence[EstimateRecord], example: Mapping[str, Any] | None = None
) -> Calibration:
    """The calibration that simulated patients give; ``example`` as in `Calibration`.

    InputError as `pairs_of`.
    """
    pairs = pairs_of(estimates)
    found = asdict(recalibrate(pairs.x, pairs.V, pairs.truth))
    return Calibration(
        measured_for=MeasuredFor(**pairs.row["measured_for"]),
        parameters=tuple(pairs.row["parameters"]),
        simulated=len(estimates),
        patients=len(pairs.estimates),
        seeds=tuple(sorted(one.seed for one in pairs.estimates if one.seed is not None)),
        example=example or {},
        **{name: value.tolist() for name, value in found.items()},
    )
