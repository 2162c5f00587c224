r"""Elements and materials of FEBio.

FEBio has no linear law of the Biot strain, :math:`\tfrac12 \epsilon : C : \epsilon`
(:mod:`mvest.mechanics.law.biot`). Two of its materials have the same stiffness at rest:

``orthotropic``
    ``orthotropic elastic``: the same C, of the Green-Lagrange strain (St. Venant's law).
``neo-hookean``
    ``neo-Hookean transiso``: the same moduli in a neo-Hookean form.

Node orders follow FEBio's shape functions (``FESolidElementShape.cpp``): corners of the lower face
counterclockwise, corners of the upper face, midpoints of the lower, the upper and the upright
edges; then, of a brick, midpoints of its sides, of the lower and the upper face, and its centre.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.mechanics.body import outer_faces
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.typing import FloatArray, IntArray
from mvest.valve.mesh.solid_mesh import SolidMesh

FebLaw = dict[str, float | str]
"""A material of FEBio: its ``type`` and its parameters."""
LAWS = {"orthotropic": "orthotropic elastic", "neo-hookean": "neo-Hookean transiso"}
"""FEBio's materials for the linear law."""

BRICK = np.array([0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15, 10, 14, 16,
                  12, 4, 22, 13])  # fmt: skip
WEDGE = np.array([0, 1, 2, 12, 13, 14, 3, 4, 5, 15, 16, 17, 6, 7, 8])
"""Nodes of hex27 and wedge18 in FEBio's order; FEBio's wedge has no midpoints of its sides."""
QUADRILATERAL = np.array([0, 2, 8, 6, 1, 5, 7, 3, 4])
"""Nodes of quad9 in FEBio's order; triangles have the same order."""
NAMES = {
    "tet4": ("tet4", {}, np.arange(4)),
    "tet10": ("tet10", {"elem_type": "TET10G4"}, np.arange(10)),
    "hex27": ("hex27", {}, BRICK),
    "wedge18": ("penta15", {}, WEDGE),
}
"""Element -> FEBio's name, integration rule if there is a choice, and nodes."""
UPRIGHT = {"hex18": "hex27", "wedge12": "wedge18"}
"""Elements that get nodes halfway through the thickness."""


def febio_law(tissue: TransverselyIsotropic, kind: str = "orthotropic") -> FebLaw:
    """The material of FEBio, one of `LAWS`, for the tissue of one region."""
    if kind == "neo-hookean":
        return {"type": LAWS[kind], "Ep": tissue.E_p, "Ez": tissue.E_f, "vz": tissue.nu_fp,
                "vp": tissue.nu_pp, "gz": tissue.G}  # fmt: skip
    across = tissue.E_p / (2 * (1 + tissue.nu_pp))
    # v31 / E3 is the compliance that v13 / E1 is.
    return {
        "type": LAWS[kind], "E1": tissue.E_f, "E2": tissue.E_p, "E3": tissue.E_p,
        "G12": tissue.G, "G23": across, "G31": tissue.G,
        "v12": tissue.nu_fp, "v23": tissue.nu_pp, "v31": tissue.nu_fp * tissue.E_p / tissue.E_f,
    }  # fmt: skip


def febio_mesh(mesh: SolidMesh) -> SolidMesh:
    """The mesh with elements of `NAMES`; its first nodes are those of ``mesh``.

    Elements with two layers of nodes get a third one halfway between them.

    Raises
    ------
    InputError
        FEBio has no such element.
    """
    kind = mesh.element_type
    if kind in NAMES:
        return mesh
    if kind not in UPRIGHT:
        raise InputError(f"FEBio has nothing like the element {kind}")
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
        element_type=UPRIGHT[kind],
        fibre=np.concatenate([mesh.fibre[:, :half], fibre, mesh.fibre[:, half:]], axis=1),
    )


def opposite_faces(mesh: SolidMesh) -> IntArray:
    """Faces ``(f, k)`` on the side of the leaflets opposite to the pressure, normals outward.

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
