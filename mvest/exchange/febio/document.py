r"""FEBio's input file, elements and materials, following the FEBio 4.11 reader (``FEBioXML``).

Numbers are written with all digits.

FEBio has no linear law of the Biot strain, :math:`\tfrac12 \epsilon : C : \epsilon`
(:mod:`mvest.mechanics.law.biot`). Two of its materials have the same stiffness at rest:

``orthotropic``
    ``orthotropic elastic``: the same C applied to the Green-Lagrange strain (St. Venant's law).
``neo-hookean``
    ``neo-Hookean transiso``: the same moduli in a neo-Hookean form.

Node orders follow FEBio's shape functions (``FESolidElementShape.cpp``): corners of the lower face
counterclockwise, corners of the upper face, midpoints of the lower, the upper and the upright
edges; for a brick also the midpoints of its sides, its lower and its upper face, and its centre.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial import cKDTree

from mvest.files import write_atomically
from mvest.mechanics.body import outer_faces
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh

FebLaw = dict[str, float | str]
"""A material of FEBio: its ``type`` and its parameters."""
LAWS = {"orthotropic": "orthotropic elastic", "neo-hookean": "neo-Hookean transiso"}
"""FEBio's materials for the linear law."""

BRICK = np.array([0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15, 10, 14, 16,
                  12, 4, 22, 13])  # fmt: skip
WEDGE = np.array([0, 1, 2, 12, 13, 14, 3, 4, 5, 15, 16, 17, 6, 7, 8])
"""Nodes of hex27 and wedge18 in FEBio's order; FEBio's wedge has no side midpoints."""
QUADRILATERAL = np.array([0, 2, 8, 6, 1, 5, 7, 3, 4])
"""Nodes of quad9 in FEBio's order; triangles need no reordering."""
NAMES = {
    "tet4": ("tet4", {}, np.arange(4)),
    "tet10": ("tet10", {"elem_type": "TET10G4"}, np.arange(10)),
    "hex27": ("hex27", {}, BRICK),
    "wedge18": ("penta15", {}, WEDGE),
}
"""Element -> FEBio's name, integration rule if there is a choice, and nodes."""
AXES = ("x", "y", "z")
SECTIONS = ("Module", "Control", "Material", "Mesh", "MeshDomains", "MeshData", "Boundary", "Loads",
            "Contact", "Constraints", "Discrete", "LoadData", "Output")  # fmt: skip
"""Sections in an order that lets FEBio resolve names."""
UPDATES = 10
"""BFGS updates; FEBio's tangent for its neo-Hookean law is not exact."""


def febio_law(tissue: TransverselyIsotropic, kind: str = "orthotropic") -> FebLaw:
    """The FEBio material, one of `LAWS`, for the tissue of one region."""
    if kind == "neo-hookean":
        return {"type": LAWS[kind], "Ep": tissue.E_p, "Ez": tissue.E_f, "vz": tissue.nu_fp,
                "vp": tissue.nu_pp, "gz": tissue.G}  # fmt: skip
    across = tissue.E_p / (2 * (1 + tissue.nu_pp))
    # The compliance is symmetric: v31 / E3 = v13 / E1.
    return {
        "type": LAWS[kind], "E1": tissue.E_f, "E2": tissue.E_p, "E3": tissue.E_p,
        "G12": tissue.G, "G23": across, "G31": tissue.G,
        "v12": tissue.nu_fp, "v23": tissue.nu_pp, "v31": tissue.nu_fp * tissue.E_p / tissue.E_f,
    }  # fmt: skip


def opposite_faces(mesh: SolidMesh) -> IntArray:
    """Faces ``(f, k)`` on the unpressurised side of the leaflets, normals outward.

    These are the outer faces whose normal is opposite to that of the nearest pressure face.
    """

    def middles(faces: IntArray) -> tuple[FloatArray, FloatArray]:
        corners = [0, 2, 8] if faces.shape[1] == 9 else [0, 1, 2]
        a, b, c = (mesh.nodes[faces[:, i]] for i in corners)
        normal = np.cross(b - a, c - a)
        return (a + b + c) / 3, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    faces = outer_faces(mesh.elements, mesh.element_type)
    middle, normal = middles(faces)
    there, along = middles(mesh.pressure_faces)
    _, near = cKDTree(there).query(middle)
    return np.asarray(faces[np.einsum("fi,fi->f", normal, along[near]) < -0.5])


class FebDocument:
    """One body; each method adds a load, constraint or interaction.

    ``mesh`` has elements in `NAMES`; ``laws`` has one material per region. ``end`` (s) is
    the end time, ``step`` (s) the first and largest time step. ``tolerance`` is relative for
    displacements; its square applies to the energy. ``dynamic`` uses inertia (generalised alpha at
    its most dissipative) and BFGS; otherwise the run is static with Newton's method. ``further
    (k, 3)`` mm are nodes without elements, numbered after those of the mesh. ``density`` is in
    t/mm^3.
    """

    def __init__(
        self,
        mesh: SolidMesh,
        laws: Sequence[FebLaw],
        end: float,
        step: float,
        tolerance: float,
        *,
        dynamic: bool = False,
        further: FloatArray = np.zeros((0, 3)),  # noqa: B008
        density: float = 1.04e-9,
    ) -> None:
        self.nodes = np.vstack([mesh.nodes, further])
        self._at = {name: Xml.Element(name) for name in SECTIONS}
        self._at["Module"].set("type", "solid")
        self._curves = self._springs = 0
        self._face = mesh.reference.face
        _fill(
            self._at["Control"],
            analysis="DYNAMIC" if dynamic else "STATIC",
            time_steps=max(1, round(end / step)),
            step_size=step,
            plot_level="PLOT_MAJOR_ITRS",
        )
        stepper = {"max_retries": 10, "opt_iter": 15, "aggressiveness": 1, "cutback": 0.5,
                   "dtmin": 1e-4 * step, "dtmax": step}  # fmt: skip
        _fill(_add(self._at["Control"], "time_stepper", type="default"), **stepper)
        solver = _add(self._at["Control"], "solver", type="solid")
        _fill(solver, symmetric_stiffness=0, equation_scheme="staggered", optimize_bw=0, lstol=0.9)
        _fill(solver, max_refs=25, diverge_reform=1, min_residual=1e-16, dtol=tolerance)
        _fill(solver, etol=tolerance**2, rtol=0, rhoi=0)
        _fill(_add(solver, "qn_method", type="BFGS"), max_ups=UPDATES if dynamic else 0)
        nodes = _add(self._at["Mesh"], "Nodes", name="all")
        for k, x in enumerate(self.nodes, start=1):
            _add(nodes, "node", x, id=k)
        number = 0
        name, rule, order = NAMES[mesh.element_type]
        for k, (region, law) in enumerate(zip(mesh.region_names, laws, strict=True)):
            material = _add(self._at["Material"], "material", id=k + 1, name=region)
            material.set("type", str(law["type"]))
            _fill(material, density=density, **{key: law[key] for key in law if key != "type"})
            _add(self._at["MeshDomains"], "SolidDomain", name=region, mat=region, **rule)
            elements = _add(self._at["Mesh"], "Elements", type=name, name=region)
            own = np.flatnonzero(mesh.region == k)
            for element in mesh.elements[own][:, order] + 1:
                number += 1
                _add(elements, "elem", element, id=number)
            self._axes(mesh, own, region)
        log = {"data": "x;y;z", "name": "positions", "delim": ","}
        self._log = Xml.Element("node_data", log)
        self._log.text = f"1:{len(self.nodes)}"
        plot = _add(self._at["Output"], "plotfile", type="febio")
        for field in ("displacement", "stress", "Lagrange strain", "contact pressure"):
            _add(plot, "var", type=field)
        _add(self._at["Output"], "logfile").append(self._log)

    def prescribe(
        self,
        name: str,
        nodes: IntArray,
        displacement: FloatArray,
        curve: FloatArray,
        axes: Sequence[str] = AXES,
    ) -> None:
        """Prescribe ``displacement (k, 3)`` mm of nodes ``(k,)`` along some axes; zeros fix them.

        ``curve (c, 2)`` gives times (s) and the fraction applied.
        """
        _add(self._at["Mesh"], "NodeSet", nodes + 1, name=name)
        for axis, values in zip(AXES, displacement.T, strict=True):
            data = _add(self._at["MeshData"], "NodeData", name=f"{name}_{axis}")
            data.attrib |= {"data_type": "scalar", "node_set": name}
            for j, value in enumerate(values, start=1):
                _add(data, "node", value, lid=j)
        if not displacement.any():
            fixed = _add(self._at["Boundary"], "bc", type="zero displacement", node_set=name)
            _fill(fixed, **{f"{axis}_dof": int(axis in axes) for axis in AXES})
            return
        number = self._curve(curve)
        for axis in axes:
            moved = _add(self._at["Boundary"], "bc", type="prescribed displacement", node_set=name)
            _add(moved, "dof", axis)
            _add(moved, "value", f"{name}_{axis}", lc=number, type="map")
            _add(moved, "relative", 0)

    def press(self, faces: IntArray, curve: FloatArray) -> None:
        """Follower pressure on faces of the mesh; ``curve (c, 2)`` of times (s) and MPa."""
        self._surface("pressed", faces)
        load = _add(self._at["Loads"], "surface_load", type="pressure", surface="pressed")
        _add(load, "pressure", 1.0, lc=self._curve(curve))
        _fill(load, symmetric_stiffness=0, linear=0)

    def damp(self, alpha: float) -> None:
        """Add mass-proportional damping (1/s)."""
        _fill(_add(self._at["Loads"], "body_load", type="mass damping"), C=alpha)

    def average(self, nodes: IntArray, of: Embedding) -> None:
        """Tie nodes ``(k,)`` to weighted averages ``(k,)`` of others by linear constraints."""
        for (node, terms), axis in itertools.product(zip(nodes, _sums(of), strict=True), AXES):
            follow = _add(self._at["Boundary"], "bc", type="linear constraint")
            _fill(follow, node=node + 1, dof=axis)
            for member, weight in terms:
                _fill(_add(follow, "child_dof"), node=member, dof=axis, value=weight)

    def support(self, *groups: tuple[IntArray, Embedding, FloatArray | float]) -> None:
        """Pull weighted averages ``(k,)`` of nodes to nodes ``(k,)``, each group by a stiffness.

        The first entry of a group has the nodes, its last one ``(k,)`` N/mm or one number. Each
        average begins at its node.
        """
        largest = max(np.max(stiffness) for *_, stiffness in groups)
        constraint = _add(self._at["Constraints"], "constraint", type="linear constraint")
        constraint.set("name", "support")
        _fill(constraint, laugon=0, penalty=largest)
        # The energy of a constraint is half its square times the penalty.
        rows = [
            (target, np.sqrt(own / largest), terms)
            for at, of, stiffness in groups
            for target, own, terms in zip(
                at, np.broadcast_to(stiffness, at.shape), _sums(of), strict=True
            )
        ]
        for (target, factor, terms), axis in itertools.product(rows, AXES):
            own = _add(constraint, "linear_constraint")
            _add(own, "node", -factor, id=target + 1, bc=axis)
            for member, weight in terms:
                _add(own, "node", factor * weight, id=member, bc=axis)
        # Nodes without elements have no degrees of freedom in FEBio; a weak spring adds them.
        targets = np.concatenate([at for at, *_ in groups])
        material = self._spring("targets", np.stack([targets, np.roll(targets, 1)], axis=1))
        material.attrib |= {"type": "linear spring", "name": "none"}
        _fill(material, E=1e-12)

    def pull(self, pairs: IntArray, forces: Sequence[FloatArray]) -> None:
        """Add springs between nodes ``(k, 2)``.

        Each force ``(p, 2)`` tabulates elongation from the initial length (mm) and force (N); it is
        linear between and beyond the points.
        """
        for k, (pair, force) in enumerate(zip(pairs, forces, strict=True)):
            material = self._spring(f"spring_{k}", pair[None])
            material.attrib |= {"type": "nonlinear spring", "name": f"chord_{k}"}
            _add(material, "measure", "elongation")
            function = _add(material, "force", type="point")
            _fill(function, interpolate="linear", extend="extrapolate")
            _points(function, force)

    def touch(self, faces: IntArray, **parameters: float) -> None:
        """Add a contact potential between faces of the mesh, with FEBio's parameters."""
        self._surface("atrial", faces)
        pair = _add(self._at["Mesh"], "SurfacePair", name="atrial_pair")
        _fill(pair, primary="atrial", secondary="atrial")
        contact = _add(self._at["Contact"], "contact", type="contact potential")
        contact.set("surface_pair", "atrial_pair")
        _fill(contact, **parameters)

    def write(self, path: Path, remark: str = "") -> Path:
        """Write the file with a remark at its head; FEBio will log to `positions_file`.

        InputError if the file cannot be written.
        """
        self._log.set("file", positions_file(path).name)
        root = Xml.Element("febio_spec", version="4.0")
        root.append(Xml.Comment(f" {remark.replace('--', '- -')} "))
        root.extend(section for section in self._at.values() if len(section) or section.attrib)
        Xml.indent(root, " ")
        text = Xml.tostring(root, encoding="unicode")
        return write_atomically(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')

    def _curve(self, curve: FloatArray) -> int:
        self._curves += 1
        at = _add(self._at["LoadData"], "load_controller", id=self._curves, type="loadcurve")
        _fill(at, interpolate="LINEAR", extend="CONSTANT")
        _points(at, curve)
        return self._curves

    def _axes(self, mesh: SolidMesh, own: IntArray, region: str) -> None:
        """The direction of the fibre at the centre of each element."""
        data = _add(self._at["MeshData"], "ElementData", elem_set=region, type="mat_axis")
        shape = mesh.reference.shape(mesh.reference.centre)[0]
        for j, along in enumerate(np.einsum("a,mai->mi", shape, mesh.fibre[own]), start=1):
            a = along / np.linalg.norm(along)
            # d may be any other direction: the laws are isotropic around the fibre.
            _fill(_add(data, "elem", lid=j), a=a, d=np.roll(a, 1) + np.array([0.1, 0.2, 0.3]))

    def _surface(self, name: str, faces: IntArray) -> None:
        surface = _add(self._at["Mesh"], "Surface", name=name)
        order = QUADRILATERAL if self._face == "quad9" else slice(None)
        for k, face in enumerate(faces[:, order] + 1, start=1):
            _add(surface, self._face, face, id=k)

    def _spring(self, name: str, pairs: IntArray) -> Xml.Element:
        """An empty spring material for nodes ``(k, 2)``."""
        connected = _add(self._at["Mesh"], "DiscreteSet", name=name)
        for pair in pairs:
            _add(connected, "delem", pair + 1)
        section = self._at["Discrete"]
        material = Xml.Element("discrete_material")
        section.insert(self._springs, material)
        self._springs += 1
        _add(section, "discrete", dmat=self._springs, discrete_set=name)
        return material


def positions_file(path: Path) -> Path:
    """The file to which FEBio logs the positions of the nodes."""
    return path.with_name(f"{path.stem}_positions.csv")


def _sums(of: Embedding) -> list[list[tuple[int, float]]]:
    """The node numbers and weights of each weighted sum."""
    rows = zip((of.nodes + 1).tolist(), of.weights.tolist(), strict=True)
    return [[term for term in zip(*row, strict=True) if term[1]] for row in rows]


def _add(at: Xml.Element, tag: str, value: Any = None, **attributes: Any) -> Xml.Element:
    element = Xml.SubElement(at, tag, {key: str(own) for key, own in attributes.items()})
    if value is not None:
        numbers = "" if isinstance(value, str) else np.ravel(value).tolist()
        element.text = value if isinstance(value, str) else ",".join(map(repr, numbers))
    return element


def _fill(at: Xml.Element, **values: Any) -> None:
    for tag, value in values.items():
        _add(at, tag, value)


def _points(at: Xml.Element, points: FloatArray) -> None:
    rows = _add(at, "points")
    for point in points:
        _add(rows, "pt", point)
