"""
Two moduli from a simulated observation
=======================================

A valve closes with known moduli, every coordinate gets an error of 0.5 mm, and a filter estimates
both moduli.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

import mvest

template = mvest.Template()
tissue = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}
model = mvest.ClosureModel(
    valve=template.valve(56, 15),
    contact_valve=template.valve(72, 16),
    mesh=mvest.structured_mesh(template, "hex18", 24, 3),
    settings=mvest.MechanicsSettings(tissue),
    names=("E_f.anterior", "E_f.posterior"),
    continuation=True,
)
truth = np.array([6.23, 2.09])
exact = model(truth).y
observed = exact + np.random.default_rng(1).normal(0, 0.5, exact.shape)
prior = mvest.Gaussian.from_variance([4.0, 3.5], 4.0)
estimate = mvest.IteratedFilter()(model, prior, observed, R=0.25, names=model.names)

figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
axes.plot(*estimate.iterates.T, "o-", color="0.3", label=f"{estimate.forward_solves} closures")
values, axes_of = np.linalg.eigh(estimate.covariance)
angle = np.degrees(np.arctan2(*axes_of[::-1, 1]))
width = 2 * np.sqrt(5.99 * values[::-1])  # 95 % of a normal distribution in two dimensions
axes.add_patch(Ellipse(estimate.mean, *width, angle=angle, alpha=0.3, label="95 % region"))
axes.plot(*truth, "*", ms=13, color="C3", label="truth")
axes.annotate("prior mean", estimate.iterates[0], xytext=(8, -4), textcoords="offset points")
axes.set(xlabel="E_f (anterior), MPa", ylabel="E_f (posterior), MPa")
axes.legend(frameon=False)
print(estimate.mean.round(2), "±", estimate.std.round(2), "MPa;", estimate.reason.value)

# %%
# Observation and estimate use the same mesh, which tests the filter alone. With another mesh for
# the truth the mesh error dominates, and the standard deviation does not contain it.
