"""Poses, principal modes of shapes, and shapes that agree with pulls."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.imaging.detection import shape_model
from mvest.imaging.detection.pose import Poses, pose_of, rotation_grid
from mvest.imaging.detection.shape_model import Misses, Pulls, fit_shape, fit_shape_model, relax
from mvest.imaging.layout import ValveLayout
from tests.imaging.detection.made_up import LAYOUT, TIPS, labelled, moving_valve, placed, poses
from tests.made_up_sequence import leaflets


def test_modes_are_orthonormal_and_coefficients_undo_shapes(shape):
    flat = shape.modes.reshape(len(shape.modes), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-9)
    assert np.all(np.diff(shape.std) <= 0)
    assert shape.std[-1] > 0
    b = np.random.default_rng(0).standard_normal((3, len(shape.std))) * shape.std
    np.testing.assert_allclose(shape.coefficients(shape.shape(b)), b, atol=1e-9)
    # Fewer coefficients are those of the leading modes.
    padded = np.concatenate([b[:, :4], np.zeros((3, len(shape.std) - 4))], axis=1)
    np.testing.assert_allclose(shape.shape(b[:, :4]), shape.shape(padded), atol=1e-12)


def test_deviations_are_those_of_the_coefficients():
    # Singular values over the number of vertices, or not over that of shapes, fail here.
    valves = [moving_valve(k, 3) for k in range(5)]
    model = fit_shape_model(valves, 4)
    found = []
    for valve in valves:
        for x, tips in zip(valve.vertices, valve.tips, strict=True):
            local = pose_of(x, tips, model.layout, model.size_mm).local(x[None])
            found.append(model.coefficients(local)[0])
    np.testing.assert_allclose(np.mean(found, axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.std(found, axis=0), model.std, atol=1e-9)


def test_repeated_frames_and_poses_make_no_difference():
    valves = [moving_valve(k, 3) for k in range(4)]
    first, changed = valves[0], []
    x, tips = np.repeat(first.vertices, 4, 0), np.repeat(first.tips, 4, 0)
    repeated = replace(first, times=0.01 * np.arange(12), vertices=x, tips=tips)
    for k, valve in enumerate([repeated, *valves[1:]]):
        by = poses(1, k, 60.0).repeated(len(valve.times))
        by = replace(by, log_scale=0 * by.log_scale)
        x, tips = by.world(valve.vertices), by.world(valve.tips)
        changed.append(replace(valve, vertices=x, tips=tips))
    a, b = fit_shape_model(changed, 5), fit_shape_model(valves, 5)
    for name in ("size_mm", "mean", "tips", "std"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-8)
    overlap = np.abs(np.einsum("kni,kni->k", a.modes, b.modes))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-6)


def to_all(model, pose, b, target, std=0.05):
    """Pulls of all vertices to where they belong."""
    now = pose.world(model.shape(b[None]))[0]
    every = np.arange(len(target))
    return Pulls.to_points(every, now, target, np.full(len(target), std))


def same_pose(a, b, mm=1e-3, radians=1e-4):
    by = a.towards(b)[0]
    assert np.abs(by[:3]).max() < mm
    assert np.abs(by[3:6]).max() < radians
    assert abs(by[6]) < radians


@pytest.mark.parametrize("seed", range(3))
def test_exact_pulls_give_pose_and_coefficients_back(shape, seed):
    # A wrong sign in the turn's columns, a scale that the modes do not follow, or coefficients
    # added to the wrong ones do not converge.
    rng = np.random.default_rng(seed)
    true, b = poses(1, seed), rng.standard_normal(8) * shape.std[:8]
    target = true.world(shape.shape(b[None]))[0]
    pose, found = true.moved(rng.standard_normal((1, 7)) * [3, 3, 3, 0.2, 0.2, 0.2, 0.08]), b * 0
    for _ in range(12):
        pose, found = fit_shape(shape, pose, found, to_all(shape, pose, found, target, 0.02))
    same_pose(pose, true)
    np.testing.assert_allclose(found, b, atol=2e-3 * shape.std[0])


def test_one_coefficient_shrinks_as_the_analytic_solution_says(shape, monkeypatch):
    # MAP: b = pull / (1 + std^2 / (s^2 |a|^2)) where a is how far the pulled points move for b = 1.
    k, mode_std, std = 1, float(shape.std[0]), 0.8
    pose = Poses(np.zeros((1, 3)), np.eye(3)[None], np.zeros(1))
    a = shape.modes[0]
    vertex = int(np.argmax(np.linalg.norm(a, axis=1)))
    size = np.linalg.norm(a[vertex])
    direction = a[vertex] / size
    offset = 0.05  # far below std: robust weights are 1
    # The pose does not move at all.
    monkeypatch.setattr(shape_model, "POSE_STD", shape_model.POSE_STD * 1e-6)

    def pull(by):
        return Pulls(np.array([vertex]), direction[None], np.array([by]), np.array([std]))

    _, found = fit_shape(shape, pose, np.zeros(k), pull(offset))
    expected = (offset * size / std**2) / (size**2 / std**2 + 1 / mode_std**2)
    assert found[0] == pytest.approx(expected, rel=1e-3)
    # From an earlier estimate the prior draws towards zero, not towards that estimate.
    _, again = fit_shape(shape, pose, found + 0.3, pull(offset - (found[0] + 0.3) * size))
    assert again[0] == pytest.approx(expected, abs=2e-3 * mode_std)


def test_outliers_lose_weight(shape):
    # A tenth of the vertices are pulled 15 mm astray: with least squares the valve goes along.
    rng = np.random.default_rng(2)
    true = poses(1, 8)
    target = true.world(shape.shape(np.zeros((1, 1))))[0]
    wrong = target.copy()
    astray = rng.choice(len(target), len(target) // 10, replace=False)
    wrong[astray] += np.array([15.0, 0.0, 0.0])
    pose, b = true.moved(np.array([[1.0, 0.5, -0.5, 0.03, 0, 0, 0.0]])), np.zeros(6)
    for _ in range(6):
        pose, b = fit_shape(shape, pose, b, to_all(shape, pose, b, wrong, 0.5))
    x = pose.world(shape.shape(b[None]))[0]
    rest = np.setdiff1d(np.arange(len(target)), astray)
    assert np.linalg.norm(x - target, axis=1)[rest].mean() < 0.3


# --- relax --------------------------------------------------------------------------------------

SMALL = ValveLayout(8, 4)


def some_pulls(count, seed=0):
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Pulls(
        rng.integers(SMALL.size, size=count),
        direction,
        rng.standard_normal(count),
        rng.uniform(0.5, 1.5, count),
    )


X = np.random.default_rng(1).standard_normal((SMALL.size, 3))


def dense(x, layout, pulls, stiffness, hold):
    """The same problem written out: neighbours in a ring of columns and a line of rows."""
    n, columns = layout.size, layout.columns
    laplacian = np.zeros((n, n))
    for a in range(n):
        j, i = divmod(a, columns)
        beside = [j * columns + (i + 1) % columns, j * columns + (i - 1) % columns]
        for b in [*beside, *(b for b in (a + columns, a - columns) if 0 <= b < n)]:
            laplacian[a, a] += 1
            laplacian[a, b] -= 1
    matrix = np.kron(stiffness * laplacian.T @ laplacian + hold * np.eye(n), np.eye(3))
    right = np.zeros(3 * n)
    for v, d, o, s in zip(pulls.vertex, pulls.direction, pulls.offset, pulls.std, strict=True):
        at = slice(3 * v, 3 * v + 3)
        matrix[at, at] += np.outer(d, d) / s**2
        right[at] += d * o / s**2
    return x + np.linalg.solve(matrix, right).reshape(n, 3)


def test_relax_equals_the_dense_solution_and_turns_with_the_valve():
    # Columns not joined in a ring, or several pulls of one vertex of which one counts.
    pulls = some_pulls(60)
    assert len(np.unique(pulls.vertex)) < 60
    found = relax(X, SMALL, pulls, 3.0, 0.2)
    np.testing.assert_allclose(found, dense(X, SMALL, pulls, 3.0, 0.2), atol=1e-9)
    turn = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    turned = pulls._replace(direction=pulls.direction @ turn.T)
    again = relax(X @ turn.T, SMALL, turned, 3.0, 0.2)
    np.testing.assert_allclose(again, found @ turn.T, atol=1e-9)


def angle(a, b):
    """Degrees between rotations."""
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude())


def test_moved_by_towards_arrives():
    # A turn applied from the wrong side, or a shift in world axes on one way only, does not.
    some, other = poses(6, 1), poses(6, 2)
    there = some.moved(some.towards(other))
    np.testing.assert_allclose(there.centre, other.centre, atol=1e-9)
    np.testing.assert_allclose(there.rotation, other.rotation, atol=1e-9)
    np.testing.assert_allclose(there.log_scale, other.log_scale, atol=1e-12)


@pytest.mark.parametrize("closure", [0.0, 1.0])
def test_the_pose_of_a_template_valve_is_along_its_own_axes(closure):
    # z to the atrium although the annulus alone does not tell, y anterior, x to phi = 0.
    found = pose_of(leaflets(LAYOUT, closure), TIPS, LAYOUT)
    assert angle(found.rotation[0], np.eye(3)) < 3
    size = np.exp(found.log_scale[0])
    assert 10 < size < 20


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_of_a_valve_follows_a_known_similarity(seed):
    # A mirrored frame (determinant -1) or a size that is not one fails here.
    x = leaflets(LAYOUT, 0.6)
    before = pose_of(x, TIPS, LAYOUT, 15.0)
    by = poses(1, seed, 50.0)
    after = pose_of(by.world(x)[0], by.world(TIPS)[0], LAYOUT, 15.0)
    np.testing.assert_allclose(after.centre[0], by.world(before.centre)[0, 0], atol=1e-9)
    np.testing.assert_allclose(after.rotation[0], by.rotation[0] @ before.rotation[0], atol=1e-9)
    assert after.log_scale[0] == pytest.approx(before.log_scale[0] + by.log_scale[0], abs=1e-10)
    assert np.linalg.det(after.rotation[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(after.local(by.world(x)), before.local(x[None]), atol=1e-9)


def test_a_grid_of_rotations_covers_all_orientations():
    # Quaternions q and -q are the same turn; were they not taken so, half would be left out.
    grid = rotation_grid(300)
    np.testing.assert_allclose(np.linalg.det(grid), 1.0, atol=1e-9)
    np.testing.assert_allclose(grid @ np.swapaxes(grid, 1, 2), np.tile(np.eye(3), (300, 1, 1)),
                               atol=1e-9)  # fmt: skip
    some = Rotation.random(600, rng=np.random.default_rng(5)).as_matrix()

    def gap(of):
        trace = np.einsum("aij,bij->ab", some, of)
        return np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1))).min(axis=1).max()

    # Drawn at random as many leave gaps of 40 to 48 degrees.
    assert gap(grid) < 34
    np.testing.assert_array_equal(grid, rotation_grid(300))


# -- guesses that miss a valve by set amounts -----------------------------------------------------
def test_misses_have_the_requested_deviations(shape):
    # Degrees taken for radians, or one amount for all, fail here.
    true = placed(shape, poses(1, 1), 0.7 * shape.std)
    misses = Misses(2.0, 10.0, 0.05)
    found = labelled(true, shape).missed_poses(misses, 4000)
    by = true.pose.repeated(4000).towards(found)
    expected = [2.0] * 3 + [np.deg2rad(10.0)] * 3 + [0.05]
    np.testing.assert_allclose(by.std(axis=0), expected, rtol=0.05)
    np.testing.assert_allclose(by.mean(axis=0) / expected, 0, atol=0.06)
