"""Drawing a valve on plain axes, for the scripts beside this file."""

import numpy as np

from mvest.problem.fields import CaseFields, chord_fields
from mvest.reporting.case.drawing import draw_valve, leaflet_colours, paint_leak, same_scale
from mvest.reporting.figures import ATRIUM

__all__ = ["draw", "fields_of", "same_scale"]


def fields_of(valve, reach=None):
    """What the drawing needs of a valve, whose leaflets touch within ``reach`` mm."""
    surface = valve.surface
    return CaseFields(
        triangles=surface.triangles, region=surface.region, rest=surface.vertices,
        annulus=valve.annulus, free_edge=valve.free_edge, frames=("closed",),
        seen=np.array([True]), tips=valve.motion.papillary_tips, observed_points={},
        reach_mm=reach, **chord_fields(valve.chordae, surface.vertices),
    )  # fmt: skip


def draw(
    axes, valve, points=None, view=ATRIUM, values=None, cmap=None, norm=None, chords=False,
    reach=None,
):  # fmt: skip
    """Draw a shape ``(n, 3)`` of a valve, coloured by leaflet or by values at its vertices.

    Of a closed one, whose leaflets touch within ``reach`` mm, the slit is grey and a gap is red.
    """
    fields, surface = fields_of(valve, reach), valve.surface
    points = surface.vertices if points is None else points
    colours = leaflet_colours(surface.region)
    if values is not None:
        colours = cmap(norm(values))[:, :3][surface.triangles]
    draw_valve(axes, fields, points, colours, view, 0, chords=chords, strength=0.3)
    paint_leak(axes, fields, points, 0)
