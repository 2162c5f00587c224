"""All forces of a body at one instant: residual, consistent tangent and partial derivatives.

The residual is the internal minus the external force, so that equilibrium is ``r(x) = 0``:
``r = f_solid + f_cables + f_contact + f_hinge + f_ties - p f_pressure``; the time integrator adds
inertia and mass-proportional damping. The tangent is dr/dx, exact in every term.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.assembly import (
    BlockMatrix,
    SparsityPattern,
    add_forces,
    add_forces_at,
    adjacency,
    elements_of_nodes,
    scatter_blocks,
)
from mvest.mechanics.forces.cables import Cables, Hinge, Ties
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.forces.pair_search import ContactPairs
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law import Law, Points
from mvest.mechanics.parameters import NamePart, Parameter, kind_of
from mvest.mechanics.solid import Solid, SolidState
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding

CONTACT_MARGIN = 0.12
"""Distance beyond its reach, over the reach, at which a pair enters the sparsity pattern."""

_NO_NODES: IntArray = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Prescribed loads and positions at one instant."""

    pressure: float = 0.0  #: MPa
    #: (n_tips, 3), (h, 3) and (n_fixed, 3) mm, papillary tips, targets of the hinge points, and
    #: fixed nodes
    tips: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    hinge: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    fixed: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    body_force: FloatArray | None = None  #: (n, 3) N or None, dead nodal forces
    tie_lengths: FloatArray | None = None  #: (k,) mm or None, force-free lengths of the ties


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """Factors on pressure and chordae (for all, or ``(c,)`` for each)."""

    pressure: float = 1.0
    chord_stiffness: float | FloatArray = 1.0
    chord_rest_length: float | FloatArray = 1.0

    @property
    def chordae(self) -> tuple[float | FloatArray, float | FloatArray]:
        """Factors on stiffness and rest length."""
        return self.chord_stiffness, self.chord_rest_length


@dataclass(slots=True, eq=False)
class Evaluation:
    """Residual (without inertia), its scale, and the state and blocks for its derivatives."""

    residual: FloatArray
    scale: float
    solid: SolidState
    blocks: FloatArray | None


class System:
    """A body with all forces on it.

    Parameters
    ----------
    solid : Solid
    pressure : PressureLoad or None
    cables : Cables or None
    contact : Contact or None
    hinge : Hinge or None
    fixed_nodes : ndarray
        Nodes whose positions are prescribed.
    ties : Ties or None
    fixed_components : ndarray or None
        ``(n, 3)`` bool, single coordinates that keep their initial value.
    """

    def __init__(
        self,
        solid: Solid,
        *,
        pressure: PressureLoad | None = None,
        cables: Cables | None = None,
        contact: Contact | None = None,
        hinge: Hinge | None = None,
        fixed_nodes: IntArray = _NO_NODES,
        factors: Factors | None = None,
        ties: Ties | None = None,
        fixed_components: BoolArray | None = None,
    ) -> None:
        self.solid = solid
        self.pressure = pressure
        self.cables = cables
        self.contact = contact
        self.hinge = hinge
        self.fixed_nodes = np.asarray(fixed_nodes, dtype=np.int64)
        self.factors = factors or Factors()
        self.ties = ties
        self.n = solid.n_nodes
        if self.fixed_nodes.size and (
            self.fixed_nodes.min() < 0 or self.fixed_nodes.max() >= self.n
        ):
            raise InputError(f"fixed_nodes must lie between 0 and {self.n - 1}")
        self.held = np.zeros((self.n, 3), dtype=bool)
        self.held[self.fixed_nodes] = True
        if fixed_components is not None:
            self.held |= fixed_components
        groups = [solid.mesh.elements] + ([] if pressure is None else [pressure.faces])
        groups += [np.hstack([row.nodes, column.nodes]) for row, column in self._coupled_points()]
        self._static = SparsityPattern.of(
            adjacency(self.n, groups),
            np.zeros((0, 2), dtype=np.int64) if pressure is None else pressure.rim(),
        )
        self._around = elements_of_nodes(self.n, solid.mesh.elements)
        self._build_pattern(np.zeros((0, 2), dtype=np.int64))

    def retune(self, law: Law, factors: Factors) -> None:
        """Exchange the law and the factors only."""
        self.solid.law = law
        self.solid.reset()
        self.factors = factors

    def forget_contact(self) -> None:
        """Remove all contact from the sparsity pattern."""
        self._build_pattern(np.zeros((0, 2), dtype=np.int64))

    # -- sparsity ---------------------------------------------------------------------------------
    def _coupled_points(self) -> list[tuple[Embedding, Embedding]]:
        """Points of cables, hinge and ties that the blocks of `_attached` couple."""
        own = [self.hinge.points] if self.hinge else []
        own += [self.ties.spans] if self.ties else []
        if self.cables is None:
            return [(points, points) for points in own]
        first, second = map(self.cables.patches.take, self.cables.trees.pairs.T)
        return [(first, second), *((points, points) for points in own)]

    def _build_pattern(self, hosts: IntArray) -> None:
        """Pattern with contact between the pairs of elements ``hosts (g, 2)``, in their order."""
        elements = self.solid.mesh.elements
        self._coupled = hosts[:, 0] * len(elements) + hosts[:, 1]
        self.pattern = self._static.with_coupling(elements, hosts, self._around)
        self._at_elements = self.pattern.within(elements)
        if self.pressure is not None:
            self._at_faces = self.pattern.within(self.pressure.faces)
            self._at_faces_skew = self.pattern.within_skew(self.pressure.faces)
        self._at_attached = [
            (self.pattern.within(row.nodes, column.nodes), row.weights, column.weights)
            for row, column in self._coupled_points()
        ]
        self._at_contact = self.pattern.between(elements[hosts[:, 0]], elements[hosts[:, 1]])
        self._at_diagonal = self.pattern.pointer[:-1]
        free, rows, columns = ~self.held, self.pattern.rows, self.pattern.all_columns
        some: BoolArray = np.any(self.held, axis=1)
        at = np.flatnonzero(some[rows] | some[columns])
        held = ~(free[rows[at]][:, :, None] & free[columns[at]][:, None, :])
        self._held_entries = (9 * at[:, None] + np.arange(9))[held.reshape(-1, 9)]

    def search_contact(self, x: FloatArray) -> ContactPairs | None:
        """Candidate pairs at nodal positions ``x``."""
        return None if self.contact is None else self.contact.search(self.contact.points(x))

    def _contact_slots(self, contact: Contact, pairs: ContactPairs, y: FloatArray) -> IntArray:
        """Positions of the groups of ``pairs`` in the contact pattern, rebuilt if needed.

        The pattern holds only groups that touch or are about to: zero entries would cause fill.
        """
        keys = pairs.hosts[:, 0] * len(self.solid.mesh.elements) + pairs.hosts[:, 1]
        touching = contact.touching(pairs, y)
        if not np.isin(keys[touching], self._coupled, assume_unique=True).all():
            self._build_pattern(pairs.hosts[contact.touching(pairs, y, CONTACT_MARGIN)])
        slots = np.full(len(keys), -1, dtype=np.int64)
        slots[touching] = np.searchsorted(self._coupled, keys[touching])
        return slots

    # -- evaluation -------------------------------------------------------------------------------
    def evaluate(
        self,
        x: FloatArray,
        loads: Loads,
        pairs: ContactPairs | None,
        previous: FloatArray,
        rate: float,
        *,
        tangent: bool,
    ) -> Evaluation:
        """Residual ``(n, 3)`` N and, with ``tangent``, the blocks of its tangent N/mm."""
        state = self.solid.evaluate(x, previous, rate)
        residual = np.zeros((self.n, 3))
        add_forces(residual, self.solid.mesh.elements, self.solid.forces(state))
        scale = float(np.linalg.norm(residual))
        p = self.factors.pressure * loads.pressure
        if self.pressure is not None and p != 0:
            external = np.zeros((self.n, 3))
            add_forces(external, self.pressure.faces, p * self.pressure.forces(x))
            residual -= external
            scale = max(scale, float(np.linalg.norm(external)))
        if loads.body_force is not None:
            residual -= loads.body_force
            scale = max(scale, float(np.linalg.norm(loads.body_force)))
        for points, force, _ in self._attached(x, loads):
            add_forces_at(residual, points, force)
        if self.contact is not None and pairs is not None:
            points = self.contact.points
            add_forces_at(residual, points, self.contact.forces(pairs, points(x)))
        blocks = self.tangent(x, loads, pairs, state) if tangent else None
        return Evaluation(residual, scale, state, blocks)

    def tangent(
        self,
        x: FloatArray,
        loads: Loads,
        pairs: ContactPairs | None,
        state: SolidState,
        *,
        load_stiffness: bool = True,
    ) -> FloatArray:
        """Blocks N/mm of the derivative of the residual with the same arguments.

        ``state`` is the solid's state of that evaluation. Without ``load_stiffness`` the part of
        the pressure is left out.
        """
        slots, y = None, None
        if self.contact is not None and pairs is not None:
            y = self.contact.points(x)
            slots = self._contact_slots(self.contact, pairs, y)
        blocks = self.pattern.zeros()
        self.solid.add_tangents(state, self._at_elements, blocks)
        p = self.factors.pressure * loads.pressure
        if self.pressure is not None and p != 0 and load_stiffness:
            self.pressure.add_tangent(x, -p, self._at_faces, self._at_faces_skew, blocks)
        attached = zip(self._at_attached, self._attached(x, loads), strict=False)
        for at, (_, _, stiffness) in attached:
            scatter_blocks(blocks, *at, stiffness)
        if self.contact is not None and pairs is not None and y is not None and slots is not None:
            self.contact.add_tangent(pairs, y, blocks, slots, self._at_contact, self._at_elements)
        return blocks

    def _attached(
        self, x: FloatArray, loads: Loads
    ) -> Iterator[tuple[Embedding, FloatArray, FloatArray]]:
        """Points of cables, hinge and ties, with their internal forces N and stiffness N/mm."""
        if self.cables is not None:
            forces = self.cables.forces(x, loads.tips, *self.factors.chordae)
            yield self.cables.patches, *forces
        if self.hinge is not None:
            yield self.hinge.points, self.hinge.forces(x, loads.hinge), self.hinge.blocks
        if self.ties is not None and loads.tie_lengths is not None:
            yield self.ties.spans, *self.ties.forces(x, loads.tie_lengths)

    def matrix(self, blocks: FloatArray, mass_factor: float) -> BlockMatrix:
        """Tangent ``(3n, 3n)`` plus ``mass_factor`` times lumped mass; held rows are identity.

        Overwrites ``blocks`` and refers to them.
        """
        for i in range(3):
            blocks[self._at_diagonal, i, i] += mass_factor * self.solid.lumped_mass
        if self._held_entries.size:
            blocks.reshape(-1)[self._held_entries] = 0.0
            nodes, axes = np.nonzero(self.held)
            blocks[self._at_diagonal[nodes], axes, axes] = 1.0
        return self.pattern.matrix(blocks)

    # -- partial derivatives ----------------------------------------------------------------------
    def partial_stress(
        self, parameter: Parameter, state: SolidState, previous: FloatArray, rate: float
    ) -> FloatArray:
        """Partial derivative of the stress ``(e, q, 6)`` by the parameter, at fixed strain.

        ``previous`` and ``rate`` are those of the evaluation of ``state``. InputError if the body
        has no such parameter.
        """
        if kind_of(parameter.name).part not in (NamePart.REGION, NamePart.MODE):
            return np.zeros_like(state.stress)
        mesh, names = self.solid.mesh, self.solid.mesh.region_names
        if parameter.region not in names:
            raise InputError(
                f"parameter {parameter.name!r}: unknown region; the mesh has {', '.join(names)}"
            )
        at, which = Points(state.green, mesh.region, previous, rate), names.index(parameter.region)
        return self.solid.law.partial_stress(parameter, at, which=which, stress=state.stress)

    def partial_load(self, parameter: Parameter, x: FloatArray, loads: Loads) -> FloatArray:
        """Partial derivative ``(n, 3)`` of the residual without the solid's part."""
        kind_of(parameter.name)
        out = np.zeros((self.n, 3))
        if parameter.kind == "pressure_scale" and self.pressure is not None:
            add_forces(out, self.pressure.faces, -loads.pressure * self.pressure.forces(x))
        elif parameter.kind in ("chord_stiffness", "chord_rest_length") and self.cables is not None:
            cables, factors = self.cables, self.factors.chordae
            state = cables.state(x, loads.tips, *factors)
            own = cables.members(parameter.part) / parameter.value
            # A chord's factor is a product: its derivative by one factor is the product over that.
            if parameter.kind == "chord_stiffness":
                force = cables.change(state, stiffness=factors[0] * own)
            else:
                force = cables.change(state, length=factors[1] * own)
            add_forces_at(out, cables.patches, force)
        return out
