"""Small bodies on which the physics can be checked by hand."""

import numpy as np
from scipy import sparse

from mvest.elements import ELEMENTS
from mvest.mechanics.assembly import BlockMatrix, SparsityPattern
from mvest.mechanics.body import box, outer_faces
from mvest.mechanics.forces.cables import Cables, Hinge
from mvest.mechanics.forces.contact import Contact
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.settings import ContactSettings
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import Factors, Loads, System
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed

ELEMENT_NAMES = tuple(ELEMENTS)
MATERIALS = {
    "isotropic": TransverselyIsotropic.isotropic(2.0, 0.488),
    "A": TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL),
    "C": TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.NEARLY_INCOMPRESSIBLE),
}


class SaintVenantKirchhoff:
    """A law of one's own: ``S = C : E`` of each region's material, damped as the strain E."""

    kinds = ("E_f",)

    def __init__(self, materials):
        self.stiffness = np.array([material.stiffness for material in materials])

    def strain(self, green):
        return green

    def response(self, at):
        stiffness = self.stiffness[at.region]
        strain = at.green + at.rate * (at.green - at.previous)
        tangent = np.repeat((1 + at.rate) * stiffness[:, None], at.green.shape[1], axis=1)
        return np.einsum("eij,eqj->eqi", stiffness, strain), tangent

    def partial_stress(self, parameter, at, *, which, stress):
        return np.where((at.region == which)[:, None, None], stress, 0.0) / parameter.value

    def history_stress(self, at, d_previous):
        return -at.rate * np.einsum("eij,eqj->eqi", self.stiffness[at.region], d_previous)

    def strain_change(self, green, d_green):
        return d_green


def block_matrix(matrix):
    """A sparse matrix of 3x3 blocks by its symmetric and its skew part."""
    halves = [
        sparse.bsr_matrix(0.5 * part, blocksize=(3, 3))
        for part in (matrix + matrix.T, matrix - matrix.T)
    ]
    for half in halves:
        half.sort_indices()
    n = matrix.shape[0] // 3
    rows = [np.repeat(np.arange(n), np.diff(half.indptr)) for half in halves]
    skew = np.column_stack([rows[1], halves[1].indices])
    stored = sparse.csr_matrix(
        (np.ones(len(rows[0])), halves[0].indices, halves[0].indptr), shape=(n, n)
    )
    pattern = SparsityPattern.of(stored, skew)
    upper = [half.data[row <= half.indices] for half, row in zip(halves, rows, strict=True)]
    return BlockMatrix(pattern, np.concatenate(upper))


def rotation(axis, angle):
    """Rodrigues' formula."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def block(element_type, cells=(3, 2, 2), size=(4.0, 3.0, 2.0), fibre=(1, 0, 0), distortion=()):
    """A block of one region; `distortion` moves inner corners by up to this share of a cell."""
    nodes, elements = box(element_type, cells, size)
    if len(distortion):
        nodes = distorted(element_type, nodes, elements, cells, size, distortion)
    fibre = np.tile(np.asarray(fibre, dtype=float) / np.linalg.norm(fibre), (len(nodes), 1))
    region = np.zeros(len(elements), dtype=int)
    faces = outer_faces(elements, element_type)
    return SolidMesh(nodes, elements, element_type, region, ("tissue",), fibre, faces)


def distorted(element_type, nodes, elements, cells, size, distortion):
    """Move corners within their boundary planes and put the other nodes back on straight edges.

    Straight edges keep the quadrature exact for a constant stress, as the patch test needs.
    """
    cells, size = np.array(cells), np.array(size)
    grid = nodes / size * cells
    inner = (grid > 1e-9) & (grid < cells - 1e-9)
    move = np.random.default_rng(7).uniform(-1, 1, nodes.shape) * np.array(distortion)
    moved = nodes + inner * move * size / cells
    xi = ELEMENTS[element_type].node_coordinates
    if element_type.startswith("tet"):
        corners, weights = np.arange(4), np.column_stack([1 - xi.sum(axis=1), xi])
    elif element_type.startswith("wedge"):
        corners = np.r_[0:3, len(xi) - 6 : len(xi) - 3]
        plane = np.column_stack([1 - xi[:, 0] - xi[:, 1], xi[:, :2]])
        weights = np.hstack([plane * (0.5 - 0.5 * xi[:, 2:]), plane * (0.5 + 0.5 * xi[:, 2:])])
    else:
        corners = np.flatnonzero(np.abs(xi).min(axis=1) == 1)
        weights = np.prod(0.5 * (1 + xi[:, None, :] * xi[None, corners, :]), axis=2)
    out = nodes.copy()
    out[elements] = np.einsum("ac,mci->mai", weights, moved[elements[:, corners]])
    return out


def boundary(nodes):
    """Nodes on the faces of the block's bounding box."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    return np.flatnonzero(np.any((nodes < low + 1e-9) | (nodes > high - 1e-9), axis=1))


def point_masses(n):
    """Embedding of points that are the nodes themselves."""
    return Embedding(np.arange(n)[:, None], np.ones((n, 1)), np.zeros(n, dtype=int))


def grid_triangles(n):
    """Triangles of an n x n grid of points numbered row by row."""
    i, j = (v.ravel() for v in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a = i * n + j
    return np.concatenate(
        [np.stack([a, a + n, a + n + 1], axis=1), np.stack([a, a + n + 1, a + 1], axis=1)]
    )


SIDE, GAP = 9.0, 2.6  # mm; the gap is that of the midsurfaces of the two sheets, 1 mm thick


def sandwich(
    moduli=(0.6, 0.5), factors=None, element_type="hex18", cells=3, contact=True, samples=13
):
    """Two sheets that pressure pushes against each other.

    The lower one is clamped, the upper one hangs on an elastic hinge along its rim and on two
    cables from above. Returns the system and its loads as a function of time.
    """
    one, cells_of_one = box(element_type, (cells, cells, 1), (SIDE, SIDE, 1.0))
    faces = outer_faces(cells_of_one, element_type)
    level = one[faces][:, :, 2].mean(axis=1)
    n = len(one)
    nodes = np.concatenate([one, one + np.array([0, 0, GAP])])
    elements = np.concatenate([cells_of_one, cells_of_one + n])
    region = np.repeat([0, 1], len(cells_of_one))
    mesh = SolidMesh(
        nodes, elements, element_type, region, ("lower", "upper"),
        np.tile([0.8, 0.6, 0.0], (2 * n, 1)),
        np.concatenate([faces[level < 0.01], faces[level > 0.99] + n]),
    )  # fmt: skip
    law = BiotLaw.of(
        tuple(
            TransverselyIsotropic.from_ratio(e, 1.5, 0.45, PoissonReading.LITERAL) for e in moduli
        )
    )
    line = np.linspace(0, SIDE, samples)
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    sheets = [np.column_stack([plane, np.full(len(plane), z)]) for z in (0.5, 0.5 + GAP)]
    points = np.concatenate(sheets)
    edge = np.ones(samples)
    edge[[0, -1]] = 0.5
    areas = np.tile(np.outer(edge, edge).ravel() * (SIDE / (samples - 1)) ** 2, 2)
    triangles = grid_triangles(samples)
    embedded = embed(mesh, points)
    rim = np.flatnonzero(np.any((plane == 0) | (plane == SIDE), axis=1)) + len(plane)
    support = embed(mesh, points[rim])
    ends = embed(mesh, np.array([[3.0, 4.5, 0.5 + GAP], [5.5, 5.0, 0.5 + GAP]]))
    tips = np.array([[2.0, 2.0, 12.0], [7.0, 6.5, 11.0]])
    system = System(
        Solid(mesh, law),
        pressure=PressureLoad(mesh.pressure_faces, mesh.reference.face),
        cables=Cables(
            ends, np.array([0, 1]), np.array([9.3, 7.9]), np.array([0.4, 0.3]), 0.03,
            {"left": np.array([True, False]), "right": np.array([False, True])},
        ),
        contact=Contact(
            embedded, points, areas, np.ones(len(points)),
            np.concatenate([triangles, triangles + len(plane)]), ContactSettings(0.004),
        ) if contact else None,
        hinge=Hinge(support, np.full(len(rim), 40.0)),
        fixed_nodes=np.flatnonzero(
            (nodes[:, 2] < 1.01) & np.any((nodes[:, :2] == 0) | (nodes[:, :2] == SIDE), axis=1)
        ),
        factors=factors or Factors(),
    )  # fmt: skip
    held, target = nodes[system.fixed_nodes], points[rim]

    def loading(t):
        share = min(t / 0.06, 1.0)
        return Loads(
            pressure=0.009 * share,
            tips=tips + np.array([0, 0, 0.5 * share]),
            hinge=target,
            fixed=held,
        )

    return system, loading
