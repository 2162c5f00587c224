"""The Kalman filter over frames, and the smoother that looks back from the last one.

Both are of the linear-Gaussian problem

    z_k = z_{k-1} + w_k,   w_k ~ N(0, Q),     y_k = d_k + H_k z_k + v_k,   v_k ~ N(0, R_k)

with parameters z (p,) that walk at random from frame to frame, or stay (Q = 0). Names are those of
Särkkä, Bayesian Filtering and Smoothing (2013).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian, as_covariance
from mvest.estimation.information.consistency import chi_square_band
from mvest.estimation.noise import NoiseCovariance, ObservationNoise, csc, observation_noise
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

__all__ = [
    "FrameState",
    "LinearFrame",
    "Trajectory",
    "filter_frames",
    "frame_noises",
    "random_walk",
    "smooth_frames",
    "split_frames",
]


@dataclass(frozen=True, slots=True, eq=False)
class LinearFrame:
    """One frame, linear in the parameters.

    Attributes
    ----------
    y : (n,)
        Observation less the constant d of its prediction d + H z.
    H : (n, p)
    noise : ObservationNoise
    """

    y: FloatArray
    H: FloatArray
    noise: ObservationNoise


@dataclass(frozen=True, slots=True, eq=False)
class FrameState:
    """What is known of the parameters once a frame has been seen, in filter coordinates.

    Attributes
    ----------
    predicted : Gaussian
        Before the frame: z_k given y_1 ... y_{k-1}.
    filtered : Gaussian
        After it: z_k given y_1 ... y_k.
    nis : float
        Normalised innovation squared of the frame, chi-square with ``size`` degrees of freedom.
    size : int
        Number of observations in the frame.
    log_likelihood : float
        log p(y_k | y_1 ... y_{k-1}).
    information_gain : float
        nats by which the frame narrows the parameters, ½ log(det P⁻ / det P); zero for a
        frame that says nothing.
    """

    predicted: Gaussian
    filtered: Gaussian
    nis: float
    size: int
    log_likelihood: float
    information_gain: float

    @property
    def nis_band(self) -> tuple[float, float]:
        """Band that holds ``nis`` with 95 % probability if model and covariances are right."""
        return chi_square_band(self.size)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Means ``(f, p)`` and covariances ``(f, p, p)`` of parameters over f frames."""

    mean: FloatArray
    covariance: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviations (f, p)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def filter_frames(
    prior: Gaussian, frames: Sequence[LinearFrame], Q: float | FloatArray = 0.0
) -> tuple[FrameState, ...]:
    """The Kalman filter (Särkkä 2013, eq. 4.20 and 4.21), frame by frame.

    Each frame after the first is preceded by a step of the random walk::

        m⁻ = m,   P⁻ = P + Q
        m, P = update of m⁻, P⁻ with the frame     see `kalman_update`

    Parameters
    ----------
    prior : Gaussian
        Of the parameters at the first frame.
    frames : sequence of LinearFrame
    Q : one variance, p variances or (p, p)
        Covariance of one step of the walk.
    """
    walk = as_covariance(Q, prior.size, "Q")
    states: list[FrameState] = []
    known = prior
    for k, frame in enumerate(frames):
        predicted = Gaussian(known.mean, known.covariance + walk) if k else known
        update = kalman_update(predicted, frame.y - frame.H @ predicted.mean, frame.H, frame.noise)
        known = update.posterior
        gain = _log_determinant(frame, predicted)
        states.append(
            FrameState(
                predicted, known, update.nis, frame.noise.size, update.log_likelihood, 0.5 * gain
            )
        )
    return tuple(states)


def smooth_frames(states: Sequence[FrameState]) -> Trajectory:
    """The fixed-interval smoother: parameters of every frame, given all frames.

    Rauch, Tung and Striebel (1965, AIAA Journal 3:1445; Särkkä 2013, eq. 8.6), from the last frame
    backwards, with the covariances that the filter has predicted::

        G   = P_k (P⁻_{k+1})⁻¹
        mˢ_k = m_k + G (mˢ_{k+1} − m⁻_{k+1})
        Pˢ_k = P_k + G (Pˢ_{k+1} − P⁻_{k+1}) Gᵀ

    Parameters that do not walk and are known exactly make P⁻ singular; its pseudo-inverse leaves
    them as they are.
    """
    if not states:
        raise InputError("there is no frame to smooth")
    means, covariances = [states[-1].filtered.mean], [states[-1].filtered.covariance]
    for state, following in zip(states[-2::-1], states[:0:-1], strict=True):
        m, P = state.filtered.mean, state.filtered.covariance
        ahead = following.predicted
        G = _divide(P, ahead)
        means.append(m + G @ (means[-1] - ahead.mean))
        S = P + G @ (covariances[-1] - ahead.covariance) @ G.T
        covariances.append(0.5 * (S + S.T))
    return Trajectory(np.array(means[::-1]), np.array(covariances[::-1]))


def random_walk(initial: Gaussian, Q: float | FloatArray, frames: int) -> Gaussian:
    """The prior of parameters that walk at random, all frames stacked, (f p,).

    cov(z_j, z_k) = P₀ + min(j, k) Q: the form in which a filter of constant parameters smooths a
    trajectory, also where an observation depends on parameters of earlier frames.
    """
    walk = as_covariance(Q, initial.size, "Q")
    if frames < 1:
        raise InputError(f"a random walk over {frames} frames, expected at least 1")
    steps = np.minimum.outer(np.arange(frames), np.arange(frames)).astype(float)
    same = np.ones((frames, frames))
    covariance = np.asarray(np.kron(same, initial.covariance) + np.kron(steps, walk))
    return Gaussian(np.tile(initial.mean, frames), covariance.astype(np.float64))


def split_frames(values: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    """Rows (n, ...) that belong to each frame."""
    if len(values) != sum(sizes):
        raise InputError(f"{len(values)} observations, expected {sum(sizes)} in all frames")
    return np.split(values, np.cumsum(sizes)[:-1])


def frame_noises(R: NoiseCovariance, sizes: Sequence[int]) -> list[ObservationNoise]:
    """The noise of each frame out of that of all; frames must be independent of each other.

    Raises
    ------
    InputError
        If the noise correlates frames, or is factorised as a whole.
    """
    if isinstance(R, ObservationNoise):
        raise InputError(
            "noise that is factorised for all frames at once cannot be taken apart; give variances "
            "or a sparse matrix"
        )
    if isinstance(R, sparse.sparray | sparse.spmatrix):
        whole = csc(R)
        ends = np.cumsum([0, *sizes])
        rows = [slice(a, b) for a, b in pairwise(ends)]
        blocks = [whole[rows_, :][:, rows_] for rows_ in rows]
        if sum(block.nnz for block in blocks) != whole.nnz:
            raise InputError("R correlates frames, which a filter over frames cannot take")
        return [observation_noise(b, n) for b, n in zip(blocks, sizes, strict=True)]
    variance = np.asarray(R, dtype=np.float64)
    if variance.ndim == 0:
        return [observation_noise(float(variance), n) for n in sizes]
    return [
        observation_noise(v, n) for v, n in zip(split_frames(variance, sizes), sizes, strict=True)
    ]


def _divide(P: FloatArray, by: Gaussian) -> FloatArray:
    """P (p, p) times the (pseudo-)inverse of a covariance, scaled so that units play no part."""
    std = np.where(by.std > 0.0, by.std, 1.0)
    inverse = np.linalg.pinv(by.covariance / np.outer(std, std), hermitian=True)
    return np.asarray(P @ (inverse / np.outer(std, std)))


def _log_determinant(frame: LinearFrame, predicted: Gaussian) -> float:
    """The log of det(I + Lᵀ Hᵀ R⁻¹ H L) with P⁻ = L Lᵀ, which is log(det P⁻ / det P)."""
    s = np.linalg.svd(frame.noise.whiten(frame.H) @ predicted.factor, compute_uv=False)
    return float(np.sum(np.log1p(s**2)))
