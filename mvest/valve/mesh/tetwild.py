"""Tetrahedral meshes of closed surfaces by pytetwild (fTetWild; Hu et al. 2020, ACM TOG 39:117).

fTetWild accepts open surfaces and NaN, may crash on bad input, returns negative volumes, and is not
deterministic. Therefore the surface is checked first, the mesher runs in a child process, its
result is checked against the surface, and the mesh is cached under the hash of its input.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mvest.cache import Entry
from mvest.errors import ConfigurationError, GeometryError, InputError, MeshingError
from mvest.processes import ending, run
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume
from mvest.valve.mesh.cells import outer_faces

WORKER = Path(__file__).with_name("_tetwild_worker.py")

Tetrahedra: TypeAlias = tuple[FloatArray, IntArray]
"""Nodes ``(n, 3)`` mm and tetrahedra ``(m, 4)`` of positive volume."""

ENVELOPE_SHARE = 0.05
"""Largest distance of the mesh's surface from the given one, over the edge length."""
SHAPING: dict[str, Any] = {"stop_energy": 10.0, "iterations": 80, "coarsen": False}
"""fTetWild's settings: shape energy at which it stops, most iterations, whether to coarsen."""
TIME_LIMIT = 300.0
"""Time limit of the mesher, s."""
VOLUME_TOLERANCE = 0.05
"""Largest relative difference between the volumes of mesh and surface."""
DISTANCE_TOLERANCE = 0.5
"""mm, largest distance from the given surface's vertices to the mesh's surface."""


def tetrahedralize(
    vertices: FloatArray, triangles: IntArray, edge_length: float, store: Path | None = None
) -> Tetrahedra:
    """Mesh the inside of a closed surface, or read the cached mesh.

    ConfigurationError if the edge length is not positive. GeometryError if the surface is invalid.
    MeshingError if the mesher failed, crashed or took too long, its mesh does not fit the surface,
    or a cached mesh is damaged.

    Parameters
    ----------
    vertices, triangles
        Closed, outward, without self-intersections; ``(n, 3)`` mm and ``(m, 3)``.
    edge_length
        Target, mm.
    store
        Cache folder. Without it the mesh is made anew, and differs each time.
    """
    if not (np.isfinite(edge_length) and edge_length > 0):
        raise ConfigurationError(f"tetrahedralize: edge_length = {edge_length}; expected positive")
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    check_surface(vertices, triangles, closed=True, name="surface to mesh")
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)
    envelope = ENVELOPE_SHARE * edge_length

    def make() -> Tetrahedra:
        return _checked(*_mesh(vertices, triangles, edge_length), vertices, triangles, envelope)

    if store is None:
        return make()

    def read(path: Path) -> Tetrahedra:
        try:
            nodes, tetrahedra = read_npz(path, ["nodes", "tetrahedra"]).values()
        except InputError as fault:
            raise MeshingError(f"{path}: stored mesh is unreadable ({fault}); delete it") from fault
        return _checked(nodes, tetrahedra, vertices, triangles, envelope)

    def save(path: Path, mesh: Tetrahedra) -> None:
        np.savez_compressed(path, nodes=mesh[0], tetrahedra=mesh[1])

    path = Path(store) / f"tetwild-{_key(vertices, triangles, edge_length)}.npz"
    # A damaged entry is not remade: the new mesh would differ.
    return Entry(path, read, remake=False).get_or_make(make, save)


def _key(vertices: FloatArray, triangles: IntArray, edge_length: float) -> str:
    """Hash of everything that shapes the mesh, without the limits that only accept or refuse it."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(triangles, dtype="<i8").tobytes())
    own = {"edge_length": edge_length, "envelope": ENVELOPE_SHARE * edge_length}
    digest.update(repr(list((own | SHAPING).items())).encode())
    return digest.hexdigest()[:24]


def _mesh(vertices: FloatArray, triangles: IntArray, edge_length: float) -> Tetrahedra:
    """Run the mesher in a child process and return its raw result."""
    # fTetWild's lengths are relative to the diagonal of the bounding box.
    share = edge_length / float(np.linalg.norm(np.ptp(vertices[np.unique(triangles)], axis=0)))
    with tempfile.TemporaryDirectory(prefix="tetwild-") as folder:
        source, target = Path(folder) / "surface.npz", Path(folder) / "mesh.npz"
        np.savez(
            source,
            vertices=vertices,
            triangles=triangles,
            edge_length_fraction=share,
            envelope_fraction=ENVELOPE_SHARE * share,
            **SHAPING,
        )
        try:
            done = run(
                [sys.executable, "-P", str(WORKER), str(source), str(target)],
                cwd=folder,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                timeout=TIME_LIMIT,
            )
        except subprocess.TimeoutExpired:
            raise MeshingError(
                f"pytetwild took longer than {TIME_LIMIT:g} s; give a longer edge_length "
                f"({edge_length:g} mm now)"
            ) from None
        if done.returncode != 0 or not target.exists():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            message = f": {lines[-1].strip()}" if lines else " without a message"
            raise MeshingError(f"pytetwild failed: {ending(done.returncode)}{message}")
        nodes, tetrahedra = read_npz(target, ["nodes", "tetrahedra"]).values()
        return nodes, tetrahedra


def _checked(
    nodes: FloatArray,
    tetrahedra: IntArray,
    vertices: FloatArray,
    triangles: IntArray,
    envelope: float,
) -> Tetrahedra:
    """The oriented mesh; MeshingError unless it fills the surface."""
    if len(tetrahedra) == 0 or not np.isfinite(nodes).all():
        raise MeshingError(
            f"pytetwild returned {len(tetrahedra)} tetrahedra on {len(nodes)} nodes; expected "
            f"some, with finite coordinates"
        )
    tetrahedra = orient(nodes, tetrahedra)
    used, number = np.unique(tetrahedra, return_inverse=True)
    nodes, tetrahedra = nodes[used], number.reshape(tetrahedra.shape)
    size = volumes(nodes, tetrahedra)
    if size.min() <= 0:
        flat = np.flatnonzero(size <= 0)
        raise MeshingError(f"pytetwild returned flat tetrahedra: {flat[:8].tolist()}")
    try:
        faces = outer_faces(tetrahedra, "tet4")
        check_surface(nodes, faces, closed=True, self_intersections=False, name="mesh's surface")
    except GeometryError as fault:
        raise MeshingError(f"pytetwild returned a mesh that is no solid: {fault}") from fault
    volume, enclosed = float(size.sum()), enclosed_volume(vertices, triangles)
    change = abs(volume / enclosed - 1)
    if change > VOLUME_TOLERANCE:
        raise MeshingError(
            f"the mesh has {volume:.4g} mm^3, its surface encloses {enclosed:.4g} mm^3: "
            f"{change:.1%} apart, expected at most {VOLUME_TOLERANCE:.0%}; give a shorter "
            "edge_length"
        )
    # The mesher checks its envelope at samples only, hence the margin.
    away = closest_points(nodes[np.unique(faces)], vertices, triangles).distance.max()
    if away > 1.5 * envelope:
        raise MeshingError(
            f"the mesh leaves its surface by {away:.3g} mm; the envelope is {envelope:g} mm"
        )
    missed = closest_points(vertices[np.unique(triangles)], nodes, faces).distance.max()
    if missed > DISTANCE_TOLERANCE:
        raise MeshingError(
            f"the mesh misses part of its surface by {missed:.3g} mm, expected at most "
            f"{DISTANCE_TOLERANCE:g} mm; give a shorter edge_length"
        )
    return nodes, tetrahedra


def volumes(nodes: FloatArray, tetrahedra: IntArray) -> FloatArray:
    """Signed volume ``(m,)`` mm³ of every tetrahedron."""
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    return np.asarray(np.linalg.det(edges) / 6.0)


def orient(nodes: FloatArray, tetrahedra: IntArray) -> IntArray:
    """Tetrahedra with two corners exchanged if the volume was negative."""
    result = np.array(tetrahedra, dtype=np.int64)
    negative = volumes(nodes, result) < 0
    result[negative, 2], result[negative, 3] = result[negative, 3], result[negative, 2].copy()
    return result
