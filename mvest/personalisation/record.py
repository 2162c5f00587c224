"""The record of a personalised case, and the arrays that its report draws.

`EstimateRecord.details` of a case holds plain rows by name, for the report and for tables. A name
whose rows were not computed is missing. Lengths are in mm, intervals hold 95 %.

============== ==================================================================================
name           columns of a row
============== ==================================================================================
about          (one row) description, source, licence, sha256, regions, derived, implausible,
               confirmed_mm (largest distance of the fitted closed valve from the one closed anew),
               law_share (how far the tissue is expected to be on its way from the linear law to an
               exponential one), error_samples (how many entered)
settings       setting, value
check          (one row) compared, value, limit: `mvest.estimation.check.ApproximationCheck`
errors         name, unit (empty: a factor), believed, believed_low, believed_high, learned, low,
               high, stretch: what was learned of the errors of the closed frame
geometry       name, unit, size, stretch: `mvest.personalisation.result.GeometryShift`
known          name, unit, estimate, low, high, generic: what follows from the estimate
               (`mvest.personalisation.known.Quantity`)
data_alone     parameter, estimate, low, high, prior_stds: moduli without their priors
shares         source, parameter, share: where the variance of a modulus' logarithm comes from
narrower       what, parameter, std_now, std_if_known: SD of the logarithm of a modulus
measurements   frame, shape (observed, generic or personalised), and one column for each of
               `mvest.valve.measure.clinical.clinical_measurements`
image_step     with image_frames and pictures: `DetectedValve.details`
============== ==================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Role
from mvest.cases.plausibility import implausible_values
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.result import FrameDistance, Personalised
from mvest.problem.estimate import StudyResult
from mvest.problem.fields import as_stored
from mvest.problem.record import (
    EstimateRecord,
    FrameFit,
    Numbers,
    Row,
    Spread,
    finite,
    record_of,
)
from mvest.problem.registration import label_of
from mvest.problem.verdict import judge
from mvest.typing import FloatArray
from mvest.valve.measure.clinical import clinical_measurements

Rows = tuple[Row, ...]


def record_of_case(
    fit: Personalised,
    *,
    gate: bool | None = None,
    images: Mapping[str, Rows] | None = None,
) -> EstimateRecord:
    """The record of a personalised case.

    Parameters
    ----------
    fit : Personalised
    gate : bool, optional
        Whether its anatomy has passed the gate; None if that was not tested.
    images : mapping, optional
        What `DetectedValve.details` states of the volume that the case is from.
    """
    result, images = fit.result, images or {}
    others = {"moduli_only": fit.moduli_only, "paper": fit.paper}
    unlike = images["image_step"][0]["unlike"] if "image_step" in images else ""
    details = {name: tuple(rows) for name, rows in _details(fit).items()} | dict(images)
    return _record(fit, result).model_copy(
        update={
            "verdict": judge(diagnostics_of(fit, gate, unlike)),
            "correlation": _correlation(result),
            "frames": tuple(map(_frame_fit, fit.distances)),
            "alternatives": {
                name: _record(fit, other) for name, other in others.items() if other is not None
            },
            "details": {name: rows for name, rows in details.items() if rows},
        }
    )


def _record(fit: Personalised, result: StudyResult) -> EstimateRecord:
    """The record of one of a case's estimations, with its priors as they were stated."""
    record = record_of(result, case=fit.case.name, simulated=fit.case.simulated)
    stated = {
        own.name: {"prior_mean": own.mean, "prior_std": own.std} for own in fit.settings.unknowns
    }
    unknowns = tuple(one.model_copy(update=stated.get(one.name, {})) for one in record.unknowns)
    return record.model_copy(update={"unknowns": unknowns})


def _correlation(result: StudyResult) -> tuple[Numbers, ...]:
    """Of the errors of the estimates, in the coordinates of the filter."""
    if result.filtered is None or result.estimate is None:
        return ()
    after = result.filtered.transformed
    share = after.covariance / np.outer(after.std, after.std)
    return tuple(tuple(map(finite, row)) for row in share.tolist())


def _frame_fit(distance: FrameDistance) -> FrameFit:
    models = {
        name: Spread.of(getattr(distance, name))
        for name in ("generic", "registered", "personalised")
    }
    return FrameFit(frame=distance.frame, seen=distance.seen, **models)


def _details(fit: Personalised) -> dict[str, Iterable[Row]]:
    """Name -> rows; see the head of this module."""
    case, known, filtered = fit.case, fit.known, fit.result.filtered
    check = None if filtered is None else filtered.check
    about = {
        "description": case.description,
        "source": case.source,
        "licence": case.licence,
        "sha256": case.sha256,
        "regions": list(case.surface.region_names),
        "derived": list(case.derived),
        "implausible": list(map(str, implausible_values(case))),
        "confirmed_mm": fit.confirmed_mm,
        "law_share": known.law_share,
        "error_samples": fit.error_samples,
    }
    checked = check and {
        "compared": check.compared,
        "value": finite(check.value),
        "limit": check.limit,
    }
    return {
        "about": [about],
        "settings": _settings("", fit.settings),
        "check": [checked] if checked else [],
        "errors": _errors(fit.result),
        "geometry": map(asdict, known.geometry),
        "known": map(asdict, known.quantities),
        "data_alone": map(asdict, known.data_alone),
        "narrower": (
            asdict(row) | {"what": f"{label_of(row.parameter)}, {row.what}"}
            for row in known.narrower
        ),
        "shares": (asdict(row) | {"source": label_of(row.source)} for row in known.shares),
        "measurements": _measurements(fit),
    }


def _settings(name: str, value: Any) -> Iterator[Row]:
    """The settings below ``name``, a row each; unknowns are in the record itself."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        for key, item in value.items():
            if key != "unknowns":
                yield from _settings(f"{name}.{key}" if name else key, item)
    else:
        plain = value if isinstance(value, str | int | float | None) else str(value)
        yield {"setting": name, "value": plain}


def _errors(result: StudyResult) -> Iterator[Row]:
    learned = None if result.filtered is None else result.filtered.learned
    for quantity in () if learned is None else learned.quantities:
        low, high = quantity.learned.interval()
        before = quantity.believed.interval()
        yield {
            "name": quantity.name,
            "unit": "" if quantity.is_factor else "mm",
            "believed": float(quantity.believed.median),
            "believed_low": float(before[0]),
            "believed_high": float(before[1]),
            "learned": float(quantity.learned.median),
            "low": float(low),
            "high": float(high),
            "stretch": float(quantity.stretch),
        }


def _measurements(fit: Personalised) -> Iterator[Row]:
    case, surface = fit.case, fit.case.surface
    reach = fit.settings.mechanics.contact.activation_distance * float(surface.thickness.mean())
    for frame in case.frames:
        shapes: dict[str, FloatArray] = {}
        if frame.corresponds:
            shapes["observed"] = frame.vertices
        for which, positions in (("generic", fit.generic), ("personalised", fit.fitted)):
            if frame.name in positions:
                shapes[which] = positions[frame.name]
        for which, points in shapes.items():
            yield {
                "frame": frame.name,
                "shape": which,
                **clinical_measurements(
                    points, surface, points[case.annulus], frame.papillary_tips, reach
                ),
            }


def arrays_of_case(fit: Personalised) -> dict[str, Any]:
    """The arrays (mm) that `mvest.reporting.case` draws; empty without an estimate."""
    if not fit.distances:
        return {}
    case, surface = fit.case, fit.case.surface
    by_name = {frame.name: frame for frame in case.frames}
    frames = [by_name[distance.frame] for distance in fit.distances]
    edge_thickness = surface.thickness[case.free_edge].mean()
    arrays: dict[str, Any] = {
        "triangles": surface.triangles,
        "region": surface.region,
        "rest": surface.vertices,
        "annulus": case.annulus,
        "free_edge": case.free_edge,
        "frames": [frame.name for frame in frames],
        "seen": [distance.seen for distance in fit.distances],
        "tips": [case.frame(Role.REFERENCE).papillary_tips, *(f.papillary_tips for f in frames)],
        "chord_tip": case.chordae.tip,
        "chord_insertion": cKDTree(surface.vertices).query(case.chordae.insertion)[1],
        "generic": [fit.generic[frame.name] for frame in frames],
        "registered": [fit.registered[frame.name] for frame in frames],
        "fitted": [fit.fitted[frame.name] for frame in frames],
        "reach_mm": fit.settings.mechanics.contact.activation_distance * edge_thickness,
    }
    if not all(frame.corresponds for frame in frames):
        arrays |= {f"observed_points_{frame.name}": frame.vertices for frame in frames}
        return as_stored(arrays)
    arrays["observed"] = [frame.vertices for frame in frames]
    if fit.settings.correspondence:
        arrays["distance_generic"] = [distance.generic for distance in fit.distances]
        arrays["distance_fitted"] = [distance.personalised for distance in fit.distances]
    return as_stored(arrays)
