"""Hypothetical changes of the closed valve: pressure, annulus, and a clip between the edges.

Scenarios are simulated; none of them is a recommendation.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from mvest.closure.model import ClosureModel
from mvest.errors import GeometryError, InputError, require_numbers
from mvest.mechanics.forces.cables import TiedPoints
from mvest.quantities import Length, Percent, Place, Pressure, Stiffness
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Motion, Valve
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.measure.annulus import AnnulusPlane, annulus_plane, measure_annulus

NARROWEST = 0.3
"""Smallest fraction of the anteroposterior diameter that a ring may leave."""


@dataclass(frozen=True, slots=True)
class Annuloplasty:
    """A ring that narrows the annulus of the closed valve from anterior to posterior.

    Each annulus point moves along the anterior direction towards the commissural line (through the
    annulus centre, along the commissures), in proportion to its distance from the line:
    ``y -> s y``. The commissural diameter and the heights along the normal do not change.
    """

    percent: Percent  #: reduction of the anteroposterior diameter

    def __post_init__(self) -> None:
        if not 0 < self.percent < 100 * (1 - NARROWEST):
            raise InputError(
                f"annuloplasty of {self.percent} %, expected more than 0 and less than "
                f"{100 * (1 - NARROWEST):g} %"
            )


@dataclass(frozen=True, slots=True)
class Clip:
    """An edge-to-edge clip, which ties pairs of points of the two leaflets together.

    The midsurfaces are held at the distance at which contact carries its reference pressure.
    """

    #: position of its centre along the commissures (0: A2 to P2), in the reference frame
    position_mm: Place = 0.0
    width_mm: Length = 5.0  #: along the free edges
    grasp_mm: Length = 4.0  #: distance from the free edges to which the leaflets are held
    stiffness: Stiffness = 100.0  #: N/mm of each pair

    def __post_init__(self) -> None:
        if not np.isfinite(self.position_mm):
            raise InputError(f"clip at {self.position_mm} mm, expected a finite number")
        require_numbers(self, "clip", "width_mm", "grasp_mm", "stiffness")


@dataclass(frozen=True, slots=True)
class Scenario:
    """Changes of a valve; without changes it is the observed valve."""

    title: str  #: its name in a table
    #: peak transmitral pressure; None: as observed
    pressure_mmHg: Pressure | None = None
    annuloplasty: Annuloplasty | None = None
    clip: Clip | None = None

    def __post_init__(self) -> None:
        if not self.title.strip():
            raise InputError("a scenario needs a title")
        if self.pressure_mmHg is not None:
            require_numbers(self, "scenario", "pressure_mmHg")


def model_under(model: ClosureModel, scenario: Scenario) -> ClosureModel:
    """A fresh model of the same valve under a scenario; its guides change too.

    GeometryError if the scenario does not fit the valve.
    """
    changed = model.fresh()
    if changed.guide is not None:
        changed.guide = model_under(changed.guide, scenario)
    if scenario.pressure_mmHg is not None:
        protocol = replace(model.settings.protocol, pressure_mmHg=scenario.pressure_mmHg)
        changed.settings = replace(model.settings, protocol=protocol)
    if scenario.annuloplasty is not None:
        annulus = model.contact_valve.motion.annulus[-1]
        plane = plane_of(model.contact_valve, annulus)
        share = _share(model.contact_valve, plane, scenario.annuloplasty)
        changed.contact_valve = _with_ring(model.contact_valve, plane, share)
        changed.valve = _with_ring(model.valve, plane, share)
    if scenario.clip is not None:
        valve = model.contact_valve
        edge = float(valve.surface.thickness[valve.free_edge].mean())
        distance = model.settings.contact.reference_distance * edge
        ends = clip_points(valve, scenario.clip)
        changed.ties = TiedPoints(*ends, distance, scenario.clip.stiffness)
    return changed


def plane_of(valve: Valve, annulus: FloatArray) -> AnnulusPlane:
    """Plane of a valve's annulus ``(k, 3)`` mm; the first region is the anterior leaflet."""
    own = valve.surface.vertex_region[valve.annulus] == 0
    return annulus_plane(annulus, valve.papillary_tips.mean(axis=0), annulus[own].mean(axis=0))


def narrowed(annulus: FloatArray, plane: AnnulusPlane, share: float) -> FloatArray:
    """Annulus ``(k, 3)`` mm with its distances from the commissural line scaled by ``share``."""
    along = (annulus - plane.origin) @ plane.anterior
    return np.asarray(annulus + ((share - 1) * along)[:, None] * plane.anterior)


def _share(valve: Valve, plane: AnnulusPlane, ring: Annuloplasty) -> float:
    """Factor for `narrowed` that gives the annulus the required diameter in its new plane.

    The factor is nearly the ratio of the diameters, but the centre of the curve moves a little.
    """
    annulus = valve.motion.annulus[-1]
    before = measure_annulus(annulus, plane).anteroposterior_diameter
    wanted = before * (1 - ring.percent / 100)

    def excess(share: float) -> float:
        new = narrowed(annulus, plane, share)
        return measure_annulus(new, plane_of(valve, new)).anteroposterior_diameter - wanted

    return float(scipy.optimize.brentq(excess, 0.5 * NARROWEST, 1.0, xtol=1e-12))


def _with_ring(valve: Valve, plane: AnnulusPlane, share: float) -> Valve:
    """The valve with the ring: its displacement grows with the phase of the closure."""
    motion, phase = valve.motion, valve.motion.phase[:, None, None]
    narrow = np.stack([narrowed(annulus, plane, share) for annulus in motion.annulus])
    ringed = motion.annulus + phase * (narrow - motion.annulus)
    return replace(valve, motion=Motion(motion.phase, ringed, motion.papillary_tips))


SPACING_MM = 2.5
"""Largest spacing of tied pairs along the free edge."""


def clip_points(valve: Valve, clip: Clip) -> tuple[FloatArray, FloatArray]:
    """Tied points of the first and the second leaflet, ``(k, 3)`` mm in the reference frame.

    Two rows on each leaflet, at half and at full grasp from its free edge, in planes perpendicular
    to the commissural direction.

    GeometryError if the free edges do not face each other at the clip, or it grasps more leaflet
    than there is.
    """
    surface = valve.surface
    if len(surface.region_names) != 2:
        raise GeometryError(f"clip: {len(surface.region_names)} leaflets, expected 2")
    plane = plane_of(valve, surface.vertices[valve.annulus])
    count = max(2, int(np.ceil(clip.width_mm / SPACING_MM)) + 1)
    sides: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    for offset in np.linspace(-0.5, 0.5, count) * clip.width_mm + clip.position_mm:
        origin = plane.origin + offset * plane.lateral
        for region, edge in enumerate(_edge_points(valve, plane, origin)):
            own = surface.triangles[surface.region == region]
            segments, _ = plane_section(surface.vertices, own, origin, plane.lateral)
            for depth in (0.5 * clip.grasp_mm, clip.grasp_mm):
                sides[region].append(_at_distance(segments, edge, depth))
    return np.array(sides[0]), np.array(sides[1])


def _edge_points(valve: Valve, plane: AnnulusPlane, origin: FloatArray) -> list[FloatArray]:
    """Where the free edge crosses a plane across the commissures, anterior leaflet first."""
    edge = valve.surface.vertices[valve.free_edge]
    x = (edge - origin) @ plane.lateral
    after = np.roll(x, -1)
    crossed = np.flatnonzero((x >= 0) != (after >= 0))
    if len(crossed) != 2:
        raise GeometryError(
            f"clip {float((origin - plane.origin) @ plane.lateral):+.1f} mm from the middle: the "
            f"free edge lies there {len(crossed)} times, expected once on each leaflet"
        )
    share = (x[crossed] / (x[crossed] - after[crossed]))[:, None]
    points = edge[crossed] + share * (np.roll(edge, -1, axis=0)[crossed] - edge[crossed])
    anterior = (points - plane.origin) @ plane.anterior
    return [points[int(np.argmax(anterior))], points[int(np.argmin(anterior))]]


def _at_distance(segments: FloatArray, edge: FloatArray, distance: float) -> FloatArray:
    """Point ``(3,)`` of a section ``(k, 2, 3)`` at a straight distance (mm) from its free edge."""
    d = np.linalg.norm(segments - edge, axis=2) - distance
    across = np.flatnonzero((d[:, 0] < 0) != (d[:, 1] < 0))
    if len(across) == 0:
        raise GeometryError(f"clip: the leaflet ends less than {distance:g} mm from its free edge")
    k = int(across[0])
    share = d[k, 0] / (d[k, 0] - d[k, 1])
    return np.asarray(segments[k, 0] + share * (segments[k, 1] - segments[k, 0]))
