"""
A simulated volume and the valve in it
======================================

The simulator images a closing valve as transoesophageal echo does. Detectors, trained on other
simulated valves, find annulus, free edge, leaflets and papillary tips.
"""

import sys
from pathlib import Path

import numpy as np

import mvest
from mvest.reporting.images import montage_figure

sys.path.append(str(Path.cwd().parent))
from make_volume import make_volume

volume, true = make_volume(frames=2)
found = mvest.detect_valve(volume, mvest.default_model())
figure = montage_figure(volume, found, title="Simulated volume, open and closed frame")

# %%
# Lines are the detected valve. Its errors are known because the volume is simulated:
for k, name in enumerate(("open", "closed")):
    off = np.linalg.norm(found.vertices[k] - true.vertices[k], axis=1)
    tips = np.linalg.norm(found.tips[k] - true.tips[k], axis=1)
    print(f"{name:6}: points of tissue {off.mean():.1f} mm, papillary tips {tips.mean():.1f} mm,"
          f" confidence {found.frame_confidence[k]:.2f}")  # fmt: skip

# %%
# The detectors' errors in patients are unknown: none was in the training set.
