"""How errors in open shape, boundary, thickness and fibres move a valve's closed state.

A change of the rest surface moves the mesh nodes and the contact samples: each keeps its position
on the surface and its fraction of the thickness. Embeddings do not change, so the same material
points are observed, touch and are held.
"""

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
from mvest.valve.anatomy.valve import lumped_areas_change
from mvest.valve.geometry.proximity import ClosestPoints, closest_points
from mvest.valve.geometry.triangles import unit_rows
from mvest.valve.mesh.solid_mesh import Embedding, embed

PARTS = ("shape", "thickness", "fibres", "annulus", "tips", "rest_lengths", "insertions")
"""Parts of a geometry; `RestGeometry` has a method for each."""


class RestGeometry:
    """The rest geometry of a closing valve, and the closed state's dependence on it.

    InputError if the protocol does not end in equilibrium: a moving valve has a history, which also
    depends on the geometry.

    Parameters
    ----------
    model : ClosureModel
        Its protocol must end in an equilibrium.
    """

    def __init__(self, model: ClosureModel) -> None:
        if not model.settings.protocol.equilibrium:
            raise InputError("derivatives by the geometry need a closure that ends in equilibrium")
        self.model, self.surface, nodes = model, model.valve.surface, model.mesh.nodes
        vertices, triangles = self.surface.vertices, self.surface.triangles
        self._normals = leaflet_normals(self.surface)
        self._closest = closest_points(nodes, vertices, triangles)
        self._normal = unit_rows(self._at(self._closest, self._normals))
        # Each node is exactly foot + height * normal, so that it turns with the surface. The foot
        # is in the plane of the closest triangle, possibly outside the triangle.
        a, b, c = np.moveaxis(vertices[triangles[self._closest.triangle]], 1, 0)
        across = np.cross(b - a, c - a)
        height = np.sum((nodes - a) * across, axis=1) / np.sum(self._normal * across, axis=1)
        foot = nodes - height[:, None] * self._normal
        area = np.sum(across**2, axis=1)
        at_b = np.sum(np.cross(foot - a, c - a) * across, axis=1) / area
        at_c = np.sum(np.cross(b - a, foot - a) * across, axis=1) / area
        weights = np.stack([1.0 - at_b - at_c, at_b, at_c], axis=1)
        self._height, self._feet = height, replace(self._closest, barycentric=weights)

    @cached_property
    def _samples(self) -> ClosestPoints:
        """Positions of the contact samples on the surface."""
        points = self.model.contact_valve.surface.vertices
        return closest_points(points, self.surface.vertices, self.surface.triangles)

    @cached_property
    def _sampled(self) -> Embedding:
        """The contact samples embedded in the mesh."""
        return embed(self.model.mesh, self.model.contact_valve.surface.vertices)

    @cached_property
    def _patches(self) -> tuple[IntArray, FloatArray, FloatArray]:
        model = self.model
        return patch_members(
            model.contact_valve, model.settings.patch_radius, model.valve.chordae.insertion
        )

    def _at(self, points: ClosestPoints, values: FloatArray) -> FloatArray:
        return points.interpolate(values, self.surface.triangles)

    def _ends(self, values: FloatArray) -> FloatArray:
        """Values at the chordal insertions, from values ``(n, ...)`` at the surface's vertices."""
        own, chordae = self.surface, self.model.valve.chordae
        return self._at(closest_points(chordae.insertion, own.vertices, own.triangles), values)

    def _still(self, q: int) -> FloatArray:
        return np.zeros((q, *self.model.mesh.nodes.shape))

    def shape(self, moves: FloatArray) -> RestVariation:
        """Change of the open shape by displacements ``(q, n, 3)`` mm of the surface's vertices.

        The annulus and the papillary tips of the closed valve do not move; the chordae follow the
        leaflets.
        """
        by_vertex = np.moveaxis(moves, 0, -1)
        turn = self._at(self._closest, leaflet_normals_change(self.surface, by_vertex))
        turn /= np.linalg.norm(self._at(self._closest, self._normals), axis=1)[:, None, None]
        turn -= self._normal[:, :, None] * np.einsum("ni,niq->nq", self._normal, turn)[:, None]
        return self._followed(self._at(self._feet, by_vertex) + self._height[:, None, None] * turn)

    def _followed(self, nodes: FloatArray) -> RestVariation:
        """Displacements ``(n, 3, q)`` mm of the mesh, with what follows its middle surface."""
        contact, (members, weights, slope) = self.model.contact_valve.surface, self._patches
        samples = self._sampled(nodes)
        areas = lumped_areas_change(contact.vertices, contact.triangles, samples).T
        ends = self._ends(self.model.observed(nodes))[:, None] - samples[members]
        wider = (areas / contact.areas)[:, members]
        return RestVariation(
            np.ascontiguousarray(np.moveaxis(nodes, -1, 0)),
            areas=areas,
            patches=patch_change(weights, slope, np.moveaxis(ends, -1, 0), wider),
            members=members,
        )

    def along_ends(self) -> FloatArray:
        """Two directions ``(c, 2, 3)`` along the leaflet at each chordal insertion."""
        return np.linalg.svd(unit_rows(self._ends(self._normals))[:, None])[2][:, 1:]

    def thickness(self, factors: FloatArray) -> RestVariation:
        """Relative changes ``(q, n)`` of the thickness at the surface's vertices.

        Where faces of the mesh are not equally far from the surface, its middle moves, too.
        """
        faces = self._height[:, None] * self._at(self._closest, factors.T)
        own = self.model.contact_valve.surface.thickness
        thickness = own * self._at(self._samples, factors.T).T
        nodes = self._normal[:, :, None] * faces[:, None]
        return replace(self._followed(nodes), thickness=thickness)

    def fibres(self, angles: FloatArray) -> RestVariation:
        """Rotation of each region's fibres about its normals by ``(q, regions)`` rad."""
        mesh = self.model.mesh
        across = np.cross(self._normal[mesh.elements], mesh.fibre)
        turned = [angle[mesh.region][:, None, None] * across for angle in angles]
        return RestVariation(self._still(len(angles)), fibre=np.array(turned))

    def annulus(self, moves: FloatArray) -> RestVariation:
        """Displacements ``(q, a, 3)`` mm of the contact valve's closed annulus."""
        copies = 2 if self.model.settings.support == "clamp" else 1
        return RestVariation(self._still(len(moves)), supports=np.tile(moves, (1, copies, 1)))

    def tips(self, moves: FloatArray, rest_length: FloatArray | None = None) -> RestVariation:
        """Displacements ``(q, t, 3)`` mm of the closed valve's papillary tips.

        ``rest_length (q, k)`` is the relative change of the segments' rest length, if the tips
        determine it.
        """
        return RestVariation(self._still(len(moves)), tips=moves, rest_length=rest_length)

    def rest_lengths(self, changes: FloatArray) -> RestVariation:
        """Relative changes ``(q, k)`` of the rest lengths of the chordae's segments."""
        return RestVariation(self._still(len(changes)), rest_length=changes)

    def insertions(self, moves: FloatArray) -> RestVariation:
        """Displacements ``(q, c, 3)`` mm of the chordal insertions at rest."""
        members, weights, slope = self._patches
        ends = np.broadcast_to(moves[:, :, None], (len(moves), *slope.shape))
        patches = patch_change(weights, slope, ends)
        return RestVariation(self._still(len(moves)), patches=patches, members=members)

    def variation(self, parts: Mapping[str, FloatArray]) -> RestVariation:
        """Change of several `PARTS` at once, each ``(q, ...)`` in its method's form."""
        return RestVariation.summed([getattr(self, name)(values) for name, values in parts.items()])

    def change(
        self,
        m: FloatArray,
        variation: RestVariation,
        states: Sequence[HeldState] = (),
        tolerance: float = EXACT,
    ) -> FloatArray | str:
        """Derivatives ``(f, n, 3, q)`` of the observed valve, or why there are none.

        Frames are the open valve, the equilibria under ``states``, and the closed valve.

        Parameters
        ----------
        m : (p,)
            Parameters of the closure; the valve first closes with them if necessary.
        variation : RestVariation
        states : sequence of HeldState
            Other loads, applied to the closed valve.
        tolerance : float
            Relative tolerance of each derivative.
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
