"""Findings of the joint estimates; errors and standard deviations are parts of the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.findings import Vector, vector
from experiments.common.record import Status
from experiments.common.whole_cycle import Bound
from mvest.closure.cycle.observation import CycleObservation
from mvest.estimation.estimate import Estimate
from mvest.estimation.information.consistency import nees
from mvest.typing import FloatArray

__all__ = ["Findings", "Fit", "Frame", "MeshError", "OtherMesh", "Pass", "measures_of"]


@dataclass(frozen=True, slots=True)
class Fit:
    """One estimate of p parameters.

    Attributes
    ----------
    status : {"converged", "failed"}
    reason : str
    estimate : (p,)
        In units of the parameters.
    error, std : (p,)
    nees : float
        Normalised squared error.
    iterations, runs : int
        Of the filter; of the model.
    residual_mm : float or None
        Root mean square.
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
    """Where the filter is at the end of a pass over all frames.

    Attributes
    ----------
    error, std : (p,)
    """

    error: Vector
    std: Vector


@dataclass(frozen=True, slots=True)
class Frame:
    """Where the filter is after a frame of its first pass.

    Attributes
    ----------
    error, std : (p,)
    nis : float
        Normalised innovation squared of the frame, at the end.
    nis_band : (2,)
        Where 95 % of such values lie.
    gain_nats : float
        Information that the frame brought.
    """

    error: Vector
    std: Vector
    nis: float
    nis_band: tuple[float, float]
    gain_nats: float


@dataclass(frozen=True, slots=True)
class OtherMesh:
    """The estimate of a truth that comes from another mesh.

    Attributes
    ----------
    fit : Fit
    cells : (2,)
        Of the truth, around and along.
    distance_mm : float
        Mean, between frames of the two meshes at the same parameters.
    """

    fit: Fit
    cells: tuple[int, ...]
    distance_mm: float


@dataclass(frozen=True, slots=True)
class MeshError:
    """How far the estimator's own mesh may have moved that estimate.

    Attributes
    ----------
    shift : (p,)
    std : (p,)
        Of the estimate, with that shift.
    nees : float
        Normalised squared error with it.
    distance_mm : float
        Mean, between frames of the estimator's mesh and of the third.
    cells : (2,)
        Of the third mesh.
    """

    shift: Vector
    std: Vector
    nees: float
    distance_mm: float
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for p parameters.

    Attributes
    ----------
    truth, start : (p,)
        In units of the parameters.
    times : (f,)
        s, of the frames.
    noise_mm, assumed_mm : float
        Standard deviation of a coordinate; that assumed of coordinates without noise.
    vertices : int
    bounds : (2,)
        Of open and closed frame, and of the whole cycle.
    exact : Fit
        Without noise.
    exact_frames, first : (f,)
        Of the first pass over frames without noise, and with that of the first seed.
    seeds : tuple of Fit
        With noise, one for each seed from the record's on.
    passes : tuple of Pass
        Those that follow `first`.
    rms_over_bound : (p,)
        Root mean square error over the seeds in parts of the bound of the whole cycle.
    finer : OtherMesh
    mesh_error : MeshError or str
        Why it is not known, if it is not.
    measures : mapping
        What runs are compared by.
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
