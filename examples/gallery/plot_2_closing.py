"""
A valve closes
==============

Pressure rises to 120 mmHg in 0.3 s while the annulus contracts; then the valve comes to rest. In
every stored step inertia, tissue, chordae and contact are in equilibrium.
"""

import matplotlib.pyplot as plt
import numpy as np
from drawing import draw, same_scale

import mvest
from mvest.reporting.figures import ATRIUM
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import orifice_area

template = mvest.Template()
tissue = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}
protocol = mvest.ClosureProtocol(dt=0.03)
model = mvest.ClosureModel(
    valve=template.valve(56, 15),
    contact_valve=template.valve(72, 16),
    mesh=mvest.structured_mesh(template, "hex18", 24, 3),
    settings=mvest.MechanicsSettings(tissue, protocol),
    names=("E_f.anterior", "E_f.posterior"),
)
closing = model.close(np.array([6.23, 2.09]), every_frame=True, sensitivities=False).simulation
shapes, valve = [model.observed(x) for x in closing.frames], model.valve
orifice = []
for x in shapes:
    ring = x[valve.annulus]
    plane = annulus_plane(ring, valve.papillary_tips.mean(axis=0), ring[len(ring) // 4])
    orifice.append(orifice_area(x, valve.surface.triangles, ring, plane))
pressure = [120 * protocol.phase(t) for t in closing.times]

figure = plt.figure(figsize=(9, 4.8), layout="constrained")
grid = figure.add_gridspec(2, 4, height_ratios=[1, 1.1])
panels = [figure.add_subplot(grid[0, k]) for k in range(4)]
for axes, k in zip(panels, (0, 4, 5, -1), strict=True):
    draw(axes, valve, shapes[k], reach=model.contact_reach_mm if k == -1 else None)
    title = "equilibrium" if k == -1 else f"{closing.times[k]:.2f} s"
    axes.set_title(f"{title}, {pressure[k]:.0f} mmHg", fontsize=10)
same_scale(panels, shapes[:1], ATRIUM)
axes = figure.add_subplot(grid[1, :])
axes.plot(closing.times[:-1], orifice[:-1], "o-", color="0.2")  # the equilibrium has no time
axes.set(xlabel="time (s)", ylabel="orifice (mm²)", ylim=(0, None))
beside = axes.twinx()
beside.plot(closing.times[:-1], pressure[:-1], "--", color="C3")
beside.set_ylabel("pressure (mmHg)", color="C3")

# %%
# The last drawing is the static equilibrium, which is compared with a closed frame. White slits are
# gaps between midsurfaces, which are a thickness apart where thick leaflets touch.
