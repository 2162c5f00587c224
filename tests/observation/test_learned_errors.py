"""Priors of observation errors as the noise of each kind of observation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.estimation import Gaussian, IteratedFilter, Prediction
from mvest.estimation.evidence import Evidence
from mvest.estimation.noise import NoiseFamily
from mvest.estimation.spectrum import matern
from mvest.observation.learned import CURVES, ROUGH, ErrorBeliefs, error_family
from mvest.observation.surfaces import ObservedSurface, PredictedSurface, SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.typing import FloatArray, IntArray

SIDE = 16


def sheet() -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) mm of a flat sheet and its triangles."""
    x, y = np.meshgrid(np.arange(SIDE) * 1.5, np.arange(SIDE) * 1.5)
    k = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(SIDE**2)])
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


POINTS, TRIANGLES = sheet()
N = len(POINTS)
BELIEFS = ErrorBeliefs()


def covariance(family: NoiseFamily) -> FloatArray:
    """The stated R."""
    W = family.stated().whiten(np.eye(family.size))
    return np.asarray(np.linalg.inv(W.T @ W), dtype=np.float64)


def test_frames_scales_and_unseen_vertices_are_those_of_the_observation() -> None:
    positions = np.zeros((2, N, 3))
    positions[0, :30] = np.nan
    scale = np.linspace(0.5, 2.0, N)
    seen = Observation(("open", "closed"), positions, np.array([0.16, 0.64]), None, scale)
    family = error_family(seen, BELIEFS, 8.0, POINTS)
    assert family.size == len(seen.y)
    assert set(family.quantities) == {ROUGH, "frame open"}
    assert family.quantities["frame open"].median == 1.0
    variance = np.diag(covariance(family))
    rough = (BELIEFS.other_share * 0.8) ** 2 + BELIEFS.resolution_mm**2
    of_frame = np.split(variance / np.concatenate([np.repeat(s, 3) for s in
                        (scale[30:] * 0.4 / 0.8, scale)]) ** 2, [3 * (N - 30)])  # fmt: skip
    for values in of_frame:
        # On average what is stated; a resolution apart, and the edges more than the middle.
        assert values.mean() == pytest.approx(0.64 + rough, rel=0.1)
    # Coordinates and frames are independent of each other.
    R = covariance(family)
    assert np.abs(R[0::3, 1::3]).max() < 1e-12
    assert np.abs(R[: 3 * (N - 30), 3 * (N - 30) :]).max() < 1e-12


def surface_observation(height: FloatArray, curve: FloatArray) -> SurfaceObservation:
    """A sheet of two leaflets seen displaced by a height (n,), and its border."""
    border = np.concatenate(
        [np.arange(SIDE), np.arange(1, SIDE) * SIDE + SIDE - 1,
         SIDE**2 - 2 - np.arange(SIDE - 1), SIDE * (SIDE - 2 - np.arange(SIDE - 2))]
    )  # fmt: skip
    inner = np.all((POINTS[:, :2] > 1.0) & (POINTS[:, :2] < 21.0), axis=1)
    leaflet = (POINTS[TRIANGLES].mean(axis=1)[:, 0] > 11.25).astype(np.int64)
    of_point = (POINTS[:, 0] > 11.25).astype(np.int64)
    seen = ObservedSurface(
        "closed",
        (POINTS + np.outer(height, [0, 0, 1.0]))[inner],
        of_point[inner],
        free_edge=POINTS[border] + curve,
    )
    surface = PredictedSurface.refined(POINTS, TRIANGLES, leaflet, border, 2.0, 1.0)
    return SurfaceObservation((seen,), surface, 0.5)


def test_a_filter_learns_the_errors_of_distances_and_of_curves() -> None:
    rng = np.random.default_rng(6)
    K = matern(cdist(POINTS, POINTS), 6.0) + 1e-9 * np.eye(N)
    height = 0.3 * np.linalg.cholesky(K) @ rng.standard_normal(N) + 0.15 * rng.standard_normal(N)
    curve = 0.8 * rng.standard_normal((4 * SIDE - 4, 3))
    observation = surface_observation(height + 0.7, curve + np.array([0.0, 0.0, 0.7]))
    motion = np.zeros((N, 3, 2))
    motion[:, 2, 0] = 1.0
    motion[:, 2, 1] = (POINTS[:, 0] - 11.25) / 10.0

    def model(m: FloatArray) -> Prediction:
        whole = POINTS + motion @ m
        return Prediction(
            np.concatenate([POINTS.ravel(), whole.ravel()]),
            np.concatenate([np.zeros((3 * N, 2)), motion.reshape(3 * N, 2)]),
        )

    prior = Gaussian(np.zeros(2), np.eye(2))
    family = error_family(observation, BELIEFS, 8.0, POINTS[None])
    found = IteratedFilter(1e-5)(observation.of(model), prior, observation.y, family)
    assert found.converged
    assert np.all(np.abs(found.mean - [0.7, 0.0]) < 3.0 * found.std)
    assert found.std[0] > 0.05
    assert found.learned is not None
    by_name = {quantity.name: quantity.learned for quantity in found.learned.quantities}
    for name, true in ((ROUGH, 0.15), (CURVES, 0.8), ("smooth part", 0.3)):
        low, high = by_name[name].interval(0.99)
        assert low < true < high, name


@pytest.mark.parametrize(("smooth", "rough"), [(0.6, 0.02), (0.3, 0.5)])
def test_intervals_hold_although_points_are_seen_with_their_errors(
    smooth: float, rough: float
) -> None:
    # Correlated over the points as seen, which contain errors and tilt, 24 and 3 of them hold.
    rng, runs, held = np.random.default_rng(3), 40, 0
    root = np.linalg.cholesky(matern(cdist(POINTS, POINTS), 8.0) + 1e-9 * np.eye(N))
    one = np.zeros(len(TRIANGLES), dtype=np.int64)
    surface = PredictedSurface.refined(POINTS, TRIANGLES, one, None, 2.0, 1.0)
    inner = np.all((POINTS[:, :2] > 2.9) & (POINTS[:, :2] < 19.6), axis=1)
    H = np.column_stack([np.ones(N), (POINTS[:, 0] - 11.25) / 10.0])[inner]
    for _ in range(runs):
        errors = smooth * root @ rng.standard_normal((N, 3)) + rough * rng.standard_normal((N, 3))
        points, truth = (POINTS + errors)[inner], rng.standard_normal(2)
        points[:, 2] += H @ truth
        seen = ObservedSurface("closed", points, np.zeros(len(points), dtype=np.int64))
        family = error_family(
            SurfaceObservation((seen,), surface, 0.5), BELIEFS, 10.0, POINTS[None]
        )
        evidence = Evidence(family, points[:, 2], H)
        posterior = evidence.posterior()
        mean, found = evidence.update(evidence.log(posterior.mean), 2)
        variance = (found + evidence.learned(posterior, np.eye(2)).covariance)[1, 1]
        held += int(abs(mean[1] - truth[1]) < 1.96 * np.sqrt(variance))
    assert held >= 0.8 * runs


def test_errors_of_a_curve_are_correlated_along_it_alone() -> None:
    observation = surface_observation(np.zeros(N), np.zeros((4 * SIDE - 4, 3)))
    R = covariance(error_family(observation, BELIEFS, 8.0, POINTS[None]))
    q = len(observation.seen[0].points)
    assert np.abs(R[:q, q:]).max() < 1e-12
    curve = R[q:, q:].reshape(4 * SIDE - 4, 2, 4 * SIDE - 4, 2)
    assert np.abs(curve[:, 0, :, 1]).max() < 1e-12
    alike = curve[:, 0, :, 0] / np.sqrt(np.outer(*2 * [np.diag(curve[:, 0, :, 0])]))
    # Neighbours are 1.5 mm apart, points of opposite sides 22 mm.
    middle = SIDE // 2
    assert alike[middle, middle + 1] > 0.8
    assert abs(alike[middle, middle + 2 * SIDE]) < 0.3
    # As large as stated, with a fifth of it in the rough part.
    size = np.sqrt(np.trace(R[q:, q:]) / len(R[q:]))
    assert size == pytest.approx(0.5 * np.hypot(1.0, BELIEFS.other_share), rel=0.2)


BAD = (
    ("std_factor", 0.5), ("length_mm", 0.0), ("other_share", np.inf),
)  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_an_inadmissible_belief_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"errors {name} = {value}, expected"):
        replace(BELIEFS, **{name: value})
