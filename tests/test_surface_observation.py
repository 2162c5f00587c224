"""Observations without correspondence, against distances and derivatives known by hand."""

from collections.abc import Callable

import numpy as np
import pytest

from mvest.errors import InputError, MaterialError
from mvest.estimation import Gaussian, IteratedFilter, PaperFilter, Prediction, observation_noise
from mvest.surface_observation import (
    MAX_CORRELATED_POINTS,
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
    mean_surface_distance,
    surface_distance,
)

FRAMES = ("open", "closed")
Geometry = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def grid(columns: int, rows: int, size: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """A square in the plane z = 0, its normals along z, and its triangles."""
    x, y = np.meshgrid(np.linspace(0, size, columns), np.linspace(0, size, rows))
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.column_stack([a, a + 1, a + columns + 1])
    upper = np.column_stack([a, a + columns + 1, a + columns])
    return vertices, np.concatenate([lower, upper])


def rim(columns: int, rows: int) -> np.ndarray:
    """The border of a grid as a loop."""
    number = np.arange(columns * rows).reshape(rows, columns)
    return np.concatenate(
        [number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]]
    )  # fmt: skip


def model(geometry: Geometry, frames: int = 2) -> Callable[[np.ndarray], Prediction]:
    """Frames that rest at the geometry of m = 0, and the last one at that of m."""

    def predict(m: np.ndarray) -> Prediction:
        rest, slope = geometry(np.zeros_like(m))
        moved, jacobian = geometry(m)
        still = np.zeros((slope.size // len(m) * (frames - 1), len(m)))
        y = np.concatenate([*[rest.ravel()] * (frames - 1), moved.ravel()])
        return Prediction(y, np.concatenate([still, jacobian.reshape(-1, len(m))]))

    return predict


def translated(vertices: np.ndarray) -> Geometry:
    slope = np.tile(np.eye(3), (len(vertices), 1))
    return lambda m: (vertices + m, slope)


def plane(columns: int = 4, rows: int = 5) -> tuple[np.ndarray, PredictedSurface]:
    vertices, triangles = grid(columns, rows)
    loop = rim(columns, rows)
    region = np.zeros(len(triangles), dtype=int)
    return vertices, PredictedSurface(len(vertices), triangles, region, loop, loop)


def seen(points: np.ndarray, region: int | np.ndarray = 0, **curves) -> ObservedSurface:
    return ObservedSurface("closed", points, np.broadcast_to(region, len(points)), **curves)


def scattered(n: int, z: float | np.ndarray, seed: int = 1) -> np.ndarray:
    """Points over the inside of the square, at height z."""
    return np.column_stack([rng(seed).uniform(1.0, 9.0, (n, 2)), np.broadcast_to(z, n)])


def whitened(prediction: Prediction, R: object) -> np.ndarray:
    return observation_noise(R, len(prediction.y)).whiten(prediction.jacobian)


def information(prediction: Prediction, R: object) -> np.ndarray:
    A = whitened(prediction, R)
    return A.T @ A


# --- distances ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "columns"), [(1, 3), (7, 3), (200, 3), (50, 12)])
def test_a_plane_moved_along_its_normal_gives_the_shift_whatever_the_sampling(
    n: int, columns: int
) -> None:
    vertices, surface = plane(columns)
    observation = SurfaceObservation((seen(scattered(n, 0.7)),), surface, 0.5)
    predict = observation.of(model(translated(vertices)))
    for shift in (0.0, 0.7, 2.0):
        prediction = predict(np.array([0.0, 0.0, shift]))
        # Above the plane is positive: its normal points up.
        np.testing.assert_allclose(observation.y - prediction.y, shift - 0.7, atol=1e-14)
        np.testing.assert_allclose(
            prediction.jacobian, np.tile([0.0, 0.0, -1.0], (n, 1)), atol=1e-15
        )


def test_points_that_slide_within_the_surface_change_nothing() -> None:
    vertices, surface = plane()
    height = rng(3).normal(size=60)
    results = []
    for seed in (1, 2):
        points = scattered(60, height, seed)
        predict = SurfaceObservation((seen(points),), surface, 0.5).of(model(translated(vertices)))
        # The tissue sliding under the points does not either.
        results += [predict(np.array([x, -0.4, 0.3])) for x in (0.0, 0.8)]
    for result in results:
        np.testing.assert_allclose(result.y, height - 0.3, atol=1e-14)
        np.testing.assert_allclose(result.jacobian, [[0.0, 0.0, -1.0]] * 60, atol=1e-14)


def roof() -> tuple[np.ndarray, PredictedSurface]:
    """Two faces with a right angle at the ridge y = 0, z = 0, seen from above."""
    vertices = np.array([[-5, 0, 0], [5, 0, 0], [-5, -5, -5], [5, -5, -5], [-5, 5, -5], [5, 5, -5.0]])
    triangles = np.array([[0, 2, 3], [0, 3, 1], [0, 1, 5], [0, 5, 4]])
    return vertices, PredictedSurface(6, triangles, np.zeros(4, dtype=int))


@pytest.mark.parametrize(
    ("point", "distance", "direction"),
    [
        # Over the ridge: straight up, and to the side but within the wedge above both faces.
        ([0.3, 0.0, 2.0], 2.0, [0, 0, 1]),
        ([0.3, 0.6, 0.8], 1.0, [0, 0.6, 0.8]),
        # Over and under one face.
        ([0.0, 3.0, -1.0], np.sqrt(2), [0, np.sqrt(0.5), np.sqrt(0.5)]),
        ([0.0, 2.0, -4.0], -np.sqrt(2), [0, np.sqrt(0.5), np.sqrt(0.5)]),
        # On the ridge there is no direction to it; the angle-weighted normal is up.
        ([0.3, 0.0, 0.0], 0.0, [0, 0, 1]),
        # Beyond the border at x = 5, above and below the plane of the face: the distance to it.
        ([7.0, 2.5, -2.5], 2.0, [1, 0, 0]),
        ([7.0, 2.5, -3.5], -np.sqrt(4.5), np.array([-2, 0.5, 0.5]) / np.sqrt(4.5)),
        # At the vertex at the end of the ridge.
        ([6.0, 0.0, 1.0], np.sqrt(2), [np.sqrt(0.5), 0, np.sqrt(0.5)]),
    ],
)
def test_signed_distances_by_hand(point: list, distance: float, direction: list) -> None:
    vertices, surface = roof()
    observation = SurfaceObservation((seen(np.array([point], dtype=float)),), surface, 1.0)
    prediction = observation.of(model(translated(vertices)))(np.zeros(3))
    np.testing.assert_allclose(prediction.y, [distance], atol=1e-14)
    np.testing.assert_allclose(-prediction.jacobian, [direction], atol=1e-14)


def test_the_normal_at_a_vertex_is_by_angle_and_not_by_number_of_triangles() -> None:
    # The corner of a cube, one of its three faces cut into 24 triangles. By symmetry the normal is
    # along the diagonal; a plain sum of the triangles' normals would be almost along z.
    n = 24
    t = np.linspace(0, np.pi / 2, n + 1)
    arc = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    vertices = np.concatenate([[[0, 0, 0], [0, 0, -1.0]], arc])
    triangles = [[0, 2 + k, 3 + k] for k in range(n)] + [[0, 1, 2], [0, n + 2, 1]]
    surface = PredictedSurface(n + 3, np.array(triangles), np.zeros(n + 2, dtype=int))
    observation = SurfaceObservation((seen(np.zeros((1, 3))),), surface, 1.0)
    prediction = observation.of(model(translated(vertices)))(np.zeros(3))
    np.testing.assert_array_equal(prediction.y, [0.0])
    expected = np.array([[-1.0, -1.0, 1.0]]) / np.sqrt(3.0)
    np.testing.assert_allclose(-prediction.jacobian, expected, atol=1e-12)


def test_a_point_belongs_to_its_own_leaflet_even_where_another_is_nearer() -> None:
    # Two parallel leaflets 2 mm apart, facing each other; a point 0.5 mm above the lower one.
    vertices, triangles = grid(4, 4)
    both = np.concatenate([vertices, vertices + [0, 0, 2.0]])
    surface = PredictedSurface(
        len(both),
        np.concatenate([triangles, triangles[:, ::-1] + len(vertices)]),
        np.repeat([0, 1], len(triangles)),
    )
    points = scattered(3, 0.5)
    observation = SurfaceObservation((seen(points, np.array([0, 1, UNKNOWN])),), surface, 1.0)
    prediction = observation.of(model(translated(both)))(np.zeros(3))
    np.testing.assert_allclose(prediction.y, [0.5, 1.5, 0.5], atol=1e-14)
    np.testing.assert_allclose(prediction.jacobian[:, 2], [-1.0, 1.0, -1.0], atol=1e-14)
    fitted = both[None] + [0, 0, 0.1]
    np.testing.assert_allclose(observation.distance(fitted), [0.4, 1.6, 0.4], atol=1e-14)


def test_a_curve_is_compared_across_and_not_along() -> None:
    # A circle of radius 4 about a predicted polygon of 400 sides, of radius 3, 1 mm below it.
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    vertices = np.concatenate([3 * ring, np.zeros((1, 3))])
    triangles = np.array([[400, k, (k + 1) % 400] for k in range(400)])
    surface = PredictedSurface(401, triangles, np.zeros(400, dtype=int), annulus=np.arange(400))
    turn = 2 * np.pi * rng().uniform()
    s = turn + np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.column_stack([4 * np.cos(s), 4 * np.sin(s), np.ones(60)])
    only = ObservedSurface("closed", np.empty((0, 3)), np.empty(0, dtype=int), annulus=circle)
    observation = SurfaceObservation((only,), surface, 1.0, 0.1)
    prediction = observation.of(model(translated(vertices)))(np.zeros(3))
    assert prediction.y.shape == observation.y.shape == (120,)
    # 1 mm outwards (and as much as a side of the polygon bulges, 3 (1 - cos(pi / 400)) = 9e-5), and
    # 1 mm up. The two directions are any across the curve, so only the length is known.
    np.testing.assert_allclose(
        np.linalg.norm(prediction.y.reshape(60, 2), axis=1), np.sqrt(2), atol=1e-4
    )
    # Across the curve a shift counts in full in both directions, and along it not at all.
    H = prediction.jacobian.reshape(60, 2, 3)
    across = np.einsum("jik,jil->jkl", H, H)
    along = np.column_stack([-np.sin(s), np.cos(s), np.zeros(60)])
    expected = np.eye(3) - along[:, :, None] * along[:, None, :]
    np.testing.assert_allclose(across, expected, atol=0.02)


# --- derivatives --------------------------------------------------------------------------------


def waves(columns: int = 16, rows: int = 16) -> tuple[Geometry, np.ndarray, np.ndarray]:
    """A sheet that waves, bends and stretches with three parameters, none of them linearly."""
    rest, triangles = grid(columns, rows)
    x, y = rest[:, 0], rest[:, 1]

    def geometry(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b, c = m
        phase = 0.5 * x + b
        z = (1.0 + a) * np.sin(phase) + 0.05 * np.exp(c) * y**2
        moved = np.column_stack([x * np.cosh(0.2 * a), y * (1.0 + 0.1 * c**2), z])
        slope = np.zeros((len(rest), 3, 3))
        slope[:, 0, 0] = 0.2 * x * np.sinh(0.2 * a)
        slope[:, 1, 2] = 0.2 * c * y
        slope[:, 2, 0] = np.sin(phase)
        slope[:, 2, 1] = (1.0 + a) * np.cos(phase)
        slope[:, 2, 2] = 0.05 * np.exp(c) * y**2
        return moved, slope

    return geometry, triangles, rim(columns, rows)


def central_difference_errors(
    predict: Callable[[np.ndarray], Prediction], m: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """Errors ``(len(steps), n)`` of each observation's derivative, at worst over parameters."""
    exact = predict(m).jacobian
    errors = []
    for step in steps:
        columns = [
            (predict(m + step * e).y - predict(m - step * e).y) / (2 * step)
            for e in np.eye(len(m))
        ]
        errors.append(np.abs(np.column_stack(columns) - exact).max(axis=1))
    return np.array(errors)


STEPS = 1e-3 * 0.5 ** np.arange(4)


def assert_second_order(errors: np.ndarray) -> None:
    """Errors ``(s, n)`` that fall by four with each step halved, unless no more than rounding."""
    fit = np.polyfit(np.log(STEPS), np.log(np.maximum(errors.max(axis=1), 1e-300)), 1)
    assert fit[0] == pytest.approx(2.0, abs=0.1), f"order {fit[0]}, errors {errors.max(axis=1)}"


def test_derivatives_on_a_moving_sheet_converge_with_second_order() -> None:
    # Points at all distances and sides, so that their closest points lie in triangles, on edges, on
    # vertices and on the border; and a curve. Where the closest point passes from one triangle or
    # side to the next within the step, the derivative is continuous but not smooth, and the order
    # is one: those few are left out, known by a step twice as large changing the error's ratio.
    geometry, triangles, loop = waves()
    m = np.array([0.3, 0.2, 0.4])
    surface_now = geometry(m)[0]
    points = surface_now[rng().integers(0, len(surface_now), 400)] + rng(2).normal(
        0, 0.4, (400, 3)
    )
    curve = surface_now[loop] + rng(4).normal(0, 0.05, (len(loop), 3))
    surface = PredictedSurface(
        len(surface_now), triangles, np.zeros(len(triangles), dtype=int), loop
    )
    observation = SurfaceObservation((seen(points, free_edge=curve),), surface, 0.4, 0.05)
    errors = central_difference_errors(observation.of(model(geometry)), m, STEPS)
    smooth = np.all(errors[1:] < errors[:-1] / 3.0, axis=0) | np.all(errors < 1e-9, axis=0)
    n = len(points)
    assert smooth[:n].mean() > 0.97
    assert smooth[n:].mean() > 0.9
    assert_second_order(errors[:, :n][:, smooth[:n]])
    assert_second_order(errors[:, n:][:, smooth[n:]])
    # A wrong derivative would not fall with the step at all.
    assert errors[-1].max() < 0.2 * errors[0].max() + 1e-3
