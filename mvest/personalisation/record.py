"""The record of a personalised case, and the arrays that its report draws.

`EstimateRecord.details` of a case holds plain rows by name, for reports and tables. Names without
rows are missing. Lengths are in mm, intervals hold 95 %.

============== ==================================================================================
name           columns of a row
============== ==================================================================================
about          (one row) description, source, licence, sha256, regions, derived, implausible,
               confirmed_mm (largest distance of the fitted closed valve from the one closed anew),
               law_share (estimated position of the tissue between the linear law and an
               exponential one), error_samples (their number)
settings       setting, value
check          (one row) compared, value, limit: `mvest.estimation.check.ApproximationCheck`
errors         name, unit (empty: a factor), believed, believed_low, believed_high, learned, low,
               high, stretch: errors of the closed frame, as stated and as learned
geometry       name, unit, size, stretch: estimated errors of the geometry by kind
               (`mvest.personalisation.known.geometry_shifts`)
known          name, unit, estimate, low, high, generic: derived quantities
data_alone     parameter, estimate, low, high, prior_stds: moduli without their priors
shares         source, parameter, share: sources of the variance of a modulus' logarithm
narrower       what, parameter, std_now, std_if_known: SD of the logarithm of a modulus
measurements   frame, shape (observed, generic or personalised), and one column for each of
               `mvest.valve.measure.clinical.clinical_measurements`
physiology     columns of `mvest.closure.physiology.Row`: the closed valve at the estimate
resistance     part, of, and one column (%) for each of `mvest.mechanics.resistance.WAYS`: by which
               tissue it resists, and where the information on the moduli comes from
calibration    (one row) measured_for, patients (0: not calibrated), why not; parameters,
               log_estimate and log_covariance before: `FoundCalibration.row`
image_step     with image_frames and pictures: `DetectedValve.details`
============== ==================================================================================
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from mvest.cases.case import Role
from mvest.cases.plausibility import implausible_values
from mvest.estimation.transform import to_filter
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.known import data_alone, derived_quantities
from mvest.personalisation.result import Personalised
from mvest.problem.estimate import StudyResult
from mvest.problem.fields import as_stored, chord_fields
from mvest.problem.record import (
    UNCALIBRATED,
    EstimateRecord,
    FrameFit,
    Numbers,
    Row,
    Spread,
    finite,
    record_of,
)
from mvest.problem.verdict import judge
from mvest.valve.measure.clinical import clinical_measurements


def record_of_case(
    fit: Personalised,
    *,
    gate: bool | None = None,
    images: Mapping[str, tuple[Row, ...]] | None = None,
) -> EstimateRecord:
    """The record of a personalised case.

    Parameters
    ----------
    gate : bool, optional
        Whether its anatomy passed the gate; None if untested.
    images : mapping, optional
        `DetectedValve.details` of the volume that the case comes from.
    """
    images, plain, fit = images or {}, fit, calibrated(fit)
    unlike = images["image_step"][0]["unlike"] if "image_step" in images else ""
    details = {**_details(fit), "calibration": _calibration(plain), **fit.details, **images}
    others, before = dict(fit.alternatives), _record(plain, plain.result)
    if fit is not plain:
        others[UNCALIBRATED] = plain.result
    return _record(fit, fit.result).model_copy(
        update={
            "iterates": before.iterates,
            "iterate_std": before.iterate_std,
            "verdict": judge(diagnostics_of(fit, gate, unlike)),
            "correlation": _correlation(fit.result),
            "frames": tuple(
                FrameFit(
                    frame=one.frame.name,
                    seen=one.seen,
                    **{model: Spread.of(values) for model, values in one.distances.items()},
                )
                for one in fit.frames
            ),
            "alternatives": {name: _record(fit, other) for name, other in others.items()},
            "details": {name: rows for name, rows in details.items() if rows},
        }
    )


def calibrated(fit: Personalised) -> Personalised:
    """The same with calibrated moduli, and what follows from them; itself without a calibration."""
    filtered, used = fit.result.filtered, fit.calibration.calibration
    if used is None or filtered is None or fit.result.estimate is None:
        return fit
    prior = to_filter(filtered.transform, filtered.prior)
    found = used.applied(filtered.names, filtered.transformed, prior)
    means = np.array(filtered.transformed_iterates)
    covariances = np.array(filtered.transformed_iterate_covariances)
    means[-1], covariances[-1] = found.mean, found.covariance
    filtered = replace(
        filtered, transformed_iterates=means, transformed_iterate_covariances=covariances
    )
    details = dict(fit.details)
    if "known" in details:
        moduli = tuple(derived_quantities(filtered))
        names = {row["name"] for row in moduli}
        others = (row for row in details["known"] if row["name"] not in names)
        details |= {"known": (*moduli, *others), "data_alone": tuple(data_alone(filtered))}
    return replace(fit, result=replace(fit.result, filtered=filtered), details=details)


def _calibration(fit: Personalised) -> tuple[Row, ...]:
    filtered = fit.result.filtered
    if filtered is None or fit.result.estimate is None:
        return ()
    prior = to_filter(filtered.transform, filtered.prior)
    row = fit.calibration.row(filtered.names, filtered.transformed, prior)
    return () if row is None else (row,)


def _record(fit: Personalised, result: StudyResult) -> EstimateRecord:
    """The record of one of a case's estimations, with the priors as stated."""
    record = record_of(result, case=fit.case.name, simulated=fit.case.simulated)
    stated = {
        own.name: {"prior_mean": own.mean, "prior_std": own.std} for own in fit.settings.unknowns
    }
    unknowns = tuple(one.model_copy(update=stated.get(one.name, {})) for one in record.unknowns)
    return record.model_copy(update={"unknowns": unknowns})


def _correlation(result: StudyResult) -> tuple[Numbers, ...]:
    """Posterior correlation of the unknowns in filter coordinates."""
    if result.filtered is None or result.estimate is None:
        return ()
    after = result.filtered.transformed
    share = after.covariance / np.outer(after.std, after.std)
    return tuple(tuple(map(finite, row)) for row in share.tolist())


def _details(fit: Personalised) -> dict[str, tuple[Row, ...]]:
    """Name -> the rows that are not in `Personalised.details`."""
    case, filtered = fit.case, fit.result.filtered
    check = None if filtered is None else filtered.check
    about: dict[str, Any] = {
        **{name: getattr(case, name) for name in ("description", "source", "licence", "sha256")},
        "regions": list(case.surface.region_names),
        "derived": list(case.derived),
        "implausible": list(map(str, implausible_values(case))),
        **{name: getattr(fit, name) for name in ("confirmed_mm", "law_share", "error_samples")},
    }
    checked = check and {name: getattr(check, name) for name in ("compared", "value", "limit")}
    return {
        "about": (about,),
        "settings": tuple(_settings("", asdict(fit.settings))),
        "check": (checked | {"value": finite(checked["value"])},) if checked else (),
        "errors": tuple(_errors(fit.result)),
        "measurements": tuple(_measurements(fit)),
    }


def _settings(name: str, value: Any) -> Iterator[Row]:
    """The settings below ``name``, one row each; the record has the unknowns, a detail the rest."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if key not in ("unknowns", "calibration"):
                yield from _settings(f"{name}.{key}" if name else key, item)
    else:
        plain = value if isinstance(value, str | int | float | None) else str(value)
        yield {"setting": name, "value": plain}


def _errors(result: StudyResult) -> Iterator[Row]:
    learned = None if result.filtered is None else result.filtered.learned
    for quantity in () if learned is None else learned.quantities:
        row: dict[str, Any] = {"name": quantity.name, "unit": "" if quantity.is_factor else "mm"}
        for name, belief in (("believed", quantity.believed), ("learned", quantity.learned)):
            prefix = "believed_" if name == "believed" else ""
            ends = zip(("low", "high"), belief.interval(), strict=True)
            row[name] = float(belief.median)
            row |= {prefix + end: float(value) for end, value in ends}
        yield row | {"stretch": float(quantity.stretch)}


def _measurements(fit: Personalised) -> Iterator[Row]:
    case, surface = fit.case, fit.case.surface
    reach = fit.settings.mechanics.contact.activation_distance * float(surface.thickness.mean())
    compared = {one.frame.name: one.positions for one in fit.frames}
    for frame in case.frames:
        shapes = {"observed": frame.vertices} if frame.corresponds else {}
        if frame.name in compared:
            shapes |= {which: compared[frame.name][which] for which in ("generic", "personalised")}
        for which, points in shapes.items():
            measured = clinical_measurements(
                points, surface, points[case.annulus], frame.papillary_tips, reach
            )
            yield {"frame": frame.name, "shape": which, **measured}


def arrays_of_case(fit: Personalised) -> dict[str, Any]:
    """The arrays (mm) that `mvest.reporting.case` draws; empty without an estimate."""
    if not fit.frames:
        return {}
    case, surface = fit.case, fit.case.surface
    frames = [one.frame for one in fit.frames]
    edge_thickness = surface.thickness[case.free_edge].mean()
    arrays: dict[str, Any] = {
        "triangles": surface.triangles,
        "region": surface.region,
        "leaflets": list(surface.region_names),
        "rest": surface.vertices,
        "annulus": case.annulus,
        "free_edge": case.free_edge,
        "frames": [frame.name for frame in frames],
        "seen": [one.seen for one in fit.frames],
        "tips": [case.frame(Role.REFERENCE).papillary_tips, *(f.papillary_tips for f in frames)],
        **chord_fields(case.chordae, surface.vertices),
        "generic": [one.positions["generic"] for one in fit.frames],
        "registered": [one.positions["registered"] for one in fit.frames],
        "fitted": [one.positions["personalised"] for one in fit.frames],
        "reach_mm": fit.settings.mechanics.contact.activation_distance * edge_thickness,
    }
    if all(frame.corresponds for frame in frames):
        arrays["observed"] = [frame.vertices for frame in frames]
        for name, model in (("generic", "generic"), ("fitted", "personalised")):
            arrays[f"distance_{name}"] = [one.distances[model] for one in fit.frames]
    else:
        arrays |= {f"observed_points_{frame.name}": frame.vertices for frame in frames}
    return as_stored(arrays)
