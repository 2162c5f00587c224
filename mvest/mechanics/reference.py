r"""Derivatives of an equilibrium by the body's own geometry: where it was and what it was at rest.

An equilibrium is r(x; q) = 0 in nodal positions x, where q displaces the nodes at rest, turns the
fibres, moves supports and tips or thickens the sheets that touch. With the consistent tangent A

.. math:: A \, dx/dq = -\partial_q r,

so that a quantity costs a column of the residual and a back-substitution, and not an equilibrium.

The element's forces by its nodes at rest are central differences of its *residual*, the positions
and everything outside the element fixed, and the enhanced strains eliminated anew each time: two
evaluations of all elements for each of an element's coordinates, whatever the number of quantities.
Contact, cables and supports are differentiated by hand. What is embedded in the mesh stays where it
is in the material, and so do the pairs that may touch; how near to each other a pair was at rest,
which limits its reach, changes with the geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
"""Of the differences, in the size of the smallest edge at rest and in rad: their error, of second
order, and round-off are both about 1e-8 of a derivative."""


@dataclass(frozen=True, slots=True, eq=False)
class RestVariation:
    """How q independent quantities change a body at rest and its supports, each per unit.

    Attributes
    ----------
    nodes : (q, n, 3) mm
        Displacement of the nodes at rest.
    fibre : (q, e, k, 3) or None
        Change of the fibre directions at the elements' nodes, across them.
    areas, thickness : (q, c) mm² and mm, or None
        Change of what belongs to each contact point.
    supports : (q, h, 3) mm or None
        Displacement of the supports' targets.
    tips : (q, t, 3) mm or None
    rest_length : (q, cables) or None
        Relative change of the cables' rest lengths.
    patches : (q, cables, s) or None
        Change of the weights of the contact points that a cable's end is an average of.
    members : (cables, s) or None
        These points, the same for all quantities.
    """

    nodes: FloatArray
    fibre: FloatArray | None = None
    areas: FloatArray | None = None
    thickness: FloatArray | None = None
    supports: FloatArray | None = None
    tips: FloatArray | None = None
    rest_length: FloatArray | None = None
    patches: FloatArray | None = None
    members: IntArray | None = None

    def __len__(self) -> int:
        return len(self.nodes)

    @classmethod
    def joined(cls, parts: Sequence[RestVariation]) -> RestVariation:
        """The quantities of several variations of one body, one after another."""

        def one_by_one(name: str, shape: tuple[int, ...]) -> FloatArray:
            none = [np.zeros((len(part), *shape)) for part in parts]
            own = [getattr(part, name) for part in parts]
            return np.concatenate([n if o is None else o for n, o in zip(none, own, strict=True)])

        return cls._of(parts, one_by_one)

    @classmethod
    def summed(cls, parts: Sequence[RestVariation]) -> RestVariation:
        """As many quantities, each of which does what it does in all parts at once."""

        def at_once(name: str, shape: tuple[int, ...]) -> FloatArray:
            own = [values for part in parts if (values := getattr(part, name)) is not None]
            return np.asarray(sum(own[1:], own[0]))

        return cls._of(parts, at_once)

    @classmethod
    def _of(
        cls,
        parts: Sequence[RestVariation],
        combined: Callable[[str, tuple[int, ...]], FloatArray],
    ) -> RestVariation:
        """What is combined of each field that a part has, given its name and an entry's shape."""
        given: dict[str, Any] = {}
        for field in fields(cls):
            own = [values for part in parts if (values := getattr(part, field.name)) is not None]
            if own and field.name == "members":
                given["members"] = own[0]
            elif own:
                given[field.name] = combined(field.name, own[0].shape[1:])
        return cls(**given)


def vary_equilibrium(
    system: System,
    solver: LinearSolver,
    x: FloatArray,
    loads: Loads,
    variation: RestVariation,
    tolerance: float = EXACT,
) -> FloatArray:
    """Derivatives ``(q, n, 3)`` mm of an equilibrium by what varies at rest.

    Parameters
    ----------
    system : System
    solver : LinearSolver
        Factorises the tangent of the equilibrium.
    x : (n, 3) mm
        Nodal positions in equilibrium.
    loads : Loads
    variation : RestVariation
    tolerance : float
        Of each derivative, relative.
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
    """The elements of a solid with nodes of their own, so that all may be varied at once."""

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
        given = self.rest if nodes is None else nodes
        mesh = replace(
            self.mesh,
            nodes=given.reshape(-1, 3),
            fibre=self.mesh.fibre if fibre is None else fibre,
        )
        solid = Solid(mesh, self.solid.law, enhanced=self.solid.n_modes > 0)
        solid.enhanced_parameters = self.solid.enhanced_parameters.copy()
        state = solid.evaluate(self.x, solid.initial_strain(), 0.0)
        return solid.forces(state)

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
    """Change ``(n, 3)`` N of what acts on the solid by quantity ``k``, at fixed positions."""
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
        cables, factors = system.cables, system.factors
        pull, stiffness, _, by_length = cables.forces(
            x, loads.tips, factors.chord_stiffness, factors.chord_rest_length
        )
        force = np.zeros((len(stiffness), 3))
        if variation.tips is not None:
            force -= np.einsum("cij,cj->ci", stiffness, variation.tips[k][cables.tip])
        if variation.rest_length is not None:
            factor = factors.chord_rest_length * variation.rest_length[k]
            force += factor[:, None] * by_length
        if variation.patches is not None and variation.members is not None:
            assert system.contact is not None
            points, weights = system.contact.points, variation.patches[k]
            moved = np.einsum("cs,csi->ci", weights, points(x)[variation.members])
            force += np.einsum("cij,cj->ci", stiffness, moved)
            pulled = np.zeros((len(points), 3))
            add_forces(pulled, variation.members, weights[:, :, None] * pull[:, None, :])
            add_forces_at(out, points, pulled)
        add_forces_at(out, cables.patches, force)
    return out
