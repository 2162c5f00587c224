"""
Expected information before measuring
=====================================

The Cramér-Rao bound needs a model and a planned observation, but no data. One closure shows how
well different plans determine two moduli.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest

template = mvest.Template()
tissue = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}
names = ("E_f.anterior", "E_f.posterior", "chord_rest_length", "pressure_scale")
model = mvest.ClosureModel(
    valve=template.valve(56, 15),
    contact_valve=template.valve(72, 16),
    mesh=mvest.structured_mesh(template, "hex18", 24, 3),
    settings=mvest.MechanicsSettings(tissue),
    names=names,
)
at = np.array([6.23, 2.09, 1.0, 1.0])
by_vertex = model(at).jacobian.reshape(2, -1, 3, 4)[1]
every = np.arange(len(by_vertex))
plans = {
    "840 vertices, all else known": (every, 2),
    "free edge only": (model.valve.free_edge, 2),
    "20 vertices": (every[::42], 2),
    "840 vertices, rest length unknown": (every, 3),
    "840 vertices, pressure unknown too": (every, 4),
}
bounds = []
for seen, unknown in plans.values():
    H = by_vertex[seen].reshape(-1, 4)[:, :unknown]
    bounds.append(mvest.identifiability(H, 0.25, at[:unknown], names=names[:unknown]))

figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
for k, leaflet in enumerate(("anterior", "posterior")):
    std = [100 * bound.std[k] / at[k] for bound in bounds]
    rows = axes.barh(np.arange(len(plans)) - 0.2 + 0.4 * k, std, 0.38, label=f"E_f ({leaflet})")
    axes.bar_label(rows, fmt="%.1f %%", padding=3, fontsize=8)
axes.set(xlabel="smallest standard deviation with errors of 0.5 mm (%)", xlim=(0, 44))
axes.set_yticks(range(len(plans)), plans)
axes.invert_yaxis()
axes.legend(frameon=False)
for group in bounds[-1].confounded():
    print("hardly distinguished:", ", ".join(group.parameters))

# %%
# Fewer vertices cost accuracy; an unknown pressure costs more than anything else, because a stiffer
# valve under a higher pressure closes to almost the same shape.
