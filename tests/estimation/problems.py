"""Problems whose posteriors are known on paper, for all filters."""

import numpy as np

from mvest.estimation import Gaussian, Prediction, chi_square_band, identifiability


def consistent(values, freedom):
    """Whether NEES or NIS of independent runs are chi-square with so many degrees of freedom.

    Their sum is then in the band that holds it in 99 of 100 cases (Bar-Shalom, Li and Kirubarajan
    2001, section 5.4).
    """
    low, high = chi_square_band(len(values) * freedom, 0.99)
    return low <= np.sum(values) <= high


class Linear:
    """h(m) = H m with and without its derivative, and the posterior in covariance form."""

    def __init__(self, n=15, p=3, seed=3):
        rng = np.random.default_rng(seed)
        self.H = rng.standard_normal((n, p))
        A = rng.standard_normal((p, p))
        self.prior = Gaussian(rng.standard_normal(p), A @ A.T + np.eye(p))
        self.R = rng.uniform(0.2, 1.0, n)
        self.y = self.H @ rng.standard_normal(p) + np.sqrt(self.R) * rng.standard_normal(n)
        P = self.prior.covariance
        S = self.H @ P @ self.H.T + np.diag(self.R)
        K = P @ self.H.T @ np.linalg.inv(S)
        self.mean = self.prior.mean + K @ (self.y - self.H @ self.prior.mean)
        self.covariance = P - K @ S @ K.T

    def differentiated(self, m):
        return Prediction(self.H @ m, self.H)

    def plain(self, m):
        return Prediction.undifferentiated(self.H @ m)

    def by(self, filter_, *, plain=False):
        """The estimate of a filter, of the model with or without derivatives."""
        model = self.plain if plain else self.differentiated
        return filter_(model, self.prior, self.y, self.R)


def square(m):
    """h(m) = m²."""
    return Prediction(m**2, 2.0 * m[:, None])


def saturating(m):
    """Two numbers that tell little of a large m and much of a small one."""
    x = np.exp(-m)
    return Prediction(np.concatenate([x, 2.0 * x]), np.concatenate([-x, -2.0 * x])[:, None])


def banana(m):
    """h(m) = m₁ + m₀², exactly quadratic: where little noise is, m lies on a parabola."""
    return Prediction(np.array([m[1] + m[0] ** 2]), np.array([[2.0 * m[0], 1.0]]))


def wings(m):
    """h(m) = m² + m/10, which two values of m answer equally well."""
    return Prediction(m**2 + 0.1 * m, (2.0 * m + 0.1)[:, None])


def gridded(model, prior, y, R, reach=5.0, points=201):
    """Mean, standard deviation and kurtosis (p,) of a posterior of one or two parameters."""
    axis = np.linspace(-reach, reach, points)
    u = np.stack(np.meshgrid(*[axis] * prior.size, indexing="ij"), axis=-1).reshape(-1, prior.size)
    at = prior.mean + u @ prior.factor.T
    misfit = np.array([0.5 * np.sum((y - model(m).y) ** 2 / R) for m in at])
    weights = np.exp(misfit.min() - misfit - 0.5 * np.sum(u**2, axis=1))
    weights /= weights.sum()
    mean = weights @ at
    variance = weights @ (at - mean) ** 2
    return mean, np.sqrt(variance), weights @ (at - mean) ** 4 / variance**2


def bound(H, R, prior=None):
    """The Cramér-Rao bound of all parameters, of no scale in particular."""
    return identifiability(H, R, np.ones(np.shape(H)[-1]), prior=prior).covariance
