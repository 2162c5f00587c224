"""Which part of the closed valve informs which modulus, from the sensitivities of one case.

With independent errors of standard deviation sigma, point v adds ``|m dx_v/dm|^2 / sigma^2`` to the
Fisher information on the logarithm of a modulus m. What the nuisances explain is removed by
least squares: with S = dx/dm / sigma, ``r_j = S_j - S_N (S_N' S_N + P_N^-1)^-1 S_N' S_j``, and
``r_j' S_j`` is the information on m_j that remains (Kay, Fundamentals of Statistical Signal
Processing I, 1993, chapter 3: the Schur complement of the information matrix).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lstsq
from scipy.spatial import cKDTree

from mvest.reporting.case.fields import CaseFields
from mvest.reporting.case.findings import NUISANCE, UnknownRow
from mvest.typing import FloatArray

__all__ = ["Information", "columns_of", "information", "where_words"]

ZONES = ("annular third", "belly", "third at the free edge")
"""Thirds of the way from the annulus to the free edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information on one modulus over the valve.

    Attributes
    ----------
    name, label : str
    raw : ndarray
        ``(n,)`` Fisher information on the logarithm of the modulus that each vertex adds; NaN
        where the valve was not seen.
    beyond : ndarray
        ``(n,)`` the same after removing what the nuisances explain.
    kept : float
        Share of the information that remains.
    """

    name: str
    label: str
    raw: FloatArray
    beyond: FloatArray
    kept: float


def columns_of(parameters: Sequence[UnknownRow], width: int) -> list[UnknownRow]:
    """The parameters to which ``width`` columns of a result belong; none if no choice fits."""
    for treatments in (
        ("estimated",),
        ("estimated", "considered"),
        ("estimated", "considered", "fixed"),
    ):
        chosen = [p for p in parameters if p.treatment in treatments]
        if len(chosen) == width:
            return chosen
    moduli = [p for p in parameters if p.is_modulus]
    return moduli if len(moduli) == width else []


def information(
    fields: CaseFields, parameters: Sequence[UnknownRow], std_mm: float | None
) -> list[Information]:
    """Maps of the information on each modulus; empty where sensitivities are missing.

    Parameters
    ----------
    fields : CaseFields
    parameters : sequence of UnknownRow
        In the order of the columns of ``fields.sensitivity``.
    std_mm : float, optional
        Standard deviation of an observed coordinate; without it 1 mm is taken, and the nuisances
        count as unknown beforehand.
    """
    if fields.sensitivity is None:
        return []
    columns = columns_of(parameters, fields.sensitivity.shape[2])
    n = len(fields.rest)
    seen = _seen(fields)
    S = np.where(seen[:, None, None], fields.sensitivity, 0.0).reshape(3 * n, -1)
    S = S / (1.0 if std_mm is None else std_mm)
    nuisance = [k for k, p in enumerate(columns) if p.kind == NUISANCE]
    informations = []
    for k, parameter in enumerate(columns):
        if not parameter.is_modulus or parameter.estimate is None:
            continue
        own = S[:, k] * parameter.estimate
        rest = _beyond(own, S[:, nuisance], [columns[i] for i in nuisance], std_mm)
        raw = float(own @ own)
        informations.append(
            Information(
                parameter.name,
                parameter.label,
                np.where(seen, (own.reshape(n, 3) ** 2).sum(axis=1), np.nan),
                np.where(seen, (rest.reshape(n, 3) ** 2).sum(axis=1), np.nan),
                float(rest @ own) / raw if raw > 0 else 0.0,
            )
        )
    return informations


def _beyond(
    own: FloatArray,
    nuisance: FloatArray,
    parameters: Sequence[UnknownRow],
    std_mm: float | None,
) -> FloatArray:
    """Part of a column that no combination of the nuisances, as likely beforehand, gives."""
    if not parameters:
        return own
    scale = np.array([p.prior_std or 1.0 for p in parameters])
    columns, target = nuisance * scale, own
    if std_mm is not None:
        columns = np.concatenate([columns, np.eye(len(scale))])
        target = np.concatenate([own, np.zeros(len(scale))])
    weights = lstsq(columns, target)[0]
    return own - (nuisance * scale) @ weights


def _seen(fields: CaseFields) -> Any:
    """Vertices ``(n,)`` that were observed in the closed frame."""
    for array in (fields.distance_fitted, fields.distance_generic):
        if array is not None:
            return np.isfinite(array[fields.closed])
    return np.ones(len(fields.rest), dtype=bool)


def where_words(
    fields: CaseFields, field: FloatArray, names: Sequence[str], count: int = 3
) -> list[tuple[str, float]]:
    """Parts of the valve that hold most of a field: words and shares, the largest first."""
    total = float(np.nansum(field))
    if total <= 0:
        return []
    region, zone = fields.vertex_region, _zone(fields)
    shares = []
    for r in range(int(region.max()) + 1):
        leaflet = f"{names[r]} leaflet" if r < len(names) else f"leaflet {r + 1}"
        for z, place in enumerate(ZONES):
            share = float(np.nansum(field[(region == r) & (zone == z)])) / total
            shares.append((f"{place} of the {leaflet}", share))
    return sorted(shares, key=lambda part: -part[1])[:count]


def _zone(fields: CaseFields) -> Any:
    """Third ``(n,)`` of the way from the annulus to the free edge, at rest."""
    if not len(fields.free_edge):
        return np.ones(len(fields.rest), dtype=np.int64)
    annulus = cKDTree(fields.rest[fields.annulus]).query(fields.rest)[0]
    edge = cKDTree(fields.rest[fields.free_edge]).query(fields.rest)[0]
    way = annulus / np.maximum(annulus + edge, 1e-12)
    return np.minimum((3 * way).astype(np.int64), 2)
