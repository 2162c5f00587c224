"""Chordae from line segments, as SlicerHeart's ValveFemExport writes them.

Every segment has two points of its own and runs from a papillary tip to the leaflets: a trunk to
its branching point, branches from there (a fan at the free edge, radial ones on the body of a
leaflet).
"""

import numpy as np
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import FAMILIES
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Chordae, paths

DECIMALS = 3
"""Points (mm) that agree in so many decimals are one: text has six digits."""
MARGINAL_MM = 4.0
"""Largest distance from the free edge at which a marginal chord inserts."""
MAX_AWAY = 3.0
"""Largest distance (mm) of a chord's beginning from its papillary tip."""


def _graph(segments: FloatArray) -> tuple[FloatArray, IntArray]:
    """Points ``(n, 3)`` mm, and the first and last point ``(k, 2)`` of the different segments."""
    points = segments.reshape(-1, 3)
    rounded = np.round(points, DECIMALS)
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    pairs = np.unique(number.reshape(-1, 2), axis=0)
    return points[first], pairs[pairs[:, 0] != pairs[:, 1]]


def beginnings(segments: FloatArray) -> FloatArray:
    """The points ``(t, 3)`` mm at which chords begin.

    None if there are as many as segments: these then run from the leaflets, or are single chords
    whose tips are unknown.
    """
    points, pairs = _graph(segments)
    roots = np.setdiff1d(pairs[:, 0], pairs[:, 1])
    return points[roots] if len(roots) < len(pairs) else points[:0]


def chordae_of_lines(segments: FloatArray, tips: FloatArray, free_edge: FloatArray) -> Chordae:
    """Chordae of segments ``(k, 2, 3)`` mm, with papillary tips ``(t, 3)`` and edge ``(e, 3)``.

    They are as long as they are drawn. Chords within `MARGINAL_MM` of the edge are marginal, others
    basal. Each family is as stiff at the tips as that of the template, each of its leaflet ends has
    the same share, and a trunk is as stiff as its branches together.

    InputError if chords begin elsewhere than at the tips, meet, or form a cycle.
    """
    points, pairs = _graph(segments)
    branches = np.isin(pairs[:, 1], pairs[:, 0])
    # Leaflet ends first, then branching points in the order of their numbers.
    begin, end = pairs[np.lexsort([pairs[:, 1], branches])].T
    c = int(np.count_nonzero(~branches))
    junction, count = np.unique(end[c:], return_counts=True)
    if np.any(count > 1):
        at = np.round(points[junction[np.argmax(count)]], 1).tolist()
        raise InputError(f"{count.max()} chords meet at {at}, where others begin; expected one")
    parent = np.where(np.isin(begin, junction), np.searchsorted(junction, begin), -1)
    on = paths(parent, c)
    root = np.argmax(on & (parent < 0), axis=1)
    away, tip = map(np.asarray, cKDTree(tips).query(points[begin[root]]))
    if away.max() > MAX_AWAY:
        raise InputError(
            f"chords begin up to {away.max():.1f} mm from the papillary tips, expected at most "
            f"{MAX_AWAY:g} mm"
        )
    template = Template().chordae()
    at_tip = template.axial_stiffness * (template.parent < 0)
    marginal = template.family == template.family_names.index(FAMILIES[0])
    inwards = np.asarray(cKDTree(free_edge).query(points[end[:c]])[0])
    family = (inwards > MARGINAL_MM).astype(np.int64)
    total = np.array([at_tip[marginal].sum(), at_tip[~marginal].sum()])
    stiffness = (total / np.maximum(np.bincount(family, minlength=2), 1))[family]
    beyond = on[:c].T  # leaflet ends (columns) of each segment
    return Chordae(
        tip=tip,
        insertion=points[end[:c]],
        family=1 - np.any(beyond & (family == 0), axis=1),
        family_names=FAMILIES,
        rest_length=np.linalg.norm(points[end] - points[begin], axis=1),
        axial_stiffness=beyond @ stiffness,
        toe_strain=template.toe_strain,
        junction=points[junction],
        parent=parent,
    )
