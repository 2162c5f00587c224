"""A valve with another rest geometry, against which derivatives are tested."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve


def displaced(geometry: RestGeometry, parts: Mapping[str, FloatArray]) -> ClosureModel:
    """A fresh model of the valve with another geometry.

    Embeddings keep their material points. A displacement of the open shape moves the mesh as
    its derivative predicts. Junctions of the chordae stay: their place at rest only matters
    while they are slack.

    ``parts``: some of `PARTS` -> one quantity each, where `RestGeometry.variation` takes several.
    """
    own = {name: np.asarray(values)[None] for name, values in parts.items()}
    model, nodes = geometry.model, np.zeros_like(geometry.model.mesh.nodes)
    for name in ("shape", "thickness"):
        if name in own:
            nodes = nodes + getattr(geometry, name)(own[name]).nodes[0]
    mesh = replace(model.mesh, nodes=model.mesh.nodes + nodes)
    if "fibres" in own:
        angle, normal = parts["fibres"][mesh.region][:, None, None], geometry._normal[mesh.elements]
        along = np.sum(normal * mesh.fibre, axis=2, keepdims=True) * normal
        across = np.cross(normal, mesh.fibre)
        fibre = along + np.cos(angle) * (mesh.fibre - along) + np.sin(angle) * across
        mesh = replace(mesh, fibre=fibre)
    ends = geometry._ends(model.observed(nodes)) + parts.get("insertions", 0.0)
    chordae = replace(
        model.valve.chordae,
        insertion=model.valve.chordae.insertion + ends,
        rest_length=model.valve.chordae.rest_length * (1.0 + parts.get("rest_lengths", 0.0)),
    )

    def moved(valve: Valve, by: FloatArray, thicker: FloatArray, to: FloatArray | float) -> Valve:
        annulus, tips = np.array(valve.motion.annulus), np.array(valve.motion.papillary_tips)
        annulus[0] += by[valve.annulus]
        annulus[-1] += to
        tips[-1] += parts.get("tips", 0.0)
        surface = replace(
            valve.surface,
            vertices=valve.surface.vertices + by,
            thickness=valve.surface.thickness * (1.0 + thicker),
        )
        motion = replace(valve.motion, annulus=annulus, papillary_tips=tips)
        return replace(valve, surface=surface, chordae=chordae, motion=motion)

    thickness = parts.get("thickness", np.zeros(len(geometry.surface.vertices)))
    thicker = geometry._at(geometry._samples, thickness)
    annulus = parts.get("annulus", 0.0)
    contact = moved(model.contact_valve, geometry._sampled(nodes), thicker, annulus)
    same = model.contact_valve is model.valve
    valve = contact if same else moved(model.valve, model.observed(nodes), thickness, 0.0)
    assert model.guide is None
    return replace(
        model, mesh=mesh, valve=valve, contact_valve=contact, guide=None, rounded_start=False
    )
