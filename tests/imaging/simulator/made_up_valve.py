"""A valve that moves in a made-up way: from the open template half way to its intended closure."""

import numpy as np

from mvest.imaging.layout import ValveLayout
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.valve_sequence import MovingValve
from mvest.valve.anatomy.template import Template

FRAMES = 3

SMALL = Acquisition(
    axial_mm=2.2,
    lateral_deg=4.0,
    elevation_deg=5.0,
    depth_mm=(4.0, 100.0),
    voxel_mm=2.0,
    shape=(48, 40, 48),
)
"""A coarse and fast scanner."""


def made_up_valve() -> MovingValve:
    template, layout = Template(), ValveLayout()
    valve = template.valve(layout.columns, layout.rows)
    still, s = valve.surface.vertices, layout.s
    share = 0.5 * np.linspace(0, 1, FRAMES)[:, None, None]
    inward = np.stack([0 * s, -0.8 * s * still[:, 1], 0.3 * s * still[:, 2]], axis=1)
    tips = valve.papillary_tips + np.array([0.0, 0.0, 2.0]) * share
    phi = np.array(template.parameters.chordae.marginal)
    phi = np.mod(np.concatenate([phi, 180 - phi]), 360)
    return MovingValve(
        "made up", layout, 0.04 * np.arange(FRAMES), still + share * inward, tips,
        template.thickness(layout.phi, s), phi, np.full(len(phi), 0.97),
        np.repeat([0, 1], len(phi) // 2),
    )  # fmt: skip
