"""
A stiff patch of a leaflet
==========================

A valve with a stiff patch in the middle of its anterior leaflet closes on a separate mesh. The
estimator does not know of the patch: its modulus is a smooth random field with a few modes, which
cannot represent the patch exactly. They are estimated from one closed frame, with both moduli.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest
from mvest.mechanics.law.regional import FieldBasis
from mvest.mechanics.settings import ModulusField, StiffPatch

template = mvest.Template()
tissue = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}
moduli = ("E_f.anterior", "E_f.posterior")
centre = template.position(np.array([90.0]), np.array([0.5]))[0]  # half-way down the leaflet
patch = StiffPatch("anterior", tuple(centre), radius_mm=8.0, factor=2.0)
field = ModulusField(correlation_length_mm=5.0, std_log=0.4, modes=16)


def model(columns, rows, names, **more):
    return mvest.ClosureModel(
        valve=template.valve(56, 15),
        contact_valve=template.valve(72, 16),
        mesh=mvest.structured_mesh(template, "hex18", columns, rows),
        settings=mvest.MechanicsSettings(tissue, **more),
        names=names,
        continuation=True,
    )


true_valve = model(36, 4, moduli, patches={"patch": patch})
modes = tuple(f"field.anterior.{k}" for k in range(field.modes))
valve = model(24, 3, (*moduli, *modes), fields={"anterior": field})
exact = true_valve(np.array([6.23, 2.09])).y
observed = exact + np.random.default_rng(1).normal(0, 0.5, exact.shape)
prior = mvest.Gaussian.from_variance([5.0, 3.0, *[0.0] * 16], [6.25, 2.25, *[1.0] * 16])
logs = mvest.Log((True, True, *[False] * 16))
estimate = mvest.IteratedFilter(0.05)(
    valve, prior, observed, R=0.25, names=valve.names, transform=logs
)

# log E_f at the vertices is linear in the unknowns: log modulus and modes.
surface = valve.valve.surface
of_modes = FieldBasis.of(surface, "anterior", field)(surface.vertices)
rows = np.column_stack([np.ones(len(of_modes)), np.zeros(len(of_modes)), of_modes])
maps = {
    "true E_f (MPa)": 6.23 * np.exp(patch.log_scale(surface.vertices)),
    "estimated E_f (MPa)": np.exp(rows @ estimate.transformed.mean),
    "SD of log E_f": np.sqrt(np.sum(rows @ estimate.transformed.covariance * rows, axis=1)),
}
row, column = np.divmod(np.arange(len(rows)), 56)
triangles = surface.triangles[surface.region == surface.region_names.index("anterior")]
figure, grid = plt.subplots(1, 3, figsize=(10, 2.8), sharey=True, layout="constrained")
for axes, (title, values) in zip(grid, maps.items(), strict=True):
    levels = np.linspace(0, 0.4, 17) if "SD" in title else np.linspace(3, 14, 23)
    drawn = axes.tricontourf(360 / 56 * column, row / 14, triangles, values, levels, extend="both")
    axes.set(title=title, xlabel="angle (degrees)", xlim=(0, 180))
    figure.colorbar(drawn, ax=axes)
grid[0].set_ylabel("share of the way down")
grid[0].invert_yaxis()
print(estimate.reason.value)

# %%
# The position of the patch is right, and with one frame so is the stated standard deviation. With
# fifteen frames of a cycle the mesh error dominates, and only 65 % of the leaflet lies within two
# standard deviations (`study <../studies/patch.html>`_).
