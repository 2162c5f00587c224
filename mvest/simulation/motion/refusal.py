"""Which simulated motions are refused, and why: they would teach what no valve does."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.imaging.moving_valve import MovingValve
from mvest.quantities import Count, Factor, Place
from mvest.valve.geometry.proximity import intersecting_triangles
from mvest.valve.geometry.triangles import surface_edges
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import orifice_area


class Refusal(Enum):
    """Why a motion is refused."""

    NOT_CLOSED = "the closure does not converge"
    NOT_HELD = "the closed valve is not held at a lower pressure"
    LEAKS = "the closed valve leaves too much of its orifice open"
    APART = "the free edges of the closed valve do not lie at each other"
    FLAILS = "the free edge of the closed valve lies above its annulus"
    STRETCHED = "a leaflet is stretched too far"
    CROSSED = "leaflets pass through each other"


class RefusedError(GeometryError):
    """A motion that is refused.

    Attributes
    ----------
    reason : Refusal
    """

    def __init__(self, name: str, reason: Refusal, detail: str) -> None:
        super().__init__(f"simulated valve {name}: {reason.value} ({detail})")
        self.reason = reason


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What is refused. The values are choices.

    Attributes
    ----------
    orifice : float
        Share of the open valve's orifice that midsurfaces may leave open in the closed one. A
        closed valve leaves some 5 %, as midsurfaces keep a thickness apart; a tethered one more.
    edge_gap : float
        mm between the free edges of the closed valve, the median over its middle half. Where a
        leaflet has closed first and holds the other one below it, they stay some 9 mm apart;
        otherwise 1 to 5 mm.
    edge_height : float
        mm by which the free edge of the closed valve may rise above its annulus plane.
    stretch : float
        Length of an edge of the layout over its length in the open valve; at most one edge in a
        hundred may be longer.
    crossings : int
        Pairs of intersecting triangles in any frame. The layout is finer than contact is sampled.
    """

    orifice: Factor = 0.15
    edge_gap: Place = 7.0
    edge_height: Place = 0.0
    stretch: Factor = 1.6
    crossings: Count = 4

    def __post_init__(self) -> None:
        if not (
            self.orifice > 0 and self.edge_gap > 0 and self.stretch > 1 and self.crossings >= 0
        ):
            raise InputError(
                f"limits of a motion {self}: expected orifice, edge_gap > 0, stretch > 1, "
                "crossings >= 0"
            )


def check_motion(valve: MovingValve, closed: int, limits: MotionLimits) -> None:
    """Refuse a valve beyond its limits.

    Parameters
    ----------
    valve : MovingValve
        Its first frame is the open one.
    closed : int
        Number of the closed frame.
    limits : MotionLimits

    Raises
    ------
    RefusedError
    """
    layout, name = valve.layout, valve.name
    edges = surface_edges(layout.triangles)
    lengths = np.linalg.norm(
        valve.vertices[:, edges[:, 0]] - valve.vertices[:, edges[:, 1]], axis=2
    )
    stretch = float(np.quantile(lengths[1:] / lengths[0], 0.99, axis=1).max())
    if stretch > limits.stretch:
        raise RefusedError(name, Refusal.STRETCHED, f"{stretch:.2f} times its length")
    for k, vertices in enumerate(valve.vertices):
        crossings = len(intersecting_triangles(vertices, layout.triangles))
        if crossings > limits.crossings:
            raise RefusedError(
                name, Refusal.CROSSED, f"{crossings} pairs of triangles in frame {k}"
            )
    areas, plane = [], None
    for frame in (0, closed):
        vertices = valve.vertices[frame]
        annulus = vertices[layout.annulus]
        plane = annulus_plane(annulus, valve.tips[frame].mean(axis=0), annulus[layout.column(90)])
        areas.append(orifice_area(vertices, layout.triangles, annulus, plane, 0.3))
    if areas[1] > limits.orifice * areas[0]:
        raise RefusedError(
            name, Refusal.LEAKS, f"{areas[1]:.0f} of {areas[0]:.0f} mm2 are left open"
        )
    edge = valve.vertices[closed][layout.free_edge]
    middle = np.arange(layout.columns // 8, 3 * layout.columns // 8 + 1)
    gap = float(np.median(np.linalg.norm(edge[middle] - edge[-middle], axis=1)))
    if gap > limits.edge_gap:
        raise RefusedError(name, Refusal.APART, f"{gap:.1f} mm apart")
    assert plane is not None
    height = -float(plane.coordinates(edge)[:, 2].min())
    if height > limits.edge_height:
        raise RefusedError(name, Refusal.FLAILS, f"by {height:.1f} mm")
