"""Findings about a stiff patch: the modulus that was estimated beside the true one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.findings import Vector
from experiments.common.record import Status
from mvest.mechanics.settings import ModulusField, StiffPatch

__all__ = ["Compared", "Findings", "Fit", "Places"]


@dataclass(frozen=True, slots=True)
class Places:
    """Where n points of the leaflet are when it is unrolled, and their triangles.

    Attributes
    ----------
    along_mm, down_mm : (n,)
        Along the annulus from the patch's centre, and down from it.
    triangles : (m, 3)
    """

    along_mm: Vector
    down_mm: Vector
    triangles: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """The estimated modulus beside the true one; standard deviations are of the noise.

    Attributes
    ----------
    truth, modulus : (n,) MPa
    log_std : (n,)
        Standard deviation of the logarithm of the modulus.
    at_centre, true_at_centre : float
        MPa, at the point nearest to the patch's centre.
    log_std_at_centre : float
    peak : float
        MPa, the highest modulus.
    peak_log_std, peak_distance_mm : float
        The latter is from the patch's centre.
    outside : float
        MPa, geometric mean outside the patch.
    rms_log_error : float
        Of the logarithm, over the leaflet.
    within_two_std : float
        Share of the leaflet.
    shift_rms : float or None
        Of the logarithm, by the estimator's mesh; None if that is not known.
    within_two_with_shift : float or None
        Share of the leaflet within two standard deviations and shifts.
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
    """The estimate of one valve.

    Attributes
    ----------
    status : {"converged", "failed"}
    reason : str
    estimate : (p,)
        In units of the parameters.
    std : (p,)
        In the filter's coordinates.
    runs : int
        Of the model.
    residual_mm : float or None
        Root mean square.
    compared : Compared
    shift_unknown : str
        Why it is not known how far the mesh shifts the estimate; empty if it is.
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
    """What follows for a valve with a patch, and of one without it.

    Attributes
    ----------
    truth : tuple of float
        MPa, the modulus of each leaflet outside the patch.
    patch : StiffPatch
    field : ModulusField
        What the estimator knows of it beforehand.
    share : float
        Of the field's variance that its modes have.
    noise_mm : float
        Standard deviation of a coordinate.
    times : tuple of float
        s, of the frames.
    vertices : int
    cells_of_truth : (2,)
        Around and along.
    prior_std : (p,)
        In the filter's coordinates.
    map : Places
    results : mapping
        "patch" and, if asked for, "no patch".
    measures : mapping
        What runs are compared by.
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
