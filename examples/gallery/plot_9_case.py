"""
Reading a case
==============

A case is a folder with ``case.yaml`` and surfaces. The one in ``examples/case`` has the least that
is needed: an open and a closed surface, the papillary tips and the pressures. What is missing is
derived, and every derivation is stated.
"""

import textwrap
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from drawing import draw, same_scale

import mvest
from mvest.reporting.case.drawing import ATRIUM

case = mvest.read_case(Path.cwd().parent / "case")
for sentence in case.derived:
    print(textwrap.fill("* " + sentence, 96, subsequent_indent="  "))

figure, panels = plt.subplots(1, 2, figsize=(8, 3.9), layout="constrained")
for axes, frame in zip(panels, case.frames, strict=True):
    draw(axes, case.valve, frame.vertices)
    axes.set_title(f"{frame.name}: {frame.pressure_mmHg:.0f} mmHg", fontsize=10)
same_scale(panels, [frame.vertices for frame in case.frames], ATRIUM)
moved = case.frames[1].vertices - case.frames[0].vertices
print(f"leaflets move by {np.linalg.norm(moved, axis=1).mean():.1f} mm on average (simulated)")

# %%
# The closed surface is uneven because it is "seen" with errors of 0.5 mm. From here to moduli with
# intervals: ``python -m experiments.run experiment=own_valve case=examples/case``, first with
# ``check=true``.
