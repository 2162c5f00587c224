"""Plain data and arrays of a personalised case."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy import sparse

from experiments.common.estimate_record import make_record
from mvest.cases.case import Role
from mvest.estimation.information.consistency import moran, zero_mean
from mvest.personalise.result import Personalised
from mvest.problem.estimate import StudyResult
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import surface_edges
from mvest.valve.measure.clinical import clinical_measurements

__all__ = ["case_record", "fields_of", "of_all_unknowns"]


LABELS = {
    "pressure_scale": "pressure (factor)",
    "chord_stiffness": "chordal stiffness (factor)",
    "chord_rest_length": "chordal rest length (factor)",
}

Values = Mapping[str, Any]


def case_record(
    config: Values, fit: Personalised, config_hash: str, started: float
) -> dict[str, Any]:
    """Plain data of a personalised case, what it hides excluded."""
    case, result = fit.case, fit.result
    record = make_record(
        result,
        {**config, "filter": {**config["filter"], "initial": fit.prior.mean.tolist()}},
        config_hash=config_hash,
        meshes={
            "sha256": fit.mesh.sha256,
            "nodes": len(fit.mesh.nodes),
            "elements": len(fit.mesh.elements),
        },
        closure=None,
        truth_values=None,
        started=started,
    )
    unknowns = _unknowns(fit, result, fit.names)
    innovation = record["innovation"]
    if innovation is not None:
        innovation = {**innovation, "tests": _whiteness(fit)}
    of_all = {key: record[key] for key in ("iterates", "iterate_std", "identifiability")}
    if of_all["identifiability"] is not None:
        of_all["identifiability"]["observation_std_mm"] = case.uncertainty.typical_mm
    # What every study's record tells is the moduli; ``unknowns`` tells all.
    record = _of_moduli(record)
    return record | {
        "row": case.name,
        "of_all_unknowns": of_all,
        "case": {
            "name": case.name,
            "description": case.description,
            "source": case.source,
            "licence": case.licence,
            "simulated": case.simulated,
            "derived": list(case.derived),
            "sha256": case.sha256,
            "regions": list(case.surface.region_names),
        },
        "model": {
            "element": fit.mesh.element_type,
            "cells": [fit.settings.mesh.columns, fit.settings.mesh.rows, 1],
            "source": fit.settings.mesh.source,
            "filter": "iterated",
            "noise_mm": case.uncertainty.typical_mm,
        },
        "data": {"citation": case.source, "sha256": case.sha256},
        "unknowns": unknowns,
        "moduli": _moduli(fit, unknowns),
        "without_nuisances": _others(fit, fit.moduli_only),
        "as_in_the_paper": _others(fit, fit.paper),
        "distances": [
            {
                "frame": d.frame,
                "seen": d.seen,
                "generic": _spread(d.generic),
                "registered": _spread(d.registered),
                "personalised": _spread(d.personalised),
                "to_truth": None,
            }
            for d in fit.distances
        ],
        "objective": None
        if result.filtered is None
        else [v if np.isfinite(v) else None for v in result.filtered.objective.tolist()],
        "innovation": innovation,
        "narrow": _narrow(fit),
        "image_errors": _image_errors(fit),
        "measurements": _measurements(fit),
        "confirmed_mm": fit.confirmed_mm,
        "gate": None
        if fit.confirmed_mm is None
        else f"closed anew from the open valve it differs by at most {fit.confirmed_mm:.2g} mm",
        "settings": {
            "personal": dict(config["personal"]),
            "mechanics": dict(config["mechanics"]),
        },
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "parts_s": dict(fit.seconds),
    }


def of_all_unknowns(record: Values) -> dict[str, Any]:
    """A record whose parameters are all unknowns, and not the moduli alone."""
    distances = [
        row if row["to_truth"] is None else {**row, "to_truth": row["to_truth"]["personalised"]}
        for row in record["distances"]
    ]
    return {
        **record,
        **record["of_all_unknowns"],
        "title": record["case"]["description"] or record["case"]["name"],
        "parameters": record["unknowns"],
        "distances": distances,
    }


def _of_moduli(record: dict[str, Any]) -> dict[str, Any]:
    """A record of the moduli among its parameters."""
    kept = [k for k, name in enumerate(record["parameters"]) if name.startswith("E_f.")]

    def part(values: list[Any] | None) -> list[Any] | None:
        return None if values is None else [values[k] for k in kept]

    out = dict(record)
    for key in ("parameters", "initial", "estimate", "std"):
        out[key] = part(record[key])
    for key in ("iterates", "iterate_std"):
        out[key] = None if record[key] is None else [part(row) for row in record[key]]
    if record["identifiability"] is not None:
        bound = part(record["identifiability"]["cramer_rao_std"])
        out["identifiability"] = {**record["identifiability"], "cramer_rao_std": bound}
    return out


def fields_of(fit: Personalised) -> dict[str, Any]:
    """The arrays of the report, mm."""
    case, surface = fit.case, fit.case.surface
    frames = [d.frame for d in fit.distances]
    by_name = {frame.name: frame for frame in case.frames}
    seen = [by_name[name] for name in frames]
    reference = case.frame(Role.REFERENCE)
    arrays: dict[str, Any] = {
        "triangles": surface.triangles.astype(np.int32),
        "region": surface.region.astype(np.int8),
        "rest": surface.vertices.astype(np.float32),
        "annulus": case.annulus.astype(np.int32),
        "free_edge": case.free_edge.astype(np.int32),
        "frames": np.array(frames),
        "seen": np.array([d.seen for d in fit.distances]),
        "tips": np.stack(
            [reference.papillary_tips, *(frame.papillary_tips for frame in seen)]
        ).astype(np.float32),
        "chord_tip": case.chordae.tip.astype(np.int32),
        "chord_insertion": np.array(
            [
                int(np.argmin(np.linalg.norm(surface.vertices - point, axis=1)))
                for point in case.chordae.insertion
            ],
            dtype=np.int32,
        ),
    }
    for name, positions in (
        ("generic", fit.generic),
        ("registered", fit.registered),
        ("fitted", fit.fitted),
    ):
        arrays[name] = np.stack([positions[frame] for frame in frames]).astype(np.float32)
    if all(frame.corresponds for frame in seen):
        arrays["observed"] = np.stack([frame.vertices for frame in seen]).astype(np.float32)
        if fit.settings.correspondence:
            arrays["distance_generic"] = np.stack([d.generic for d in fit.distances])
            arrays["distance_registered"] = np.stack([d.registered for d in fit.distances])
            arrays["distance_fitted"] = np.stack([d.personalised for d in fit.distances])
    else:
        for frame in seen:
            arrays[f"observed_points_{frame.name}"] = frame.vertices.astype(np.float32)
    filtered = fit.result.filtered
    if filtered is not None and filtered.prediction is not None:
        sensitivity = filtered.prediction.jacobian
        if sensitivity.size == surface.vertices.size * len(fit.names):
            arrays["sensitivity"] = sensitivity.reshape(-1, 3, len(fit.names)).astype(np.float32)
            if filtered.innovation is not None:
                arrays["innovation"] = filtered.innovation.standardised.reshape(-1, 3)
    return arrays


def _unknowns(
    fit: Personalised, result: StudyResult, names: tuple[str, ...]
) -> list[dict[str, Any]]:
    """What is known of each unknown before and after; intervals of 95 %."""
    about = {unknown.name: unknown for unknown in fit.settings.unknowns}
    low: FloatArray | None = None
    high: FloatArray | None = None
    if result.estimate is not None and result.filtered is not None:
        low, high = result.filtered.interval(0.95)
    rows = []
    for k, name in enumerate(names):
        unknown = about[name]
        rows.append(
            {
                "name": name,
                "label": _label(name),
                "unit": _unit(name),
                "kind": "modulus" if unknown.is_modulus else "nuisance",
                "treatment": unknown.treatment.value,
                "prior_mean": unknown.mean,
                "prior_std": unknown.std,
                "estimate": None if result.estimate is None else float(result.estimate[k]),
                "std": None if result.std is None else float(result.std[k]),
                "low": None if low is None else float(low[k]),
                "high": None if high is None else float(high[k]),
                "truth": None,
            }
        )
    return rows


def _moduli(fit: Personalised, unknowns: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All moduli that follow from the estimated ones through the fixed ratios."""
    by_name = {row["name"]: row for row in unknowns}
    rows = []
    for modulus in fit.result.moduli:
        row = by_name[f"E_f.{modulus.region}"]
        share = modulus.estimate / row["estimate"]
        rows.append(
            {
                **asdict(modulus),
                "relative_error": None,
                "low": share * row["low"],
                "high": share * row["high"],
            }
        )
    return rows


def _others(fit: Personalised, result: StudyResult | None) -> dict[str, Any] | None:
    """An estimation of the moduli alone."""
    if result is None:
        return None
    filtered = result.filtered
    return {
        "status": "converged" if result.converged else "failed",
        "reason": result.reason,
        "detail": result.detail,
        "forward_solves": 0 if filtered is None else filtered.forward_solves,
        "parameters": _unknowns(fit, result, result.parameters),
        "distance_mm": None if result.distance is None else _spread(result.distance),
    }


def _whiteness(fit: Personalised) -> list[dict[str, Any]]:
    """Tests of the standardised innovation of the closed frame."""
    filtered = fit.result.filtered
    if filtered is None or filtered.innovation is None:
        return []
    standardised = filtered.innovation.standardised
    rows = [("mean zero", zero_mean(standardised))]
    surface = fit.case.surface
    if standardised.size == surface.vertices.size:
        adjacency = _adjacency(len(surface.vertices), surface.triangles)
        by_axis = standardised.reshape(-1, 3)
        rows += [
            (f"neighbours alike, {axis}", moran(by_axis[:, k], adjacency))
            for k, axis in enumerate("xyz")
        ]
    return [
        {
            "name": name,
            "statistic": test.statistic,
            "p_value": test.p_value,
            "verdict": "as white noise" if test.p_value > 0.05 else "not as white noise",
        }
        for name, test in rows
    ]


def _adjacency(n: int, triangles: IntArray) -> sparse.csr_array:
    """Which of n vertices share an edge."""
    a, b = surface_edges(triangles).T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
    return sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))


def _narrow(fit: Personalised) -> list[dict[str, Any]]:
    """How wide the interval of each modulus would be if something more were known."""
    moduli = [name for name in fit.names if name.startswith("E_f.")]
    if not fit.narrower:
        return []
    now = fit.narrower["now"]
    return [
        {
            "what": f"{_label(name)}, {what}",
            "parameter": name,
            "std_now": float(now[k]),
            "std_if_known": float(values[k]),
        }
        for what, values in fit.narrower.items()
        if what != "now"
        for k, name in enumerate(moduli)
    ]


def _image_errors(fit: Personalised) -> dict[str, Any] | None:
    """What errors of the frames that the model was built from do to the estimate."""
    if fit.geometry is None:
        return None
    moduli = [name for name in fit.names if name.startswith("E_f.")]
    share = fit.image_share
    return {
        "samples": fit.geometry.asked,
        "failures": list(fit.geometry.failures),
        "share_of_variance": None
        if share is None
        else dict(zip(moduli, map(float, share), strict=True)),
    }


def _measurements(fit: Personalised) -> dict[str, Any]:
    """Frame -> what is measured -> measurements."""
    case, surface = fit.case, fit.case.surface
    thickness = float(surface.thickness.mean())
    reach = fit.settings.mechanics.contact.activation_distance * thickness
    measured: dict[str, Any] = {}
    for frame in case.frames:
        shapes: dict[str, FloatArray] = {}
        if frame.corresponds:
            shapes["observed"] = frame.vertices
        for which, positions in (("generic", fit.generic), ("personalised", fit.fitted)):
            if frame.name in positions:
                shapes[which] = positions[frame.name]
        measured[frame.name] = {
            which: clinical_measurements(
                points, surface, points[case.annulus], frame.papillary_tips, reach
            )
            for which, points in shapes.items()
        }
    return measured


def _spread(values: FloatArray) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "max": float(np.max(values)),
    }


def _label(name: str) -> str:
    kind, _, part = name.partition(".")
    if kind == "E_f":
        return f"E_f {part}"
    if kind in ("shift", "turn"):
        return f"{kind} {'along' if kind == 'shift' else 'about'} {part}"
    return LABELS.get(name, name)


def _unit(name: str) -> str:
    kind = name.partition(".")[0]
    return {"E_f": "MPa", "shift": "mm", "turn": "degrees"}.get(kind, "")
