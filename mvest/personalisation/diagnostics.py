"""Diagnostics of a personalised case, from which its verdict follows."""

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
"""Of an observed point, as on a surface of triangles."""
APPROXIMATION = 2.0
"""Doubtful from this multiple of the limit of a filter's check (`mvest.estimation.check`). The
check covers the worst direction among all unknowns, and moduli lay inside their intervals where it
failed by less."""
WORSE = 1.05
"""Doubtful ratio of the distances of a held-out frame from the fitted and the generic valve."""
SAME_MM = 0.5
"""Largest distance of the same closed state, as in the gate."""


def diagnostics_of(
    fit: Personalised, gate: bool | None = None, unlike: str = ""
) -> dict[str, Found]:
    """Findings for and against an estimate, for `mvest.problem.verdict.judge`; without the truth.

    Parameters
    ----------
    gate : bool, optional
        Whether its valve passed the gate; None if untested.
    unlike : str
        How the volume of the case differs from those that detectors were trained on.
    """
    result, filtered, strange = fit.result, fit.result.filtered, implausible_values(fit.case)
    ended = f"{result.reason} ({result.detail})" if result.detail else result.reason
    estimated = filtered is not None and result.estimate is not None
    seen: dict[str, Found] = {
        "failed": texts("" if estimated else ended or "the run gives no reason"),
        "unfinished": texts(ended) if estimated and not result.converged else (),
        "mistakes": texts(*(str(value) for value in strange if value.mistake)),
        "implausible": texts(*(str(value) for value in strange if not value.mistake)),
        "unlike": texts(unlike),
        "unaccounted": texts(*fit.unaccounted),
    }
    if fit.calibration.stale or fit.calibration.calibration is not None:
        seen["calibration"] = texts(fit.calibration.why)
    if filtered is None or not estimated:
        return seen
    if (check := filtered.check) is not None:
        far = check.value > APPROXIMATION * check.limit
        seen["approximation"] = texts(check.sentence if far else "")
    values = {
        "moved": fit.moved,
        "law": fit.law_share,
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
        correlation = _neighbour_correlation(result.observation, filtered.standardised)
        if correlation is not None:
            seen["correlation"] = [(abs(correlation), {"correlation": correlation})]
    alone = {one["parameter"]: one["prior_stds"] for one in fit.details.get("data_alone", ())}
    for key, sizes in (("stretch", _stretch(fit, filtered)), ("data_alone", alone)):
        if sizes:
            seen[key] = [(abs(size), {"what": what}) for what, size in sizes.items()]
    held = []
    for one in fit.frames:
        if not one.seen:
            generic, fitted = (
                float(np.nanmean(one.distances[name])) for name in ("registered", "personalised")
            )
            words: dict[str, object] = {"frame": one.frame.name}
            held.append((fitted - WORSE * generic, words | {"generic": generic, "fitted": fitted}))
    if held:
        seen["held_out"] = held
    closed = fit.case.frame(Role.CLOSED)
    observed = free_orifice(fit.case, closed)
    for one in fit.frames:
        if one.frame is closed and observed is not None:
            free = free_orifice(fit.case, closed, one.positions["personalised"])
            if free is not None:
                seen["closure"] = [(free - observed, {"fitted": free, "observed": observed})]
    return seen


def _stretch(fit: Personalised, filtered: Estimate) -> dict[str, float]:
    """Prior -> its displacement by the data in standard deviations."""
    prior, after = to_filter(filtered.transform, filtered.prior), filtered.transformed
    moved = dict(zip(filtered.names, ((after.mean - prior.mean) / prior.std).tolist(), strict=True))
    if filtered.learned is not None:
        # Errors smaller than stated contradict nothing.
        moved |= {
            f"{q.name} of the errors": q.stretch if q.name == LENGTH else max(q.stretch, 0.0)
            for q in filtered.learned.quantities
        }
    shifts = fit.details.get("geometry", ())
    return moved | {f"{own['name']} of the valve": own["stretch"] for own in shifts}


def _neighbour_correlation(observation: Observed, standardised: FloatArray) -> float | None:
    """Largest covariance of neighbours in the standardised innovation, over the coordinates.

    Moran's I (`moran`), in units of the stated variance if the actual one is smaller.
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
    statistics = [
        moran(column, neighbours) * min(1.0, float(np.var(column))) if np.ptp(column) else 0.0
        for column in values.T
    ]
    return float(max(statistics, key=abs))
