"""A triangulated two-leaflet valve in material coordinates, as the template is by construction.

A surface from outside has no columns and rows. Its harmonic coordinates give it both: ``s`` runs
from the annulus (0) to the free edge (1), and ``phi`` in degrees once around the valve, 0 and 180
on the lines between the leaflets (whatever course they take), the first leaflet in (0, 180). So
everything that is laid out on the template (layered meshes, samples of contact, chordae) can be
laid out on any valve.
"""

from __future__ import annotations

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve, sampled_valve
from mvest.valve.geometry.surface_coordinates import SurfaceCoordinates, surface_coordinates
from mvest.valve.geometry.thickening import smooth_normals_change, smooth_vertex_normals
from mvest.valve.geometry.triangles import edges_between, mean_fibre

INSIDE = 2.0
"""Degrees from the line between two leaflets at which the fibre of either is read."""

NORMAL_SMOOTHING_MM = 2.0
"""mm, over which normals are averaged, as the template averages its own: at the commissures the
leaflets bend with a radius of about the thickness."""


class Band:
    """Material coordinates of a valve with two leaflets.

    Parameters
    ----------
    valve : Valve
        Its surface is one band between annulus and free edge, normals to the ventricle.

    Raises
    ------
    InputError
        If it has not two leaflets.
    GeometryError
        If it is no band, or the leaflets do not meet along two lines from annulus to free edge.
    """

    def __init__(self, valve: Valve) -> None:
        surface = valve.surface
        if len(surface.region_names) != 2:
            raise InputError(
                f"material coordinates of {len(surface.region_names)} leaflets "
                f"({', '.join(surface.region_names)}); expected 2"
            )
        self.valve = valve
        self.region_names = surface.region_names
        self._coordinates: SurfaceCoordinates = surface_coordinates(
            surface.vertices, surface.triangles, valve.annulus, valve.free_edge
        )
        # phi runs so that (along the leaflet) x (along phi) points to the ventricle: triangles,
        # whose normals do, are then run through clockwise in the plane of (phi, s).
        self._sign = 1.0 if self._coordinates.clockwise else -1.0
        self._lines = self._leaflet_lines(surface)
        self._normals = leaflet_normals(surface)

    def _leaflet_lines(self, surface: LeafletSurface) -> tuple[FloatArray, FloatArray]:
        """The two lines between the leaflets as ``(k, 2)`` of s and theta, that to phi = 0 first.

        theta runs as phi does, and is unwrapped about each line's beginning.
        """
        between = np.unique(edges_between(surface.triangles, surface.region))
        self._between = np.isin(np.arange(len(surface.vertices)), between)
        if not between.size:
            raise GeometryError("the two leaflets do not touch: no line between them")
        theta = np.mod(self._sign * self._coordinates.theta[between], 2 * np.pi)
        s = self._coordinates.s[between]
        # Two clusters round the valve: cut at the widest gaps.
        order = np.argsort(theta)
        gaps = np.diff(np.concatenate([theta[order], theta[order[:1]] + 2 * np.pi]))
        cuts = np.sort(np.argsort(gaps)[-2:])
        first = order[cuts[0] + 1 : cuts[1] + 1]
        second = np.setdiff1d(order, first)
        lines = []
        for members in (first, second):
            along = members[np.argsort(s[members])]
            if len(along) < 2 or s[along[0]] > 1e-6 or s[along[-1]] < 1 - 1e-6:
                raise GeometryError(
                    "the leaflets do not meet along two lines from the annulus to the free edge"
                )
            angle = np.unwrap(theta[along])
            _, once = np.unique(s[along], return_index=True)
            lines.append(np.column_stack([s[along][once], angle[once]]))
        return self._ordered(surface, lines[0], lines[1])

    def _ordered(
        self, surface: LeafletSurface, one: FloatArray, other: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The lines such that the first leaflet follows the first line in the direction of phi."""
        middle = one[0, 1] + 0.5 * np.mod(other[0, 1] - one[0, 1], 2 * np.pi)
        triangle, _ = self._coordinates.locate(
            np.mod(self._sign * np.array([middle]), 2 * np.pi), np.array([0.5])
        )
        return (one, other) if surface.region[triangle[0]] == 0 else (other, one)

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles ``(k,)`` and barycentric weights ``(k, 3)`` of material points."""
        phi = np.mod(np.asarray(phi, dtype=np.float64), 360.0)
        s = np.clip(np.asarray(s, dtype=np.float64), 0.0, 1.0)
        zero, half = (np.interp(s, line[:, 0], line[:, 1]) for line in self._lines)
        first = np.mod(half - zero, 2 * np.pi)
        theta = np.where(
            phi <= 180.0,
            zero + phi / 180.0 * first,
            zero + first + (phi / 180.0 - 1.0) * (2 * np.pi - first),
        )
        return self._coordinates.locate(np.mod(self._sign * theta, 2 * np.pi), s)

    def coordinates(self) -> tuple[FloatArray, FloatArray]:
        """``phi`` (degrees) and ``s`` of the surface's vertices, ``(n,)`` each."""
        s = self._coordinates.s
        theta = self._sign * self._coordinates.theta
        zero, half = (np.interp(s, line[:, 0], line[:, 1]) for line in self._lines)
        first = np.mod(half - zero, 2 * np.pi)
        from_zero = np.mod(theta - zero, 2 * np.pi)
        phi = np.where(
            from_zero <= first,
            180.0 * from_zero / first,
            180.0 + 180.0 * (from_zero - first) / (2 * np.pi - first),
        )
        return np.mod(phi, 360.0), s

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(k, 3)`` mm of material points; zeta is -1 on the atrial face."""
        surface = self.valve.surface
        at = self._at(phi, s)
        middle = _mean(at, surface, surface.vertices)
        zeta = np.broadcast_to(np.asarray(zeta, float), np.shape(phi))
        if not np.any(zeta):
            return middle
        normal = self._normal(at)
        half = 0.5 * zeta * _mean(at, surface, surface.thickness)
        return np.asarray(middle + half[..., None] * normal)

    def normal(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Unit normals ``(k, 3)`` towards the ventricle, along which the leaflets are thick."""
        return self._normal(self._at(phi, s))

    def _normal(self, at: tuple[IntArray, FloatArray]) -> FloatArray:
        normal = _mean(at, self.valve.surface, self._normals)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(..., 3)`` as seen from the leaflet ``region``."""
        low = np.where(region == 0, INSIDE, 180.0 + INSIDE)
        high = np.where(region == 0, 180.0 - INSIDE, 360.0 - INSIDE)
        # The end of the second leaflet is 360 and not 0.
        turned = np.where((np.asarray(region) == 1) & (np.mod(phi, 360.0) < 90.0), 360.0, phi)
        inside = np.clip(np.where(turned == 360.0, 360.0, np.mod(turned, 360.0)), low, high)
        surface = self.valve.surface
        triangle, weights = self._at(inside, s)
        corners = surface.fibre[surface.triangles[triangle]]
        # A vertex between the leaflets has the fibre of one of them, and it is not known of which.
        own = np.where(self._between[surface.triangles[triangle]], 0.0, weights)
        total = own.sum(axis=-1, keepdims=True)
        weights = np.where(total > 1e-9, own / np.maximum(total, 1e-9), weights)
        fibre = mean_fibre(corners, weights)
        return np.asarray(fibre / np.linalg.norm(fibre, axis=-1, keepdims=True))

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)`` mm."""
        return _mean(self._at(phi, s), self.valve.surface, self.valve.surface.thickness)

    def displaced(self, phi: FloatArray, s: FloatArray, vertices: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` of material points where the surface's vertices are elsewhere."""
        return _mean(self._at(phi, s), self.valve.surface, vertices)

    def annulus_positions(self, phi: FloatArray, annulus: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` of annulus points, given those of the valve's annulus vertices.

        Parameters
        ----------
        phi : ndarray
            ``(k,)`` degrees.
        annulus : ndarray
            ``(a, 3)`` mm, of the vertices ``valve.annulus``.
        """
        vertices = np.array(self.valve.surface.vertices)
        displacement = np.zeros_like(vertices)
        displacement[self.valve.annulus] = annulus - vertices[self.valve.annulus]
        at = self._at(phi, np.zeros(len(phi)))
        return _mean(at, self.valve.surface, vertices + displacement)

    def sampled(self, columns: int, rows: int) -> Valve:
        """The same valve on a grid of ``columns x rows`` vertices, chordae and motion with it."""
        valve, motion = self.valve, self.valve.motion

        def hung(phi: FloatArray) -> tuple[FloatArray, Chordae, Motion]:
            annulus = np.stack([self.annulus_positions(phi, frame) for frame in motion.annulus])
            moved = Motion(motion.phase, annulus, motion.papillary_tips)
            return valve.papillary_tips, valve.chordae, moved

        return sampled_valve(self, columns, rows, hung)

    def _at(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Triangles and weights of points in arrays of any shape."""
        phi, s = np.broadcast_arrays(np.asarray(phi, float), np.asarray(s, float))
        triangle, weights = self.locate(phi.ravel(), s.ravel())
        return triangle.reshape(phi.shape), weights.reshape(*phi.shape, 3)


def _mean(
    at: tuple[IntArray, FloatArray], surface: LeafletSurface, values: FloatArray
) -> FloatArray:
    """Values given at the vertices, at material points."""
    triangle, weights = at
    corners = values[surface.triangles[triangle]]
    if values.ndim == 1:
        return np.asarray(np.sum(weights * corners, axis=-1))
    return np.asarray(np.einsum("...c,...ci->...i", weights, corners))


def leaflet_normals(surface: LeafletSurface) -> FloatArray:
    """Smooth unit normals ``(n, 3)`` along which leaflets are thick, to the ventricle."""
    return smooth_vertex_normals(surface.vertices, surface.triangles, _rounds(surface))


def leaflet_normals_change(surface: LeafletSurface, moves: FloatArray) -> FloatArray:
    """Their change ``(n, 3, q)`` 1/mm by displacements ``(n, 3, q)`` of the surface's vertices."""
    return smooth_normals_change(surface.vertices, surface.triangles, _rounds(surface), moves)[1]


def _rounds(surface: LeafletSurface) -> int:
    """Over as many neighbours is averaged."""
    corner = surface.vertices[surface.triangles]
    edge = float(np.median(np.linalg.norm(corner[:, 1] - corner[:, 0], axis=1)))
    # The spread of a random walk grows with the root of its steps.
    return max(1, round((NORMAL_SMOOTHING_MM / edge) ** 2))
