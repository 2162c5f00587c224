"""Principal modes of shapes: what they must be whatever the valves' poses and frames."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.shape_model import fit_shape_model
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


def test_modes_are_orthonormal_and_deviations_decrease(shape):
    flat = shape.modes.reshape(len(shape.modes), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-9)
    assert np.all(np.diff(shape.std) <= 0)
    assert shape.std[-1] > 0


def test_coefficients_undo_shapes(shape):
    b = np.random.default_rng(0).standard_normal((3, len(shape.std))) * shape.std
    np.testing.assert_allclose(shape.coefficients(shape.shape(b)), b, atol=1e-9)
    # Fewer coefficients are those of the leading modes.
    padded = np.concatenate([b[:, :4], np.zeros((3, len(shape.std) - 4))], axis=1)
    np.testing.assert_allclose(shape.shape(b[:, :4]), shape.shape(padded), atol=1e-12)


def test_deviations_are_those_of_the_coefficients():
    # Singular values over the number of vertices, or not over that of shapes, are seen here.
    valves = [moving_valve(k, 3) for k in range(5)]
    model = fit_shape_model(valves, 4)
    found = []
    for valve in valves:
        for x, tips in zip(valve.vertices, valve.tips, strict=True):
            found.append(model.coefficients(model.pose_of(x, tips).local(x[None]))[0])
    np.testing.assert_allclose(np.mean(found, axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.std(found, axis=0), model.std, atol=1e-9)


def test_the_mean_valve_has_the_models_size_and_axes(shape):
    pose = pose_of(shape.mean, shape.tips, shape.layout, shape.size_mm)
    np.testing.assert_allclose(pose.centre, 0, atol=1e-9)
    assert abs(pose.log_scale[0]) < 0.02
    assert np.trace(pose.rotation[0]) > 2.99


def test_valves_count_alike_however_many_frames_they_have():
    # One of them has each of its frames four times: no mean and no mode may lean towards it.
    valves = [moving_valve(k, 3) for k in range(5)]
    first = valves[0]
    longer = replace(
        first,
        times=0.01 * np.arange(12),
        vertices=np.repeat(first.vertices, 4, 0),
        tips=np.repeat(first.tips, 4, 0),
    )
    same(fit_shape_model([longer, *valves[1:]], 5), fit_shape_model(valves, 5))


def test_pose_is_taken_off():
    # The same shapes, each frame somewhere else; the model sees no difference.
    valves = [moving_valve(k, 3) for k in range(4)]
    moved = []
    for k, valve in enumerate(valves):
        by = poses(3, k, 60.0)
        by = replace(by, log_scale=np.zeros(3))
        moved.append(replace(valve, vertices=by.world(valve.vertices), tips=by.world(valve.tips)))
    same(fit_shape_model(moved, 5), fit_shape_model(valves, 5))


def test_size_is_taken_off():
    valves = [moving_valve(k, 3) for k in range(4)]
    factors = np.exp([0.2, -0.2, 0.1, -0.1])  # of geometric mean 1
    scaled = [
        replace(v, vertices=f * v.vertices, tips=f * v.tips)
        for v, f in zip(valves, factors, strict=True)
    ]
    same(fit_shape_model(scaled, 5), fit_shape_model(valves, 5))


def test_too_few_shapes_and_other_layouts_are_refused():
    valves = [moving_valve(k, 2) for k in range(2)]
    with pytest.raises(InputError, match="4 shapes, expected more than 4 modes"):
        fit_shape_model(valves, 4)
    with pytest.raises(InputError, match="same layout"):
        fit_shape_model([*valves, moving_valve(2, 2, ValveLayout(24, 7))], 2)
