"""How errors of a valve's geometry move its closed state: open shape, boundary, thickness, fibres.

A change of the surface at rest is carried into the mesh and to the points where contact is sampled:
each of them keeps its place on the surface and its share of the thickness. All embeddings stay as
they are, so that the same material points are observed, touch and are held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.mechanics.reference import RestVariation, vary_equilibrium
from mvest.mechanics.solver import EXACT
from mvest.mechanics.valve_system import (
    HeldState,
    boundary_loading,
    held_loading,
    patch_change,
    patch_members,
)
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.band import leaflet_normals, leaflet_normals_change
from mvest.valve.anatomy.valve import Valve, lumped_areas_change
from mvest.valve.geometry.proximity import ClosestPoints, closest_points
from mvest.valve.geometry.triangles import unit_rows
from mvest.valve.mesh.solid_mesh import Embedding, embed

PARTS = ("shape", "thickness", "fibres", "annulus", "tips", "rest_lengths", "insertions")
"""Of a geometry, by the methods of `RestGeometry` that say what each is a change of."""


class RestGeometry:
    """The geometry at rest of a closing valve, and what changes of it do to its closed state.

    Parameters
    ----------
    model : ClosureModel
        Its protocol must end in an equilibrium.
    seen : ClosureModel, optional
        The one that it was displaced from, if changes are meant from there.

    Raises
    ------
    InputError
        If it does not: a valve that still moves has a history, which depends on the geometry too.
    """

    def __init__(self, model: ClosureModel, seen: ClosureModel | None = None) -> None:
        if not model.settings.protocol.equilibrium:
            raise InputError("derivatives by the geometry need a closure that ends in equilibrium")
        self.model, self.seen = model, seen or model
        self.surface, nodes = self.seen.valve.surface, self.seen.mesh.nodes
        self._normals = leaflet_normals(self.surface)
        self._closest = closest_points(nodes, self.surface.vertices, self.surface.triangles)
        self._normal = unit_rows(self._at(self._closest, self._normals))
        self._height, self._nodes = self._feet()

    def _feet(self) -> tuple[FloatArray, ClosestPoints]:
        """Heights ``(n,)`` mm of the mesh's nodes, and where along the normals they stand.

        Feet lie in the plane of the closest triangle, and possibly beyond its sides: with them a
        node is exactly foot plus height times normal, so that it turns as the surface does.
        """
        surface, nodes, normal = self.surface, self.seen.mesh.nodes, self._normal
        a, b, c = np.moveaxis(surface.vertices[surface.triangles[self._closest.triangle]], 1, 0)
        across = np.cross(b - a, c - a)
        height = np.sum((nodes - a) * across, axis=1) / np.sum(normal * across, axis=1)
        foot = nodes - height[:, None] * normal
        area = np.sum(across**2, axis=1)
        at_b = np.sum(np.cross(foot - a, c - a) * across, axis=1) / area
        at_c = np.sum(np.cross(b - a, foot - a) * across, axis=1) / area
        weights = np.stack([1.0 - at_b - at_c, at_b, at_c], axis=1)
        return height, replace(self._closest, barycentric=weights)

    @cached_property
    def _samples(self) -> ClosestPoints:
        """Where the samples of contact are on the surface."""
        points = self.seen.contact_valve.surface.vertices
        return closest_points(points, self.surface.vertices, self.surface.triangles)

    @cached_property
    def _sampled(self) -> Embedding:
        """The samples of contact in the mesh."""
        return embed(self.seen.mesh, self.seen.contact_valve.surface.vertices)

    @cached_property
    def _patches(self) -> tuple[IntArray, FloatArray, FloatArray]:
        model = self.model
        return patch_members(
            model.contact_valve, model.settings.patch_radius, model.valve.chordae.insertion
        )

    def _at(self, points: ClosestPoints, values: FloatArray) -> FloatArray:
        return points.interpolate(values, self.surface.triangles)

    def _still(self, q: int) -> FloatArray:
        return np.zeros((q, *self.model.mesh.nodes.shape))

    def shape(self, moves: FloatArray) -> RestVariation:
        """Of the open shape, by displacements ``(q, n, 3)`` mm of the surface's vertices.

        The annulus and the papillary tips of the closed valve stay where they are; the chordae go
        with the leaflets.
        """
        contact, by_vertex = self.model.contact_valve.surface, np.moveaxis(moves, 0, -1)
        members, weights, slope = self._patches
        turn = self._at(self._closest, leaflet_normals_change(self.surface, by_vertex))
        turn /= np.linalg.norm(self._at(self._closest, self._normals), axis=1)[:, None, None]
        turn -= self._normal[:, :, None] * np.einsum("ni,niq->nq", self._normal, turn)[:, None]
        nodes = self._at(self._nodes, by_vertex) + self._height[:, None, None] * turn
        samples = self._sampled(nodes)
        areas = lumped_areas_change(contact.vertices, contact.triangles, samples).T
        ends = self._ends(by_vertex)[:, None] - samples[members]
        wider = (areas / contact.areas)[:, members]
        return RestVariation(
            np.ascontiguousarray(np.moveaxis(nodes, -1, 0)),
            areas=areas,
            patches=patch_change(weights, slope, np.moveaxis(ends, -1, 0), wider),
            members=members,
        )

    def along_ends(self) -> FloatArray:
        """Two directions ``(c, 2, 3)`` along the leaflet where each chord ends."""
        return np.linalg.svd(unit_rows(self._ends(self._normals))[:, None])[2][:, 1:]

    def _ends(self, values: FloatArray) -> FloatArray:
        """Values at the chordae's ends, of those ``(n, ...)`` at the surface's vertices."""
        own, chordae = self.surface, self.seen.valve.chordae
        return self._at(closest_points(chordae.insertion, own.vertices, own.triangles), values)

    def thickness(self, factors: FloatArray) -> RestVariation:
        """Of the thickness, by relative changes ``(q, n)`` at the surface's vertices."""
        nodes = [
            (self._height * self._at(self._closest, factor))[:, None] * self._normal
            for factor in factors
        ]
        own = self.seen.contact_valve.surface.thickness
        thickness = [own * self._at(self._samples, factor) for factor in factors]
        return RestVariation(np.array(nodes), thickness=np.array(thickness))

    def fibres(self, angles: FloatArray) -> RestVariation:
        """Of the fibres, by turns ``(q, regions)`` rad of each region's about its normals."""
        mesh = self.model.mesh
        across = np.cross(self._normal[mesh.elements], mesh.fibre)
        turned = [angle[mesh.region][:, None, None] * across for angle in angles]
        return RestVariation(self._still(len(angles)), fibre=np.array(turned))

    def annulus(self, moves: FloatArray) -> RestVariation:
        """Of the closed annulus, by displacements ``(q, a, 3)`` mm of the contact valve's."""
        copies = 2 if self.model.settings.support == "clamp" else 1
        return RestVariation(self._still(len(moves)), supports=np.tile(moves, (1, copies, 1)))

    def tips(self, moves: FloatArray, rest_length: FloatArray | None = None) -> RestVariation:
        """Of the closed valve's papillary tips, by displacements ``(q, t, 3)`` mm.

        ``rest_length (q, c)`` is how much longer the chordae then are at rest, relative, where that
        follows from the tips.
        """
        return RestVariation(self._still(len(moves)), tips=moves, rest_length=rest_length)

    def rest_lengths(self, changes: FloatArray) -> RestVariation:
        """Of the chordae's rest lengths, by relative changes ``(q, c)``."""
        share = self.seen.valve.chordae.rest_length / self.model.valve.chordae.rest_length
        return RestVariation(self._still(len(changes)), rest_length=changes * share)

    def insertions(self, moves: FloatArray) -> RestVariation:
        """Of where the chordae end, by displacements ``(q, c, 3)`` mm at rest."""
        members, weights, slope = self._patches
        ends = np.broadcast_to(moves[:, :, None], (len(moves), *slope.shape))
        patches = patch_change(weights, slope, ends)
        return RestVariation(self._still(len(moves)), patches=patches, members=members)

    def variation(self, parts: Mapping[str, FloatArray]) -> RestVariation:
        """Of several parts of the geometry at once, each ``(q, ...)`` as its method takes it.

        Parameters
        ----------
        parts : mapping
            Some of `PARTS` -> as many quantities of each.
        """
        return RestVariation.summed([getattr(self, name)(values) for name, values in parts.items()])

    def displaced(self, parts: Mapping[str, FloatArray]) -> ClosureModel:
        """The model of the valve with another geometry, its guide's too; it has closed nothing.

        Everything embedded stays where it is in the material. A displacement of the open shape
        carries the mesh along as its derivative says.

        Parameters
        ----------
        parts : mapping
            Some of `PARTS` -> what `variation` takes, of one quantity.

        Raises
        ------
        GeometryError
            If a leaflet would have no thickness, or a chord no length.
        """
        own = {name: np.asarray(values)[None] for name, values in parts.items()}
        model, still = self.model, np.zeros_like(self.model.mesh.nodes)
        shape = self.shape(own["shape"]).nodes[0] if "shape" in own else still
        thicker = self.thickness(own["thickness"]).nodes[0] if "thickness" in own else still
        nodes = shape + thicker
        mesh = replace(model.mesh, nodes=model.mesh.nodes + nodes)
        if "fibres" in own:
            angle, normal = parts["fibres"][mesh.region][:, None, None], self._normal[mesh.elements]
            along = np.sum(normal * mesh.fibre, axis=2, keepdims=True) * normal
            across = np.cross(normal, mesh.fibre)
            fibre = along + np.cos(angle) * (mesh.fibre - along) + np.sin(angle) * across
            mesh = replace(mesh, fibre=fibre)
        ends = self._ends(model.observed(nodes)) + parts.get("insertions", 0.0)
        chordae = replace(
            model.valve.chordae,
            insertion=model.valve.chordae.insertion + ends,
            rest_length=model.valve.chordae.rest_length * (1.0 + parts.get("rest_lengths", 0.0)),
        )
        thickness = parts.get("thickness", np.zeros(len(self.surface.vertices)))

        def moved(
            valve: Valve, by: FloatArray, thicker: FloatArray, to: FloatArray | float
        ) -> Valve:
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

        to = parts.get("annulus", 0.0)
        contact = moved(
            model.contact_valve, self._sampled(nodes), self._at(self._samples, thickness), to
        )
        same = model.contact_valve is model.valve
        valve = contact if same else moved(model.valve, model.observed(nodes), thickness, 0.0)
        guide = None if model.guide is None else RestGeometry(model.guide).displaced(parts)
        return replace(
            model, valve=valve, contact_valve=contact, mesh=mesh, guide=guide, anchors=None
        )

    def change(
        self,
        m: FloatArray,
        variation: RestVariation,
        states: Sequence[HeldState] = (),
        tolerance: float = EXACT,
    ) -> FloatArray | str:
        """Derivatives ``(f, n, 3, q)`` of the observed open and closed valve, or why none.

        Those of the states come between them.

        Parameters
        ----------
        m : (p,)
            Parameters of the closure; it is gone to from the last closed state, if that is another.
        variation : RestVariation
        states : sequence of HeldState
            Under other loads, gone to from the closed valve.
        tolerance : float
            Of each derivative, relative.
        """
        model = self.model
        if model.closed is None or not np.array_equal(model.closed.at, m):
            simulation = model.close(m, sensitivities=False).simulation
            if not simulation.converged:
                return simulation.reason.value
        assert model.closed is not None
        system, _ = model.tuned(m)
        loading = boundary_loading(system, model.valve, model.contact_valve, model.settings)
        ends = [(model.closed.positions, loading(model.settings.protocol.end))]
        for state, end in zip(states, model.rests(m, states)[1:] if states else (), strict=False):
            if not end.converged:
                return end.reason.value
            held = held_loading(system, model.contact_valve, state)
            ends.append((end.frames[-1], held(0.0)))
        moves = [
            vary_equilibrium(system, model.solver, positions, loads, variation, tolerance)
            for positions, loads in ends
        ]
        frames = (variation.nodes, *moves[1:], moves[0])
        return np.moveaxis(np.array([[model.observed(dx) for dx in one] for one in frames]), 1, -1)
