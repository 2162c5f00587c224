"""Principal modes of shapes: what they must be whatever the valves' poses and frames.

Shapes that agree with pulls: exact ones, contradictory ones, and what the model cannot show.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.errors import InputError
from mvest.imaging.detection import shape_model
from mvest.imaging.detection.pose import Poses, pose_of
from mvest.imaging.detection.shape_model import Pulls, fit_shape, fit_shape_model, relax
from mvest.imaging.layout import ValveLayout
from tests.imaging.detection.made_up import moving_valve, poses


def same(a, b, atol=1e-8):
    """Whether two models show the same shapes (modes up to their sign)."""
    assert a.size_mm == pytest.approx(b.size_mm, rel=1e-9)
    np.testing.assert_allclose(a.mean, b.mean, atol=atol)
    np.testing.assert_allclose(a.tips, b.tips, atol=atol)
    np.testing.assert_allclose(a.std, b.std, atol=atol)
    overlap = np.abs(np.einsum("kni,kni->k", a.modes, b.modes))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-6)


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


def with_repeated_frames(k, valve):
    """The first valve with each of its frames four times."""
    if k:
        return valve
    x, tips = np.repeat(valve.vertices, 4, 0), np.repeat(valve.tips, 4, 0)
    return replace(valve, times=0.01 * np.arange(len(x)), vertices=x, tips=tips)


def elsewhere(k, valve):
    by = replace(poses(3, k, 60.0), log_scale=np.zeros(3))
    return replace(valve, vertices=by.world(valve.vertices), tips=by.world(valve.tips))


@pytest.mark.parametrize("change", [with_repeated_frames, elsewhere])
def test_frames_poses_and_sizes_make_no_difference(change):
    valves = [moving_valve(k, 3) for k in range(4)]
    changed = [change(k, valve) for k, valve in enumerate(valves)]
    same(fit_shape_model(changed, 5), fit_shape_model(valves, 5))


def test_too_few_shapes_and_other_layouts_are_refused():
    valves = [moving_valve(k, 2) for k in range(2)]
    with pytest.raises(InputError, match="4 shapes, expected more than 4 modes"):
        fit_shape_model(valves, 4)
    with pytest.raises(InputError, match="same layout"):
        fit_shape_model([*valves, moving_valve(2, 2, ValveLayout(24, 7))], 2)


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
