"""Represents two thick leaflets as signed distances on a grid; makes their closed surface.

Where two leaflets meet they are either one piece of tissue (at a commissure) or only in contact; a
segmentation does not distinguish the two. In an open valve they meet only at the commissures, down
to a distance from the annulus that does not change. So the leaflets of a closed valve are cut apart
wherever they meet farther from the annulus, or deeper than their thickness.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri
from skimage import measure

from mvest.errors import GeometryError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.proximity import ClosestPoints, closest_points
from mvest.valve.geometry.triangles import (
    connected_pieces,
    edge_table,
    euler_number,
    surface_edges,
    unit_normals,
)

# skimage has no type hints.
marching_cubes: Any = measure.marching_cubes
MARGIN_MM = 3.0
STEP_MM = 0.2
"""Grid step (mm). The cut between leaflets must leave most of a 1 mm leaflet intact, and a coarser
grid cuts off the rims of thin ones."""
CUT_STEPS = 2.0
"""Width of the cut between leaflets in contact, in grid steps. The cut is not refilled: smoothing
removes as much from a free wall, so the midsurface does not move."""
SEAM_REACH_MM = 2.0
"""Leaflets are one piece within this distance (mm) of the seam."""
SEAM_THICKNESSES = 1.7
"""Largest seam width relative to the thickness; beyond it leaflets are in contact. A seam that is
too narrow leaves holes."""
LAYER_MM = 0.5
"""Depth (mm) of the layers below the annulus in which a seam's outermost point is searched."""
LEVELS = (0.0, 0.1, 0.2, 0.3, 0.4)
"""Wall offsets (voxels), tried in order until the orifice is the only hole."""
ON_GRID = 0.02
"""Smallest distance of a grid point from the surface, in steps."""
MAX_VOXELS = 4 * 10**7
SEEN = 0.7
"""Half thickness over the blur, below which no point has half a share of tissue (0.675)."""
NEAR = 1.5
"""Distance from a wall, in standard deviations of the blur, within which the share states it."""


@dataclass(frozen=True, slots=True, eq=False)
class LeafletFields:
    """Signed distances to the leaflets, positive inside, on a grid."""

    #: (2, I, J, K) mm, to the anterior and posterior leaflets, or (1, I, J, K) mm, to both if they
    #: share one label
    distance: FloatArray
    union: FloatArray  #: (I, J, K) mm, to both leaflets together
    step: float  #: mm between grid points
    blur_mm: float  #: standard deviation by which the share of tissue is blurred, normal
    voxel_mm: float  #: size of the original voxels, 0 for surfaces

    def label(self, points: FloatArray) -> IntArray:
        """The nearest leaflet ``(k,)``, 0 anterior or 1 posterior, to points ``(k, 3)``.

        Points are in mm from the first grid point.
        """
        at = (points / self.step).T
        apart = self.distance[0] - self.distance[1]
        between = ndimage.map_coordinates(apart, at, order=1, mode="nearest")
        return np.asarray((between < 0).astype(np.int64))

    def true_thickness(self, thickness: FloatArray) -> FloatArray:
        """True thickness (mm) of tissue, given that between the walls of the fields.

        Of a sheet of thickness 2 a, ``F((a - x) / blur) + F((a + x) / blur) - 1`` with the normal
        distribution F is the blurred share of tissue at x from its middle, half at the walls.
        """
        half = np.linspace(SEEN, 8.0, 200)

        def off(wall: float, own: float) -> float:
            return float(ndtr(own - wall) + ndtr(own + wall) - 1.5)

        wall = np.array([brentq(off, 0.0, own + 1.0, args=(own,)) for own in half])
        given = 0.5 * thickness / self.blur_mm
        return 2 * self.blur_mm * np.where(given < wall[-1], np.interp(given, wall, half), given)

    def lost_rim(self, thickness: FloatArray) -> FloatArray:
        """How far (mm) the fields end short of a square rim, given the true thickness.

        The middle of a sheet has the share ``2 F(a / blur) - 1`` of tissue, and as far from its end
        as the fields' wall half of that is left.
        """
        half = np.maximum(0.5 * thickness / self.blur_mm, SEEN)
        return np.asarray(self.blur_mm * ndtri(0.5 / (2.0 * ndtr(half) - 1.0)))


class ThickLeaflets(NamedTuple):
    """The closed surface of two leaflets, cut apart where they are in contact."""

    #: ``(n, 3)`` mm from the first point of the grid, and ``(m, 3)``
    vertices: FloatArray
    triangles: IntArray
    #: (2,) mm, length from the annulus down over which the leaflets are one piece, on the side of
    #: each tip
    seams: FloatArray
    grown_mm: float  #: outward offset of all walls needed to close holes
    derived: tuple[str, ...]  #: changes needed to get one closed surface


def fields_of_masks(
    masks: Sequence[BoolArray], spacing: FloatArray, blur: float
) -> tuple[LeafletFields, FloatArray]:
    """Compute signed distances to sets of voxels.

    Next to a flat wall the blurred share of tissue is ``F(d / blur)`` at the distance d, with the
    normal distribution F, which is solved for d. Distances from voxel to voxel lose thin rims.

    GeometryError if a leaflet has no voxels, or the leaflets are too large for the grid.

    Parameters
    ----------
    masks
        ``(I, J, K)`` each: voxels of the anterior and posterior leaflets, or of both together.
    spacing : (3,) mm
    blur
        Standard deviation of the smoothing, in voxels.

    Returns
    -------
    LeafletFields
        On a finer grid around the leaflets.
    ndarray
        ``(3,)`` position of the grid's first point, in voxels.
    """
    if not all(mask.any() for mask in masks):
        raise GeometryError("no voxel of a leaflet")
    voxel = float(np.prod(spacing) ** (1 / 3))
    both = np.any(masks, axis=0)
    box = ndimage.find_objects(both.astype(np.int8))[0]
    pad = np.ceil(MARGIN_MM / spacing).astype(int)
    low = np.array([part.start for part in box]) - pad
    high = np.array([part.stop for part in box]) + pad
    step = min(STEP_MM, voxel)
    shape = np.ceil((high - 1 - low) * spacing / step).astype(int) + 1
    if np.prod(shape.astype(float)) > MAX_VOXELS:
        size = " x ".join(f"{extent:.0f}" for extent in (high - low) * spacing)
        raise GeometryError(f"leaflets of {size} mm, expected those of one valve alone")
    at = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")) * step
    at /= spacing[:, None, None, None]

    # Linear interpolation blurs as well.
    blur_mm = voxel * float(np.hypot(blur, 6**-0.5))

    def distance(mask: BoolArray) -> FloatArray:
        part = np.zeros(high - low, dtype=np.bool_)
        inside = tuple(
            slice(b.start - start, b.stop - start) for b, start in zip(box, low, strict=True)
        )
        part[inside] = mask[box]
        share = ndimage.map_coordinates(part.astype(np.float32), at, order=1)
        share = ndimage.gaussian_filter(share, blur * voxel / step)
        near = blur_mm * ndtri(np.clip(share, 1e-3, 1 - 1e-3))
        inner, outer = (ndimage.distance_transform_edt(own) for own in (near > 0, near <= 0))
        far = step * np.where(near > 0, inner - 0.5, 0.5 - outer)
        return np.asarray(np.where(np.abs(near) < NEAR * blur_mm, near, far))

    fields = LeafletFields(
        np.stack([distance(mask) for mask in masks]), distance(both), step, blur_mm, voxel
    )
    return fields, low.astype(np.float64)


def inside_surfaces(
    surfaces: Sequence[tuple[FloatArray, IntArray]], step_mm: float
) -> tuple[list[BoolArray], FloatArray]:
    """Find the points of a common grid inside each of several closed surfaces.

    Near a surface, the normal at the closest point decides (`_signed_normals`); holes are then
    filled.

    Parameters
    ----------
    surfaces
        Vertices ``(n, 3)`` mm and triangles ``(m, 3)``, normals outwards.
    step_mm
        Grid step.

    Returns
    -------
    masks
        ``(I, J, K)`` for each surface.
    origin
        ``(3,)`` mm, the first point.
    """
    points = np.concatenate([vertices for vertices, _ in surfaces])
    low = points.min(axis=0) - MARGIN_MM
    shape = np.ceil((points.max(axis=0) + MARGIN_MM - low) / step_mm).astype(int) + 1
    if np.prod(shape.astype(float)) > MAX_VOXELS:
        size = " x ".join(f"{extent:.0f}" for extent in np.ptp(points, axis=0))
        raise GeometryError(f"leaflets of {size} mm, expected those of one valve, in mm")
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    grid = grid.reshape(-1, 3) * step_mm + low
    masks = []
    for vertices, triangles in surfaces:
        corner = vertices[triangles]
        longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max()
        near, _ = cKDTree(vertices).query(grid, distance_upper_bound=longest + 2 * step_mm)
        close = np.flatnonzero(np.isfinite(near))
        nearest = closest_points(grid[close], vertices, triangles)
        foot = nearest.interpolate(vertices, triangles)
        normal = _signed_normals(nearest, vertices, triangles)
        inside = np.zeros(len(grid), dtype=np.bool_)
        inside[close] = np.einsum("ij,ij->i", grid[close] - foot, normal) < 0
        masks.append(np.asarray(ndimage.binary_fill_holes(inside.reshape(shape))))
    return masks, low


def _signed_normals(found: ClosestPoints, vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Normals ``(k, 3)`` at closest points, also at those on an edge or a vertex of the surface.

    Points from which they point away are inside, however sharp the edges are: the sum of an edge's
    two normals, and the sum of a vertex's, weighted by the angles of its triangles (Baerentzen and
    Aanaes 2005, IEEE Trans. Vis. Comput. Graph. 11:243).
    """
    face = unit_normals(vertices, triangles)
    _, edges, number, _ = edge_table(triangles)
    at_edge, at_vertex = np.zeros((len(edges), 3)), np.zeros_like(vertices)
    np.add.at(at_edge, number, np.repeat(face, 3, axis=0))
    corner = vertices[triangles]
    along = np.roll(corner, -1, axis=1) - corner
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-np.sum(along * np.roll(along, 1, axis=1), axis=2), -1, 1))
    np.add.at(at_vertex, triangles, angle[..., None] * face[:, None])

    normal = face[found.triangle]
    away = found.barycentric == 0
    on_edge, on_vertex = (away.sum(axis=1) == n for n in (1, 2))
    opposite = 3 * found.triangle[on_edge] + (away[on_edge].argmax(axis=1) + 1) % 3
    normal[on_edge] = at_edge[number[opposite]]
    own = triangles[found.triangle[on_vertex], away[on_vertex].argmin(axis=1)]
    normal[on_vertex] = at_vertex[own]
    return normal


def thick_leaflets(
    fields: LeafletFields, tips: FloatArray, seams: FloatArray | None = None
) -> ThickLeaflets:
    """Make the closed surface of both leaflets: joined at the commissures, cut apart in contact.

    GeometryError if the leaflets do not meet, or the orifice is not their only hole at any of
    `LEVELS`.

    Parameters
    ----------
    fields
    tips
        ``(2, 3)`` papillary tips, mm from the first grid point.
    seams
        ``(2,)`` mm, `ThickLeaflets.seams` of the open valve. Without it, and with one label for
        both leaflets, the leaflets are one piece wherever they meet.
    """
    if len(fields.distance) == 1:
        meet, half = np.zeros(fields.union.shape, dtype=np.bool_), fields.union
        joined, lengths = ~meet, np.zeros(2)
    else:
        half = 0.5 * (fields.distance[0] - fields.distance[1])
        near = np.minimum(*fields.distance) > -fields.voxel_mm - fields.step
        meet = (np.abs(half) <= fields.step) & (fields.union > 0) & near
        if not meet.any():
            raise GeometryError("the leaflets meet nowhere, expected at two commissures")
        joined, lengths = _joined(fields, meet, tips, seams)
    cut = 0.5 * CUT_STEPS * fields.step
    found = ""
    for level in LEVELS:
        grown = level * fields.voxel_mm
        together = fields.union + grown
        together = np.where(joined, together, np.minimum(together, np.abs(half) - cut))
        # A surface through a grid point would have triangles without area.
        close = np.abs(together) < ON_GRID * fields.step
        together = np.where(close, np.copysign(ON_GRID * fields.step, together), together)
        vertices, faces, _, _ = marching_cubes(together, 0.0, spacing=(fields.step,) * 3)
        triangles = faces.astype(np.int64)[:, ::-1]
        vertices, triangles, pieces = _largest(vertices.astype(np.float64), triangles)
        euler = euler_number(triangles)
        if euler == 0:
            break
        found = found or f"Euler number {euler}"
    else:
        raise GeometryError(
            f"leaflets with {found}, expected 0, one orifice: fill the holes of the leaflets, join "
            "them at the commissures, and part them elsewhere where they are open"
        )
    touching = meet & ~joined & (np.abs(half) <= 0.5 * fields.step)
    area = float(touching.sum()) * fields.step**2
    derived = [f"{pieces} loose pieces of the leaflets left out"] if pieces else []
    if grown:
        derived.append(f"walls drawn {grown:.2g} mm farther out, so that no hole is left")
    if area:
        derived.append(
            f"leaflets cut apart where they touch, over {area:.0f} mm^2, and one piece within "
            f"{lengths[0]:.1f} and {lengths[1]:.1f} mm of the annulus at the commissures, as in "
            "the open frame"
        )
    return ThickLeaflets(vertices, triangles, lengths, grown, tuple(derived))


def _joined(
    fields: LeafletFields, meet: BoolArray, tips: FloatArray, seams: FloatArray | None
) -> tuple[BoolArray, FloatArray]:
    """Grid points where the leaflets are one piece, and the lengths of both seams.

    A seam starts where the leaflets meet farthest up and out on the side of its papillary tip, and
    follows the outermost meeting points. Leaflets that meet farther in, such as folds next to a
    commissure, are in contact. If nothing is in contact, all grid points are returned.
    """
    where = np.argwhere(meet) * fields.step
    tissue = np.argwhere(fields.union > 0).mean(axis=0) * fields.step
    up = tissue - tips.mean(axis=0)
    up /= np.linalg.norm(up)
    side = tips[0] - tips[1]
    side -= (side @ up) * up
    side /= np.linalg.norm(side)
    # The mean distance within a sheet is a quarter of its thickness.
    thickness = fields.true_thickness(4 * fields.distance[fields.distance > 0].mean())
    width = SEAM_THICKNESSES * float(thickness)
    apart = np.full(len(where), seams is not None)
    lengths = np.zeros(2)
    depth = where @ up
    outward = (where - where.mean(axis=0)) @ side
    for k, sign in enumerate((1.0, -1.0)):
        beginning = where[np.argmax(where @ up + sign * outward)]
        distance = np.linalg.norm(where - beginning, axis=1)
        own = sign * outward > 0
        if not own.any():
            raise GeometryError("the leaflets meet on one side alone, expected at two commissures")
        if seams is None:
            lengths[k] = distance[own].max()
        else:
            lengths[k] = seams[k]
            behind = _behind_outermost(depth[own], sign * outward[own])
            apart[own] = (distance[own] > seams[k]) | (behind > width)
    touching = np.zeros(meet.shape, dtype=np.bool_)
    touching[meet] = apart
    if not touching.any():
        return ~touching, lengths
    away, nearest = ndimage.distance_transform_edt(~meet, return_indices=True)
    return ~touching[tuple(nearest)] & (away * fields.step <= SEAM_REACH_MM), lengths


def _behind_outermost(depth: FloatArray, outward: FloatArray) -> FloatArray:
    """Distance ``(k,)`` mm of points inward from the outermost point at similar depth."""
    layer = np.floor((depth - depth.min()) / LAYER_MM).astype(np.int64)
    farthest = np.full(layer.max() + 1, -np.inf)
    np.maximum.at(farthest, layer, outward)
    return np.asarray(ndimage.maximum_filter1d(farthest, 3)[layer] - outward)


def _largest(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray, int]:
    """The largest connected piece, and the number of other pieces."""
    pieces, piece = connected_pieces(surface_edges(triangles), len(vertices))
    kept = np.bincount(piece).argmax()
    used, inverse = np.unique(triangles[piece[triangles[:, 0]] == kept], return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3), pieces - 1
