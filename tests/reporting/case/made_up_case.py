"""A case as a run stores it, made up: no physics, only shapes and numbers that look like a valve's.

The template valve closes along parabolas whose belly is deeper the softer the leaflet and the
higher the pressure, and whose edge sinks with longer chordae. Distances, sensitivities and
innovations are those of this formula, so that they fit each other; they say nothing about valves.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np

from mvest.valve.anatomy.template import Template

COLUMNS, ROWS = 40, 12
NOISE_MM = 0.4
TRUTH = {"E_f.anterior": 6.2, "E_f.posterior": 2.1, "chord_slack": 0.03, "pressure": 104.0}
GENERIC = {"E_f.anterior": 3.0, "E_f.posterior": 4.0, "chord_slack": 0.0, "pressure": 100.0}
FITTED = {"E_f.anterior": 5.8, "E_f.posterior": 2.2, "chord_slack": 0.026, "pressure": 100.0}


def closed_shape(m: dict[str, float], late: float = 0.0) -> np.ndarray:
    """Closed positions ``(n, 3)`` mm by a made-up formula; ``late`` raises the belly further."""
    rest = Template().valve(COLUMNS, ROWS).surface.vertices
    column, row = np.arange(len(rest)) % COLUMNS, np.arange(len(rest)) // COLUMNS
    s, phi = row / (ROWS - 1), 360.0 * column / COLUMNS
    start, edge = rest[column], rest[column + (ROWS - 1) * COLUMNS]
    u = np.clip(edge[:, 0] / 15.5, -1, 1)
    side = np.where(phi < 180, 0.3, -0.3) * np.sqrt(1 - 0.98 * u**2)
    drop = -10.5 - 3.0 * u**2 - 60.0 * m["chord_slack"] * (1 - u**2)
    end = np.stack([13.5 * u, 1.8 - 6.5 * (1 - u**2) + side, drop], axis=1)
    middle = end * [1, 1, 0] + np.stack([0 * u, 0 * u, -3.0 - 1.5 * u**2], axis=1)
    line = (1 - s)[:, None] ** 2 * start + (2 * s * (1 - s))[:, None] * middle
    line += s[:, None] ** 2 * end
    stiffness = np.where(phi < 180, m["E_f.anterior"], m["E_f.posterior"])
    belly = 4 * s * (1 - s) * np.abs(np.sin(np.deg2rad(phi)))
    line[:, 2] += belly * (m["pressure"] / 100.0 + late) * 4.0 / np.sqrt(stiffness)
    return line


def arrays(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What ``fields.npz`` holds."""
    valve = Template().valve(COLUMNS, ROWS)
    lates = (0.0, 0.25)
    truth = np.stack([closed_shape(TRUTH, late) for late in lates])
    generic = np.stack([closed_shape(GENERIC, late) for late in lates])
    fitted = np.stack([closed_shape(FITTED, late) for late in lates])
    observed = truth + rng.normal(0.0, NOISE_MM, truth.shape)
    # A corner of the image: these were not seen.
    observed[:, :4] = np.nan
    columns = []
    for name, value in FITTED.items():
        h = 1e-4 * max(abs(value), 1e-2)
        up, down = FITTED | {name: value + h}, FITTED | {name: value - h}
        columns.append((closed_shape(up) - closed_shape(down)) / (2 * h))
    insertion = [
        int(np.argmin(np.linalg.norm(valve.surface.vertices - p, axis=1)))
        for p in valve.chordae.insertion
    ]
    return {
        "triangles": valve.surface.triangles,
        "region": valve.surface.region,
        "rest": valve.surface.vertices,
        "annulus": valve.annulus,
        "free_edge": valve.free_edge,
        "frames": np.array(["closed", "late"]),
        "seen": np.array([True, False]),
        "observed": observed,
        "generic": generic,
        "registered": generic + np.array([0.0, 0.1, 0.2]),
        "fitted": fitted,
        "truth": truth,
        "distance_generic": np.linalg.norm(generic - observed, axis=2),
        "distance_fitted": np.linalg.norm(fitted - observed, axis=2),
        "tips": np.repeat(valve.papillary_tips[None], 3, axis=0),
        "chord_tip": valve.chordae.tip,
        "chord_insertion": np.array(insertion),
        "sensitivity": np.stack(columns, axis=-1),
        "innovation": (observed[0] - generic[0]) / (1.5 * NOISE_MM),
    }


def _parameter(
    name: str, label: str, unit: str, treatment: str, prior: tuple[float, float], std: float
) -> dict[str, Any]:
    estimate = FITTED[name] if treatment == "estimated" else prior[0]
    return {
        "name": name,
        "label": label,
        "unit": unit,
        "kind": "modulus" if name.startswith("E_") else "nuisance",
        "treatment": treatment,
        "prior_mean": prior[0],
        "prior_std": prior[1],
        "estimate": estimate,
        "std": std,
        "low": estimate - 1.96 * std,
        "high": estimate + 1.96 * std,
        "truth": TRUTH[name],
    }


PARAMETERS = [
    _parameter("E_f.anterior", "E_f anterior", "MPa", "estimated", (4.0, 2.0), 0.8),
    _parameter("E_f.posterior", "E_f posterior", "MPa", "estimated", (3.0, 1.5), 0.3),
    _parameter("chord_slack", "slack of the chordae", "", "estimated", (0.0, 0.02), 0.008),
    _parameter("pressure", "pressure", "mmHg", "considered", (100.0, 5.0), 5.0),
]


def _spread(distance: np.ndarray) -> dict[str, float]:
    known = distance[np.isfinite(distance)]
    return {"mean": float(known.mean()), "std": float(known.std()), "max": float(known.max())}


def _record(fields: dict[str, np.ndarray]) -> dict[str, Any]:
    parameters = copy.deepcopy(PARAMETERS)
    alone = copy.deepcopy(parameters[:2])
    for p in alone:
        half = 0.4 * (p["high"] - p["low"]) / 2
        p |= {"estimate": p["estimate"] - 0.3, "std": 0.4 * p["std"]}
        p |= {"low": p["estimate"] - half, "high": p["estimate"] + half}
    registered = np.linalg.norm(fields["registered"] - fields["observed"], axis=2)
    to_truth = np.linalg.norm(fields["fitted"] - fields["truth"], axis=2)
    shape = {
        "ap_diameter_mm": 26.4,
        "commissural_diameter_mm": 35.7,
        "annulus_height_mm": 6.5,
        "annulus_area_mm2": 748.0,
        "tenting_volume_mm3": 2210.0,
        "coaptation_length_mm": None,
    }
    return {
        "title": "A made-up valve",
        "case": {
            "name": "made_up",
            "description": "A valve by a formula, for tests of the report.",
            "source": "tests",
            "licence": "MIT",
            "simulated": True,
            "derived": ["Thickness of the leaflets: taken from the literature."],
            "sha256": "ef" * 32,
        },
        "status": "converged",
        "reason": "the change of every parameter is below the tolerance",
        "region_names": ["anterior", "posterior"],
        "parameters": parameters,
        "moduli": [
            {"region": region, "name": "E_f"}
            | {key: parameters[k][key] for key in ("estimate", "low", "high", "truth")}
            for k, region in enumerate(("anterior", "posterior"))
        ],
        "without_nuisances": {"parameters": alone},
        "distances": [
            {
                "frame": frame,
                "seen": bool(fields["seen"][k]),
                "generic": _spread(fields["distance_generic"][k]),
                "registered": _spread(registered[k]),
                "personalised": _spread(fields["distance_fitted"][k]),
                "to_truth": _spread(to_truth[k]),
            }
            for k, frame in enumerate(("closed", "late"))
        ],
        "iterates": [[4.0, 3.0, 0.0], [5.2, 2.4, 0.02], [5.7, 2.2, 0.025], [5.8, 2.2, 0.026]],
        "iterate_std": [[2.0, 1.5, 0.02], [1.0, 0.4, 0.01], [0.8, 0.3, 0.008], [0.8, 0.3, 0.008]],
        "objective": [920.0, 340.0, 301.0, 300.2],
        "innovation": {
            "size": 1428,
            "rms": 1.02,
            "nis": 1485.0,
            "nis_band": [1325.0, 1535.0],
            "tests": [
                {"name": "Kolmogorov–Smirnov", "statistic": 0.03, "p_value": 0.21, "verdict": "ok"},
                {"name": "runs", "statistic": -0.4, "p_value": 0.69, "verdict": "ok"},
            ],
        },
        "identifiability": {
            "cramer_rao_std": [0.9, 0.32, 0.009],
            "condition_number": 48.0,
            "flat": [],
            "confounded": [
                {
                    "parameters": ["E_f.anterior", "chord_slack"],
                    "changes": [0.58, -0.0031],
                    "relative": [0.1, -0.031],
                    "correlation": 0.9578,
                }
            ],
            "shares": [
                {
                    "parameter": "E_f.anterior",
                    "from": {"chord_slack": 0.42, "pressure": 0.2, "noise": 0.38},
                },
                {
                    "parameter": "E_f.posterior",
                    "from": {"chord_slack": 0.1, "pressure": 0.6, "noise": 0.3},
                },
            ],
            "observation_std_mm": NOISE_MM,
        },
        "narrow": [
            {
                "what": "E_f anterior, if the pressure were known",
                "std_now": 0.8,
                "std_if_known": 0.71,
            },
            {
                "what": "E_f anterior, if the chordae were known",
                "std_now": 0.8,
                "std_if_known": 0.5,
            },
        ],
        "measurements": {
            "open": {"observed": shape | {"annulus_area_mm2": 801.0}},
            "closed": {
                "observed": shape,
                "generic": shape | {"tenting_volume_mm3": 1840.0},
                "personalised": shape | {"tenting_volume_mm3": 2190.0},
            },
        },
        "gate": "closed anew from the open valve it differs by at most 0.089 mm",
        "settings": {"filter": {"name": "iterated", "tolerance": 1e-4}, "seeds": [1, 2]},
        "provenance": {
            "git": {"sha": "0123456789abcdef" * 2 + "01234567", "dirty": False},
            "versions": {"mvest": "0.1.0"},
            "config_hash": "cd" * 32,
            "mesh_hash": "ab" * 32,
            "seconds": 61.2,
            "memory_mb": 812.0,
            "finished": "2025-01-31T12:00:00+00:00",
        },
    }


def made_up_case(folder: Path) -> tuple[dict[str, Any], Path]:
    """Write ``fields.npz`` into a folder; returns the record that goes with it, and its path."""
    fields = arrays(np.random.default_rng(1))
    path = folder / "fields.npz"
    np.savez(path, **fields)
    return _record(fields), path
