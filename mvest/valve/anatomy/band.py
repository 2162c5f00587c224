"""Material coordinates of a triangulated valve, as the template has by construction.

An imported surface has no columns and rows. Its harmonic coordinates provide both: ``s`` runs from
the annulus (0) to the free edge (1), and ``phi`` (degrees) once around the valve. Each of n
leaflets has a section of ``360 / n`` degrees between the lines to its neighbours, whatever course
these take, and the first leaflet has the first section. Layered meshes, contact samples and chordae
can therefore be laid out on any valve as on the template.
"""

import numpy as np

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve, sampled_valve
from mvest.valve.geometry.surface_coordinates import SurfaceCoordinates, surface_coordinates
from mvest.valve.geometry.thickening import smooth_normals_change, smooth_vertex_normals
from mvest.valve.geometry.triangles import connected_pieces, edges_between, mean_fibre

INSIDE = 2.0
"""Degrees from the line between two leaflets at which the fibre of each is read."""

NORMAL_SMOOTHING_MM = 3.0
"""mm over which normals are averaged, as the template averages its own: at the commissures the
leaflets bend with a radius of about the thickness. With 2 mm cells of 40 x 5 were inverted there in
five of 13 random valves, with 3 mm none; 72 x 8 in two. Wider averages make leaflets thinner."""

Located = tuple[IntArray, FloatArray]
"""Triangles ``(...)`` and barycentric weights ``(..., 3)`` of material points."""


class Band:
    """Material coordinates of a valve.

    GeometryError if the surface is no band, or the leaflets do not meet along as many lines from
    annulus to free edge, each between two neighbours.

    Parameters
    ----------
    valve : Valve
        Its surface is one band between annulus and free edge, with normals to the ventricle.

    Attributes
    ----------
    region_names : tuple of str
        Those of the valve.
    sections : tuple of int
        The leaflet, an index into ``region_names``, of each section of phi; the first one is 0. The
        leaflets may be named in any order.
    """

    def __init__(self, valve: Valve) -> None:
        surface = valve.surface
        self.given = valve
        self.region_names = surface.region_names
        self._coordinates: SurfaceCoordinates = surface_coordinates(
            surface.vertices, surface.triangles, valve.annulus, valve.free_edge
        )
        # phi runs so that (along the leaflet) x (along phi) points to the ventricle. Triangles,
        # whose normals do so too, then run clockwise in the plane of (phi, s).
        self._sign = 1.0 if self._coordinates.clockwise else -1.0
        between = edges_between(surface.triangles, surface.region)
        self._between = np.isin(np.arange(len(surface.vertices)), between)
        self._lines = self._leaflet_lines(between)
        self.sections = self._leaflets_behind(surface.region)
        first = self.sections.index(0)
        self._lines = self._lines[first:] + self._lines[:first]
        self.sections = self.sections[first:] + self.sections[:first]
        self._width = 360.0 / len(self.sections)
        self._normals = leaflet_normals(surface)

    def _leaflet_lines(self, between: IntArray) -> list[FloatArray]:
        """The lines between leaflets as ``(k, 2)`` of s and theta, in the order around the valve.

        Theta runs as phi does, and is unwrapped along each line. ``between (e, 2)`` are the edges
        on which leaflets meet. One leaflet alone begins and ends at an angle of 0.
        """
        names = self.region_names
        if len(names) == 1:
            return [np.array([[0.0, 0.0], [1.0, 0.0]])]
        _, piece = connected_pieces(between, len(self._between))
        theta, s = np.mod(self._sign * self._coordinates.theta, 2 * np.pi), self._coordinates.s
        lines = []
        for number in np.unique(piece[between]):
            members = np.flatnonzero(piece == number)
            along = members[np.argsort(s[members])]
            if s[along[0]] < 1e-6 and s[along[-1]] > 1 - 1e-6:
                _, once = np.unique(s[along], return_index=True)
                lines.append(np.column_stack([s[along], np.unwrap(theta[along])])[once])
        if len(lines) != len(names):
            raise GeometryError(
                f"{len(lines)} lines between leaflets from the annulus to the free edge, expected "
                f"{len(names)}: each of {', '.join(names)} meets the next one along a line"
            )
        return sorted(lines, key=lambda line: float(line[0, 1]))

    def _leaflets_behind(self, region: IntArray) -> tuple[int, ...]:
        """The leaflet that follows each line, of the regions ``(m,)`` of the triangles."""
        begin, extent = self._extents(np.array([0.5]))
        theta = np.mod(self._sign * (begin + 0.5 * extent)[:, 0], 2 * np.pi)
        triangle, _ = self._coordinates.locate(theta, np.full(len(theta), 0.5))
        behind = tuple(region[triangle].tolist())
        if len(set(behind)) != len(self.region_names):
            listed = ", ".join(self.region_names[k] for k in behind)
            raise GeometryError(f"the leaflets around the valve are {listed}; expected each once")
        return behind

    def _extents(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angle from which each section runs, and its extent, ``(n, k)`` rad at ``s (k,)``."""
        theta = np.stack([np.interp(s, line[:, 0], line[:, 1]) for line in self._lines])
        extent = np.mod(np.diff(theta, axis=0), 2 * np.pi)
        before = np.concatenate([np.zeros_like(theta[:1]), np.cumsum(extent, axis=0)])
        return theta[0] + before, np.concatenate([extent, 2 * np.pi - before[-1:]])

    def locate(self, phi: FloatArray, s: FloatArray) -> Located:
        """Triangles and barycentric weights of material points, given in arrays of any shape."""
        phi, s = np.broadcast_arrays(np.asarray(phi, float), np.asarray(s, float))
        turns, flat = np.mod(phi.ravel(), 360.0) / self._width, np.clip(s.ravel(), 0.0, 1.0)
        begin, extent = self._extents(flat)
        section = np.minimum(turns.astype(np.int64), len(extent) - 1)
        at = section, np.arange(len(flat))
        theta = begin[at] + (turns - section) * extent[at]
        triangle, weights = self._coordinates.locate(np.mod(self._sign * theta, 2 * np.pi), flat)
        return triangle.reshape(phi.shape), weights.reshape(*phi.shape, 3)

    def coordinates(self) -> tuple[FloatArray, FloatArray]:
        """``phi`` (degrees) and ``s`` of the surface's vertices, ``(n,)`` each."""
        s = self._coordinates.s
        begin, extent = self._extents(s)
        theta = np.mod(self._sign * self._coordinates.theta - begin[0], 2 * np.pi)
        before = np.cumsum(extent, axis=0) - extent
        section = (theta > before[1:]).sum(axis=0)
        at = section, np.arange(len(s))
        phi = self._width * section + self._width * (theta - before[at]) / extent[at]
        return np.mod(phi, 360.0), s

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(k, 3)`` mm of material points; zeta is -1 on the atrial face."""
        surface = self.given.surface
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
        normal = _mean(at, self.given.surface, self._normals)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(..., 3)`` as seen from the leaflet ``region``."""
        section, phi = np.argsort(self.sections)[region], np.mod(phi, 360.0)
        begin, end = self._width * section, self._width * (section + 1)
        # The last section ends at 360 and not at 0.
        phi = np.where((end > 359.0) & (phi < begin - 0.5 * (360.0 - self._width)), 360.0, phi)
        surface = self.given.surface
        triangle, weights = self.locate(np.clip(phi, begin + INSIDE, end - INSIDE), s)
        corners = surface.fibre[surface.triangles[triangle]]
        # A vertex between leaflets has the fibre of one of them, and which one is unknown.
        inner = np.where(self._between[surface.triangles[triangle]], 0.0, weights)
        total = inner.sum(axis=-1, keepdims=True)
        weights = np.where(total > 1e-9, inner / np.maximum(total, 1e-9), weights)
        fibre = mean_fibre(corners, weights)
        return np.asarray(fibre / np.linalg.norm(fibre, axis=-1, keepdims=True))

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)`` mm."""
        surface = self.given.surface
        return _mean(self.locate(phi, s), surface, surface.thickness)

    def annulus_positions(self, phi: FloatArray, annulus: FloatArray) -> FloatArray:
        """Positions ``(..., k, 3)`` of annulus points, given those of the valve's annulus vertices.

        Parameters
        ----------
        phi : (k,) degrees
        annulus : ndarray
            ``(..., a, 3)`` mm, of the vertices ``valve.annulus``.
        """
        vertices = self.given.surface.vertices
        whole = np.broadcast_to(vertices, (*annulus.shape[:-2], *vertices.shape)).copy()
        whole[..., self.given.annulus, :] = annulus
        triangle, weights = self.locate(phi, np.zeros(len(phi)))
        corners = whole[..., self.given.surface.triangles[triangle], :]
        return np.asarray(np.einsum("kc,...kci->...ki", weights, corners))

    def valve(self, columns: int, rows: int) -> Valve:
        """The valve, its chordae and motion on a grid of ``columns x rows`` vertices."""
        given, motion = self.given, self.given.motion

        def attached(phi: FloatArray) -> tuple[FloatArray, Chordae, Motion]:
            annulus = self.annulus_positions(phi, motion.annulus)
            moved = Motion(motion.phase, annulus, motion.papillary_tips)
            return given.papillary_tips, given.chordae, moved

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
