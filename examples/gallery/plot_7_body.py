"""
A body without a valve
======================

The mechanics take plain arrays. A strip of 20 × 10 × 1.3 mm, clamped on the left, is bent by
pressure from below, with two meshes of one layer each.
"""

import matplotlib.pyplot as plt
import numpy as np

import mvest
from mvest.mechanics.body import box, outer_faces

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
# Linear tetrahedra lock: they are many times too stiff in bending, however fine the mesh in the
# plane. The solid-shell is within a few per cent of the converged answer. Leaflets bend as the
# valve closes, so the element decides whether an estimated modulus is right.
