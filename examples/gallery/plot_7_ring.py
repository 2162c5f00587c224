"""
A thin ring, by forces and symmetry
===================================

A ring of 0.2 mm, 20 mm across, is pulled apart by two forces. By symmetry a quarter suffices:
nodes on the planes of symmetry keep one coordinate. A body this thin needs small cells.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest
from mvest.mechanics.body import box

unit, elements = box("hex18", (36, 1, 1), (1.0, 1.0, 1.0))
angle, radius = np.pi / 2 * unit[:, 0], 9.8 + 0.2 * unit[:, 2]
nodes = np.stack([radius * np.sin(angle), 2.0 * unit[:, 1], radius * np.cos(angle)], axis=1)
top, side = unit[:, 0] == 0, unit[:, 0] == 1
fixed = np.stack([top, unit[:, 1] == 0, side], axis=1)  # x on top, z at the side, y along one edge
pull = np.zeros_like(nodes)
pull[side, 0] = 0.01 / np.count_nonzero(side)  # N
ring = mvest.simulate_body(
    nodes,
    elements,
    "hex18",
    material=mvest.TransverselyIsotropic.isotropic(E=100.0, nu=0.3),
    fixed_components=fixed,
    forces=lambda t: t * pull,
    times=[1.0, 4.0, 16.0],
    static=True,
)
line = np.flatnonzero((unit[:, 1] == 0) & (unit[:, 2] == 0))
line = line[np.argsort(angle[line])]
figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
for time, frame in zip(ring.times, ring.frames, strict=True):
    x, z = frame[line][:, [0, 2]].T
    whole = [np.r_[-x[::-1], x, x[::-1], -x], np.r_[z[::-1], z, -z[::-1], -z]]
    axes.plot(*whole, color=plt.cm.viridis(np.sqrt(time) / 4.5), label=f"{0.02 * time:.2f} N")
axes.set(xlabel="x (mm)", ylabel="z (mm)", aspect="equal")
axes.legend(frameon=False, title="pull", loc="center left", bbox_to_anchor=(1.0, 0.5))
print(ring)
