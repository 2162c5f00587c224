"""What a personalised case shows of how far it may be believed."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_array
from scipy.spatial import cKDTree

from mvest.cases.case import Role
from mvest.cases.plausibility import doubts, free_orifice
from mvest.estimation.check import ApproximationCheck
from mvest.estimation.evidence import LENGTH
from mvest.estimation.information.consistency import moran
from mvest.estimation.transform import to_filter
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.personalisation.errors import WeighedObservation
from mvest.personalisation.result import Personalised
from mvest.problem.estimate import Observed
from mvest.problem.verdict import APPROXIMATION, Held, Indications
from mvest.typing import FloatArray

NEIGHBOURS = 6
"""Of a point that was seen, as on a surface of triangles."""
SAME_MM = 0.5
"""Largest distance at which a valve that was closed anew is the same, as of the gate."""


def indications_of(fit: Personalised, gate: bool | None = None) -> Indications:
    """What speaks for and against the estimate of a case; nothing of it needs the truth.

    Parameters
    ----------
    fit : Personalised
    gate : bool, optional
        Whether its valve has passed the gate, if it was asked.
    """
    result, closed = fit.result, fit.case.frame(Role.CLOSED)
    found = doubts(fit.case)
    mistakes = tuple(str(doubt) for doubt in found if doubt.mistake)
    doubtful = tuple(str(doubt) for doubt in found if not doubt.mistake)
    filtered = result.filtered
    if filtered is None or result.estimate is None:
        ended = f"{result.reason} ({result.detail})" if result.detail else result.reason
        return Indications(
            estimated=False,
            ended=ended,
            mistakes=mistakes,
            doubts=doubtful,
            unaccounted=fit.unaccounted,
        )
    prior, after = to_filter(filtered.transform, filtered.prior), filtered.transformed
    moved = dict(zip(filtered.names, ((after.mean - prior.mean) / prior.std).tolist(), strict=True))
    if filtered.learned is not None:
        # Errors smaller than believed contradict nothing.
        moved |= {
            f"{q.name} of the errors": q.stretch if q.name == LENGTH else max(q.stretch, 0.0)
            for q in filtered.learned.quantities
        }
    moved |= {f"{own.name} of the valve": own.stretch for own in fit.known.geometry}
    innovation = filtered.innovation
    return Indications(
        estimated=True,
        ended=f"{result.reason} ({result.detail})" if result.detail else result.reason,
        converged=result.converged,
        approximation=_approximation(filtered.check),
        nis=None if innovation is None else innovation.nis / innovation.size,
        nis_band=None
        if innovation is None
        else (
            innovation.nis_band[0] / innovation.size,
            innovation.nis_band[1] / innovation.size,
        ),
        stretch=moved,
        data_alone={one.parameter: one.prior_stds for one in fit.known.data_alone},
        alike=None
        if filtered.standardised is None or result.observation is None
        else _alike(result.observation, filtered.standardised),
        held_out=tuple(
            Held(
                one.frame,
                float(np.nanmean(one.registered)),
                float(np.nanmean(one.personalised)),
            )
            for one in fit.distances
            if not one.seen
        ),
        orifice_mm2=free_orifice(fit.case, closed, fit.fitted[closed.name])
        if closed.name in fit.fitted
        else None,
        observed_orifice_mm2=free_orifice(fit.case, closed),
        again=None if fit.confirmed_mm is None else fit.confirmed_mm <= SAME_MM,
        gate=gate,
        moved=fit.moved,
        law=fit.known.law_share,
        unaccounted=fit.unaccounted,
        mistakes=mistakes,
        doubts=doubtful,
    )


def _approximation(check: ApproximationCheck | None) -> str | None:
    """What is wrong with the filter's own approximation, if it is much; None if not checked."""
    if check is None:
        return None
    return "" if check.value <= APPROXIMATION * check.limit else check.sentence


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
        moran(column, neighbours).statistic * min(1.0, float(np.var(column))) for column in values.T
    ]
    return float(max(statistics, key=abs))
