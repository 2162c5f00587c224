"""Which parameters the data distinguish, from the Jacobian; shift by an error of the model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from mvest.errors import InputError
from mvest.estimation.estimate import Estimate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance, observation_noise
from mvest.estimation.prediction import require_finite
from mvest.estimation.transform import to_filter
from mvest.estimation.update import kalman_update
from mvest.typing import FloatArray

STEP = 0.1
"""Change of the first parameter of a trade-off, relative to its scale."""
RELEVANT_SHARE = 0.1
"""Smallest share in a combination for a parameter to be named."""
UNDETERMINED = ("not determined at all", "known to no better than its own size")
"""Words for combinations with an infinite standard deviation, and with one of their scales."""


@dataclass(frozen=True, slots=True)
class TradeOff:
    """Parameters that compensate each other in the data."""

    parameters: tuple[str, ...]  #: tuple of str, (q,), the first is most correlated with the others
    #: tuple of float, (q,), changes in their units that hardly affect the data together: the first
    #: by `STEP` of its scale, the others by cov(i, first) / var(first) of that
    changes: tuple[float, ...]
    relative: tuple[float, ...]  #: tuple of float, (q,), the same relative to their scales
    #: smallest absolute correlation of the first with one of the others, at the bound
    correlation: float


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """Fisher information of p parameters in units of their scales."""

    names: tuple[str, ...]  #: tuple of str, (p,)
    #: (p,) in units of each parameter, A large change of each parameter; eigenvectors depend on it
    scale: FloatArray
    #: (p, p), D Hᵀ R⁻¹ H D, D = diag(scale), plus D P⁻¹ D of a prior if given
    information: FloatArray
    #: (p,), ascending, A combination with eigenvalue λ has the standard deviation 1/√λ, relative to
    #: the scales
    eigenvalues: FloatArray
    eigenvectors: FloatArray  #: (p, p), in columns; the first is the least known combination
    #: (p, p) in products of the parameters' units, cramér-Rao bound: no unbiased estimator has a
    #: smaller covariance. Infinite (and NaN off the diagonal) for parameters that the data leave
    #: undetermined.
    covariance: FloatArray

    @property
    def std(self) -> FloatArray:
        """Smallest attainable standard deviations (p,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def condition_number(self) -> float:
        """Largest over smallest eigenvalue; infinite if a combination is undetermined."""
        smallest = float(self.eigenvalues[0])
        return float(self.eigenvalues[-1]) / smallest if smallest > 0.0 else np.inf

    @property
    def correlation(self) -> FloatArray:
        """Correlations (p, p) at the bound; NaN for undetermined parameters."""
        std = self.std
        result = np.full_like(self.covariance, np.nan)
        known = np.ix_(np.isfinite(std), np.isfinite(std))
        result[known] = self.covariance[known] / np.outer(std, std)[known]
        return result

    def flat(self, limit: float = 0.5) -> tuple[str, ...]:
        """Combinations with a standard deviation above `limit` of the scales, in words."""
        with np.errstate(divide="ignore"):
            widths = 1.0 / np.sqrt(self.eigenvalues)
        words = []
        for vector, width in zip(self.eigenvectors.T, widths, strict=True):
            if width > limit:
                # The largest share first, and positive.
                order = np.argsort(-np.abs(vector))
                own = vector * np.sign(vector[order[0]])
                named = [i for i in order if abs(own[i]) >= RELEVANT_SHARE]
                terms = " ".join(f"{own[i]:+.2f} {self.names[i]}" for i in named).removeprefix("+")
                known = f"known to ±{100 * width:.3g} %"
                words.append(
                    f"{terms}: {known if width < 1 else UNDETERMINED[int(width < np.inf)]}"
                )
        return tuple(words)

    def confounded(self, limit: float = 0.9, width: float = 0.05) -> tuple[TradeOff, ...]:
        """Groups of parameters that the data hardly distinguish, the largest group first.

        Two are grouped if their absolute correlation at the bound is at least `limit` and both have
        standard deviations of at least `width` of their scales. Undetermined parameters have no
        correlation; see `flat`.
        """
        uncertain = self.std / self.scale >= width
        size = np.where(np.outer(uncertain, uncertain), np.abs(self.correlation), 0.0)
        # NaN compares as false.
        alike = sparse.coo_array(size >= limit)
        count, group = connected_components(cast(Any, alike), directed=False)
        groups = []
        for label in range(count):
            members = np.flatnonzero(group == label)
            if members.size < 2:
                continue
            first = members[np.argmax(size[np.ix_(members, members)].sum(axis=0))]
            others = [int(i) for i in members[np.argsort(-size[first, members])] if i != first]
            order = [int(first), *others]
            scaled = self.covariance[order, first] / (self.scale[order] * self.scale[first])
            relative = STEP * (scaled / scaled[0])
            groups.append(
                TradeOff(
                    tuple(self.names[i] for i in order),
                    tuple((relative * self.scale[order]).tolist()),
                    tuple(relative.tolist()),
                    float(size[first, others].min()),
                )
            )
        return tuple(sorted(groups, key=lambda one: -len(one.parameters)))


def identifiability(
    H: FloatArray,
    R: NoiseCovariance,
    scale: FloatArray,
    *,
    prior: Gaussian | None = None,
    names: Sequence[str] | None = None,
) -> Identifiability:
    """Cramér-Rao bound and flat directions of an observation with Jacobian H and noise R.

    With W H D = U diag(s) Vᵀ, Wᵀ W = R⁻¹, D = diag(scale), the scaled Fisher information is
    V diag(s²) Vᵀ and the bound D V diag(s⁻²) Vᵀ D. A prior is one more observation (Van Trees'
    bound, to first order).

    InputError if shapes disagree, or a value is not admissible.

    Parameters
    ----------
    H : (n, p) in units of the observation per unit of each parameter
    R : NoiseCovariance, in squared units of the observation
    scale : (p,) in units of each parameter
        Positive; with the parameters' values, results are relative.
    prior : Gaussian, optional
        Positive definite.
    names : p names, optional
    """
    H = np.asarray(H, dtype=np.float64)
    if H.ndim != 2 or H.size == 0:
        raise InputError(f"a Jacobian must have shape (n, p); got {H.shape}")
    require_finite(H, "the Jacobian")
    n, p = H.shape
    D = np.asarray(scale, dtype=np.float64)
    if D.shape != (p,) or not np.all(np.isfinite(D)) or np.any(D <= 0.0):
        raise InputError(f"scale must be {p} positive numbers; got {scale}")
    names = tuple(f"m[{i}]" for i in range(p)) if names is None else tuple(names)
    if len(names) != p:
        raise InputError(f"{p} parameters need as many names; got {names}")

    rows = observation_noise(R, n).whiten(H) * D
    if prior is not None:
        if prior.size != p:
            raise InputError(f"the prior must have {p} parameters; it has {prior.size}")
        try:
            rows = np.vstack([rows, np.linalg.solve(prior.factor, np.diag(D))])
        except np.linalg.LinAlgError as error:
            raise InputError(
                "the prior's covariance must be positive definite here; leave fixed parameters out"
            ) from error
    _, s, Vt = np.linalg.svd(rows, full_matrices=len(rows) < p)
    s = np.concatenate([s, np.zeros(p - s.size)])
    s[s <= s[0] * np.finfo(np.float64).eps * max(rows.shape)] = 0.0
    s, V = s[::-1], Vt[::-1].T
    known = s > 0.0
    X = D[:, None] * V[:, known] / s[known]
    covariance = X @ X.T
    # A parameter with a share in an undetermined combination is itself undetermined.
    lost = np.any(np.abs(V[:, ~known]) > np.sqrt(np.finfo(np.float64).eps), axis=1)
    covariance[lost, :] = np.nan
    covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return Identifiability(names, D, (V * s**2) @ V.T, s**2, V, covariance)


def shift_by_model_error(found: Estimate, R: NoiseCovariance, offset: FloatArray) -> FloatArray:
    """Shift (p,) of an estimate by an error of its model, to first order, in filter coordinates.

    If the observations differ by ``offset (n,)`` from the model's prediction at the truth, the
    posterior mode moves by::

        b = (Hᵀ R⁻¹ H + P⁻¹)⁻¹ Hᵀ R⁻¹ offset

    with the prior's P and the Jacobian H at the estimate. The offset of a mesh is the prediction of
    a finer one less its own.
    """
    assert found.prediction is not None
    noise, prior = observation_noise(R, len(offset)), to_filter(found.transform, found.prior)
    H = found.prediction.jacobian * found.transform.derivative(found.transformed.mean)
    return kalman_update(prior, offset, H, noise).posterior.mean - prior.mean


def with_shift(found: Estimate, shift: FloatArray) -> Estimate:
    """The estimate with diag(b²) added to its covariance, for a shift b (p,) by a model error.

    Only the size of b is known, not its direction: b bᵀ would leave the covariance across b as is.
    """
    covariances = found.transformed_iterate_covariances.copy()
    covariances[-1] += np.diag(shift**2)
    return replace(found, transformed_iterate_covariances=covariances)
