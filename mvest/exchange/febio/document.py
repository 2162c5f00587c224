"""FEBio's input file, section by section, in the order in which FEBio reads them.

Written by this project after the reader of FEBio 4.11 (``FEBioXML``): every tag and attribute is
one that it asks for. Numbers are written so that they are read back the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from mvest.errors import InputError
from mvest.exchange.febio.mesh import FebLaw, FebMesh
from mvest.files import write_atomically
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding

AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Prescribed:
    """Nodes that go to where they are told.

    Attributes
    ----------
    name : str
    nodes : (k,)
    displacement : (k, 3) mm
        In full; zeros hold the nodes.
    curve : (c, 2)
        Times and shares of it.
    axes : tuple of str
        Coordinates that are prescribed.
    """

    name: str
    nodes: IntArray
    displacement: FloatArray
    curve: FloatArray
    axes: tuple[str, ...] = AXES


@dataclass(frozen=True, slots=True, eq=False)
class Pressure:
    """Follower pressure on faces of the mesh; ``curve (c, 2)`` of times (s) and MPa."""

    faces: IntArray
    curve: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Averages:
    """Further nodes that follow weighted averages of others, as constraints without forces.

    Attributes
    ----------
    nodes : (k,)
    of : Embedding
        ``(k,)`` of the nodes of the mesh.
    """

    nodes: IntArray
    of: Embedding


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """Elastic support of weighted averages of nodes at further nodes.

    Attributes
    ----------
    targets : (k,)
        Nodes that they are drawn to, from where the averages are at rest.
    of : Embedding
        ``(k,)``.
    stiffness : (k,) N/mm
    """

    targets: IntArray
    of: Embedding
    stiffness: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Springs:
    """Springs between pairs of nodes, each with its own force.

    Attributes
    ----------
    pairs : (k, 2)
    forces : sequence of (p, 2)
        Elongation against the distance at rest (mm) and force (N), linear between the points and
        beyond them.
    """

    pairs: IntArray
    forces: Sequence[FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class PotentialContact:
    """FEBio's ``contact potential`` between a surface and itself.

    The force between two points at distance r is ``kc / r^p`` less a constant within ``R_in`` and
    falls to zero as a parabola at ``R_out``.

    Attributes
    ----------
    surfaces : mapping
        Name -> faces ``(f, k)``; all of them together are the surface.
    stiffness : float
        kc.
    exponent, inner, outer : float
        p, and R_in and R_out in mm.
    """

    surfaces: Mapping[str, IntArray]
    stiffness: float
    exponent: float
    inner: float
    outer: float


@dataclass(frozen=True, slots=True, eq=False)
class SlidingContact:
    """FEBio's ``sliding-elastic`` between the first surface and each of the others.

    Attributes
    ----------
    surfaces : mapping
        Name -> faces ``(f, k)``.
    penalty : float
        Factor on the penalty that FEBio works out.
    reach : float
        mm within which a surface looks for the other.
    offset : float
        mm that the surfaces keep from each other.
    """

    surfaces: Mapping[str, IntArray]
    penalty: float
    reach: float
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Control:
    """How FEBio solves.

    Attributes
    ----------
    end : float
        s.
    step, smallest, largest : float
        s, the first time step and the bounds within which FEBio chooses the others.
    dynamic : bool
        With inertia (the generalised alpha rule at its most dissipative) or static.
    quasi_newton : int
        BFGS updates between two new tangents; 0 for Newton's method.
    displacement, energy, residual : float
        Tolerances; 0 asks nothing.
    retries : int
        How often a step may be shortened.
    line_search : float
        Its tolerance; 0 for none.
    """

    end: float
    step: float
    smallest: float
    largest: float
    dynamic: bool = False
    quasi_newton: int = 0
    displacement: float = 1e-6
    energy: float = 1e-10
    residual: float = 0.0
    retries: int = 10
    line_search: float = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class FebDocument:
    """A body and what acts on it.

    Attributes
    ----------
    mesh : FebMesh
    laws : tuple of FebLaw
        One per region.
    control : Control
    pressure : Pressure or None
    prescribed : tuple of Prescribed
    further : (k, 3) mm
        Nodes that belong to no element; they are numbered after those of the mesh.
    averages, support, springs, contact : optional
    density : float
        t/mm^3.
    alpha : float
        1/s, damping by mass of a dynamic run.
    remarks : tuple of str
        Comments at the head of the file.
    """

    mesh: FebMesh
    laws: tuple[FebLaw, ...]
    control: Control
    pressure: Pressure | None = None
    prescribed: tuple[Prescribed, ...] = ()
    further: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    averages: Averages | None = None
    support: Support | None = None
    springs: Springs | None = None
    contact: PotentialContact | SlidingContact | None = None
    density: float = 1.04e-9
    alpha: float = 0.0
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        regions = len(self.mesh.solid.region_names)
        if len(self.laws) != regions:
            raise InputError(f"{len(self.laws)} laws of {regions} regions")

    @property
    def n_nodes(self) -> int:
        """Nodes of the file."""
        return len(self.mesh.solid.nodes) + len(self.further)

    def write(self, path: Path) -> Path:
        """Write the file, positions of whose nodes FEBio will log into `positions_file`.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        return write_atomically(path, _Writer(self, path).text())


def positions_file(path: Path) -> Path:
    """Where FEBio logs the positions of the nodes of an input file."""
    return path.with_name(f"{path.stem}_positions.csv")


class _Writer:
    """The tree of one document."""

    def __init__(self, document: FebDocument, path: Path) -> None:
        self.document = document
        self.positions = positions_file(path).name
        self.root = Xml.Element("febio_spec", version="4.0")
        self.curves: list[FloatArray] = []

    def text(self) -> str:
        document = self.document
        for remark in document.remarks:
            # Two hyphens end a comment.
            self.root.append(Xml.Comment(f" {remark.replace('--', '- -')} "))
        _add(self.root, "Module", type="solid")
        self._control(document.control)
        self._materials()
        self._mesh()
        domains = _add(self.root, "MeshDomains")
        rule = {"elem_type": document.mesh.rule} if document.mesh.rule else {}
        for name in document.mesh.solid.region_names:
            _add(domains, "SolidDomain", name=name, mat=name, **rule)
        self._mesh_data()
        self._boundary()
        self._loads()
        self._contact()
        self._support()
        self._springs()
        load_data = _add(self.root, "LoadData")
        for k, curve in enumerate(self.curves, start=1):
            controller = _add(load_data, "load_controller", id=str(k), type="loadcurve")
            _add(controller, "interpolate", "LINEAR")
            _add(controller, "extend", "CONSTANT")
            _points(controller, curve)
        output = _add(self.root, "Output")
        plot = _add(output, "plotfile", type="febio")
        for name in ("displacement", "stress", "Lagrange strain", "contact pressure"):
            _add(plot, "var", type=name)
        log = _add(output, "logfile")
        _add(log, "node_data", f"1:{document.n_nodes}", data="x;y;z", name="positions",
             file=self.positions, delim=",")  # fmt: skip
        Xml.indent(self.root, " ")
        return (
            '<?xml version="1.0" encoding="UTF-8"?>\n'
            + Xml.tostring(self.root, encoding="unicode")
            + "\n"
        )

    def _curve(self, curve: FloatArray) -> str:
        """Number of a load curve."""
        self.curves.append(curve)
        return str(len(self.curves))

    def _control(self, control: Control) -> None:
        at = _add(self.root, "Control")
        _add(at, "analysis", "DYNAMIC" if control.dynamic else "STATIC")
        _add(at, "time_steps", str(max(1, round(control.end / control.step))))
        _add(at, "step_size", control.step)
        _add(at, "plot_level", "PLOT_MAJOR_ITRS")
        stepper = _add(at, "time_stepper", type="default")
        _add(stepper, "max_retries", str(control.retries))
        _add(stepper, "opt_iter", "15")
        _add(stepper, "aggressiveness", "1")
        _add(stepper, "cutback", 0.5)
        _add(stepper, "dtmin", control.smallest)
        _add(stepper, "dtmax", control.largest)
        solver = _add(at, "solver", type="solid")
        _add(solver, "symmetric_stiffness", "0")
        _add(solver, "equation_scheme", "staggered")
        _add(solver, "optimize_bw", "0")
        _add(solver, "lstol", control.line_search)
        _add(solver, "max_refs", "25")
        _add(solver, "diverge_reform", "1")
        _add(solver, "min_residual", 1e-16)
        _add(solver, "dtol", control.displacement)
        _add(solver, "etol", control.energy)
        _add(solver, "rtol", control.residual)
        _add(solver, "rhoi", "0")
        method = _add(solver, "qn_method", type="BFGS")
        _add(method, "max_ups", str(control.quasi_newton))

    def _materials(self) -> None:
        materials = _add(self.root, "Material")
        names = self.document.mesh.solid.region_names
        for k, (name, law) in enumerate(zip(names, self.document.laws, strict=True), start=1):
            material = _add(materials, "material", id=str(k), name=name, type=law.name)
            _add(material, "density", self.document.density)
            for tag, value in law.parameters.items():
                _add(material, tag, value)
            if law.directed == "fiber":
                _add(material, "fiber", f"fibre_{name}", type="map")

    def _mesh(self) -> None:
        document, mesh = self.document, self.document.mesh
        at = _add(self.root, "Mesh")
        nodes = _add(at, "Nodes", name="all")
        for k, x in enumerate(np.vstack([mesh.solid.nodes, document.further]), start=1):
            _add(nodes, "node", _row(x), id=str(k))
        number = 0
        for region, name in enumerate(mesh.solid.region_names):
            elements = _add(at, "Elements", type=mesh.element, name=name)
            for element in mesh.elements[mesh.solid.region == region]:
                number += 1
                _add(elements, "elem", _numbers(element), id=str(number))
        for group in document.prescribed:
            _add(at, "NodeSet", _numbers(group.nodes), name=group.name)
        surfaces = {} if document.contact is None else dict(document.contact.surfaces)
        if isinstance(document.contact, PotentialContact):
            surfaces = {"contact": np.vstack(list(surfaces.values()))}
        if document.pressure is not None:
            surfaces["pressed"] = document.pressure.faces
        for name, faces in surfaces.items():
            self._surface(at, name, faces)
        for pair, (primary, secondary) in self._pairs().items():
            surface_pair = _add(at, "SurfacePair", name=pair)
            _add(surface_pair, "primary", primary)
            _add(surface_pair, "secondary", secondary)
        if document.springs is not None:
            for k, ends in enumerate(document.springs.pairs):
                _add(_add(at, "DiscreteSet", name=f"spring_{k}"), "delem", _numbers(ends))
        if document.support is not None:
            # Nodes of no element have no freedom in FEBio: a spring without force gives them some.
            pairs = np.stack([document.support.targets, np.roll(document.support.targets, 1)], 1)
            chain = _add(at, "DiscreteSet", name="targets")
            for ends in pairs:
                _add(chain, "delem", _numbers(ends))

    def _surface(self, at: Xml.Element, name: str, faces: IntArray) -> None:
        kind, nodes = self.document.mesh.faces(faces)
        surface = _add(at, "Surface", name=name)
        for k, face in enumerate(nodes, start=1):
            _add(surface, kind, _numbers(face), id=str(k))

    def _pairs(self) -> dict[str, tuple[str, str]]:
        """Pairs of surfaces in contact."""
        contact = self.document.contact
        if contact is None:
            return {}
        if isinstance(contact, PotentialContact):
            return {"contact_pair": ("contact", "contact")}
        first, *others = contact.surfaces
        return {f"{first}_{other}": (first, other) for other in others}

    def _mesh_data(self) -> None:
        mesh = self.document.mesh
        data = _add(self.root, "MeshData")
        for group in self.document.prescribed:
            for k, axis in enumerate(AXES):
                name = f"{group.name}_{axis}"
                values = _add(data, "NodeData", name=name, node_set=group.name, data_type="scalar")
                for j, value in enumerate(group.displacement[:, k], start=1):
                    _add(values, "node", value, lid=str(j))
        reference = mesh.solid.reference
        at_centre = np.einsum("a,mai->mi", reference.shape(reference.centre)[0], mesh.solid.fibre)
        order = mesh.elements
        for region, (name, law) in enumerate(
            zip(mesh.solid.region_names, self.document.laws, strict=True)
        ):
            own = np.flatnonzero(mesh.solid.region == region)
            if law.directed == "fiber":
                values = _add(data, "ElementData", name=f"fibre_{name}", elem_set=name,
                              data_type="vec3")  # fmt: skip
                for j, e in enumerate(own, start=1):
                    columns = [int(np.flatnonzero(mesh.solid.elements[e] == n)[0])
                               for n in order[e]]  # fmt: skip
                    _add(values, "elem", _row(mesh.solid.fibre[e, columns].ravel()), lid=str(j))
                continue
            values = _add(data, "ElementData", elem_set=name, type="mat_axis")
            for j, e in enumerate(own, start=1):
                axes = _add(values, "elem", lid=str(j))
                along = at_centre[e] / np.linalg.norm(at_centre[e])
                _add(axes, "a", _row(along))
                # Any other direction: the laws are the same all around the fibre.
                _add(axes, "d", _row(np.roll(along, 1) + np.array([0.1, 0.2, 0.3])))

    def _boundary(self) -> None:
        at = _add(self.root, "Boundary")
        for group in self.document.prescribed:
            if not group.displacement.any():
                fixed = _add(at, "bc", type="zero displacement", node_set=group.name)
                for axis in AXES:
                    _add(fixed, f"{axis}_dof", "1" if axis in group.axes else "0")
                continue
            curve = self._curve(group.curve)
            for axis in group.axes:
                moved = _add(at, "bc", type="prescribed displacement", node_set=group.name)
                _add(moved, "dof", axis)
                _add(moved, "value", f"{group.name}_{axis}", lc=curve, type="map")
                _add(moved, "relative", "0")
        averages = self.document.averages
        if averages is None:
            return
        for node, members, weights in zip(
            averages.nodes, averages.of.nodes, averages.of.weights, strict=True
        ):
            for axis in AXES:
                follow = _add(at, "bc", type="linear constraint")
                _add(follow, "node", str(node + 1))
                _add(follow, "dof", axis)
                for member, weight in zip(members, weights, strict=True):
                    if weight:
                        child = _add(follow, "child_dof")
                        _add(child, "node", str(member + 1))
                        _add(child, "dof", axis)
                        _add(child, "value", weight)

    def _loads(self) -> None:
        at = _add(self.root, "Loads")
        pressure = self.document.pressure
        if pressure is not None:
            load = _add(at, "surface_load", type="pressure", surface="pressed")
            _add(load, "pressure", 1.0, lc=self._curve(pressure.curve))
            _add(load, "symmetric_stiffness", "0")
            _add(load, "linear", "0")
        if self.document.control.dynamic and self.document.alpha:
            _add(_add(at, "body_load", type="mass damping"), "C", self.document.alpha)

    def _contact(self) -> None:
        at, contact = _add(self.root, "Contact"), self.document.contact
        for pair in self._pairs():
            if isinstance(contact, PotentialContact):
                own = _add(at, "contact", type="contact potential", surface_pair=pair)
                _add(own, "kc", contact.stiffness)
                _add(own, "p", contact.exponent)
                _add(own, "R_in", contact.inner)
                _add(own, "R_out", contact.outer)
            elif isinstance(contact, SlidingContact):
                own = _add(at, "contact", type="sliding-elastic", surface_pair=pair)
                _add(own, "laugon", "0")
                _add(own, "penalty", contact.penalty)
                _add(own, "auto_penalty", "1")
                _add(own, "two_pass", "1")
                _add(own, "search_radius", contact.reach)
                _add(own, "offset", contact.offset)

    def _support(self) -> None:
        support = self.document.support
        if support is None:
            return
        at = _add(self.root, "Constraints")
        largest = float(support.stiffness.max())
        constraint = _add(at, "constraint", type="linear constraint", name="support")
        _add(constraint, "laugon", "0")
        _add(constraint, "penalty", largest)
        for target, members, weights, stiffness in zip(
            support.targets, support.of.nodes, support.of.weights, support.stiffness, strict=True
        ):
            # The energy of a constraint is half its square times the penalty.
            factor = float(np.sqrt(stiffness / largest))
            for axis in AXES:
                own = _add(constraint, "linear_constraint")
                _add(own, "node", -factor, id=str(target + 1), bc=axis)
                for member, weight in zip(members, weights, strict=True):
                    if weight:
                        _add(own, "node", factor * weight, id=str(member + 1), bc=axis)

    def _springs(self) -> None:
        at = _add(self.root, "Discrete")
        forces = () if self.document.springs is None else self.document.springs.forces
        for k, force in enumerate(forces):
            material = _add(at, "discrete_material", type="nonlinear spring", name=f"chord_{k}")
            _add(material, "measure", "elongation")
            function = _add(material, "force", type="point")
            _add(function, "interpolate", "linear")
            _add(function, "extend", "extrapolate")
            _points(function, force)
        if self.document.support is not None:
            material = _add(at, "discrete_material", type="linear spring", name="none")
            _add(material, "E", 1e-12)
        for k in range(len(forces)):
            _add(at, "discrete", dmat=str(k + 1), discrete_set=f"spring_{k}")
        if self.document.support is not None:
            _add(at, "discrete", dmat=str(len(forces) + 1), discrete_set="targets")


def _add(at: Xml.Element, tag: str, value: float | str = "", **attributes: str) -> Xml.Element:
    element = Xml.SubElement(at, tag, attributes)
    element.text = value if isinstance(value, str) else repr(float(value))
    return element


def _points(at: Xml.Element, points: FloatArray) -> None:
    rows = _add(at, "points")
    for point in points:
        _add(rows, "pt", _row(point))


def _row(values: Iterable[float]) -> str:
    return ",".join(repr(float(value)) for value in values)


def _numbers(nodes: Iterable[int]) -> str:
    return ",".join(str(int(node) + 1) for node in nodes)
