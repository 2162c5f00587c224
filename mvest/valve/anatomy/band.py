"""Material coordinates of a triangulated two-leaflet valve, as the template has by construction.

An imported surface has no columns and rows. Its harmonic coordinates provide both: ``s`` runs from
the annulus (0) to the free edge (1), and ``phi`` (degrees) once around the valve: 0 and 180 on the
lines between the leaflets, whatever course these take, with the first leaflet in (0, 180). Layered
meshes, contact samples and chordae can therefore be laid out on any valve as on the template.
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
"""Degrees from the line between two leaflets at which the fibre of each is read."""

NORMAL_SMOOTHING_MM = 2.0
"""mm over which normals are averaged, as the template averages its own: at the commissures the
leaflets bend with a radius of about the thickness."""

Located = tuple[IntArray, FloatArray]
"""Triangles ``(...)`` and barycentric weights ``(..., 3)`` of material points."""


class Band:
    """Material coordinates of a valve with two leaflets.

    Parameters
    ----------
    valve : Valve
        Its surface is one band between annulus and free edge, with normals to the ventricle.

    Raises
    ------
    InputError
        If the valve does not have two leaflets.
    GeometryError
        If the surface is no band, or the leaflets do not meet along two lines from annulus to free
        edge.
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
        # phi runs so that (along the leaflet) x (along phi) points to the ventricle. Triangles,
        # whose normals do so too, then run clockwise in the plane of (phi, s).
        self._sign = 1.0 if self._coordinates.clockwise else -1.0
        self._lines = self._leaflet_lines(surface)
        self._normals = leaflet_normals(surface)

    def _leaflet_lines(self, surface: LeafletSurface) -> list[FloatArray]:
        """The lines at phi = 0 and 180 as ``(k, 2)`` of s and theta.

        Theta runs as phi does, and is unwrapped along each line.
        """
        between = np.unique(edges_between(surface.triangles, surface.region))
        self._between = np.isin(np.arange(len(surface.vertices)), between)
        if not between.size:
            raise GeometryError("the two leaflets do not touch: no line between them")
        theta = np.mod(self._sign * self._coordinates.theta[between], 2 * np.pi)
        s = self._coordinates.s[between]
        # The two widest gaps of theta separate the lines.
        order = np.argsort(theta)
        gaps = np.diff(np.concatenate([theta[order], theta[order[:1]] + 2 * np.pi]))
        cuts = np.sort(np.argsort(gaps)[-2:])
        first = order[cuts[0] + 1 : cuts[1] + 1]
        lines = []
        for members in (first, np.setdiff1d(order, first)):
            along = members[np.argsort(s[members])]
            if len(along) < 2 or s[along[0]] > 1e-6 or s[along[-1]] < 1 - 1e-6:
                raise GeometryError(
                    "the leaflets do not meet along two lines from the annulus to the free edge"
                )
            angle = np.unwrap(theta[along])
            _, once = np.unique(s[along], return_index=True)
            lines.append(np.column_stack([s[along][once], angle[once]]))
        start, end = (line[0, 1] for line in lines)
        middle = start + 0.5 * np.mod(end - start, 2 * np.pi)
        triangle, _ = self._coordinates.locate(
            np.mod(self._sign * np.array([middle]), 2 * np.pi), np.array([0.5])
        )
        return lines if surface.region[triangle[0]] == 0 else lines[::-1]

    def _first_leaflet(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angle at which the first leaflet starts, and its extent, ``(k,)`` rad at ``s (k,)``."""
        zero, half = (np.interp(s, line[:, 0], line[:, 1]) for line in self._lines)
        return zero, np.mod(half - zero, 2 * np.pi)

    def locate(self, phi: FloatArray, s: FloatArray) -> Located:
        """Triangles and barycentric weights of material points, given in arrays of any shape."""
        phi, s = np.broadcast_arrays(np.asarray(phi, float), np.asarray(s, float))
        turns, flat = np.mod(phi.ravel(), 360.0) / 180.0, np.clip(s.ravel(), 0.0, 1.0)
        zero, first = self._first_leaflet(flat)
        theta = np.where(
            turns <= 1.0, zero + turns * first, zero + first + (turns - 1.0) * (2 * np.pi - first)
        )
        triangle, weights = self._coordinates.locate(np.mod(self._sign * theta, 2 * np.pi), flat)
        return triangle.reshape(phi.shape), weights.reshape(*phi.shape, 3)

    def coordinates(self) -> tuple[FloatArray, FloatArray]:
        """``phi`` (degrees) and ``s`` of the surface's vertices, ``(n,)`` each."""
        s = self._coordinates.s
        zero, first = self._first_leaflet(s)
        theta = np.mod(self._sign * self._coordinates.theta - zero, 2 * np.pi)
        phi = np.where(
            theta <= first,
            180.0 * theta / first,
            180.0 + 180.0 * (theta - first) / (2 * np.pi - first),
        )
        return np.mod(phi, 360.0), s

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(k, 3)`` mm of material points; zeta is -1 on the atrial face."""
        surface = self.valve.surface
        at = self.locate(phi, s)
        middle = _mean(at, surface, surface.vertices)
        zeta = np.broadcast_to(np.asarray(zeta, float), np.shape(phi))
        if not np.any(zeta):
            return middle
        half = 0.5 * zeta * _mean(at, surface, surface.thickness)
        return np.asarray(middle + half[..., None] * self._normal(at))

    def normal(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Unit normals ``(k, 3)`` to the ventricle, the directions of the thickness."""
        return self._normal(self.locate(phi, s))

    def _normal(self, at: Located) -> FloatArray:
        normal = _mean(at, self.valve.surface, self._normals)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(..., 3)`` as seen from the leaflet ``region``."""
        region, phi = np.asarray(region), np.mod(phi, 360.0)
        # The second leaflet ends at 360 and not at 0.
        phi = np.where((region == 1) & (phi < 90.0), 360.0, phi)
        low, high = 180.0 * region + INSIDE, 180.0 * (region + 1) - INSIDE
        surface = self.valve.surface
        triangle, weights = self.locate(np.clip(phi, low, high), s)
        corners = surface.fibre[surface.triangles[triangle]]
        # A vertex between leaflets has the fibre of one of them, and which one is unknown.
        inner = np.where(self._between[surface.triangles[triangle]], 0.0, weights)
        total = inner.sum(axis=-1, keepdims=True)
        weights = np.where(total > 1e-9, inner / np.maximum(total, 1e-9), weights)
        fibre = mean_fibre(corners, weights)
        return np.asarray(fibre / np.linalg.norm(fibre, axis=-1, keepdims=True))

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)`` mm."""
        return self.displaced(phi, s, self.valve.surface.thickness)

    def displaced(self, phi: FloatArray, s: FloatArray, vertices: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` of material points while the surface's vertices are elsewhere."""
        return _mean(self.locate(phi, s), self.valve.surface, vertices)

    def annulus_positions(self, phi: FloatArray, annulus: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` of annulus points, given those of the valve's annulus vertices.

        Parameters
        ----------
        phi : (k,) degrees
        annulus : ndarray
            ``(a, 3)`` mm, of the vertices ``valve.annulus``.
        """
        vertices = np.array(self.valve.surface.vertices)
        vertices[self.valve.annulus] = annulus
        return self.displaced(phi, np.zeros(len(phi)), vertices)

    def sampled(self, columns: int, rows: int) -> Valve:
        """The same valve, chordae and motion on a grid of ``columns x rows`` vertices."""
        valve, motion = self.valve, self.valve.motion

        def attached(phi: FloatArray) -> tuple[FloatArray, Chordae, Motion]:
            annulus = np.stack([self.annulus_positions(phi, frame) for frame in motion.annulus])
            moved = Motion(motion.phase, annulus, motion.papillary_tips)
            return valve.papillary_tips, valve.chordae, moved

        return sampled_valve(self, columns, rows, attached)


def _mean(at: Located, surface: LeafletSurface, values: FloatArray) -> FloatArray:
    """Vertex values ``(n,)`` or ``(n, 3)`` at material points."""
    triangle, weights = at
    corners = values[surface.triangles[triangle]]
    if values.ndim == 1:
        return np.asarray(np.sum(weights * corners, axis=-1))
    return np.asarray(np.einsum("...c,...ci->...i", weights, corners))


def leaflet_normals(surface: LeafletSurface) -> FloatArray:
    """Smooth unit normals ``(n, 3)`` to the ventricle, the directions of the thickness."""
    return smooth_vertex_normals(surface.vertices, surface.triangles, _rounds(surface))


def leaflet_normals_change(surface: LeafletSurface, moves: FloatArray) -> FloatArray:
    """Change ``(n, 3, q)`` 1/mm of `leaflet_normals` by displacements ``(n, 3, q)`` of vertices."""
    return smooth_normals_change(surface.vertices, surface.triangles, _rounds(surface), moves)[1]


def _rounds(surface: LeafletSurface) -> int:
    """Number of smoothing rounds over neighbours."""
    corner = surface.vertices[surface.triangles]
    edge = float(np.median(np.linalg.norm(corner[:, 1] - corner[:, 0], axis=1)))
    # The spread of a random walk grows with the root of its steps.
    return max(1, round((NORMAL_SMOOTHING_MM / edge) ** 2))
