"""Closed surfaces whose midsurface is known: the template, thickened, and read back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.errors import GeometryError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve, band_grid
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.segmented import masks_midsurface, without_crossings
from mvest.valve.geometry.surface_checks import check_surface
from mvest.valve.geometry.surface_coordinates import boundary_loops, surface_coordinates
from mvest.valve.geometry.thickening import ClosedSurface, thicken
from mvest.valve.geometry.triangles import unit_normals
from mvest.valve.geometry.walls import closed_band, walls


@pytest.fixture(scope="module")
def valve() -> Valve:
    # The indentations of the posterior leaflet are 28 degrees wide.
    return Template(TemplateParameters()).valve(96, 20)


@pytest.fixture(scope="module")
def solid(valve: Valve) -> ClosedSurface:
    return thicken(valve.surface)


@pytest.fixture(scope="module")
def middle(valve: Valve, solid: ClosedSurface) -> Midsurface:
    return midsurface(solid.vertices, solid.triangles, tips=valve.papillary_tips)


def test_midsurface_is_that_which_was_thickened(valve: Valve, middle: Midsurface) -> None:
    surface = valve.surface
    nearest = closest_points(middle.vertices, surface.vertices, surface.triangles)
    assert nearest.distance.mean() < 0.04
    back = closest_points(surface.vertices, middle.vertices, middle.triangles)
    assert back.distance.mean() < 0.05
    thickness = nearest.interpolate(surface.thickness, surface.triangles)
    error = middle.thickness - thickness
    assert np.abs(error).mean() < 0.02
    # At most one vertex in ten is worse: those at the sharp bends of the commissures.
    assert np.percentile(np.abs(error), 90) < 0.03


def test_it_is_a_band_in_good_order(valve: Valve, middle: Midsurface) -> None:
    check_surface(middle.vertices, middle.triangles)
    loops = [set(loop.tolist()) for loop in boundary_loops(middle.triangles)]
    assert sorted(map(len, loops)) == [len(middle.annulus)] * 2
    assert set(middle.annulus.tolist()) in loops
    assert set(middle.free_edge.tolist()) in loops
    coordinates = surface_coordinates(
        middle.vertices, middle.triangles, middle.annulus, middle.free_edge
    )
    assert not coordinates.folded().size
    # Its annulus is the template's and not the free edge, and it faces the ventricle.
    annulus = closest_points(
        middle.vertices[middle.annulus], valve.surface.vertices[valve.annulus], _fan(valve.annulus)
    )
    assert annulus.distance.mean() < 0.3
    down = valve.papillary_tips.mean(axis=0) - middle.vertices[middle.annulus].mean(axis=0)
    area = unit_normals(middle.vertices, middle.triangles).mean(axis=0)
    assert area @ down > 0


def _fan(loop: IntArray) -> IntArray:
    n = len(loop)
    return np.column_stack([np.arange(n), np.roll(np.arange(n), -1), np.arange(n)])


def test_leaflets_are_told_apart_by_their_heights(valve: Valve, middle: Midsurface) -> None:
    surface = valve.surface
    centres = middle.vertices[middle.triangles].mean(axis=1)
    truth = surface.region[closest_points(centres, surface.vertices, surface.triangles).triangle]
    assert (truth == middle.region).mean() > 0.95
    corners = surface.vertices[valve.annulus][[0, len(valve.annulus) // 2]]
    own = middle.vertices[middle.commissures[:, 0]]
    away = np.linalg.norm(own[:, None] - corners, axis=2).min(axis=1)
    assert away.max() < 3.0
    assert any("taller" in sentence for sentence in middle.derived)


def test_labels_decide_where_they_are_known(valve: Valve, solid: ClosedSurface) -> None:
    surface = valve.surface

    def label(points: FloatArray) -> IntArray:
        near = closest_points(points, surface.vertices, surface.triangles)
        return 1 - surface.region[near.triangle]

    swapped = midsurface(solid.vertices, solid.triangles, tips=valve.papillary_tips, label=label)
    centres = swapped.vertices[swapped.triangles].mean(axis=1)
    assert (label(centres) == swapped.region).mean() > 0.98
    assert swapped.derived == ()


def test_a_seam_that_bends_at_the_annulus_ends_where_its_labels_do(
    valve: Valve, solid: ClosedSurface
) -> None:
    """A straight line through these labels would end 1.8 mm from the seam."""
    surface = valve.surface
    x, triangles = surface.vertices, surface.triangles
    own = surface_coordinates(x, triangles, valve.annulus, valve.free_edge)
    values = np.column_stack([np.cos(own.theta), np.sin(own.theta), own.s])

    def beyond_seam(points: FloatArray) -> FloatArray:
        """Angle from the seams, whose ends at the annulus are 70 degrees from the middle."""
        cosine, sine, s = closest_points(points, x, triangles).interpolate(values, triangles).T
        seam = np.deg2rad(85.0 - 15.0 * np.exp(-s / 0.15))
        return np.asarray(np.abs(np.arctan2(sine, cosine)) - seam)

    def label(points: FloatArray) -> IntArray:
        return (beyond_seam(points) > 0).astype(np.int64)

    found = midsurface(solid.vertices, solid.triangles, tips=valve.papillary_tips, label=label)
    ends = found.vertices[found.commissures[:, 0]]
    perimeter = np.linalg.norm(np.diff(x[valve.annulus], axis=0), axis=1).sum()
    off = beyond_seam(ends) / (2 * np.pi) * perimeter
    assert np.abs(off).max() < 0.25


def test_what_is_no_thick_band_is_refused(solid: ClosedSurface) -> None:
    two = np.concatenate([solid.triangles, solid.triangles + len(solid.vertices)])
    apart = np.concatenate([solid.vertices, solid.vertices + 100.0])
    with pytest.raises(GeometryError, match="2 pieces"):
        closed_band(apart, two)
    with pytest.raises(GeometryError, match="open surface with 1 holes"):
        closed_band(solid.vertices, solid.triangles[1:])
    corners = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9.0]])
    ball = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(GeometryError, match="Euler number 2, expected 0: no orifice"):
        closed_band(corners, ball)


def test_a_thick_ring_has_no_two_walls() -> None:
    u, v = (x.ravel() for x in np.meshgrid(np.arange(48), np.arange(24)))
    big, small = 2 * np.pi * u / 48, 2 * np.pi * v / 24
    radius = 20 + 8 * np.cos(small)
    ring = np.column_stack([radius * np.cos(big), radius * np.sin(big), 8 * np.sin(small)])
    a, b = v * 48 + u, v * 48 + (u + 1) % 48
    c, d = (v + 1) % 24 * 48 + (u + 1) % 48, (v + 1) % 24 * 48 + u
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    with pytest.raises(GeometryError, match="expected thin leaflets"):
        walls(*closed_band(ring, faces))


def creased(depth_mm: float) -> Midsurface:
    """A tube of 20 mm with walls 1 mm apart and a crease along it, as wide as two columns."""
    columns, rows = 80, 9
    grid = band_grid(columns, rows)
    angle = 2.0 * np.pi * np.arange(columns) / columns
    radius = np.full(columns, 10.0)
    radius[[19, 20, 21]] -= [0.5 * depth_mm, depth_mm, 0.5 * depth_mm]
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    height = np.repeat(np.linspace(10.0, 0.0, rows), columns)[:, None]
    points = np.hstack([np.tile(ring, (rows, 1)), height])
    loops = np.arange(columns), np.arange(columns) + (rows - 1) * columns
    return Midsurface(points, grid.triangles, grid.region, np.ones(len(points)), *loops, ())


def test_a_crossing_is_smoothed_where_it_is() -> None:
    surface = creased(5.0)
    check_surface(surface.vertices, surface.triangles)
    mended, done = without_crossings(surface, 0.0, thickened=True)
    assert "passed through itself" in done
    moved = np.linalg.norm(mended.vertices - surface.vertices, axis=1).reshape(9, -1)
    assert moved.max() > 0.1
    # Smoothing over 1 mm would shrink the whole tube by 0.05 mm.
    assert np.delete(moved, np.arange(10, 31), axis=1).max() < 1e-3
    same, done = without_crossings(surface, 0.0, thickened=False)
    np.testing.assert_array_equal(same.vertices, surface.vertices)
    assert done == ""


def test_a_curved_surface_of_voxels_is_where_it_was() -> None:
    """Smoothed voxels put this zone of a sphere 0.05 mm too near its centre."""
    radius, voxel, turn = 6.0, 0.8, Rotation.from_euler("xyz", [0.3, 0.5, 0.2]).as_matrix()
    places = np.stack(np.meshgrid(*3 * [np.arange(-12, 12) * voxel], indexing="ij"), axis=-1)
    x, y, z = np.moveaxis((places + 0.13) @ turn, -1, 0)
    tissue = (np.abs(np.sqrt(x**2 + y**2 + z**2) - radius) < 0.7) & (np.abs(z) < 3.6)
    tips = np.array([[4.0, 0.0, -20.0], [-4.0, 0.0, -20.0]]) @ turn.T
    grid = np.full(3, voxel), np.eye(3), places[0, 0, 0] + 0.13
    found, _ = masks_midsurface([tissue & (y >= 0), tissue & (y < 0)], grid, tips, edge_mm=0.8)
    inner = np.setdiff1d(np.arange(len(found.vertices)), [*found.annulus, *found.free_edge])
    away = np.linalg.norm(found.vertices[inner], axis=1) - radius
    assert abs(away.mean()) < 0.015
