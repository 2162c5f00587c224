"""One simulated valve over a systole: closed step by step, then held under falling pressure.

The closure is that of :mod:`mvest.closure.model`, with the steps of the pressure's rise as frames.
A valve snaps shut within a small share of this rise. So frames are chosen evenly along the path of
the free edge and shown evenly over time: they look like a systole, but slower than a real closure.
After the closed frame, the valve is held at lower pressures while annulus and papillary tips return
part of their way, each in equilibrium. Motions that no valve shows are
refused, so that no detector learns from them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.valve_system import HeldState
from mvest.quantities import (
    BeatTime,
    CellsAlong,
    CellsAround,
    Count,
    Factor,
    Place,
    PointsAlong,
    PointsAround,
    Share,
)
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.proximity import closest_points, intersecting_triangles
from mvest.valve.geometry.triangles import arc_length, surface_edges
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import orifice_area
from mvest.valve.mesh.structured import structured_mesh


class RefusedError(GeometryError):
    """A motion that is refused, and why."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"simulated valve {name}: {reason}")


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Motions beyond these limits are refused. The values are choices."""

    #: Share of the open valve's orifice that midsurfaces may leave open in the closed one. A closed
    #: valve leaves some 5 %, as midsurfaces keep a thickness apart; a tethered one more.
    orifice: Factor = 0.15
    #: mm, from the free edge of the closed posterior leaflet to the anterior one, the median over
    #: its middle half. Midsurfaces that touch keep a thickness of 1 mm apart; the rest is for a
    #: tethered valve that hardly coapts. The distance between both free edges would not do: the
    #: rough zone of the longer anterior leaflet passes 7 to 12 mm below the posterior edge.
    edge_gap: Place = 3.0
    #: mm, by which the free edge of the closed valve may rise above its annulus plane.
    edge_height: Place = 0.0
    #: Length of an edge of the layout over its length in the open valve; at most one edge in a
    #: hundred may be longer.
    stretch: Factor = 1.6
    #: Pairs of intersecting triangles in any frame. The layout is finer than contact is sampled.
    crossings: Count = 4


def check_motion(valve: MovingValve, closed: int, limits: MotionLimits) -> None:
    """Raise RefusedError if a valve is beyond its limits.

    Its first frame is the open one, ``closed`` the number of the closed one.
    """
    layout = valve.layout
    edges = surface_edges(layout.triangles)
    lengths = np.linalg.norm(
        valve.vertices[:, edges[:, 0]] - valve.vertices[:, edges[:, 1]], axis=2
    )
    stretch = float(np.quantile(lengths[1:] / lengths[0], 0.99, axis=1).max())
    if stretch > limits.stretch:
        raise RefusedError(valve.name, f"a leaflet is stretched to {stretch:.2f} times its length")
    for k, vertices in enumerate(valve.vertices):
        crossings = len(intersecting_triangles(vertices, layout.triangles))
        if crossings > limits.crossings:
            raise RefusedError(
                valve.name, f"{crossings} pairs of triangles pass through each other in frame {k}"
            )
    areas = []
    for frame in (0, closed):
        vertices = valve.vertices[frame]
        annulus = vertices[layout.annulus]
        plane = annulus_plane(annulus, valve.tips[frame].mean(axis=0), annulus[layout.column(90)])
        areas.append(orifice_area(vertices, layout.triangles, annulus, plane, 0.3))
    if areas[1] > limits.orifice * areas[0]:
        raise RefusedError(
            valve.name, f"closed it leaves {areas[1]:.0f} of {areas[0]:.0f} mm2 of its orifice open"
        )
    edge = vertices[layout.free_edge]
    posterior = edge[5 * layout.columns // 8 : 7 * layout.columns // 8 + 1]
    anterior = layout.triangles[layout.region == 0]
    gap = float(np.median(closest_points(posterior, vertices, anterior).distance))
    if gap > limits.edge_gap:
        raise RefusedError(
            valve.name, f"its closed posterior edge lies {gap:.1f} mm from the anterior leaflet"
        )
    height = -float(plane.coordinates(edge)[:, 2].min())
    if height > limits.edge_height:
        raise RefusedError(
            valve.name, f"its closed free edge lies {height:.1f} mm above the annulus"
        )


GIVE_UP: dict[str, Any] = {"max_iterations": 40, "max_halvings": 3, "largest_move": 2.0}
"""Newton's method gives up a step sooner than elsewhere, because drawing another valve takes less
time than following one whose leaflets have run away."""


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """How a valve's motion is simulated and shown."""

    columns: PointsAround = 64  #: vertices of the returned layout
    rows: PointsAlong = 15
    element: str = "hex18"
    #: Cells of the mesh that is closed: that of virtual patients. On 24 x 3 cells the same valve
    #: closes 0.04 to 0.2 mm elsewhere in the mean, which reads as 13 to 24 % of a modulus.
    mesh_columns: CellsAround = 54
    mesh_rows: CellsAlong = 6
    contact_columns: PointsAround = 168  #: points at which contact is sampled
    contact_rows: PointsAlong = 38
    steps: Count = 8  #: time steps over the ramp of the pressure
    frames: Count = 8  #: from the open to the closed one, both included; at most steps + 2
    held_pressure: tuple[Share, ...] = (0.8, 0.55, 0.35)  #: of the closed frame's, in later frames
    held_relaxation: tuple[Share, ...] = (0.15, 0.35, 0.55)  #: share of the way back
    duration: BeatTime = 0.35  #: s from the first to the last frame
    limits: MotionLimits = field(default_factory=MotionLimits)

    def __post_init__(self) -> None:
        if len(self.held_pressure) != len(self.held_relaxation):
            raise InputError(
                f"held_pressure has {len(self.held_pressure)} frames, held_relaxation "
                f"{len(self.held_relaxation)}; expected as many"
            )
        if not 2 <= self.frames <= self.steps + 2:
            raise InputError(
                f"frames = {self.frames} to the closed one, expected 2 to {self.steps + 2} of "
                f"{self.steps} steps"
            )


@dataclass(frozen=True, slots=True, eq=False)
class DrawnValve:
    """A valve before it is closed."""

    name: str
    template: Template
    #: Parameter -> true value: the moduli ``E_f.REGION`` in MPa, and any of the factors
    #: ``pressure_scale``, ``chord_stiffness`` and ``chord_rest_length``.
    values: Mapping[str, float]
    mechanics: MechanicsSettings  #: with the stated pressure
    #: (2, 3) mm, displacement of the papillary tips from the closed to the open valve.
    tip_motion: FloatArray = field(default_factory=lambda: np.zeros((2, 3)))

    def sampled(self, columns: int, rows: int) -> Valve:
        """The valve on ``columns x rows`` vertices; its tips move while it closes."""
        valve = self.template.valve(columns, rows)
        motion, end = valve.motion, valve.motion.papillary_tips[-1]
        tips = end + (1.0 - motion.phase)[:, None, None] * self.tip_motion
        moving = replace(motion, papillary_tips=tips)
        return replace(valve, papillary_tips=end + self.tip_motion, motion=moving)


def close_in_motion(drawn: DrawnValve, settings: MotionSettings) -> MovingValve:
    """Close a valve, hold it, and return its frames; the first one is open.

    Pressure and ramp are those of the mechanics' protocol, the steps those of ``settings``.

    Raises RefusedError if it does not close, or beyond its `MotionLimits`; InputError or
    MaterialError if a value is inadmissible.
    """
    mesh = structured_mesh(
        drawn.template, settings.element, settings.mesh_columns, settings.mesh_rows
    )
    mechanics, ramp = drawn.mechanics, drawn.mechanics.protocol.ramp
    protocol = replace(
        mechanics.protocol, dt=ramp / settings.steps, growth=3.0, end=1.4 * ramp, equilibrium=True
    )
    newton = replace(mechanics.newton, **GIVE_UP)
    seen = drawn.sampled(settings.columns, settings.rows)
    model = ClosureModel(
        seen,
        drawn.sampled(settings.contact_columns, settings.contact_rows),
        mesh,
        replace(mechanics, protocol=protocol, newton=newton),
        tuple(drawn.values),
        continuation=True,
    )
    at = np.array([drawn.values[parameter] for parameter in model.names])
    simulation = model.close(at, sensitivities=False, every_frame=True).simulation
    if not simulation.converged:
        reason = simulation.reason.value
        raise RefusedError(drawn.name, f"the closure does not converge ({reason})")
    positions = np.stack([model.observed(frame) for frame in simulation.frames])
    chosen = frames_along(positions[:, seen.free_edge], settings.frames)
    phase = np.array([protocol.phase(time) for time in simulation.times[chosen]])
    start, end = seen.motion.papillary_tips
    vertices = list(positions[chosen])
    tips = list(start + phase[:, None, None] * (end - start))
    pressures = [share * protocol.pressure_mmHg for share in settings.held_pressure]
    states = held_states(model.contact_valve, pressures, settings.held_relaxation)
    for state, held in zip(states, model.held(at, states), strict=True):
        if held is None:
            raise RefusedError(
                drawn.name, f"closed it has no equilibrium under {state.pressure_mmHg:.0f} mmHg"
            )
        vertices.append(held)
        tips.append(state.papillary_tips)
    layout, count = ValveLayout(settings.columns, settings.rows), len(vertices)
    places = drawn.template.chord_places()
    valve = MovingValve(
        name=drawn.name,
        layout=layout,
        times=settings.duration * np.arange(count) / (count - 1),
        vertices=np.stack(vertices),
        tips=np.stack(tips),
        thickness=drawn.template.thickness(layout.phi, layout.s),
        chord_phi=np.mod(places.phi, 360.0),
        chord_s=places.s,
        chord_tip=places.tip[: len(places.phi)],
    )
    check_motion(valve, settings.frames - 1, settings.limits)
    return valve


def held_states(
    valve: Valve,
    pressures_mmHg: Iterable[float],
    relaxations: Iterable[float],
    lift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[HeldState]:
    """The states of a valve that returns part of its way from the closed to the open shape.

    Each has a pressure, and the share of the way (relaxation) that annulus and tips have gone back.
    The states have the valve's annulus. ``lift`` is a further displacement of the tips (mm) per
    unit of relaxation.
    """
    annulus, tips = valve.motion.annulus, valve.motion.papillary_tips
    return [
        HeldState(
            pressure,
            annulus[-1] + back * (annulus[0] - annulus[-1]),
            tips[-1] + back * (np.array(lift) + (tips[0] - tips[-1])),
        )
        for pressure, back in zip(pressures_mmHg, relaxations, strict=True)
    ]


def frames_along(points: FloatArray, count: int) -> IntArray:
    """Choose ``count`` frames (2 to f), the first and the last among them, evenly along a path.

    The length of the path of ``points (f, k, 3)`` mm is that of their mean displacements.
    """
    path = arc_length(points).mean(axis=1)
    total, last = len(path), 0
    chosen = [0]
    for k in range(1, count - 1):
        # No frame twice, and enough of them left.
        allowed = np.arange(last + 1, total - (count - 1 - k))
        last = int(allowed[np.argmin(np.abs(path[allowed] - path[-1] * k / (count - 1)))])
        chosen.append(last)
    return np.array([*chosen, total - 1], dtype=np.int64)


def chord_ratios(drawn: DrawnValve, valve: MovingValve, closed: int) -> dict[str, FloatArray]:
    """Family -> true rest lengths of its chordae over the distance of their ends, closed.

    `mvest.cases.tissue` lays chordae out by these ratios. The moving valve is the drawn one,
    ``closed`` the number of its closed frame.
    """
    stated = drawn.template.valve(valve.layout.columns, valve.layout.rows)
    surface, chordae = stated.surface, stated.chordae
    place = closest_points(chordae.insertion, surface.vertices, surface.triangles)
    ends = place.interpolate(valve.vertices[closed], surface.triangles)
    away = np.linalg.norm(ends - valve.tips[closed][chordae.end_tip], axis=1)
    ratio = drawn.values["chord_rest_length"] * chordae.along(chordae.rest_length) / away
    return {
        name: ratio[chordae.family[: len(ratio)] == family]
        for family, name in enumerate(chordae.family_names)
    }
