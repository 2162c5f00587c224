"""
A case from its folder to its report
====================================

A case is a folder with ``case.yaml`` and surfaces. ``examples/case`` has an
open and a closed surface, the papillary tips, the chordae and the pressures. The rest is derived,
and every derivation is listed.
"""

import tempfile
import textwrap
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
from drawing import draw, same_scale

import mvest
from mvest.personalisation import CaseMesh
from mvest.reporting.figures import ATRIUM

case = mvest.read_case(Path.cwd().parent / "case")
print(case)
for sentence in case.derived:
    print(textwrap.fill("* " + sentence, 96, subsequent_indent="  "))

shown, panels = plt.subplots(1, 2, figsize=(8, 3.9), layout="constrained")
for axes, frame in zip(panels, case.frames, strict=True):
    draw(axes, case.valve, frame.vertices)
    axes.set_title(f"{frame.name}: {frame.pressure_mmHg:.0f} mmHg", fontsize=10)
same_scale(panels, [frame.vertices for frame in case.frames], ATRIUM)

# %%
# The closed surface is uneven because of its simulated errors of 0.5 mm. By default
# ``mvest.personalise(case)`` uses `mvest.default_settings`, which include the errors of geometry
# and law and take some minutes. Here a coarse mesh without these errors takes seconds, and the
# intervals are too narrow.

settings = replace(
    mvest.default_settings(case),
    mesh=CaseMesh(columns=16, rows=2, guide_columns=12, guide_rows=2, contact_columns=60,
                  contact_rows=16),
    nuisance_geometry=None,
    nuisance_law={},
    moduli_only=False,
    confirm=False,
)  # fmt: skip
found = mvest.personalise(case, settings)
print(found)

# %%
# The report begins with the verdict. Its numbers are in a record that your own tables and plots can
# read.

record = mvest.record_of_case(found)
print(record.verdict)
files = mvest.report(found, Path(tempfile.mkdtemp()))
print("written:", ", ".join(path.name for path in files))

figure, axes = plt.subplots(figsize=(7, 2.2), layout="constrained")
for row, modulus in enumerate(record.moduli):
    axes.plot([modulus.low, modulus.high], [row, row], linewidth=4)
    axes.plot(modulus.estimate, row, "ko")
axes.set_yticks(range(len(record.moduli)), [modulus.label for modulus in record.moduli])
axes.set(xlabel="modulus [MPa], 95 % interval", ylim=(-0.6, len(record.moduli) - 0.4))
