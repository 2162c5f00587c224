"""Chordae for a two-leaflet valve that brings none: the template's layout, in its coordinates.

The template (`mvest.valve.template`) places its chordae by an angle phi, with the commissures at 0
and 180 degrees and the anterior leaflet between them, and by s from the annulus to the free edge.
Any band has such coordinates (`mvest.valve.surface_coordinates`); here the harmonic angle is made
to fit by stretching it linearly on either side of the commissures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.cases.rims import commissures, directed
from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy import Chordae
from mvest.valve.surface_coordinates import SurfaceCoordinates, surface_coordinates
from mvest.valve.template import ChordLayout

__all__ = ["LeafletBand", "lay_out_chordae"]

FAMILIES = ("marginal", "basal")


@dataclass(frozen=True, slots=True, eq=False)
class LeafletBand:
    """A two-leaflet surface whose points can be found by the template's coordinates.

    Attributes
    ----------
    vertices : ndarray
        ``(n, 3)`` mm.
    coordinates : SurfaceCoordinates
    anterior : tuple of float
        Harmonic angle (rad) at which the anterior leaflet begins, and its width.
    """

    vertices: FloatArray
    coordinates: SurfaceCoordinates
    anterior: tuple[float, float]

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
            The coordinates fold over, or the leaflets do not each meet the annulus in one piece.
        """
        loop = directed(annulus, triangles)
        begin, end = commissures(loop, triangles, region)[anterior]
        coordinates = surface_coordinates(vertices, triangles, loop, free_edge)
        start, stop = coordinates.theta[loop[begin]], coordinates.theta[loop[end]]
        return cls(vertices, coordinates, (float(start), float(np.mod(stop - start, 2 * np.pi))))

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Corners ``(k, 3)`` and weights ``(k, 3)`` of points at phi (degrees) and s."""
        start, width = self.anterior
        turn = np.mod(phi, 360.0) / 180.0
        theta = start + np.where(
            turn <= 1.0, turn * width, width + (turn - 1.0) * (2 * np.pi - width)
        )
        triangle, weights = self.coordinates.locate(np.mod(theta, 2 * np.pi), s)
        return self.coordinates.triangles[triangle], weights

    def position(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` mm of points at phi (degrees) and s."""
        corners, weights = self.locate(phi, s)
        return _weighted(self.vertices, corners, weights)


def _weighted(vertices: FloatArray, corners: IntArray, weights: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("ka,kai->ki", weights, vertices[corners])
    return result


def lay_out_chordae(
    open_valve: LeafletBand,
    open_tips: FloatArray,
    closed_valve: LeafletBand | FloatArray,
    closed_tips: FloatArray,
    layout: ChordLayout | None = None,
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
        The closed frame: ``(n, 3)`` mm, where the vertices of the reference are in it, or a band
        with coordinates of its own if its vertices do not correspond.
    layout
        Default: the template's.

    Raises
    ------
    InputError
        There are not two papillary tips.
    """
    layout = layout or ChordLayout()
    if len(open_tips) != 2 or len(closed_tips) != 2:
        raise InputError(f"{len(open_tips)} papillary tips; the layout of chordae needs two")
    phi, s, family = _places(layout)
    corners, weights = open_valve.locate(phi, s)
    insertion = _weighted(open_valve.vertices, corners, weights)
    if isinstance(closed_valve, LeafletBand):
        closed = closed_valve.position(phi, s)
    else:
        closed = _weighted(closed_valve, corners, weights)
    reach = np.linalg.norm(insertion[:, None] - open_tips, axis=2)
    tip = np.argmin(reach, axis=1)
    slack = np.where(family == 0, layout.marginal_slack, layout.basal_slack)
    rest_length = np.maximum(
        slack * np.linalg.norm(closed - closed_tips[tip], axis=1),
        layout.open_slack * reach.min(axis=1),
    )
    stiffness = np.where(family == 0, layout.marginal_stiffness, layout.basal_stiffness)
    return Chordae(tip, insertion, family, FAMILIES, rest_length, stiffness, layout.toe_strain)


def _places(layout: ChordLayout) -> tuple[FloatArray, FloatArray, IntArray]:
    """Angle (degrees), s and family of all chordae of both halves."""
    half = [(phi, layout.marginal_s, 0) for phi in layout.marginal_phi]
    half += [(phi, s, 1) for phi, s in layout.basal]
    phi, s, family = np.array(half, dtype=np.float64).T
    return (
        np.concatenate([phi, 180.0 - phi]),
        np.tile(s, 2),
        np.tile(family, 2).astype(np.int64),
    )
