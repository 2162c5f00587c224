"""What a personalised case shows of how far it may be believed."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_array
from scipy.spatial import cKDTree

from mvest.cases.case import Role
from mvest.cases.plausibility import free_orifice, implausible_values
from mvest.estimation.estimate import Estimate
from mvest.estimation.evidence import LENGTH
from mvest.estimation.information.consistency import moran
from mvest.estimation.transform import to_filter
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.personalisation.errors import WeighedObservation
from mvest.personalisation.result import Personalised
from mvest.problem.estimate import Observed
from mvest.problem.verdict import Found, texts
from mvest.typing import FloatArray

NEIGHBOURS = 6
"""Of a point that was seen, as on a surface of triangles."""
APPROXIMATION = 2.0
"""Times the limit of a check of the filter (`mvest.estimation.check`) beyond which it is doubtful.
The check is of the worst direction among all unknowns: moduli lay inside their intervals where it
failed by less."""
WORSE = 1.05
"""Distance of a held-out frame, fitted over generic, that counts as farther."""
SAME_MM = 0.5
"""Largest distance at which a valve that was closed anew is the same, as of the gate."""


def diagnostics_of(
    fit: Personalised, gate: bool | None = None, unlike: str = ""
) -> dict[str, Found]:
    """What speaks for and against the estimate of a case; nothing of it needs the truth.

    Parameters
    ----------
    fit : Personalised
    gate : bool, optional
        Whether its valve has passed the gate, if that was tested.
    unlike : str
        How the volume that the case is from is unlike those that detectors were trained on.

    Returns
    -------
    dict
        As `mvest.problem.verdict.judge` takes it.
    """
    result, filtered, found = fit.result, fit.result.filtered, implausible_values(fit.case)
    ended = f"{result.reason} ({result.detail})" if result.detail else result.reason
    estimated = filtered is not None and result.estimate is not None
    seen: dict[str, Found] = {
        "failed": texts("" if estimated else ended or "the run gives no reason"),
        "unfinished": texts(ended) if estimated and not result.converged else (),
        "mistakes": texts(*(str(doubt) for doubt in found if doubt.mistake)),
        "implausible": texts(*(str(doubt) for doubt in found if not doubt.mistake)),
        "unlike": texts(unlike),
        "unaccounted": texts(*fit.unaccounted),
    }
    if filtered is None or not estimated:
        return seen
    if (check := filtered.check) is not None:
        far = check.value > APPROXIMATION * check.limit
        seen["approximation"] = texts(check.sentence if far else "")
    values = {
        "moved": fit.moved,
        "law": fit.known.law_share,
        "again": None if fit.confirmed_mm is None else float(fit.confirmed_mm > SAME_MM),
        "gate": None if gate is None else float(not gate),
    }
    seen |= {key: [(value, {})] for key, value in values.items() if value is not None}
    if (own := filtered.innovation) is not None:
        low, high = (end / own.size for end in own.nis_band)
        nis = own.nis / own.size
        # Errors smaller than assumed leave intervals wider than they need to be.
        roots = dict(zip(("root", "low", "high"), np.sqrt([nis, low, high]), strict=True))
        seen["innovation"] = [(nis / high, roots)]
    if filtered.standardised is not None and result.observation is not None:
        alike = _alike(result.observation, filtered.standardised)
        if alike is not None:
            seen["alike"] = [(abs(alike), {"alike": alike})]
    alone = {one.parameter: one.prior_stds for one in fit.known.data_alone}
    for key, sizes in (("stretch", _stretch(fit, filtered)), ("data_alone", alone)):
        if sizes:
            seen[key] = [(abs(size), {"what": what}) for what, size in sizes.items()]
    held = [
        (one.frame, float(np.nanmean(one.registered)), float(np.nanmean(one.personalised)))
        for one in fit.distances
        if not one.seen
    ]
    if held:
        seen["held_out"] = [
            (fitted - WORSE * generic, {"frame": frame, "generic": generic, "fitted": fitted})
            for frame, generic, fitted in held
        ]
    closed = fit.case.frame(Role.CLOSED)
    observed = free_orifice(fit.case, closed)
    if closed.name in fit.fitted and observed is not None:
        fitted = free_orifice(fit.case, closed, fit.fitted[closed.name])
        if fitted is not None:
            words = {"fitted": fitted, "observed": observed}
            seen["closure"] = [(fitted - observed, words)]
    return seen


def _stretch(fit: Personalised, filtered: Estimate) -> dict[str, float]:
    """What was known beforehand -> by how many of its standard deviations it was moved."""
    prior, after = to_filter(filtered.transform, filtered.prior), filtered.transformed
    moved = dict(zip(filtered.names, ((after.mean - prior.mean) / prior.std).tolist(), strict=True))
    if filtered.learned is not None:
        # Errors smaller than believed contradict nothing.
        moved |= {
            f"{q.name} of the errors": q.stretch if q.name == LENGTH else max(q.stretch, 0.0)
            for q in filtered.learned.quantities
        }
    return moved | {f"{own.name} of the valve": own.stretch for own in fit.known.geometry}


def _alike(observation: Observed, standardised: FloatArray) -> float | None:
    """Largest covariance of neighbours in the standardised innovation, over the coordinates.

    Moran's I (`moran`), in units of the variance that was believed where it is smaller than that.
    """
    plain = observation.plain if isinstance(observation, WeighedObservation) else observation
    if isinstance(plain, Observation):
        points = plain.positions[-1][plain.seen[-1]]
        values = standardised[-points.size :].reshape(len(points), 3)
    elif isinstance(plain, SurfaceObservation):
        points = plain.seen[-1].points
        first = sum(plain.sizes[:-1])
        values = standardised[first : first + len(points), None]
    else:
        return None
    if len(points) <= NEIGHBOURS:
        return None
    near = np.asarray(cKDTree(points).query(points, NEIGHBOURS + 1)[1])
    rows = np.repeat(np.arange(len(points)), NEIGHBOURS)
    ones = np.ones(rows.size)
    one_way = coo_matrix((ones, (rows, near[:, 1:].ravel())), shape=(len(points),) * 2)
    neighbours = csr_array(one_way.maximum(one_way.T))
    # What is smaller than believed contradicts nothing, whatever its pattern.
    statistics = [
        moran(column, neighbours) * min(1.0, float(np.var(column))) for column in values.T
    ]
    return float(max(statistics, key=abs))
