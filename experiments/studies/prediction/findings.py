"""Findings of the study of predictions: simulated patients, and what was predicted of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.records.findings import Rows, Vector, finite
from mvest.scenarios.predict import PredictedScenario, Sample

__all__ = ["Findings", "MeshStress", "Observed", "Patient", "Predicted", "Scenario"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Predicted:
    """A measure of one valve under one condition, in its own unit; None where it is not known.

    It is known at the estimated parameters, with a standard deviation by the derivative of the
    closed shape, and over the samples that have it (95 % from ``low`` to ``high``). ``mesh_error``
    is a standard deviation by the estimator's mesh, and the wide interval is of samples and mesh.
    The true parameters are on the truth's own mesh and on that of the estimator; whether the
    interval of the samples holds one and the other, and the wide one the first, is ``inside_...``.
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
    """What is predicted under one condition, by measure; reasons are empty where there is none.

    A valve may fail to close at the estimate, with the truth and on the finer mesh; ``failures``
    are the reasons of samples, and ``sampled`` the measures of each.
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
    """A simulated patient, with ``(p,)`` in units of the parameters and ``correlation (p, p)``.

    There are no scenarios where there is no estimate; ``reason`` is why the estimation ended.
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
    """Peak stress in MPa, by measure, of the first patient as observed, on one mesh.

    The cells are around and along the leaflets; the reason is empty if the valve closed.
    """

    cells: tuple[int, ...]
    gap_mm2: float | None
    stress: Mapping[str, float]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """How patients were seen: the truth's mesh, around and along, and errors of a coordinate.

    ``noise_mm`` is of independent errors, ``correlated_mm`` of those that are alike over
    ``correlation_length_mm``, all standard deviations.
    """

    vertices: int
    truth_cells: tuple[int, ...]
    truth_element: str
    noise_mm: float
    correlated_mm: float
    correlation_length_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for all patients; runs are compared by the estimate of the first.

    ``scenarios`` and ``measures`` say what their names mean, the latter are empty where nothing was
    predicted. Leaflets touch whose midsurfaces are nearer than ``reach_mm``. ``check_mesh (2,)``
    are the cells of the mesh that shows the mesh's error, if there is one.
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
