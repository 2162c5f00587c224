"""The walls and rims of plates as voxels, in any direction."""

import numpy as np
import pytest
from matplotlib.path import Path as MplPath
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from mvest.valve.geometry.leaflet_fields import fields_of_masks, inside_surfaces

THICKNESS = 1.2
"""mm, of the plate |z| <= 0.6, |x| <= 9 and -9 <= y <= 0 in its own axes."""


def plate(voxel, turn):
    """Voxels more than half of which lie in a plate, and their position (mm) to its own axes."""
    n = int(np.ceil(30.0 / voxel))

    def own(index):
        return (index * voxel - 15.0) @ turn

    parts = (np.indices((4, 4, 4)).reshape(3, -1).T - 1.5) / 4
    index = np.indices((n, n, n)).reshape(3, -1).T
    share = np.zeros(len(index))
    for part in parts:
        x, y, z = own(index + part).T
        share += (np.abs(x) <= 9) & (y <= 0) & (y >= -9) & (np.abs(z) <= THICKNESS / 2)
    return (share > 32).reshape(n, n, n)


def crossing(field, points):
    """Where the field first turns negative along lines of points (k, l, 3), as a share."""
    value = map_coordinates(field, np.moveaxis(points, -1, 0), order=1)
    first = np.argmax(value < 0, axis=1)
    k = np.arange(len(value))
    before, after = value[k, first - 1], value[k, first]
    return (first - 1 + before / (before - after)) / (value.shape[1] - 1)


@pytest.mark.parametrize("voxel", [0.5, 0.8])
def test_walls_and_rims_are_where_they_are(voxel):
    walls, ends = [], []
    for turn in Rotation.random(6, random_state=4).as_matrix():
        fields, first = fields_of_masks([plate(voxel, turn)], np.full(3, voxel), 0.5)
        x = np.linspace(-6, 6, 40)
        along = np.linspace(0, 1, 60)[None, :]

        def at(x, y, z, turn=turn, fields=fields, first=first):
            points = np.stack(np.broadcast_arrays(x[:, None], y, z), axis=-1) @ turn.T + 15.0
            return (points - voxel * first) / fields.step

        for side in (-1, 1):
            walls.append(1.5 * crossing(fields.union, at(x, -4.5, 1.5 * side * along)))
        ends.append(-3.0 + 4.0 * crossing(fields.union, at(x, -3.0 + 4.0 * along, 0.0 * along)))
    thickness = fields.true_thickness(2 * np.mean(walls))
    lost = float(fields.lost_rim(np.array(THICKNESS)))
    # The end of one line varies by an eighth of a voxel or more (standard deviation).
    assert thickness == pytest.approx(THICKNESS, abs=voxel / 8)
    assert np.mean(ends) + lost == pytest.approx(0.0, abs=voxel / 8)
    # Of coarse voxels the rim is lost, by twice as much.
    assert (lost > voxel / 4) is (voxel > 0.6)


def test_a_point_beside_a_sharp_edge_is_outside():
    """With area-weighted normals, some points beside the rims of a bent plate count as inside."""
    angle, n = np.linspace(0.0, 2.0, 5), 5
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    profile = np.concatenate([5.4 * arc, 4.6 * arc[::-1]])
    k, m = np.arange(2 * n), 2 * n
    sides = np.concatenate(
        [
            np.stack([k, np.roll(k, -1), k + m], axis=1),
            np.stack([np.roll(k, -1), np.roll(k, -1) + m, k + m], axis=1),
        ]
    )
    a, b = np.arange(n - 1), m - 1 - np.arange(n - 1)
    cap = np.concatenate([np.stack([a, b, a + 1], axis=1), np.stack([a + 1, b, b - 1], axis=1)])
    triangles = np.concatenate([sides, cap, cap[:, ::-1] + m])
    ends = [np.column_stack([profile, np.full(m, z)]) for z in (-3.0, 3.0)]
    turn = Rotation.from_euler("zyx", [0.5, 0.4, 0.3]).as_matrix()
    (inside,), low = inside_surfaces([(np.concatenate(ends) @ turn.T, triangles)], 0.13)
    points = (low + 0.13 * np.argwhere(np.ones_like(inside))) @ turn
    expected = MplPath(profile).contains_points(points[:, :2]) & (np.abs(points[:, 2]) < 3.0)
    np.testing.assert_array_equal(inside.ravel(), expected)
