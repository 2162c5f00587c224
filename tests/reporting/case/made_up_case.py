"""A case as a run stores it, made up: no physics, only shapes and numbers that look like a valve's.

The template valve closes along parabolas whose belly is deeper the softer the leaflet and the
higher the pressure, and whose edge sinks with longer chordae. Distances fit this formula.
"""

from pathlib import Path
from typing import Any

import numpy as np

from mvest.estimation.estimate import InnovationSummary
from mvest.estimation.information.identifiability import TradeOff
from mvest.problem.fields import chord_fields
from mvest.problem.record import EstimateRecord, FrameFit, Spread, Unknown
from mvest.valve.anatomy.template import Template

COLUMNS, ROWS = 40, 12
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
    truth, generic, fitted = (
        np.stack([closed_shape(m, late) for late in (0.0, 0.25)]) for m in (TRUTH, GENERIC, FITTED)
    )
    observed = truth + rng.normal(0.0, 0.4, truth.shape)
    observed[:, :4] = np.nan  # a corner that was not seen
    x = valve.surface.vertices
    return {
        "triangles": valve.surface.triangles,
        "region": valve.surface.region,
        "rest": x,
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
        **chord_fields(valve.chordae, x),
    }


def _unknown(
    name: str, label: str, unit: str, prior: tuple[float, float], std: float | None, by: float = 0.0
) -> Unknown:
    """An unknown that is fixed without a standard deviation, and else found ``by`` too high."""
    found = None if std is None else FITTED[name] + by
    return Unknown(
        name=name,
        label=label,
        unit=unit,
        kind="modulus" if name.startswith("E_") else "nuisance",
        treatment="fixed" if std is None else "estimated",
        prior_mean=prior[0],
        prior_std=prior[1],
        estimate=found,
        std=std,
        low=None if found is None else found - 1.96 * std,
        high=None if found is None else found + 1.96 * std,
        truth=TRUTH[name],
    )


UNKNOWNS = (
    _unknown("E_f.anterior", "E_f anterior", "MPa", (4.0, 2.0), 0.8),
    _unknown("E_f.posterior", "E_f posterior", "MPa", (3.0, 1.5), 0.3),
    _unknown("chord_slack", "slack of the chordae", "", (0.0, 0.02), 0.008),
    _unknown("pressure", "pressure", "mmHg", (100.0, 5.0), None),
)
ALONE = (
    _unknown("E_f.anterior", "E_f anterior", "MPa", (4.0, 2.0), 0.32, -0.3),
    _unknown("E_f.posterior", "E_f posterior", "MPa", (3.0, 1.5), 0.12, -0.3),
)


def _frame(fields: dict[str, np.ndarray], k: int, frame: str) -> FrameFit:
    models = {"generic": "generic", "registered": "registered", "personalised": "fitted"}
    off = {
        f"{name}{end}": Spread.of(np.linalg.norm(fields[shape][k] - fields[what][k], axis=1))
        for name, shape in models.items()
        for end, what in (("", "observed"), ("_to_truth", "truth"))
    }
    return FrameFit(frame=frame, seen=bool(fields["seen"][k]), **off)


ABOUT = {
    "description": "A valve by a formula, for tests of the report.",
    "source": "tests",
    "licence": "MIT",
    "sha256": "ef" * 32,
    "regions": ["anterior", "posterior"],
    "derived": ["Thickness of the leaflets: taken from the literature."],
    "implausible": [],
    "confirmed_mm": 0.089,
    "law_share": None,
}
ANTERIOR = {"parameter": "E_f.anterior", "std_now": 0.8}
SHAPE = {
    "ap_diameter_mm": 26.4,
    "commissural_diameter_mm": 35.7,
    "tenting_volume_mm3": 2210.0,
    "coaptation_length_mm": None,
}
DETAILS = {
    "about": (ABOUT,),
    "errors": (
        {"name": "rough part", "unit": "mm", "stretch": 0.5}
        | {"believed": 0.12, "believed_low": 0.014, "believed_high": 1.03}
        | {"learned": 0.205, "low": 0.198, "high": 0.212},
    ),
    "narrower": (
        {"what": "E_f anterior, if the pressure were known", "std_if_known": 0.71} | ANTERIOR,
        {"what": "E_f anterior, if the chordae were known", "std_if_known": 0.5} | ANTERIOR,
    ),
    "shares": (
        {"source": "thickness", "parameter": "E_f.anterior", "share": 0.6},
        {"source": "pressure (factor)", "parameter": "E_f.anterior", "share": 0.395},
        {"source": "fibres", "parameter": "E_f.anterior", "share": 0.005},
    ),
    "known": (
        {"name": "ratio of E_f anterior to posterior", "unit": "", "generic": 2.98}
        | {"estimate": 2.6, "low": 2.3, "high": 3.0},
    ),
    "measurements": (
        {"frame": "open", "shape": "observed", **SHAPE},
        {"frame": "closed", "shape": "generic", **SHAPE, "tenting_volume_mm3": 1840.0},
    ),
    "physiology": (
        {"quantity": "membrane strain", "part": "anterior", "value": -0.9, "unit": "%", "p5": -3.6}
        | {"p95": 1.2, "low": None, "high": None, "source": "", "mark": ""},
        {"quantity": "tenting height", "part": "valve", "value": 9.3, "unit": "mm", "p5": None}
        | {"p95": None, "low": 4.0, "high": 6.0, "source": "echo", "mark": "outside"},
        {"quantity": "closed gap", "part": "valve", "value": 0.0, "unit": "mm²", "p5": None}
        | {"p95": None, "low": None, "high": 0.0, "source": "none", "mark": "inside"},
    ),
    "resistance": (
        {"part": "anterior", "of": "information on E_f", "tension": 1.2, "bending": 98.8},
    ),
    "settings": ({"setting": "tolerance", "value": 1e-4},),
}


def _record(fields: dict[str, np.ndarray]) -> EstimateRecord:
    alone = EstimateRecord(status="converged", reason="converged", unknowns=ALONE)
    return EstimateRecord(
        case="made_up",
        simulated=True,
        status="converged",
        reason="the change of every parameter is below the tolerance",
        unknowns=UNKNOWNS,
        alternatives={"moduli_only": alone},
        frames=tuple(_frame(fields, k, frame) for k, frame in enumerate(("closed", "late"))),
        innovation=InnovationSummary(
            size=1428, rms=1.02, max_abs=3.1, nis=1485.0, nis_band=(1325.0, 1535.0)
        ),
        condition_number=48.0,
        confounded=(
            TradeOff(
                parameters=("E_f.anterior", "chord_slack"),
                changes=(0.58, -0.0031),
                relative=(0.1, -0.031),
                correlation=0.9578,
            ),
        ),
        details=DETAILS,
    )


LINE = "own_valve: mvest 0.1.0, commit 0123456789ab, configuration cdcdcdcdcdcd"
PROVENANCE = {
    "git": {"sha": "0123456789abcdef" * 2 + "01234567", "dirty": False},
    "versions": {"mvest": "0.1.0"},
    "config_hash": "cd" * 32,
}


def made_up_case(folder: Path) -> tuple[EstimateRecord, Path]:
    """Write ``fields.npz`` into a folder; returns the record that goes with it, and its path."""
    fields = arrays(np.random.default_rng(1))
    path = folder / "fields.npz"
    np.savez(path, **fields)
    return _record(fields), path


CHOICES = ("kind", "treatment", "status", "trust", "shape", "name", "parameters")
"""Texts by which a page or a record decides something."""


def poisoned(value: Any, attack: str, key: str = "") -> Any:
    """Plain data in which every text ends in an attack, except those of `CHOICES`."""
    if isinstance(value, dict):
        return {k: poisoned(v, attack, k) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(poisoned(v, attack, key) for v in value)
    return value + attack if isinstance(value, str) and key not in CHOICES else value


def poisoned_record(record: EstimateRecord, attack: str, **details: Any) -> EstimateRecord:
    """The record with an attack at the end of every text, and with further details."""
    plain = poisoned(record.model_dump(mode="json"), attack)
    plain["details"] |= details
    return EstimateRecord.model_validate(plain)
