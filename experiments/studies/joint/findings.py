"""Findings of the joint estimates; errors and standard deviations are parts of the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.building.whole_cycle import Bound
from experiments.common.records.findings import Vector, vector
from experiments.common.records.record import Status
from mvest.closure.cycle.observation import CycleObservation
from mvest.estimation.estimate import Estimate
from mvest.estimation.information.consistency import nees
from mvest.typing import FloatArray

__all__ = ["Findings", "Fit", "Frame", "MeshError", "OtherMesh", "Pass", "measures_of"]


@dataclass(frozen=True, slots=True)
class Fit:
    """One estimate in units of the parameters ``(p,)``, with its normalised squared error.

    Iterations are of the filter, runs of the model, and the residual is a root mean square.
    """

    status: Status
    reason: str
    estimate: Vector
    error: Vector
    std: Vector
    nees: float
    iterations: int
    runs: int
    residual_mm: float | None

    @classmethod
    def of(cls, found: Estimate, truth: FloatArray, seen: CycleObservation) -> Fit:
        """An estimate from what was seen, beside the truth ``(p,)``."""
        error = found.mean - truth
        return cls(
            "converged" if found.converged else "failed",
            found.reason.value,
            vector(found.mean),
            vector(error / truth),
            vector(found.std / truth),
            nees(error, found.covariance),
            found.iterations,
            found.forward_solves,
            found.residual_rms(seen.y),
        )


@dataclass(frozen=True, slots=True)
class Pass:
    """Where the filter is at the end of a pass over all frames, ``(p,)``."""

    error: Vector
    std: Vector


@dataclass(frozen=True, slots=True)
class Frame:
    """Where the filter is after a frame of its first pass, ``(p,)``.

    ``nis`` is the normalised innovation squared of the frame, at the end; 95 % of such values lie
    in ``nis_band``. ``gain_nats`` is the information that the frame brought.
    """

    error: Vector
    std: Vector
    nis: float
    nis_band: tuple[float, float]
    gain_nats: float


@dataclass(frozen=True, slots=True)
class OtherMesh:
    """The estimate of a truth from another mesh with these cells, around and along.

    ``distance_mm`` is the mean between frames of the two meshes at the same parameters.
    """

    fit: Fit
    cells: tuple[int, ...]
    distance_mm: float


@dataclass(frozen=True, slots=True)
class MeshError:
    """How far ``(p,)`` the estimator's own mesh may have moved that estimate.

    Standard deviations ``(p,)`` and normalised squared error are with that shift; the distance is
    the mean between frames of the estimator's mesh and of the third, which has these cells.
    """

    shift: Vector
    std: Vector
    nees: float
    distance_mm: float
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters: without noise, with it for each seed, and on another mesh.

    Truth and start ``(p,)`` are in units of the parameters, ``times (f,)`` in s. ``assumed_mm`` is
    the standard deviation that is assumed of coordinates without noise. Bounds are of open and
    closed frame and of the whole cycle; ``rms_over_bound (p,)`` is the root mean square error over
    the seeds in parts of the latter. ``exact_frames`` and ``first (f,)`` are of the first pass over
    frames without noise and with that of the first seed, ``passes`` those that follow. The mesh's
    error may be unknown, for a reason. Runs are compared by ``measures``.
    """

    truth: Vector
    start: Vector
    times: Vector
    noise_mm: float
    assumed_mm: float
    vertices: int
    bounds: tuple[Bound, Bound]
    exact: Fit
    exact_frames: tuple[Frame, ...]
    seeds: tuple[Fit, ...]
    first: tuple[Frame, ...]
    passes: tuple[Pass, ...]
    rms_over_bound: Vector
    finer: OtherMesh
    mesh_error: MeshError | str
    measures: Mapping[str, float]


def measures_of(
    parameters: tuple[str, ...], exact: Fit, rms_over_bound: Vector, finer: Fit
) -> dict[str, float]:
    """What runs are compared by."""
    return {
        f"{what}.{name}": value
        for what, values in (
            ("error_exact", exact.error),
            ("rms_over_bound", rms_over_bound),
            ("error_finer", finer.error),
        )
        for name, value in zip(parameters, values, strict=True)
    }
