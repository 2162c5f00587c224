"""
A body without a valve
======================

The mechanics take plain arrays. A strip of 20 × 10 × 1.3 mm, clamped on the left, is bent by
pressure from below, with two meshes of one layer each.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest
from mvest.mechanics.blocks import box, outer_faces

size = (20.0, 10.0, 1.3)
tissue = mvest.TransverselyIsotropic.isotropic(E=2.0, nu=0.488)
figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
axes.plot([0, size[0]], [0, 0], color="0.7", lw=6, solid_capstyle="butt", label="at rest")
for element, cells, style in (("hex18", (8, 4, 1), "C0o-"), ("tet4", (20, 10, 1), "C1s-")):
    nodes, elements = box(element, cells, size)
    faces = outer_faces(elements, element)
    strip = mvest.simulate_body(
        nodes,
        elements,
        element,
        material=tissue,
        fixed_nodes=np.flatnonzero(nodes[:, 0] == 0),
        pressure_faces=faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)],
        pressure=[(0.0, 0.0), (1.0, 3e-5)],  # MPa, rising with the time
        times=np.linspace(0.25, 1.0, 4),
        static=True,
    )
    # The middle line of the lower face.
    line = np.flatnonzero((nodes[:, 1] == size[1] / 2) & (nodes[:, 2] == 0))
    line = line[np.argsort(nodes[line, 0])]
    shape = strip.frames[-1][line]
    label = f"{element}, {len(nodes)} nodes: tip rises {shape[-1, 2]:.2f} mm"
    axes.plot(shape[:, 0], shape[:, 2], style, ms=4, label=label)
axes.set(xlabel="x (mm)", ylabel="z (mm)")
axes.legend(frameon=False)

# %%
# Linear tetrahedra resist bending many times too much (they lock), however many there are in the
# plane. The solid-shell is within some per cent of the converged answer. What bends in a closing
# valve is the leaflets, so this decides what an estimated modulus is worth.
#
# Forces and symmetry
# -------------------
#
# A ring of 0.2 mm, 20 mm across, is pulled apart by two forces. A quarter of it will do: nodes on
# the planes of symmetry keep one coordinate. So thin a body takes ``hex18_thin``.

unit, elements = box("hex18_thin", (12, 1, 1), (1.0, 1.0, 1.0))
angle, radius = np.pi / 2 * unit[:, 0], 9.8 + 0.2 * unit[:, 2]
nodes = np.stack([radius * np.sin(angle), 2.0 * unit[:, 1], radius * np.cos(angle)], axis=1)
top, side = unit[:, 0] == 0, unit[:, 0] == 1
fixed = np.stack([top, unit[:, 1] == 0, side], axis=1)  # x on top, z at the side, y along one edge
pull = np.zeros_like(nodes)
pull[side, 0] = 0.01 / np.count_nonzero(side)  # N
ring = mvest.simulate_body(
    nodes,
    elements,
    "hex18_thin",
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
