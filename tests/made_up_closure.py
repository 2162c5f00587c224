"""A case whose closure is a formula, for fast tests of everything around a closure.

Every unknown moves the leaflets by a smooth field, pressure over stiffness as a belly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.closure.frames import ERROR, OFFSET
from mvest.estimation import Prediction
from mvest.estimation.noise import ErrorColumns
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation import PersonaliseSettings, Prior
from mvest.personalisation.geometry import GeometryModes
from mvest.personalisation.sources import LAW, ErrorSource
from mvest.problem.registration import REGISTRATION, displace
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

COLUMNS, ROWS = 32, 9
WIDE = {
    "leaflets.posterior.length": 20.0,
    "leaflets.indentation": 0.0,
    "leaflets.scallop_bulge": 0.0,
    "free_edge.posterior_opening": 8.0,
}
"""A valve for a smooth formula, which closes no narrow orifice and bends no short leaflet."""

TEMPLATE = Template(TemplateParameters().changed(WIDE))
VALVE = TEMPLATE.valve(COLUMNS, ROWS)
MESH = structured_mesh(TEMPLATE, "hex18", 8, 1)
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
MECHANICS = MechanicsSettings(TISSUE, ClosureProtocol(pressure_mmHg=120.0))
PRESSURE = 100.0
"""mmHg of the closed frame."""

TRUE = {
    "E_f.anterior": 5.1,
    "E_f.posterior": 2.6,
    "pressure_scale": 1.07,
    "chord_stiffness": 0.85,
    "chord_rest_length": 1.012,
    "shift.x": 0.6,
    "shift.y": -0.4,
    "shift.z": 0.9,
    "turn.x": 1.7,
    "turn.y": -1.1,
    "turn.z": 2.3,
}
PRIORS = {
    "E_f.anterior": (6.23, 3.1),
    "E_f.posterior": (2.09, 1.05),
    "pressure_scale": (1.0, 0.1),
    "chord_stiffness": (1.0, 0.2),
    "chord_rest_length": (1.0, 0.02),
    **{name: (0.0, 1.0 if name.startswith("shift") else 2.0) for name in REGISTRATION},
}


def unknowns(fixed: bool = False, **means: float) -> tuple[Prior, ...]:
    """The moduli estimated, everything else estimated or fixed."""
    return tuple(
        Prior(name, means.get(name, mean), std, fixed and not name.startswith("E_f."))
        for name, (mean, std) in PRIORS.items()
    )


def settings(*given: Prior, **changes: Any) -> PersonaliseSettings:
    """Settings with some unknowns, all of them estimated if none are given; errors as stated."""
    return PersonaliseSettings(given or unknowns(), MECHANICS, **{"errors": None} | changes)


def _fields() -> dict[str, np.ndarray]:
    """Directions ``(n, 3)`` in which the leaflets are moved."""
    column = np.arange(COLUMNS * ROWS) % COLUMNS
    s = np.arange(COLUMNS * ROWS) // COLUMNS / (ROWS - 1)
    phi = 2 * np.pi * column / COLUMNS
    belly = 4 * s * (1 - s) * np.abs(np.sin(phi))
    up = np.array([0.0, 0.0, 1.0])
    return {
        "E_f.anterior": np.outer(belly * (phi < np.pi), up),
        "E_f.posterior": np.outer(0.5 * belly * (phi > np.pi), up),
        "stretch": np.outer(s**2 * np.cos(phi) ** 2, -up),
        "loose": np.outer(s * (1 - s) * np.cos(phi), np.array([0.0, 1.0, 0.5])),
        "length": np.outer(s**3, np.array([0.3, 1.0, -1.0])),
    }


FIELDS = _fields()
BELOW = np.clip(-VALVE.surface.vertices[:, 2:] / 20.0, 0.0, 1.0)
BASE = VALVE.surface.vertices * (
    1.0 - np.array([0.008, 0.064, 0.0]) - BELOW * np.array([0.1, 0.3, 0.1])
)


def shape(values: dict[str, float], pressure: float = PRESSURE) -> np.ndarray:
    """Closed positions ``(n, 3)`` mm under a pressure in mmHg."""
    p = values.get("pressure_scale", 1.0) * pressure / PRESSURE
    k, length = values.get("chord_stiffness", 1.0), values.get("chord_rest_length", 1.0)
    x = BASE + sum(
        12.0 * p / values[name] * FIELDS[name] for name in ("E_f.anterior", "E_f.posterior")
    )
    x = x + 1.5 * p / k * FIELDS["stretch"] + 8.0 * p * FIELDS["loose"]
    return x + 25.0 * (length - 1.0) * FIELDS["length"]


@dataclass(eq=False)
class MadeUpClosure:
    """Stands for a ``ClosureModel``; ``calls`` counts its predictions, ``states`` what was held."""

    names: tuple[str, ...]
    fixed: dict[str, float] = field(default_factory=dict)
    continuation: bool = True
    repeat: bool = False
    guide: None = None
    on_step: Any = None
    fails_above: float = np.inf
    calls: list[np.ndarray] = field(default_factory=list)
    states: list[HeldState] = field(default_factory=list)
    valve = VALVE
    contact_valve = VALVE
    mesh = MESH
    settings = MECHANICS
    closed = None
    contact_reach_mm = 1.5

    def restart(self, closed: Any) -> None:
        """Nothing is remembered."""

    def _values(self, m: np.ndarray) -> dict[str, float]:
        return {**self.fixed, **dict(zip(self.names, map(float, m), strict=True))}

    def _jacobian(self, m: np.ndarray, pressure: float) -> np.ndarray:
        columns = []
        for k in range(len(m)):
            # The formula is smooth: central differences are exact to nine digits.
            h = 1e-5 * m[k] * np.eye(len(m))[k]
            up, down = (shape(self._values(m + step), pressure) for step in (h, -h))
            columns.append(((up - down) / (2 * h[k])).ravel())
        return np.stack(columns, axis=1)

    def __call__(self, m: np.ndarray) -> Prediction:
        self.calls.append(np.array(m))
        values = self._values(m)
        if values["E_f.anterior"] > self.fails_above:
            return Prediction.failed("no equilibrium")
        jacobian = self._jacobian(m, PRESSURE)
        rest = VALVE.surface.vertices
        return Prediction(
            np.concatenate([rest.ravel(), shape(values).ravel()]),
            np.concatenate([np.zeros_like(jacobian), jacobian]),
        )

    def predict_held(self, m: np.ndarray, states: Sequence[HeldState]) -> list[Prediction]:
        """The closed frame by the formula, and those under other loads, with derivatives."""
        whole = self(m)
        if not whole.converged:
            return [whole]
        half = len(whole.y) // 2
        parts = [replace(whole, y=whole.y[half:], jacobian=whole.jacobian[half:])]
        for at, state in zip(self.held(m, states), states, strict=True):
            parts.append(Prediction(at.ravel(), self._jacobian(m, state.pressure_mmHg)))
        return parts

    def held(self, m: np.ndarray, states: Sequence[HeldState]) -> list[np.ndarray]:
        """The formula under other pressures; it is carried along with the annulus."""
        self.states += states
        lifts = [(state.annulus - CLOSED_ANNULUS).mean(axis=0) for state in states]
        return [
            shape(self._values(m), state.pressure_mmHg) + lift
            for state, lift in zip(states, lifts, strict=True)
        ]


CLOSED_ANNULUS = VALVE.motion.annulus[-1]
HELD_ANNULUS = CLOSED_ANNULUS + np.array([0.1, -0.2, 0.5])


def made_up_case(
    std_mm: float = 0.01,
    correlation_length_mm: float = 0.0,
    noise: np.random.Generator | None = None,
    corresponds: bool = True,
    displaced: bool = True,
) -> ValveCase:
    """A case that the formula predicts exactly at ``TRUE``, apart from noise of ``std_mm``."""
    surface, motion = VALVE.surface, VALVE.motion
    registration = displaced * np.array([TRUE[name] for name in REGISTRATION])
    centre = CLOSED_ANNULUS.mean(axis=0)
    lift = (HELD_ANNULUS - CLOSED_ANNULUS).mean(axis=0)

    def frame(
        name: str, time: float, role: Role, pressure: float, x: np.ndarray, annulus: np.ndarray
    ) -> Frame:
        if role is not Role.REFERENCE:
            x = displace(x, registration, centre)
            if noise is not None:
                x = x + std_mm * noise.standard_normal(x.shape)
        tips = VALVE.papillary_tips if role is Role.REFERENCE else motion.papillary_tips[-1]
        return Frame(
            name, time, role, pressure, x, surface.triangles, surface.region, annulus,
            x[VALVE.free_edge], tips, corresponds or role is Role.REFERENCE,
        )  # fmt: skip

    return ValveCase(
        name="made_up",
        description="A valve by a formula.",
        source="tests",
        licence="MIT",
        simulated=True,
        surface=surface,
        annulus=VALVE.annulus,
        free_edge=VALVE.free_edge,
        frames=(
            frame("open", 0.0, Role.REFERENCE, 0.0, surface.vertices, motion.annulus[0]),
            frame("closed", 0.3, Role.CLOSED, PRESSURE, shape(TRUE), CLOSED_ANNULUS),
            frame("late", 0.4, Role.HELD_OUT, 70.0, shape(TRUE, 70.0) + lift, HELD_ANNULUS),
        ),
        chordae=VALVE.chordae,
        uncertainty=Uncertainty(std_mm, correlation_length_mm),
    )


def use(monkeypatch: Any, **changes: Any) -> list[MadeUpClosure]:
    """Let ``personalise`` build the formula instead of a closure; the models it builds.

    It has no geometry and no law that could be in doubt, and no tissue.
    """
    built: list[MadeUpClosure] = []

    def build(case: ValveCase, wanted: PersonaliseSettings, store: Any = None) -> MadeUpClosure:
        other = (*REGISTRATION, OFFSET, ERROR)
        own = [u for u in wanted.unknowns if not u.name.startswith(other)]
        free = tuple(u.name for u in own if not u.fixed)
        fixed = {u.name: u.mean for u in own if u.fixed}
        built.append(MadeUpClosure(free, fixed, **changes))
        return built[-1]

    monkeypatch.setattr("mvest.personalisation.estimation.build_model", build)
    monkeypatch.setattr("mvest.personalisation.design.build_model", build)
    monkeypatch.setattr("mvest.personalisation.design.build_coarse", build)
    monkeypatch.setattr("mvest.personalisation.chain.closed_details", lambda *_: {})
    monkeypatch.setattr("mvest.personalisation.design.closed_details", lambda *_: {})
    monkeypatch.setattr("mvest.personalisation.errors.geometry_modes", lambda *_: ())
    monkeypatch.setattr("mvest.personalisation.errors.law_and_mesh_sources", lambda *_: ())
    return built


def error_source(rows: np.ndarray, modes: GeometryModes | None = None) -> ErrorSource:
    """An error of the geometry, or of the law, that moves the closed valve by ``rows (3 n, q)``."""
    name, factor = (LAW, 1.0) if modes is None else (modes.name, modes.factor)
    moved = rows.reshape(-1, 3, rows.shape[1])
    moves = np.stack([np.zeros_like(moved), moved])
    return ErrorSource(ErrorColumns(name, rows, factor), rows, moves, modes)
