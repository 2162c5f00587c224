"""
Your own model behind a filter
==============================

A filter knows a model only as a function from parameters to a prediction and its derivatives. Here
it is a strip of tissue that stiffens as it stretches, with noisy forces.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest

stretch = np.linspace(1.02, 1.2, 12)


def force(m):
    """Force (N) of an exponential strip, and its derivatives by scale and exponent."""
    scale, exponent = m
    growth = np.exp(exponent * (stretch - 1))
    y = scale * (growth - 1)
    return y, np.stack([growth - 1, scale * growth * (stretch - 1)], axis=1)


truth = np.array([0.05, 18.0])
observed = force(truth)[0] + np.random.default_rng(3).normal(0, 0.03, stretch.size)
prior = mvest.Gaussian.from_variance([0.08, 15.0], [0.03**2, 3.0**2])
filters = {
    "one update": mvest.ExtendedFilter(),
    "iterated": mvest.IteratedFilter(),
    "unscented, no derivatives": mvest.UnscentedFilter(),
    "ensemble of 30": mvest.EnsembleFilter(),
}
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
axes.errorbar(stretch, observed, 0.03, fmt="o", color="0.3", ms=4, label="observed")
axes.plot(stretch, force(prior.mean)[0], ":", color="0.5", label="prior mean")
for name, some_filter in filters.items():
    estimate = some_filter(force, prior, observed, R=0.03**2)
    label = f"{name}: {estimate.mean[0]:.3f} N, {estimate.mean[1]:.1f}"
    axes.plot(stretch, force(estimate.mean)[0], label=label)
axes.set(xlabel="stretch", ylabel="force (N)", ylim=(-0.1, 2.6))
axes.legend(frameon=False, title=f"truth: {truth[0]:.3f} N, {truth[1]:.1f}", loc="upper left")

# %%
# Filters with one step miss the curve; those that relinearise do not. A program in any language can
# be the model through files: see the page on own models.
