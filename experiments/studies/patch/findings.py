"""Findings about a stiff patch: the modulus that was estimated beside the true one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.records.findings import Vector
from experiments.common.records.record import Status
from mvest.mechanics.settings import ModulusField, StiffPatch

__all__ = ["Compared", "Findings", "Fit", "Places"]


@dataclass(frozen=True, slots=True)
class Places:
    """Where n points of the leaflet are when it is unrolled, and their triangles ``(m, 3)``.

    Along the annulus from the patch's centre, and down from it.
    """

    along_mm: Vector
    down_mm: Vector
    triangles: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """The estimated modulus ``(n,)`` MPa beside the true one; deviations of the logarithm.

    Standard deviations are of the noise. At the point nearest to the patch's centre, where the
    modulus is highest and how far that is from the centre, and its geometric mean outside the
    patch. ``rms_log_error`` is over the leaflet, of which ``within_two_std`` is a share. The shift
    by the estimator's mesh is None if it is not known.
    """

    truth: Vector
    modulus: Vector
    log_std: Vector
    at_centre: float
    true_at_centre: float
    log_std_at_centre: float
    peak: float
    peak_log_std: float
    peak_distance_mm: float
    outside: float
    rms_log_error: float
    within_two_std: float
    shift_rms: float | None
    within_two_with_shift: float | None


@dataclass(frozen=True, slots=True)
class Fit:
    """The estimate ``(p,)`` of one valve; ``std (p,)`` is in the filter's coordinates.

    Runs are of the model, the residual is a root mean square, and ``shift_unknown`` says why it is
    not known how far the mesh shifts the estimate; empty if it is.
    """

    status: Status
    reason: str
    estimate: Vector
    std: Vector
    runs: int
    residual_mm: float | None
    compared: Compared
    shift_unknown: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What follows for a valve with a patch, and, if asked for, of one without it, by label.

    Truth in MPa is the modulus of each leaflet outside the patch, ``field`` what the estimator
    knows of it beforehand, whose modes have a ``share`` of its variance; ``prior_std (p,)`` is in
    the filter's coordinates, times are of the frames in s. Runs are compared by ``measures``.
    """

    truth: Vector
    patch: StiffPatch
    field: ModulusField
    share: float
    noise_mm: float
    times: Vector
    vertices: int
    cells_of_truth: tuple[int, int]
    prior_std: Vector
    map: Places
    results: Mapping[str, Fit]
    measures: Mapping[str, float]
