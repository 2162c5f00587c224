"""Findings of the study of predictions: simulated patients, and what was predicted of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.findings import Rows, Vector, finite
from mvest.scenarios.predict import PredictedScenario, Sample

__all__ = ["Findings", "MeshStress", "Observed", "Patient", "Predicted", "Scenario"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Predicted:
    """A measure of one valve under one condition, in its own unit; None where it is not known.

    Attributes
    ----------
    estimate : float
        At the estimated parameters.
    first_order_std : float or None
        By the derivative of the closed shape.
    mean, std, low, high : float or None
        Of the samples, with the ends of their 95 % interval.
    samples : int
        That have it.
    mesh_error : float or None
        Standard deviation by the estimator's mesh.
    wide_low, wide_high : float or None
        95 % interval of samples and mesh.
    truth_own_mesh, truth_same_mesh : float or None
        Of the true parameters on the truth's mesh, and on that of the estimator.
    inside_own_mesh, inside_same_mesh, inside_wide : bool or None
        Whether the interval of the samples holds one and the other truth, and whether that of
        samples and mesh holds the first.
    """

    estimate: float
    first_order_std: float | None
    mean: float | None
    std: float | None
    low: float | None
    high: float | None
    samples: int
    mesh_error: float | None
    wide_low: float | None
    wide_high: float | None
    truth_own_mesh: float | None
    inside_own_mesh: bool | None
    truth_same_mesh: float | None
    inside_same_mesh: bool | None
    inside_wide: bool | None

    @classmethod
    def of(cls, predicted: PredictedScenario, own: Sample, same: Sample, measure: str) -> Predicted:
        """A measure beside that of the true valve on its own and on the same mesh."""
        spread, (low, high) = predicted.spread(measure), predicted.interval(measure)
        truths = [sample.measures.get(measure) for sample in (own, same)]
        return cls(
            estimate=predicted.at_estimate.measures[measure],
            first_order_std=predicted.first_order.get(measure),
            mean=finite(spread.mean),
            std=finite(spread.std),
            low=finite(spread.low),
            high=finite(spread.high),
            samples=spread.count,
            mesh_error=finite(predicted.mesh_error(measure)),
            wide_low=finite(low),
            wide_high=finite(high),
            truth_own_mesh=truths[0],
            inside_own_mesh=_inside(spread.low, truths[0], spread.high),
            truth_same_mesh=truths[1],
            inside_same_mesh=_inside(spread.low, truths[1], spread.high),
            inside_wide=_inside(low, truths[0], high),
        )


def _inside(low: float, true: float | None, high: float) -> bool | None:
    """Whether an interval holds the truth; None where one of them is not known."""
    if true is None or not math.isfinite(high - low):
        return None
    return bool(low <= true <= high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What is predicted under one condition; reasons are empty where there is none.

    Attributes
    ----------
    failure, truth_failure, finer_failure : str
        Why there is no closed valve at the estimate, of the truth, on the finer mesh.
    samples : int
        That were tried.
    failures : tuple of str
        Reasons of those without a closed valve.
    sampled : tuple of mapping
        Measure -> value, of each sample.
    measures : mapping
        By name.
    """

    failure: str
    samples: int
    failures: tuple[str, ...]
    sampled: tuple[Mapping[str, float], ...]
    truth_failure: str
    finer_failure: str
    measures: Mapping[str, Predicted]


@dataclass(frozen=True, slots=True, kw_only=True)
class Patient:
    """A simulated patient; no scenarios where there is no estimate.

    Attributes
    ----------
    seed : int
    truth : (p,)
        In units of the parameters.
    estimate, std, relative_error : (p,) or None
    reason : str
        Why the estimation ended.
    correlation : (p, p) or None
    scenarios : mapping
        By name.
    """

    seed: int
    truth: Vector
    estimate: Vector | None
    std: Vector | None
    relative_error: Vector | None
    reason: str
    correlation: Rows | None
    scenarios: Mapping[str, Scenario]


@dataclass(frozen=True, slots=True)
class MeshStress:
    """Peak stress of the first patient as observed, on one mesh.

    Attributes
    ----------
    cells : (2,)
        Around and along the leaflets.
    gap_mm2 : float or None
    stress : mapping
        Measure -> MPa.
    reason : str
        Why it did not close; empty if it did.
    """

    cells: tuple[int, ...]
    gap_mm2: float | None
    stress: Mapping[str, float]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """How patients were seen.

    Attributes
    ----------
    vertices : int
    truth_cells : (2,)
        Around and along.
    truth_element : str
    noise_mm, correlated_mm : float
        Standard deviation of independent errors of a coordinate, and of those that are alike.
    correlation_length_mm : float
    """

    vertices: int
    truth_cells: tuple[int, ...]
    truth_element: str
    noise_mm: float
    correlated_mm: float
    correlation_length_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for all patients.

    Attributes
    ----------
    patients : tuple of Patient
    estimate, std, relative_error : (p,) or None
        Of the first patient, by which runs are compared.
    scenarios : mapping
        Name -> what a reader calls it.
    stress_meshes : tuple of MeshStress
    reach_mm : float
        Distance of midsurfaces within which leaflets touch.
    check_mesh : tuple of int
        Cells of the mesh that shows the mesh's error; empty if there is none.
    observed : Observed
    measures : mapping
        Measure -> what it means; empty where nothing was predicted.
    """

    patients: tuple[Patient, ...]
    estimate: Vector | None
    std: Vector | None
    relative_error: Vector | None
    scenarios: Mapping[str, str]
    stress_meshes: tuple[MeshStress, ...]
    reach_mm: float
    check_mesh: tuple[int, ...]
    observed: Observed
    measures: Mapping[str, str]
