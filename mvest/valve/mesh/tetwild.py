"""Tetrahedral meshes of closed surfaces by pytetwild (fTetWild; Hu et al. 2020, ACM TOG 39:117).

fTetWild meshes open or NaN surfaces without complaint, may end the process on bad input, returns
negative volumes, and is not deterministic. So the surface is checked first, the mesher runs in a
process of its own, its answer is checked against the surface, and the mesh is stored under the
hash of its input and read back ever after.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mvest.cache import Entry
from mvest.errors import ConfigurationError, GeometryError, InputError, MeshingError
from mvest.processes import ending, run
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume
from mvest.valve.mesh.cells import (
    QualityReport,
    content_sha256,
    drop_unused_nodes,
    mesh_quality,
    orient,
    outer_faces,
    volumes,
)

WORKER = Path(__file__).with_name("_tetwild_worker.py")


@dataclass(frozen=True, slots=True)
class TetwildSettings:
    """Settings of the mesher and limits on its answer.

    Attributes
    ----------
    edge_length
        Target edge length, mm. (pytetwild takes it relative to the bounding-box diagonal.)
    envelope
        Largest distance of the mesh's surface from the given one, mm. (Likewise.)
    stop_energy
        Shape energy at which optimisation stops; 10 is fTetWild's default, lower is better.
    iterations
        Largest number of optimisation rounds.
    coarsen
        Use as few tetrahedra as the quality allows.
    time_limit
        s after which the mesher is stopped.
    volume_tolerance
        Largest relative difference between the volumes of mesh and surface.
    distance_tolerance
        Largest distance, mm, from the given surface's vertices to the mesh's surface.
    """

    edge_length: float
    envelope: float
    stop_energy: float = 10.0
    iterations: int = 80
    coarsen: bool = False
    time_limit: float = 300.0
    volume_tolerance: float = 0.05
    distance_tolerance: float = 0.5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name != "coarsen" and not (np.isfinite(value) and value > 0):
                raise ConfigurationError(f"tetrahedralize: {name} = {value}; expected positive")
        if self.envelope > self.edge_length:
            raise ConfigurationError(
                f"tetrahedralize: envelope = {self.envelope} mm exceeds edge_length = "
                f"{self.edge_length} mm; about a twentieth of it is usual"
            )


@dataclass(frozen=True, slots=True)
class TetwildReport:
    """How well a mesh fills its surface.

    Attributes
    ----------
    quality
        Shape of the tetrahedra.
    surface_volume
        mm³ inside the given surface.
    to_surface, from_surface
        Largest distance, mm, from the mesh's outer nodes to the given surface, and from the given
        vertices to the mesh's surface.
    """

    quality: QualityReport
    surface_volume: float
    to_surface: float
    from_surface: float

    def __str__(self) -> str:
        return (
            f"{self.quality}; surface volume {self.surface_volume:.1f} mm^3, distance to the "
            f"surface {self.to_surface:.3f} mm, from it {self.from_surface:.3f} mm"
        )


@dataclass(frozen=True, slots=True, eq=False)
class TetrahedralMesh:
    """A mesh of linear tetrahedra of positive volume.

    Attributes
    ----------
    nodes
        ``(n, 3)`` mm.
    tetrahedra
        ``(m, 4)``.
    report
        What the checks found.
    """

    nodes: FloatArray
    tetrahedra: IntArray
    report: TetwildReport

    @property
    def sha256(self) -> str:
        """Hash of the content (not of the file that stores it)."""
        return content_sha256(self.nodes, self.tetrahedra)


def tetrahedralize(
    vertices: FloatArray,
    triangles: IntArray,
    settings: TetwildSettings,
    store: Path | None = None,
) -> TetrahedralMesh:
    """Mesh the inside of a closed surface, or read the mesh made of it before.

    Parameters
    ----------
    vertices, triangles
        Closed, outward, without self-intersections; ``(n, 3)`` mm and ``(m, 3)``.
    settings
        See `TetwildSettings`.
    store
        Folder in which the mesh is kept as ``tetwild-KEY.npz``, KEY being the hash of surface and
        settings. Not given, the mesh is made anew, and never the same twice.

    Raises
    ------
    GeometryError
        The surface has a fault; its name and the triangles are in the message.
    MeshingError
        The mesher failed, crashed or took too long, its mesh does not fit the surface, or a stored
        mesh is damaged.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    check_surface(vertices, triangles, closed=True, name="surface to mesh")
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)

    def make() -> TetrahedralMesh:
        return _checked(*_mesh(vertices, triangles, settings), vertices, triangles, settings)

    if store is None:
        return make()

    def read(path: Path) -> TetrahedralMesh:
        return _checked(*_load(path), vertices, triangles, settings)

    path = Path(store) / f"tetwild-{_key(vertices, triangles, settings)}.npz"
    # Another mesh would not be the same again.
    return Entry(path, read, remake=False).get_or_make(make, _save)


def _key(vertices: FloatArray, triangles: IntArray, settings: TetwildSettings) -> str:
    """Hash of everything that shapes the mesh; limits that only accept or refuse it are not in."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(triangles, dtype="<i8").tobytes())
    shaping = ("edge_length", "envelope", "stop_energy", "iterations", "coarsen")
    digest.update(repr([(name, getattr(settings, name)) for name in shaping]).encode())
    return digest.hexdigest()[:24]


def _mesh(
    vertices: FloatArray, triangles: IntArray, settings: TetwildSettings
) -> tuple[FloatArray, IntArray]:
    """Run the mesher in its own process and return its raw answer."""
    diagonal = float(np.linalg.norm(np.ptp(vertices[np.unique(triangles)], axis=0)))
    with tempfile.TemporaryDirectory(prefix="tetwild-") as folder:
        source, target = Path(folder) / "surface.npz", Path(folder) / "mesh.npz"
        np.savez(
            source,
            vertices=vertices,
            triangles=triangles,
            edge_length_fraction=settings.edge_length / diagonal,
            envelope_fraction=settings.envelope / diagonal,
            stop_energy=settings.stop_energy,
            iterations=settings.iterations,
            coarsen=settings.coarsen,
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
                timeout=settings.time_limit,
            )
        except subprocess.TimeoutExpired:
            raise MeshingError(
                f"pytetwild took longer than time_limit = {settings.time_limit:g} s; give a longer "
                f"edge_length ({settings.edge_length:g} mm now) or more time"
            ) from None
        if done.returncode != 0 or not target.exists():
            raise MeshingError(f"pytetwild {_failure(done.returncode, done.stderr)}")
        nodes, tetrahedra = read_npz(target, ["nodes", "tetrahedra"]).values()
        return nodes, tetrahedra


def _failure(code: int, stderr: str) -> str:
    lines = [line for line in stderr.splitlines() if line.strip()]
    said = f": {lines[-1].strip()}" if lines else " without a message"
    return f"failed: {ending(code)}{said}"


def _checked(
    nodes: FloatArray,
    tetrahedra: IntArray,
    vertices: FloatArray,
    triangles: IntArray,
    settings: TetwildSettings,
) -> TetrahedralMesh:
    """Orient the mesh, and refuse it unless it fills the surface."""
    if len(tetrahedra) == 0 or not np.isfinite(nodes).all():
        raise MeshingError(
            f"pytetwild returned {len(tetrahedra)} tetrahedra on {len(nodes)} nodes; expected "
            f"some, with finite coordinates"
        )
    nodes, tetrahedra = drop_unused_nodes(nodes, orient(nodes, tetrahedra))
    size = volumes(nodes, tetrahedra)
    if size.min() <= 0:
        flat = np.flatnonzero(size <= 0)
        raise MeshingError(f"pytetwild returned flat tetrahedra: {flat[:8].tolist()}")
    try:
        faces, _ = outer_faces(tetrahedra)
        check_surface(nodes, faces, closed=True, self_intersections=False, name="mesh's surface")
    except GeometryError as fault:
        raise MeshingError(f"pytetwild returned a mesh that is no solid: {fault}") from fault
    report = TetwildReport(
        quality=mesh_quality(nodes, tetrahedra, "tet4"),
        surface_volume=enclosed_volume(vertices, triangles),
        to_surface=float(
            closest_points(nodes[np.unique(faces)], vertices, triangles).distance.max()
        ),
        from_surface=float(
            closest_points(vertices[np.unique(triangles)], nodes, faces).distance.max()
        ),
    )
    change = abs(report.quality.volume / report.surface_volume - 1)
    if change > settings.volume_tolerance:
        raise MeshingError(
            f"the mesh has {report.quality.volume:.4g} mm^3, its surface encloses "
            f"{report.surface_volume:.4g} mm^3: {change:.1%} apart, volume_tolerance is "
            f"{settings.volume_tolerance:.1%}; give a smaller envelope"
        )
    # The mesher checks its envelope on samples, hence the margin.
    if report.to_surface > 1.5 * settings.envelope:
        raise MeshingError(
            f"the mesh leaves its surface by {report.to_surface:.3g} mm; the envelope is "
            f"{settings.envelope:g} mm"
        )
    if report.from_surface > settings.distance_tolerance:
        raise MeshingError(
            f"the mesh misses part of its surface by {report.from_surface:.3g} mm; "
            f"distance_tolerance is {settings.distance_tolerance:g} mm"
        )
    return TetrahedralMesh(nodes, tetrahedra, report)


def _save(path: Path, mesh: TetrahedralMesh) -> None:
    np.savez_compressed(path, nodes=mesh.nodes, tetrahedra=mesh.tetrahedra, sha256=mesh.sha256)


def _load(path: Path) -> tuple[FloatArray, IntArray]:
    try:
        nodes, tetrahedra, stored = read_npz(path, ["nodes", "tetrahedra", "sha256"]).values()
    except InputError as fault:
        raise MeshingError(f"{path}: stored mesh is unreadable ({fault}); delete it") from fault
    if content_sha256(nodes, tetrahedra) != str(stored):
        raise MeshingError(f"{path}: stored mesh does not match its hash {stored}; delete it")
    return nodes, tetrahedra
