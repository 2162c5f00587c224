"""The case in ``examples/case``, made anew: ``make_case.py FOLDER``.

A simulated valve, open and closed under 120 mmHg on a finer mesh than an estimation uses. Its
closed frame is seen with errors of 0.5 mm that are alike over 10 mm. The true moduli are the
generic ones times 1.2 and 0.8. They are written beside the folder (``FOLDER_truth.txt``), where no
estimation looks. The folder has two surfaces, the papillary tips, the chordae, the pressures and
the size of the errors; whoever reads the case derives the rest.
"""

import sys
from pathlib import Path

import numpy as np

import mvest
from mvest.cases.tissue import write_chordae
from mvest.exchange.surfaces import Surface, write_surface
from mvest.observation.errors import CorrelatedNoise, SpatialCorrelation

TRUTH = np.array([1.2 * 6.23, 0.8 * 2.09])
NAMES = ("E_f.anterior", "E_f.posterior")
TISSUE = {"anterior": mvest.TissueSettings(2.65), "posterior": mvest.TissueSettings(1.11)}
TEXT = """\
version: 1
name: simulated example
description: Template valve, closed on 54 x 6 cells, with errors of 0.5 mm
simulated: true
units: {{length: mm}}
regions: [anterior, posterior]
frames:
- {{name: open, time: 0.0, role: reference, surface: open.vtp, pressure: 0,
   papillary_tips: {tips}}}
- {{name: closed, time: 0.35, role: closed, surface: closed.vtp, pressure: 120,
   papillary_tips: {tips}}}
chordae: {{file: chordae.csv, families: [{families}]}}
observation: {{std_mm: 0.5, correlation_length_mm: 10.0}}
"""


def make_case(folder):
    """Write the case into a folder; returns it."""
    template = mvest.Template()
    valve = template.valve(40, 11)
    model = None
    for columns, rows in ((24, 3), (54, 6)):
        mesh = mvest.structured_mesh(template, "hex18", columns, rows)
        # The coarse valve guides the fine one to its closed state.
        model = mvest.ClosureModel(
            valve, template.valve(168, 38), mesh, mvest.MechanicsSettings(TISSUE),
            NAMES, guide=model,
        )  # fmt: skip
    frames = model(TRUTH).y.reshape(2, -1, 3).copy()
    errors = CorrelatedNoise(0.5, SpatialCorrelation(valve.surface.vertices, 10.0))
    frames[1:] = errors(frames[1:], frames[1:], np.random.default_rng(1))
    frames[1][valve.annulus] = valve.motion.annulus[-1]
    folder.mkdir(parents=True, exist_ok=True)
    surface = valve.surface
    for name, x in zip(("open", "closed"), frames, strict=True):
        labelled = Surface(x, surface.triangles, cell_data={"region": surface.region})
        write_surface(folder / f"{name}.vtp", labelled)
    write_chordae(folder / "chordae.csv", valve.chordae)
    tips, families = valve.papillary_tips.round(3).tolist(), ", ".join(valve.chordae.family_names)
    text = TEXT.format(tips=tips, families=families)
    (folder / "case.yaml").write_text(text, encoding="utf-8")
    true = "".join(f"{name} {value:.2f} MPa\n" for name, value in zip(NAMES, TRUTH, strict=True))
    folder.with_name(f"{folder.name}_truth.txt").write_text(true, encoding="utf-8")
    return folder


if __name__ == "__main__":
    print(make_case(Path(sys.argv[1])))
