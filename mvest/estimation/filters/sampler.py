"""Draws from a posterior by an affine-invariant ensemble sampler, and whether they are enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import read_only
from mvest.quantities import Count, Factor, within
from mvest.typing import FloatArray

LogDensity: TypeAlias = Callable[[FloatArray], FloatArray]
"""Logarithm of a density, up to a constant, at many points (k, p), as (k,); −inf where it is 0."""

BURN_IN = 0.25
"""Share of the steps of each chain that is left out at its beginning."""


@dataclass(frozen=True, slots=True)
class SamplerSettings:
    """How much is drawn, and when it is enough.

    Attributes
    ----------
    chains : int
        Independent ensembles of walkers, whose agreement is what `r_hat` says.
    walkers : int
        Of each ensemble.
    steps : int
        Of each walker.
    largest_r_hat : float
    least_effective : float
        Effective draws of each parameter.
    """

    chains: Count = 4
    walkers: Count = 24
    steps: Count = 1500
    largest_r_hat: Factor = 1.02
    least_effective: Annotated[float, within(0, 100_000, "", "draws")] = 1000.0

    def __post_init__(self) -> None:
        if self.chains < 2 or self.walkers < 4 or self.steps < 20:
            raise InputError(
                f"a sampler needs at least 2 chains of 4 walkers and 20 steps; got {self.chains}, "
                f"{self.walkers} and {self.steps}"
            )
        if not self.largest_r_hat > 1.0 or not self.least_effective > 0.0:
            raise InputError(
                f"the largest R-hat must be above 1 and the smallest number of effective draws "
                f"positive; got {self.largest_r_hat} and {self.least_effective}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Draws:
    """Draws from a density of p parameters, burn-in left out.

    Attributes
    ----------
    points : (s, p)
        Of all chains and walkers.
    autocorrelation_time : (p,)
        Steps after which a walker has forgotten where it was, the mean over the chains.
    effective : (p,)
        Independent draws that tell as much about the mean as all s.
    r_hat : (p,)
        See `split_r_hat`.
    acceptance : float
        Share of the proposed moves that were taken.
    """

    points: FloatArray
    autocorrelation_time: FloatArray
    effective: FloatArray
    r_hat: FloatArray
    acceptance: float

    @property
    def mean_error(self) -> FloatArray:
        """Standard error (p,) of the mean of the draws."""
        return np.asarray(self.points.std(axis=0, ddof=1) / np.sqrt(self.effective))

    def enough(self, settings: SamplerSettings) -> bool:
        """Whether the chains agree and forget often enough."""
        agree = np.all(self.r_hat <= settings.largest_r_hat)
        return bool(agree and np.all(self.effective >= settings.least_effective))


def draw(
    density: LogDensity, start: Gaussian, settings: SamplerSettings, rng: np.random.Generator
) -> Draws:
    """Draw with stretch moves (Goodman and Weare 2010, Commun. Appl. Math. Comput. Sci. 5:65).

    The moves are those of emcee (Foreman-Mackey, Hogg, Lang and Goodman 2013, PASP 125:306). They
    need no scale to be tuned, since they are the same in any linear coordinates.

    Parameters
    ----------
    density : callable
    start : Gaussian
        From which the walkers start; those of zero density are drawn again.
    settings : SamplerSettings
    rng : numpy.random.Generator

    Raises
    ------
    InputError
        If there are fewer walkers than the moves need, or no start of positive density is found.
    """
    import emcee  # loads most of SciPy, for this function alone

    if settings.walkers < 2 * start.size:
        raise InputError(
            f"{start.size} parameters need at least {2 * start.size} walkers; got "
            f"{settings.walkers}"
        )
    chains, accepted = [], []
    for _ in range(settings.chains):
        sampler = emcee.EnsembleSampler(settings.walkers, start.size, density, vectorize=True)
        # emcee knows the older kind of generator only.
        sampler.random_state = np.random.RandomState(int(rng.integers(2**32))).get_state()
        sampler.run_mcmc(_starts(density, start, settings.walkers, rng), settings.steps)
        chains.append(sampler.get_chain(discard=int(BURN_IN * settings.steps)))
        accepted.append(float(np.mean(sampler.acceptance_fraction)))
    # (chains, steps, walkers, p)
    drawn = np.array(chains)
    times = np.array(
        [emcee.autocorr.integrated_time(chain, tol=0, quiet=True) for chain in drawn]
    ).mean(axis=0)
    times = np.maximum(times, 1.0)
    points = drawn.reshape(-1, start.size)
    return Draws(
        points=read_only(points),
        autocorrelation_time=read_only(times),
        effective=read_only(len(points) / times),
        r_hat=read_only(split_r_hat(drawn)),
        acceptance=float(np.mean(accepted)),
    )


def split_r_hat(chains: FloatArray) -> FloatArray:
    """Potential scale reduction (p,) of draws (chains, steps, walkers, p).

    The walkers of one chain are not independent of each other, so that a sequence is one half of
    one chain with all its walkers. With the mean variance w within the m sequences and the variance
    b of their means, it is √((w + b) / w) (Gelman et al., Bayesian Data Analysis, 3rd ed. 2013,
    section 11.4, for long sequences): 1 where all halves of all chains tell the same.
    """
    count, steps, _, size = chains.shape
    half = steps // 2
    sequences = chains[:, : 2 * half].reshape(2 * count, -1, size)
    within = sequences.var(axis=1, ddof=1).mean(axis=0)
    between = sequences.mean(axis=1).var(axis=0, ddof=1)
    return np.asarray(np.sqrt((within + between) / within))


def _starts(
    density: LogDensity, start: Gaussian, walkers: int, rng: np.random.Generator
) -> FloatArray:
    """Walkers (w, p) of positive density."""
    starts = np.empty((0, start.size))
    for _ in range(100):
        drawn = start.mean + rng.standard_normal((walkers, start.size)) @ start.factor.T
        starts = np.vstack([starts, drawn[np.isfinite(density(drawn))]])
        if len(starts) >= walkers:
            return starts[:walkers]
    raise InputError("no start of positive density is found for the walkers of a sampler")
