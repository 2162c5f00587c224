"""A reference heart whose valve is known: the template thickened, and muscles below its tips."""

from pathlib import Path

import meshio
import numpy as np
import trimesh

from experiments.studies.imported import HeartSettings
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.segmented import HEAD_MM
from mvest.valve.geometry.thickening import thicken

PARTS = (
    "mitral_valve.ply",
    "papillary_muscle_anterolateral.ply",
    "papillary_muscle_posteromedial.ply",
)
TEMPLATE = Template()
# Seen from the atrium the antero-lateral tip is on the left of the anterior leaflet.
TIPS = TEMPLATE.valve(64, 20).papillary_tips[::-1]
SHIFT = np.array([40.0, 470.0, -12.0])


def muscle(tip):
    """A spindle 40 mm long and 8 mm wide below a tip, which is the middle of its head."""
    found = trimesh.creation.icosphere(subdivisions=4)
    return tip + found.vertices * [4.0, 4.0, 20.0] - [0, 0, 20.0 - 0.5 * HEAD_MM], found.faces


def parts():
    """The template thickened and its muscles, mm: points and triangles of each."""
    valve = TEMPLATE.valve(64, 20)
    thick = thicken(valve.surface)
    found = [(thick.vertices, thick.triangles), *map(muscle, TIPS)]
    return [(points + SHIFT, triangles) for points, triangles in found]


def heart(folder: Path) -> Path:
    """Write the parts of the template's heart."""
    folder.mkdir()
    for name, (points, triangles) in zip(PARTS, parts(), strict=True):
        meshio.Mesh(points, [("triangle", triangles.astype(np.int32))]).write(folder / name)
    return folder


def settings_of(folder: Path, **changes: object) -> HeartSettings:
    """Settings of the study that name the parts in a folder."""
    valve, *muscles = (str(folder / name) for name in PARTS)
    return HeartSettings(**{"source": valve, "muscles": tuple(muscles), **changes})  # type: ignore[arg-type]
