"""Chordae for a two-leaflet valve that brings none: the template's layout, in its coordinates.

The template (`mvest.valve.anatomy.template`) places its chordae by an angle phi, with the
commissures at 0 and 180 degrees and the anterior leaflet between them, and by s from the annulus to
the free edge. Any band has harmonic coordinates (`mvest.valve.geometry.surface_coordinates`), but
their angle is not spread along the edges as the template's is, and the leaflets' common borders are
no lines of it. So phi is the share of the arc length between the commissures, on the annulus (s =
0) and on the free edge (s = 1), and between the two the harmonic angle of a phi is linear in s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mvest.cases.rims import arc_shares, commissures, directed, loop_vector_area
from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import ChordLayout, TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Chordae
from mvest.valve.geometry.surface_coordinates import SurfaceCoordinates, surface_coordinates

FAMILIES = ("marginal", "basal")

CLOSED_DEPTH = 0.75
"""Of the free edge below the annulus, closed over open, where no closed frame is known; the
template's rises from 16.3 to 12.2 mm on average."""

SEEN_CLOSURE = replace(ChordLayout(), marginal_slack=1.007, basal_slack=0.985)
"""The template's layout by where a closed valve was seen, rather than by the closure it intends.

Under pressure a valve does not close just as intended, and its chordae are stretched: in thirty
simulated virtual patients they are 1.007 (SD from chord to chord 0.028, marginal) and 0.985 (0.023,
basal) times as long as their ends lie apart in the closed valve."""

SEEN_ON_BAND = replace(ChordLayout(), marginal_slack=1.0, basal_slack=0.966)
"""The same where a `LeafletBand` places them, basal ones up to 1.7 mm elsewhere: there chordae are
1.002 (SD 0.03, marginal) and 0.966 (0.013, basal) times as long in sixteen simulated valves."""


class Places(NamedTuple):
    """A valve whose points are found by the template's coordinates.

    Attributes
    ----------
    vertices : (n, 3) mm
    locate : callable
        phi ``(k,)`` (degrees) and s ``(k,)`` -> corners ``(k, 3)`` and weights ``(k, 3)``.
    """

    vertices: FloatArray
    locate: Callable[[FloatArray, FloatArray], tuple[IntArray, FloatArray]]


@dataclass(frozen=True, slots=True, eq=False)
class LeafletBand:
    """A two-leaflet surface whose points can be found by the template's coordinates.

    Attributes
    ----------
    vertices : ndarray
        ``(n, 3)`` mm.
    coordinates : SurfaceCoordinates
    annulus_angle, edge_angle : ndarray
        ``(2, k)`` tables of phi (degrees, 0 to 360) and the harmonic angle (rad, unwrapped) along
        the annulus and along the free edge.
    """

    vertices: FloatArray
    coordinates: SurfaceCoordinates
    annulus_angle: FloatArray
    edge_angle: FloatArray

    @classmethod
    def of(
        cls,
        vertices: FloatArray,
        triangles: IntArray,
        region: IntArray,
        annulus: IntArray,
        free_edge: IntArray,
        anterior: int,
    ) -> LeafletBand:
        """Solve for the coordinates of a band.

        Parameters
        ----------
        vertices, triangles, region
            ``(n, 3)`` mm, ``(m, 3)`` and ``(m,)``.
        annulus, free_edge
            The two boundary loops.
        anterior
            Which region is the anterior leaflet.

        Raises
        ------
        GeometryError
            The coordinates fold over, or a leaflet does not meet the annulus or the free edge in
            one piece.
        """
        around, edge = directed(annulus, triangles), directed(free_edge, triangles)
        coordinates = surface_coordinates(vertices, triangles, around, free_edge)
        pieces, of_edge = (commissures(loop, triangles, region) for loop in (around, edge))
        on_annulus = _angle_table(vertices, pieces, around, coordinates.theta, anterior)
        # The free edge runs against the annulus.
        on_edge = _angle_table(vertices, of_edge, edge, coordinates.theta, anterior, backwards=True)
        on_edge[1] += 2 * np.pi * np.round((on_annulus[1, 0] - on_edge[1, 0]) / (2 * np.pi))
        return cls(vertices, coordinates, on_annulus, on_edge)

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Corners ``(k, 3)`` and weights ``(k, 3)`` of points at phi (degrees) and s."""
        turn = np.mod(phi, 360.0)
        theta = (1 - s) * np.interp(turn, *self.annulus_angle) + s * np.interp(
            turn, *self.edge_angle
        )
        triangle, weights = self.coordinates.locate(np.mod(theta, 2 * np.pi), s)
        return self.coordinates.triangles[triangle], weights

    def position(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` mm of points at phi (degrees) and s."""
        corners, weights = self.locate(phi, s)
        return _weighted(self.vertices, corners, weights)


def _angle_table(
    vertices: FloatArray,
    pieces: dict[int, tuple[int, int]],
    loop: IntArray,
    theta: FloatArray,
    anterior: int,
    backwards: bool = False,
) -> FloatArray:
    """Phi (degrees) and harmonic angle (rad, unwrapped) ``(2, k)`` along a loop in its pieces."""
    tables = []
    for label in sorted(pieces, key=lambda piece: piece != anterior):
        positions, share = arc_shares(vertices[loop], *pieces[label])
        if backwards:
            positions, share = positions[::-1], 1.0 - share[::-1]
        start = 0.0 if label == anterior else 180.0
        tables.append((start + 180.0 * share, theta[loop[positions]]))
    phi, angle = (np.concatenate(parts) for parts in zip(*tables, strict=True))
    return np.stack([phi, np.unwrap(angle)])


def _weighted(vertices: FloatArray, corners: IntArray, weights: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("ka,kai->ki", weights, vertices[corners])
    return result


def assumed_closure(
    open_valve: LeafletBand,
    annulus: FloatArray,
    tips: FloatArray,
    closed_depth: float = CLOSED_DEPTH,
) -> FloatArray:
    """Where the vertices of a valve may be once it is closed, if only its open shape is known.

    The free edges of the two leaflets meet half-way between where they are, point by point of equal
    share between the commissures, at ``closed_depth`` of their depth below the annulus; leaflets
    follow in proportion to their coordinate s. It is not how the valve closes, but says how long
    chordae must be to let it.

    Parameters
    ----------
    open_valve
    annulus
        ``(k, 3)`` mm, in loop order.
    tips
        ``(t, 3)`` mm, on the side of the ventricle.
    closed_depth
        Of the free edge below the annulus, closed over open.

    Returns
    -------
    ndarray
        ``(n, 3)`` mm.
    """
    phi, theta = open_valve.edge_angle
    here, there = (open_valve.position(turn, np.ones(len(phi))) for turn in (phi, 360.0 - phi))
    goal = 0.5 * (here + there)
    centre, normal = annulus.mean(axis=0), loop_vector_area(annulus)
    down = normal / np.linalg.norm(normal) * np.sign((tips.mean(axis=0) - centre) @ normal)
    depth = (goal - centre) @ down
    move = goal - (1 - closed_depth) * depth[:, None] * down - here
    coordinates = open_valve.coordinates
    along = [np.interp(coordinates.theta, theta, each, period=2 * np.pi) for each in move.T]
    return np.asarray(open_valve.vertices + coordinates.s[:, None] * np.stack(along, axis=1))


def lay_out_chordae(
    open_valve: Places | LeafletBand,
    open_tips: FloatArray,
    closed_valve: LeafletBand | FloatArray,
    closed_tips: FloatArray,
    layout: ChordLayout,
) -> Chordae:
    """Place the chordae of a layout on a valve.

    Every insertion belongs to the nearer of the two tips in the reference frame. As in the
    template, a chord is as long as ``slack`` times its distance in the closed frame, and at least
    ``open_slack`` times its distance in the open one.

    Parameters
    ----------
    open_valve
        The reference frame.
    open_tips, closed_tips
        ``(2, 3)`` mm.
    closed_valve
        The closed frame: ``(n, 3)`` mm, where the vertices of the reference are in it, or a valve
        with coordinates of its own if its vertices do not correspond.
    layout
        The template's for a closed frame that is intended (`assumed_closure`), and for one that was
        seen `SEEN_CLOSURE`, or `SEEN_ON_BAND` if the valves are of that kind.

    Raises
    ------
    InputError
        There are not two papillary tips.
    """
    if len(open_tips) != 2 or len(closed_tips) != 2:
        raise InputError(f"{len(open_tips)} papillary tips; the layout of chordae needs two")
    phi, s, family, _ = Template(TemplateParameters(chordae=layout)).chord_places()
    corners, weights = open_valve.locate(phi, s)
    insertion = _weighted(open_valve.vertices, corners, weights)
    if isinstance(closed_valve, np.ndarray):
        closed = _weighted(closed_valve, corners, weights)
    else:
        closed = _weighted(closed_valve.vertices, *closed_valve.locate(phi, s))
    reach = np.linalg.norm(insertion[:, None] - open_tips, axis=2)
    tip = np.argmin(reach, axis=1)
    slack = np.where(family == 0, layout.marginal_slack, layout.basal_slack)
    rest_length = np.maximum(
        slack * np.linalg.norm(closed - closed_tips[tip], axis=1),
        layout.open_slack * reach.min(axis=1),
    )
    stiffness = np.where(family == 0, layout.marginal_stiffness, layout.basal_stiffness)
    return Chordae(tip, insertion, family, FAMILIES, rest_length, stiffness, layout.toe_strain)
