"""The template's marginal chordae as trees of two levels; its basal ones stay straight."""

from dataclasses import replace

import numpy as np

from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template

STRAIGHT = Template(TemplateParameters().changed({"chordae.branches": 1})).chordae()
"""The template's chordae without branches."""
LOW, HIGH = 0.4, 0.6
"""Where the chordae branch, over the length from tip to leaflet."""
SLACK = 1.07
"""Least rest length over the length in the open valve, to the insertion. The patch around it, which
the chord pulls at, has its centre up to 0.4 mm nearer to the annulus."""


def branching(straight, tips):
    """Chordae whose neighbouring marginal ends join in pairs, and neighbouring pairs in fours.

    The rest length from tip to insertion is that of the straight chord, or more if the open valve
    needs it.
    """
    c = len(straight)
    trunks = []  # the tip, the leaflet ends, the place, and the segments that start there
    for tip in np.unique(straight.tip):
        own = np.flatnonzero((straight.tip == tip) & (straight.family == 0)).tolist()
        pairs = [(tip, own[k : k + 2], HIGH, own[k : k + 2]) for k in range(0, len(own) - 1, 2)]
        first = c + len(trunks)
        trunks += pairs
        for k in range(0, len(pairs) - 1, 2):
            ends = pairs[k][1] + pairs[k + 1][1]
            trunks.append((tip, ends, LOW, [first + k, first + k + 1]))
    parent = np.full(c + len(trunks), -1)
    for junction, (*_, parts) in enumerate(trunks):
        parent[parts] = junction
    own = [(where * straight.rest_length[ends].min(), tip) for tip, ends, where, _ in trunks]
    reach, tip = (
        np.concatenate([a, b])
        for a, b in zip((straight.rest_length, straight.tip), np.array(own).T, strict=True)
    )
    tip = tip.astype(int)
    middles = np.array([straight.insertion[ends].mean(axis=0) for _, ends, *_ in trunks])
    where = np.array([where for *_, where, _ in trunks])[:, None]
    junction = (1 - where) * tips[tip[c:]] + where * middles
    chordae = replace(
        straight,
        tip=tip,
        family=np.append(straight.family, np.zeros(len(trunks), int)),
        rest_length=np.maximum(reach - np.where(parent >= 0, reach[c + parent], 0.0), 0.1),
        axial_stiffness=np.append(straight.axial_stiffness, np.full(len(trunks), 30.0)),
        junction=junction,
        parent=parent,
    )
    least = SLACK * np.linalg.norm(np.diff(chordae.ends(tips), axis=1)[:, 0], axis=1)
    return replace(chordae, rest_length=np.maximum(chordae.rest_length, least))


def branched(valve):
    """The template's valve with trees of two levels instead of its chordae."""
    return replace(valve, chordae=branching(STRAIGHT, valve.papillary_tips))
