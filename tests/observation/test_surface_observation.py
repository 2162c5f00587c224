"""Observations without correspondence, against distances and derivatives known by hand."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from mvest.errors import InputError
from mvest.estimation import (
    Prediction,
    observation_noise,
)
from mvest.observation.surfaces import (
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
    return vertices, surface_of(vertices, triangles, free_edge=loop)


def surface_of(
    vertices: np.ndarray,
    triangles: np.ndarray,
    region: np.ndarray | None = None,
    free_edge: np.ndarray | None = None,
    width: float = 1.0,
) -> PredictedSurface:
    """A surface drawn with edges of the width over which it is smoothed."""
    region = np.zeros(len(triangles), dtype=int) if region is None else region
    return PredictedSurface.refined(vertices, triangles, region, free_edge, width, width)


def band(ring: np.ndarray, width: float) -> tuple[np.ndarray, PredictedSurface]:
    """A narrow band within a ring, which is its free edge."""
    n = len(ring)
    k, after = np.arange(n), np.roll(np.arange(n), -1)
    triangles = np.concatenate(
        [np.column_stack([k, after, n + k]), np.column_stack([after, n + after, n + k])]
    )
    vertices = np.concatenate([ring, 0.98 * ring])
    return vertices, surface_of(vertices, triangles, free_edge=k, width=width)


def seen(points: np.ndarray, region: int | np.ndarray = 0, **curves) -> ObservedSurface:
    return ObservedSurface("closed", points, np.broadcast_to(region, len(points)), **curves)


def scattered(n: int, z: float | np.ndarray, seed: int = 1) -> np.ndarray:
    """Points over the inside of the square, at height z."""
    return np.column_stack([rng(seed).uniform(1.0, 9.0, (n, 2)), np.broadcast_to(z, n)])


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


def test_a_point_belongs_to_its_own_leaflet_even_where_another_is_nearer() -> None:
    # Two parallel leaflets 2 mm apart, facing each other; a point 0.5 mm above the lower one.
    vertices, triangles = grid(4, 4)
    both = np.concatenate([vertices, vertices + np.array([0, 0, 2.0])])
    surface = surface_of(
        both,
        np.concatenate([triangles, triangles[:, ::-1] + len(vertices)]),
        np.repeat([0, 1], len(triangles)),
        width=0.15,
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
    vertices, surface = band(3 * ring, width=0.02)
    turn = 2 * np.pi * rng().uniform()
    s = turn + np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.column_stack([4 * np.cos(s), 4 * np.sin(s), np.ones(60)])
    only = ObservedSurface("closed", np.empty((0, 3)), np.empty(0, dtype=int), free_edge=circle)
    observation = SurfaceObservation((only,), surface, 0.1)
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


# --- noise --------------------------------------------------------------------------------------


def test_errors_are_correlated_within_a_leaflet_and_a_frame_only() -> None:
    # Two leaflets at one place and in two frames: of the four blocks, only those on the diagonal.
    # The curve is one, and each of its points has two independent components.
    vertices, triangles = grid(4, 4)
    both = np.concatenate([vertices, vertices])
    surface = surface_of(
        both,
        np.concatenate([triangles, triangles + len(vertices)]),
        np.repeat([0, 1], len(triangles)),
        rim(4, 4),
    )
    points, region = scattered(12, 0.0), np.repeat([0, 1], 6)
    points[6:] = points[:6]
    frames = tuple(
        ObservedSurface(name, points, region, free_edge=vertices[rim(4, 4)]) for name in FRAMES
    )
    observation = SurfaceObservation(frames, surface, 0.5, 4.0)
    n = observation.y.size
    assert n == 2 * (12 + 2 * 12)
    noise = observation_noise(observation.R, n)
    W = noise.whiten(np.eye(n))
    R = np.linalg.inv(W.T @ W)

    def matern(at):  # C(d) = (1 + sqrt(3) d / l) exp(-sqrt(3) d / l), times 0.5^2
        d = np.sqrt(3) / 4.0 * np.linalg.norm(at[:, None] - at, axis=2)
        return 0.25 * (1 + d) * np.exp(-d)

    leaflet, curve = matern(points[:6]), np.kron(matern(vertices[rim(4, 4)]), np.eye(2))
    expected = block_diag(*2 * [leaflet, leaflet, curve])
    np.testing.assert_allclose(R, expected, atol=1e-9)
    assert noise.log_determinant == pytest.approx(np.linalg.slogdet(expected)[1], rel=1e-9)


def test_curves_have_as_many_degrees_of_freedom_as_noise() -> None:
    # A ring of 15 mm seen at 200 points, 0.47 mm apart, with noise of each coordinate.
    # Across it are two components each; counting three would give 2/3. Where points are nearer to
    # each other than the noise, directions between neighbours would be any, and give 2/3 again.
    # Directions are known to 1 / (6 sqrt(2)) rad, which takes 1/72 = 0.014 off.
    std, t = 0.5, np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = 15 * np.column_stack([np.cos(t), np.sin(t), 0 * t])
    vertices, surface = band(ring, width=0.2)
    squares = []
    for seed in range(40):
        curve = ring + std * rng(seed).normal(size=ring.shape)
        observation = SurfaceObservation((seen(np.empty((0, 3)), free_edge=curve),), surface, std)
        prediction = observation.of(model(translated(vertices)))(np.zeros(3))
        e = observation_noise(observation.R, 400).whiten(observation.y - prediction.y)
        squares.append(e @ e / 400)
    # 16000 squares of normal numbers have a mean of 1 with a standard error of 0.011.
    assert np.mean(squares) == pytest.approx(1.0 - 1 / 72, abs=3 * 0.011)


# --- frames and failures ------------------------------------------------------------------------


def test_frames_are_chosen_by_name_out_of_any_number() -> None:
    vertices, surface = plane()
    names = ("open", "half", "closed")
    last = lambda m: model(translated(vertices), frames=3)(m)  # noqa: E731
    points = scattered(5, 1.0)
    frames = tuple(
        ObservedSurface(name, points, np.zeros(5, dtype=int)) for name in ("closed", "half")
    )
    predict = SurfaceObservation(frames, surface, 1.0, predicted=names).of(last)
    m = np.array([0.0, 0.0, 0.4])
    prediction = predict(m)
    # Only the closed frame, here the first observed one, moves.
    np.testing.assert_allclose(prediction.y, np.repeat([0.6, 1.0], 5), atol=1e-14)
    np.testing.assert_allclose(prediction.jacobian[:, 2], np.repeat([-1.0, 0.0], 5), atol=1e-14)
    np.testing.assert_array_equal(prediction.aux, [vertices + m, vertices])
    with pytest.raises(InputError, match="half"):
        SurfaceObservation(frames, surface, 1.0).of(last)


def test_a_model_that_fails_or_does_not_fit_says_so() -> None:
    vertices, surface = plane()
    observation = SurfaceObservation((seen(scattered(5, 1.0)),), surface, 1.0)
    newton = Prediction.failed("Newton's method did not converge")
    assert observation.of(lambda m: newton)(np.zeros(3)) is newton
    with pytest.raises(InputError, match="20 vertices"):
        observation.of(model(translated(vertices[:-1])))(np.zeros(3))


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"points": np.full((3, 3), np.nan)}, "finite"),
        ({"region": np.zeros(2, dtype=int)}, "expected \\(3,\\)"),
        ({"free_edge": SQUARE[:2]}, "three or more"),
    ],
)
def test_wrong_points_and_curves_are_refused(change: dict, words: str) -> None:
    given = {"points": np.zeros((3, 3)), "region": np.zeros(3, dtype=int)}
    with pytest.raises(InputError, match=words):
        ObservedSurface("closed", **(given | change))


@pytest.mark.parametrize(
    ("frame", "settings", "words"),
    [
        ({}, {"std_mm": 0.0}, "std_mm = 0"),
        ({"region": np.array([0, 0, 3])}, {}, "region 3"),
        ({"points": np.empty((0, 3)), "region": np.empty(0, dtype=int)}, {}, "nothing is seen"),
    ],
)
def test_an_observation_that_cannot_be_is_refused(frame: dict, settings: dict, words: str) -> None:
    surface = surface_of(SQUARE[:3], np.array([[0, 1, 2]]), free_edge=np.array([0, 1, 2]))
    of_frame = {"points": np.zeros((3, 3)), "region": np.zeros(3, dtype=int)} | frame
    with pytest.raises(InputError, match=words):
        SurfaceObservation(
            (ObservedSurface("closed", **of_frame),), surface, **({"std_mm": 1.0} | settings)
        )
    bare = replace(surface, free_edge=None)
    with pytest.raises(InputError, match="surface has none"):
        SurfaceObservation((seen(np.zeros((3, 3)), free_edge=SQUARE),), bare, 1.0)
    frames = (seen(np.zeros((3, 3))),) * 2
    with pytest.raises(InputError, match="observed frames"):
        SurfaceObservation(frames, surface, 1.0)


# --- for reporting ------------------------------------------------------------------------------


def test_the_mean_distance_is_by_area_and_of_both_ways() -> None:
    # A square 1 mm above a larger one. Every vertex of the small one is 1 mm away; of the large one
    # (2 x 2 triangles, one central vertex) the corners and sides are farther.
    small, small_triangles = grid(3, 3, 2.0)
    large, large_triangles = grid(3, 3, 4.0)
    small += 1.0
    distance = surface_distance(large, small, small_triangles)
    expected = np.sqrt([3, 2, 3, 2, 1, 2, 3, 2, 3])
    np.testing.assert_allclose(distance, expected, atol=1e-14)
    # Areas of the vertices in eights of the triangles' corners: two corners have two triangles and
    # two have one, the sides three, the middle six.
    weight = np.array([2, 3, 1, 3, 6, 3, 1, 3, 2])
    both = 0.5 * (1.0 + np.average(expected, weights=weight))
    found = mean_surface_distance(small, small_triangles, large, large_triangles)
    assert found == pytest.approx(both, rel=1e-12)
    assert mean_surface_distance(large, large_triangles, small, small_triangles) == found
