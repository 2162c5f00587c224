"""
Two material laws on the same data
==================================

Leaflets stiffen as they stretch; the linear law of the paper does not. A valve with an exponential
law closes, and both laws are fitted to its closed frame. The exponents are those usually quoted
from May-Newman and Yin (1998) for excised leaflets.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest
from mvest.estimation.information.consistency import chi_square_band
from mvest.mechanics.law.exponential import biaxial_stress
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.valve_system import material_law

template = mvest.Template()


def model(names, anterior, posterior):
    return mvest.ClosureModel(
        valve=template.valve(56, 15),
        contact_valve=template.valve(72, 16),
        mesh=mvest.structured_mesh(template, "hex18", 24, 3),
        settings=mvest.MechanicsSettings({"anterior": anterior, "posterior": posterior}),
        names=names,
        continuation=True,
    )


def exponential(*coefficients):
    return mvest.TissueSettings(1, law="exponential", exponential=ExponentialTissue(*coefficients))


names = ("c0.anterior", "c2.anterior", "c0.posterior", "c2.posterior")
right = model(names, exponential(0.06, 4.325, 1446.5), exponential(0.04, 4.848, 305.4))
linear = mvest.TissueSettings(2.65), mvest.TissueSettings(1.11)
wrong = model(("E_f.anterior", "E_f.posterior"), *linear)
truth = np.array([0.06, 1446.5, 0.04, 305.4])
exact = right(truth).y
observed = exact + np.random.default_rng(1).normal(0, 0.5, exact.shape)
low, high = np.divide(chi_square_band(observed.size), observed.size)
print(f"chi square per coordinate of a right model: {low:.3f} to {high:.3f}")
found = {"true": (right, truth, "k-")}
starts = ("exponential", right, [0.03, 700, 0.03, 700], "C0--"), ("linear", wrong, [5, 3], "C1-.")
for name, one, start, style in starts:
    prior = mvest.Gaussian.from_variance(start, np.square(start))  # as uncertain as it is large
    estimate = mvest.IteratedFilter()(one, prior, observed, 0.25, transform=mvest.Log())
    misfit = np.mean((estimate.prediction.y - observed) ** 2) / 0.25
    print(f"{name}: {misfit:.3f};", *one.names, estimate.mean.round(3))
    found[f"estimated, {name} law"] = (one, estimate.mean, style)

# %%
# A sheet of each leaflet, stretched along and across its fibres at once:

figure, grid = plt.subplots(2, 2, figsize=(8, 6), sharex=True, layout="constrained")
stretch = np.repeat(np.linspace(1.0, 1.25, 51)[:, None], 2, axis=1)
for label, (one, values, style) in found.items():
    law = material_law(one.mesh, one.settings, dict(zip(one.names, values, strict=True)))
    for region, row in enumerate(grid):
        for k, direction in enumerate(("along", "across")):
            stress = biaxial_stress(law, stretch, region)[:, k]
            row[k].plot(stretch[:, 0], stress, style, label=label)
            title = f"{one.mesh.region_names[region]}, {direction} the fibres"
            row[k].set(title=title, ylim=(0, 0.8))
grid[0, 1].legend(frameon=False)
figure.supxlabel("stretch")
figure.supylabel("nominal stress (MPa)")

# %%
# The data distinguish the laws: the misfit of the linear law is significant. They determine the
# scale c0, but hardly the fibre exponent c2 of the posterior leaflet. The `whole study
# <../studies/law.html>`_ has a finer mesh and ten samples of the errors.
