r"""Derivatives of an equilibrium with respect to the geometry of the body at rest.

An equilibrium is r(x; q) = 0 in nodal positions x, where q displaces the nodes at rest, rotates
fibres, moves supports and tips, or thickens the sheets in contact. With the consistent tangent A

.. math:: A \, dx/dq = -\partial_q r,

so that a quantity costs one right-hand side and one back-substitution instead of an equilibrium.

Derivatives of an element's forces by its nodes at rest are central differences at fixed positions,
with the enhanced strains eliminated anew each time: two evaluations of all elements for each
coordinate of an element, independent of the number of quantities. Contact, cables and supports are
differentiated by hand. Embedded points and candidate pairs stay in the material; the distance of a
pair at rest, which limits its reach, changes with the geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from mvest.mechanics.assembly import add_forces, add_forces_at
from mvest.mechanics.forces.pair_search import ContactPairs
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import EXACT, LinearSolver
from mvest.mechanics.system import Loads, System
from mvest.typing import FloatArray, IntArray

STEP = 1e-4
"""Difference step, relative to the smallest edge at rest or in rad: the second-order error and
round-off are both about 1e-8 of a derivative."""


@dataclass(frozen=True, slots=True, eq=False)
class RestVariation:
    """Changes of a body at rest and of its supports, per unit of each of q quantities."""

    nodes: FloatArray  #: (q, n, 3) mm, displacement of the nodes at rest
    #: (q, e, k, 3) or None, change of the fibre directions at the elements' nodes, across the
    #: fibres
    fibre: FloatArray | None = None
    #: (q, c) mm² and mm, or None, changes at the contact points
    areas: FloatArray | None = None
    thickness: FloatArray | None = None
    #: (q, h, 3) mm or None, displacement of the supports' targets
    supports: FloatArray | None = None
    tips: FloatArray | None = None  #: (q, t, 3) mm or None
    #: (q, segments) or None, relative change of the rest lengths of the cables' segments
    rest_length: FloatArray | None = None
    #: (q, cables, s) or None, change of the weights of the contact points whose average is a
    #: cable's end
    patches: FloatArray | None = None
    #: (cables, s) or None, these contact points, the same for all quantities
    members: IntArray | None = None

    def __len__(self) -> int:
        return len(self.nodes)

    @classmethod
    def joined(cls, parts: Sequence[RestVariation]) -> RestVariation:
        """The quantities of several variations of one body, one after another."""
        joined: dict[str, Any] = {}
        for name, own in cls._given(parts).items():
            shape = next(iter(own.values())).shape[1:]
            blocks = [own.get(k, np.zeros((len(part), *shape))) for k, part in enumerate(parts)]
            joined[name] = own[min(own)] if name == "members" else np.concatenate(blocks)
        return cls(**joined)

    @classmethod
    def summed(cls, parts: Sequence[RestVariation]) -> RestVariation:
        """As many quantities, each with its changes in all parts at once."""
        summed: dict[str, Any] = {}
        for name, own in cls._given(parts).items():
            first, *others = own.values()
            summed[name] = first if name == "members" else np.asarray(sum(others, first))
        return cls(**summed)

    @classmethod
    def _given(cls, parts: Sequence[RestVariation]) -> dict[str, dict[int, Any]]:
        """Field -> number of a part -> values, for the fields that a part has."""
        own = {f.name: {k: getattr(p, f.name) for k, p in enumerate(parts)} for f in fields(cls)}
        own = {name: {k: v for k, v in each.items() if v is not None} for name, each in own.items()}
        return {name: each for name, each in own.items() if each}


def vary_equilibrium(
    system: System,
    solver: LinearSolver,
    x: FloatArray,
    loads: Loads,
    variation: RestVariation,
    tolerance: float = EXACT,
) -> FloatArray:
    """Derivatives ``(q, n, 3)`` mm of an equilibrium ``x (n, 3)`` mm by changes at rest.

    ``tolerance`` is the relative error of each derivative.
    """
    solid = system.solid
    pairs = system.search_contact(x)
    evaluation = system.evaluate(x, loads, pairs, solid.initial_strain(), 0.0, tangent=True)
    assert evaluation.blocks is not None
    solver.factorize(system.matrix(evaluation.blocks, 0.0))
    r = _solid_change(solid, x, variation)
    for k in range(len(variation)):
        r[k] += _outside_change(system, x, loads, pairs, variation, k)
    r[:, system.held] = 0.0
    right = -r.reshape(len(variation), -1).T
    dx = solver.solve(np.ascontiguousarray(right), tolerance)
    return np.ascontiguousarray(dx.T).reshape(r.shape)


def _solid_change(solid: Solid, x: FloatArray, variation: RestVariation) -> FloatArray:
    """Change ``(q, n, 3)`` N of the internal forces at fixed positions."""
    mesh = solid.mesh
    elements = mesh.elements
    apart = _Apart(solid, x)
    out = np.zeros((len(variation), solid.n_nodes, 3))
    if np.any(variation.nodes):
        by_nodes = apart.by_rest_nodes()
        m, k = elements.shape
        moved = variation.nodes[:, elements].transpose(1, 2, 3, 0).reshape(m, 3 * k, -1)
        forces = (by_nodes @ moved).reshape(m, k, 3, -1)
        for which in range(len(variation)):
            add_forces(out[which], elements, np.ascontiguousarray(forces[..., which]))
    if variation.fibre is not None:
        for which, turned in enumerate(variation.fibre):
            if not np.any(turned):
                continue
            ahead = apart.forces(fibre=mesh.fibre + STEP * turned)
            behind = apart.forces(fibre=mesh.fibre - STEP * turned)
            add_forces(out[which], elements, (ahead - behind) / (2 * STEP))
    return out


class _Apart:
    """The elements of a solid with separate nodes, so that all can be varied at once."""

    def __init__(self, solid: Solid, x: FloatArray) -> None:
        mesh = solid.mesh
        self.solid = solid
        self.rest = mesh.nodes[mesh.elements]
        self.x = np.ascontiguousarray(x[mesh.elements].reshape(-1, 3))
        own = np.arange(mesh.elements.size).reshape(mesh.elements.shape)
        self.mesh = replace(
            mesh,
            nodes=self.rest.reshape(-1, 3),
            elements=own,
            pressure_faces=mesh.pressure_faces[:0],
        )

    def forces(
        self, nodes: FloatArray | None = None, fibre: FloatArray | None = None
    ) -> FloatArray:
        """Nodal forces ``(e, k, 3)`` N with other nodes at rest ``(e, k, 3)`` or other fibres."""
        rest = self.mesh.nodes if nodes is None else nodes.reshape(-1, 3)
        mesh = replace(self.mesh, nodes=rest, fibre=self.mesh.fibre if fibre is None else fibre)
        solid = Solid(mesh, self.solid.law, enhanced=self.solid.n_modes > 0)
        solid.enhanced_parameters = self.solid.enhanced_parameters.copy()
        return solid.forces(solid.evaluate(self.x, solid.initial_strain(), 0.0))

    def by_rest_nodes(self) -> FloatArray:
        """Derivatives ``(e, 3 k, 3 k)`` N/mm of the forces by the nodes at rest."""
        m, k, _ = self.rest.shape
        step = STEP * float(
            np.linalg.norm(self.rest[:, None] - self.rest[:, :, None], axis=-1)[
                :, ~np.eye(k, dtype=np.bool_)
            ].min()
        )
        out = np.empty((m, 3 * k, 3 * k))
        for column in range(3 * k):
            move = np.zeros(3 * k)
            move[column] = step
            move = move.reshape(k, 3)
            ahead, behind = self.forces(self.rest + move), self.forces(self.rest - move)
            out[:, :, column] = ((ahead - behind) / (2 * step)).reshape(m, -1)
        return out


def _outside_change(
    system: System,
    x: FloatArray,
    loads: Loads,
    pairs: ContactPairs | None,
    variation: RestVariation,
    k: int,
) -> FloatArray:
    """Change ``(n, 3)`` N of the forces on the solid by quantity ``k``, at fixed positions."""
    out = np.zeros((system.n, 3))
    if system.contact is not None and pairs is not None:
        points = system.contact.points
        force = system.contact.forces_change(
            pairs,
            points(x),
            points(variation.nodes[k]),
            None if variation.areas is None else variation.areas[k],
            None if variation.thickness is None else variation.thickness[k],
        )
        add_forces_at(out, points, force)
    if system.hinge is not None and variation.supports is not None:
        force = -system.hinge.stiffness[:, None] * variation.supports[k]
        add_forces_at(out, system.hinge.points, force)
    if system.cables is not None:
        cables, factors = system.cables, system.factors.chordae
        state = cables.state(x, loads.tips, *factors)
        moves: dict[str, FloatArray] = {}
        if variation.tips is not None:
            moves["tips"] = variation.tips[k]
        if variation.rest_length is not None:
            moves["length"] = factors[1] * variation.rest_length[k]
        if variation.patches is not None and variation.members is not None:
            assert system.contact is not None
            points, weights = system.contact.points, variation.patches[k]
            moves["ends"] = np.einsum("cs,csi->ci", weights, points(x)[variation.members])
            pull = (state.tension[:, None] * state.direction)[: len(weights)]
            pulled = np.zeros((len(points), 3))
            add_forces(pulled, variation.members, weights[:, :, None] * pull[:, None, :])
            add_forces_at(out, points, pulled)
        add_forces_at(out, cables.patches, cables.change(state, **moves))
    return out
