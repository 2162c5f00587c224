"""Each error of observation against its analytic statistics."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import observation_noise
from mvest.observation.errors import (
    AnnulusOffset,
    CoaptationDropout,
    CorrelatedNoise,
    SpatialCorrelation,
    WhiteNoise,
    observe,
)
from mvest.observation.vertices import Observation
from mvest.valve.anatomy.valve import LeafletSurface


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


LINE = np.column_stack([np.linspace(0.0, 20.0, 41), np.zeros(41), np.zeros(41)])
DRAWS = 2000


def test_white_noise_has_its_variance_and_no_correlation() -> None:
    true = np.zeros((2, 5000, 3))
    noise = observe(true, [WhiteNoise(0.5)], rng())
    # Standard error of the SD of n normal numbers: 0.5 / sqrt(2 n).
    assert noise.std() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2 * noise.size))
    assert noise.mean() == pytest.approx(0.0, abs=4 * 0.5 / np.sqrt(noise.size))
    flat = noise.transpose(1, 0, 2).reshape(5000, 6)
    correlation = np.corrcoef(flat.T) - np.eye(6)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(5000)
    assert abs(np.corrcoef(flat[1:, 0], flat[:-1, 0])[0, 1]) < 4.5 / np.sqrt(5000)


def test_correlated_noise_has_its_variance_and_correlation_everywhere() -> None:
    correlation = SpatialCorrelation(LINE, 5.0)
    # Exact, whatever is drawn: the rows of the factor have length one.
    np.testing.assert_allclose((correlation.factor**2).sum(axis=1), 1.0, rtol=1e-12)
    noise = CorrelatedNoise(0.5, correlation)
    generator = rng(3)
    drawn = np.array([observe(np.zeros((1, 41, 3)), [noise], generator) for _ in range(DRAWS)])
    samples = drawn[:, 0].transpose(0, 2, 1).reshape(-1, 41)  # 3 independent coordinates
    found = samples.T @ samples / len(samples)
    # Matern 3/2 by hand at 0, 5 and 10 mm: 1, 2.7321 e^-1.7321 = 0.4834, 4.4641 e^-3.4641 = 0.1397.
    for gap, expected in ((0, 1.0), (10, 0.4834), (20, 0.1397)):
        values = np.diagonal(found, gap) / 0.25
        # Each entry has a standard error of sqrt((1 + C^2) / 6000) <= 0.018.
        np.testing.assert_allclose(values, expected, atol=4.5 * 0.0183)
    between = drawn[:, 0, 20]
    assert np.abs(np.corrcoef(between.T) - np.eye(3)).max() < 4.5 / np.sqrt(DRAWS)


@pytest.mark.parametrize("length", [0.0, -1.0, np.nan])
def test_an_inadmissible_length_is_refused(length: float) -> None:
    with pytest.raises(InputError, match="correlation length"):
        SpatialCorrelation(LINE, length)


def facing(gap: float) -> tuple[LeafletSurface, np.ndarray]:
    """Two sheets of 2 x 5 vertices, 10 mm apart at rest and ``gap`` apart in the closed frame.

    Rows of vertices are 1 mm apart; the last rows (4 mm up) share no vertex.
    """
    x, z = (v.ravel() for v in np.meshgrid([0.0, 1.0], np.arange(5.0), indexing="ij"))
    cells = [(i, i + 1, i + 5) for i in range(4)] + [(i + 1, i + 6, i + 5) for i in range(4)]
    triangles = np.array(cells + [tuple(10 + k for k in c) for c in cells])

    def sheets(y: np.ndarray) -> np.ndarray:
        return np.concatenate([np.column_stack([x, 0 * x, z]), np.column_stack([x, y, z])])

    surface = LeafletSurface(
        sheets(np.full(10, 10.0)),
        triangles,
        np.repeat([0, 1], 8),
        ("anterior", "posterior"),
        np.tile([1.0, 0.0, 0.0], (20, 1)),
        np.ones(20),
    )
    # The second sheet leans away: touching (gap) at the bottom, one mm more for each row above.
    return surface, sheets(gap + z)


def test_vertices_near_the_other_leaflet_are_not_seen() -> None:
    surface, closed = facing(0.5)
    true = np.stack([surface.vertices, closed])
    seen = observe(true, [CoaptationDropout(1.2, surface)], rng())
    assert np.isfinite(seen[0]).all()
    hidden = np.isnan(seen[1]).all(axis=1)
    # Second sheet: rows at y = 0.5, 1.5, ... are that far from the upright first one: one row.
    assert hidden[10:].reshape(2, 5).tolist() == [[True] + [False] * 4] * 2
    # First sheet to the second, which is at 45 degrees: (0.5 + z) / sqrt 2, and 0.5 at z = 0, where
    # the foot would lie beyond the edge: 0.5, 1.06, 1.77, ...: two rows.
    assert hidden[:10].reshape(2, 5).tolist() == [[True, True] + [False] * 3] * 2
    np.testing.assert_array_equal(seen[1][~hidden], true[1][~hidden])


def test_the_annulus_offset_moves_the_closed_frame_as_one() -> None:
    true = rng().normal(size=(2, 6, 3))
    seen = observe(true, [AnnulusOffset((0.0, 0.5, 1.0))], rng())
    np.testing.assert_array_equal(seen[0], true[0])
    np.testing.assert_allclose(seen[1] - true[1], np.tile([0.0, 0.5, 1.0], (6, 1)))
    with pytest.raises(InputError, match="three finite"):
        AnnulusOffset((0.0, np.nan, 1.0))


def test_scales_multiply_standard_deviations() -> None:
    points, expected = np.array([[0.0, 0, 0], [100.0, 0, 0]]), np.repeat([0.25, 1.0], 3)
    for correlation in (None, SpatialCorrelation(points, 1.0)):
        seen = Observation(
            ("closed",), points[None], np.array(0.25), correlation, np.array([1.0, 2.0])
        )
        W = observation_noise(seen.R, 6).whiten(np.eye(6))
        np.testing.assert_allclose(np.diag(np.linalg.inv(W.T @ W)), expected, rtol=1e-9)


def test_what_is_near_at_rest_is_no_coaptation() -> None:
    surface, _ = facing(0.5)
    joined = LeafletSurface(
        facing(0.5)[1], surface.triangles, surface.region, surface.region_names,
        surface.fibre, surface.thickness,
    )  # fmt: skip
    true = joined.vertices[None]
    np.testing.assert_array_equal(observe(true, [CoaptationDropout(1.2, joined)], rng()), true)
