r"""Mesh and materials in the terms of FEBio: its elements, and the law of each region.

The linear law of this project is :math:`\tfrac12 \epsilon : C : \epsilon` of the Biot strain
(:mod:`mvest.mechanics.law.biot`). FEBio has no such law; two of its materials are offered.
Both have the same stiffness at rest.

``orthotropic``
    ``orthotropic elastic``: the same C, of the Green-Lagrange strain
    (:class:`mvest.mechanics.law.linear.LinearLaw`).
``neo-hookean``
    ``neo-Hookean transiso``: the same moduli in a neo-Hookean form.

The energy of the Biot strain itself cannot be written as one of FEBio's expressions: they end after
512 characters, and the trace of the stretch is a root of a quartic.

The exponential law (:mod:`mvest.mechanics.law.exponential`) becomes ``uncoupled trans-iso
hyperelastic`` with the same exponential; the stretch of its fibres is then the isochoric one.

FEBio's quadratic elements are triquadratic bricks (``hex27``), ten-node tetrahedra and wedges with
fifteen nodes. An element of this project that has no counterpart becomes the nearest one:

==================== ========= ======================================================
here                 FEBio     how
==================== ========= ======================================================
tet4, tet10          the same
hex27                hex27
hex18, hex18_thin    hex27     nodes added halfway through the thickness
wedge18              penta15   the nodes in the middle of its three sides left out
wedge12              penta15   nodes added halfway along its three upright edges
==================== ========= ======================================================

Node orders are those of FEBio's shape functions (``FESolidElementShape.cpp``): corners of the lower
face counterclockwise, of the upper face, middles of the lower, of the upper, of the upright edges,
and of a brick the middles of its sides, of the lower and the upper face, and its centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.settings import ExponentialTissue
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import SolidMesh

LAWS = ("orthotropic", "neo-hookean")


@dataclass(frozen=True, slots=True)
class FebLaw:
    """A material of FEBio.

    Attributes
    ----------
    name : str
        Of its type.
    parameters : mapping
        Tag -> value.
    directed : str
        What carries the direction of the fibre: ``mat_axis`` or ``fiber``.
    """

    name: str
    parameters: Mapping[str, float | str]
    directed: str


def febio_law(
    tissue: TransverselyIsotropic | ExponentialTissue, kind: str = "orthotropic"
) -> FebLaw:
    """The material of FEBio for the tissue of one region.

    Parameters
    ----------
    tissue : TransverselyIsotropic or ExponentialTissue
    kind : str
        One of `LAWS`, for the linear law.

    Raises
    ------
    InputError
        For an unknown kind.
    """
    if kind not in LAWS:
        raise InputError(f"law {kind!r}, expected one of {', '.join(LAWS)}")
    if isinstance(tissue, ExponentialTissue):
        fibre = f"{tissue.c2!r}*H(sqrt(I4)-1)*(sqrt(I4)-1)^4"
        exponent = f"{tissue.c1!r}*(I1-3)^2+{fibre}"
        energy = f"{tissue.c0!r}*(exp({exponent})-1)+{tissue.mu / 2!r}*(I1-3)"
        # Pressure model 3 is kappa / 4 (J^2 - 1 - 2 ln J), as here.
        parameters: dict[str, float | str] = {"k": tissue.kappa, "pressure_model": 3, "W": energy}
        return FebLaw("uncoupled trans-iso hyperelastic", parameters, "fiber")
    if kind == "neo-hookean":
        names = {"Ep": tissue.E_p, "Ez": tissue.E_f, "vz": tissue.nu_fp, "vp": tissue.nu_pp,
                 "gz": tissue.G}  # fmt: skip
        return FebLaw("neo-Hookean transiso", names, "mat_axis")
    across = tissue.E_p / (2 * (1 + tissue.nu_pp))
    # v31 / E3 is the compliance that v13 / E1 is.
    names = {
        "E1": tissue.E_f, "E2": tissue.E_p, "E3": tissue.E_p,
        "G12": tissue.G, "G23": across, "G31": tissue.G,
        "v12": tissue.nu_fp, "v23": tissue.nu_pp, "v31": tissue.nu_fp * tissue.E_p / tissue.E_f,
    }  # fmt: skip
    return FebLaw("orthotropic elastic", names, "mat_axis")


BRICK = np.array([0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15, 10, 14, 16,
                  12, 4, 22, 13])  # fmt: skip
WEDGE = np.array([0, 1, 2, 12, 13, 14, 3, 4, 5, 15, 16, 17, 6, 7, 8])
"""Nodes of hex27 and wedge18 in FEBio's order."""
SIDES = np.array([9, 10, 11])
"""Nodes of wedge18 that penta15 lacks."""
QUADRILATERAL = np.array([0, 2, 8, 6, 1, 5, 7, 3, 4])
"""Nodes of quad9 in FEBio's order; triangles are alike."""
TURNED = {"quad9": np.array([0, 3, 6, 1, 4, 7, 2, 5, 8]), "tri6": np.array([0, 2, 1, 5, 4, 3]),
          "tri3": np.array([0, 2, 1])}  # fmt: skip
"""Nodes of a face seen from its other side."""
UPRIGHT = {"hex18": "hex27", "hex18_thin": "hex27", "wedge12": "wedge18"}
"""Elements that get nodes halfway through the thickness."""
NAMES = {
    "tet4": ("tet4", "", np.arange(4)),
    "tet10": ("tet10", "TET10G4", np.arange(10)),
    "hex27": ("hex27", "", BRICK),
    "wedge18": ("penta15", "", WEDGE),
}
"""Element -> its name in FEBio, the rule of integration where it has a choice, its nodes."""


@dataclass(frozen=True, slots=True, eq=False)
class FebMesh:
    """A mesh as FEBio has it.

    Attributes
    ----------
    solid : SolidMesh
        In elements of this project that FEBio has too (but for the sides of wedges). Its first
        nodes are those of the mesh that it was made from.
    given : int
        How many nodes that mesh has.
    """

    solid: SolidMesh
    given: int

    @property
    def element(self) -> str:
        """FEBio's name of the element."""
        return NAMES[self.solid.element_type][0]

    @property
    def rule(self) -> str:
        """FEBio's name of the rule of integration, empty for its own choice."""
        return NAMES[self.solid.element_type][1]

    @property
    def elements(self) -> IntArray:
        """``(m, k)`` nodes in FEBio's order."""
        return self.solid.elements[:, NAMES[self.solid.element_type][2]]

    def faces(self, faces: IntArray) -> tuple[str, IntArray]:
        """FEBio's name of faces ``(f, k)`` and their nodes in its order."""
        name = self.solid.reference.face
        return name, faces[:, QUADRILATERAL] if name == "quad9" else faces

    def restored(self, x: FloatArray) -> FloatArray:
        """Positions ``(..., given, 3)`` mm of the nodes given, from FEBio's ``(..., n, 3)`` mm.

        Those that FEBio's wedge lacks follow from its interpolation.
        """
        x = np.array(x)
        if self.solid.element_type == "wedge18":
            e = self.solid.elements
            for k, side in enumerate(SIDES):
                i, j = k, (k + 1) % 3
                corners = x[..., e[:, [i, j, 12 + i, 12 + j]], :].sum(axis=-2)
                middles = x[..., e[:, [3 + k, 15 + k, 6 + i, 6 + j]], :].sum(axis=-2)
                x[..., e[:, side], :] = 0.5 * middles - 0.25 * corners
        return x[..., : self.given, :]


def febio_mesh(mesh: SolidMesh) -> FebMesh:
    """The mesh in elements that FEBio has.

    Raises
    ------
    InputError
        For an element without counterpart.
    """
    solid = _with_middles(mesh) if mesh.element_type in UPRIGHT else mesh
    if solid.element_type not in NAMES:
        raise InputError(f"FEBio has nothing like the element {mesh.element_type}")
    return FebMesh(solid, len(mesh.nodes))


def _with_middles(mesh: SolidMesh) -> SolidMesh:
    """Elements with nodes halfway between those of the lower and of the upper face."""
    half = mesh.reference.n_nodes // 2
    low, high = mesh.elements[:, :half], mesh.elements[:, half:]
    pairs, number = np.unique(
        np.stack([low, high], axis=-1).reshape(-1, 2), axis=0, return_inverse=True
    )
    middle = len(mesh.nodes) + number.reshape(low.shape)
    fibre = mesh.fibre[:, :half] + mesh.fibre[:, half:]
    fibre /= np.linalg.norm(fibre, axis=2, keepdims=True)
    return replace(
        mesh,
        nodes=np.vstack([mesh.nodes, mesh.nodes[pairs].mean(axis=1)]),
        elements=np.hstack([low, middle, high]),
        element_type=UPRIGHT[mesh.element_type],
        fibre=np.concatenate([mesh.fibre[:, :half], fibre, mesh.fibre[:, half:]], axis=1),
    )


def opposite_faces(mesh: SolidMesh) -> IntArray:
    """Faces ``(f, k)`` on the other side of the leaflets than the pressure, normals outward.

    Of the outer faces of tetrahedra those whose normal points against that of the nearest pressure
    face; of layers those of the lowest one below the pressure's.
    """
    turn = TURNED[mesh.reference.face]
    if mesh.reference.layered:
        k = len(mesh.reference.top_face)
        low = mesh.elements[:, :k]
        inner = np.isin(low, mesh.elements[:, -k:]).all(axis=1)
        return np.asarray(low[~inner][:, turn])
    from scipy.spatial import cKDTree

    from mvest.mechanics.body import outer_faces

    faces = outer_faces(mesh.elements, mesh.element_type)
    middle, normal = _middles(mesh.nodes, faces)
    there, along = _middles(mesh.nodes, mesh.pressure_faces)
    _, near = cKDTree(there).query(middle)
    return np.asarray(faces[np.einsum("fi,fi->f", normal, along[near]) < -0.5])


def _middles(nodes: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Centres and unit normals ``(f, 3)`` of triangular faces."""
    a, b, c = (nodes[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    return (a + b + c) / 3, normal / np.linalg.norm(normal, axis=1, keepdims=True)
