"""Mechanics without a valve: any solid body under pressure and forces, from plain arrays.

Rectangular blocks of any element serve as sheets, strips and patches for examples and verification.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mvest.elements import FACES, element
from mvest.errors import GeometryError, InputError, MaterialError
from mvest.mechanics.forces.pressure import PressureLoad
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law import Law
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import linear_solver
from mvest.mechanics.steps import Damping, NewtonSettings, Simulation, Step
from mvest.mechanics.system import Loads, System
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.valve import checked_floats, checked_indices
from mvest.valve.mesh.cells import box as box
from mvest.valve.mesh.cells import local_faces
from mvest.valve.mesh.cells import outer_faces as outer_faces
from mvest.valve.mesh.solid_mesh import SolidMesh


def simulate_body(
    nodes: ArrayLike,
    elements: ArrayLike,
    element_type: str,
    *,
    material: TransverselyIsotropic | Sequence[TransverselyIsotropic] | Law,
    times: ArrayLike,
    fixed_nodes: ArrayLike = (),
    fixed_components: ArrayLike | None = None,
    pressure_faces: ArrayLike | None = None,
    pressure: Callable[[float], float] | ArrayLike = 0.0,
    forces: Callable[[float], ArrayLike] | ArrayLike | None = None,
    fibre: ArrayLike | None = None,
    region: ArrayLike | None = None,
    static: bool = False,
    density: float = 1.04e-9,
    damping: Damping | None = None,
    newton: NewtonSettings | None = None,
    parameters: Sequence[Parameter] = (),
    solver: str = "auto",
) -> Simulation:
    """Simulate a body that is held at some nodes, pressed on some faces and pulled at some nodes.

    Parameters
    ----------
    nodes : array_like
        ``(n, 3)`` mm.
    elements : array_like
        ``(m, k)`` node indices in the order of :mod:`mvest.elements`.
    element_type : str
        ``tet4``, ``tet10``, ``hex18``, ``hex27``, ``wedge12`` or ``wedge18``. One layer of ``tet4``
        is up to thirty times too stiff in bending; prefer the others. Where the body bends by more
        than its thickness within a cell, all are too stiff (see the results on thin shells).
    material : TransverselyIsotropic, sequence of them, or Law
        One, or one per region; or a law of one's own, which has what
        :class:`mvest.mechanics.Law` asks for, for all regions.
    times : array_like
        ``(s,)`` s, end times of the steps, increasing, > 0.
    fixed_nodes : array_like
        ``(h,)`` nodes that do not move.
    fixed_components : array_like, optional
        ``(n, 3)`` bool, coordinates x, y, z of single nodes that do not change. Nodes on a plane of
        symmetry normal to x have their first one fixed.
    pressure_faces : array_like, optional
        ``(f, kf)`` nodes of the faces pressed on, normals out of the solid
        (:func:`mvest.mechanics.body.outer_faces` finds all faces).
    pressure : float, callable or array_like
        MPa, positive pushes against the normal: a constant, a function of the time (s), or a table
        ``(t, 2)`` of times and pressures, linear between its rows and constant outside.
    forces : array_like or callable, optional
        ``(n, 3)`` N on the nodes, which keep their direction: constant, or a function of the time
        (s). A force on an edge or face of a quadratic element is not shared equally by its nodes.
    fibre : array_like, optional
        Direction of the fibre: one ``(3,)``, per node ``(n, 3)`` or per element and node
        ``(m, k, 3)``. May be left out if all materials are isotropic; of a law that is not known.
    region : array_like, optional
        ``(m,)`` material of each element; regions are called ``"0"``, ``"1"``, ...
    static : bool
        Equilibrium at each time, without inertia and damping. The load of a step that is too long
        is halved; it should therefore grow with the time.
    density : float
        t/mm^3.
    damping, newton : optional
        See :mod:`mvest.mechanics.integrate`; by default the paper's damping of 0.1 1/s and 0.1 s.
    parameters : sequence of Parameter
        To differentiate by, for example ``Parameter("E_f.0", 6.23)`` or
        ``Parameter("pressure_scale", 1.0)``.
    solver : str
        ``auto``, ``pardiso`` or ``superlu``. What has solved stands in the result.

    Returns
    -------
    Simulation
        All frames ``(1 + completed steps, n, 3)`` mm, the given state first, and the reason why the
        run ended; a run that does not converge is a result, not an exception.

    Raises
    ------
    InputError, GeometryError, MaterialError
        If an array has a wrong shape, an index out of range or a value that is not finite; if times
        do not increase; if an element is inverted, or a pressure face belongs to no element or
        points into the solid; if a material needs a fibre that is not given, or is neither a
        material nor a law.

    Examples
    --------
    A sheet of one layer of solid-shells, clamped at its rim and inflated:

    >>> import numpy as np
    >>> from mvest.mechanics import TransverselyIsotropic, box, outer_faces, simulate_body
    >>> nodes, elements = box("hex18", cells=(6, 6, 1), size=(20.0, 20.0, 1.3))
    >>> rim = np.flatnonzero(np.any((nodes[:, :2] == 0) | (nodes[:, :2] == 20), axis=1))
    >>> faces = outer_faces(elements, "hex18")
    >>> under = faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)]
    >>> tissue = TransverselyIsotropic(E_f=6.23, E_p=2.35, G=2.09, nu_fp=0.488, nu_pp=0.488)
    >>> result = simulate_body(nodes, elements, "hex18", material=tissue, fibre=(1, 0, 0),
    ...     fixed_nodes=rim, pressure_faces=under, pressure=[(0, 0), (0.05, 0.016)],
    ...     times=np.arange(1, 11) * 0.01)
    >>> result.converged, result.frames.shape
    (True, (11, 338, 3))
    """
    mesh, law = _body(nodes, elements, element_type, material, fibre, region, pressure_faces)
    n = len(mesh.nodes)
    fixed = np.unique(checked_indices("fixed_nodes", np.asarray(fixed_nodes), n, (None,)))
    system = System(
        Solid(mesh, law, density=density),
        pressure=PressureLoad(mesh.pressure_faces, mesh.reference.face),
        fixed_nodes=fixed,
        fixed_components=_components(fixed_components, n),
    )
    curve, pull = _pressure_curve(pressure), _force_curve(forces, n)
    held, ends = mesh.nodes[fixed], np.asarray(times, dtype=float)
    if ends.ndim != 1:
        raise InputError(f"times: shape {ends.shape}, expected (s,)")
    return simulate(
        system,
        lambda t: Loads(pressure=curve(t), fixed=held, body_force=pull(t)),
        [Step(float(t), static) for t in ends],
        damping=damping,
        newton=newton,
        parameters=parameters,
        solver=linear_solver(solver),
    )


def _body(
    nodes: ArrayLike,
    elements: ArrayLike,
    element_type: str,
    material: TransverselyIsotropic | Sequence[TransverselyIsotropic] | Law,
    fibre: ArrayLike | None,
    region: ArrayLike | None,
    pressure_faces: ArrayLike | None,
) -> tuple[SolidMesh, Law]:
    points, cells = np.asarray(nodes, dtype=float), np.asarray(elements)
    width = FACES[element(element_type).face].n_nodes
    law: Law
    if isinstance(material, Law):
        n_regions = 1 if region is None else int(np.max(np.asarray(region), initial=0)) + 1
        law, directed = material, True
    else:
        materials = _materials(material)
        n_regions, law = len(materials), BiotLaw.of(materials)
        directed = not all(_is_isotropic(m) for m in materials)
    if region is None and n_regions > 1:
        raise InputError(f"{n_regions} materials need the region (m,) of each element")
    if fibre is None and directed:
        raise InputError("fibre is needed: a material is not isotropic, or a law of one's own")
    direction = _unit(np.asarray((1.0, 0.0, 0.0) if fibre is None else fibre, dtype=float))
    mesh = SolidMesh(
        points,
        cells,
        element_type,
        np.zeros(len(cells), dtype=np.int64) if region is None else np.asarray(region),
        tuple(map(str, range(n_regions))),
        np.tile(direction, (len(points), 1)) if direction.shape == (3,) else direction,
        np.zeros((0, width), dtype=np.int64)
        if pressure_faces is None
        else np.asarray(pressure_faces),
    )
    _check_pressure_faces(mesh)
    return (mesh if fibre is not None else replace(mesh, fibre=_any_fibre(mesh))), law


def _materials(
    material: TransverselyIsotropic | Sequence[TransverselyIsotropic],
) -> tuple[TransverselyIsotropic, ...]:
    given = tuple(material) if isinstance(material, Sequence) else (material,)
    if not given or not all(isinstance(m, TransverselyIsotropic) for m in given):
        raise MaterialError(
            "material must be a TransverselyIsotropic, a sequence of them, or a law "
            "(mvest.mechanics.Law)"
        )
    return given


def _is_isotropic(material: TransverselyIsotropic) -> bool:
    return material == TransverselyIsotropic.isotropic(material.E_f, material.nu_fp)


def _any_fibre(mesh: SolidMesh) -> FloatArray:
    """Some direction ``(m, k, 3)`` within each layer: along the first reference axis."""
    along = mesh.reference.gradient(mesh.reference.node_coordinates)[:, :, 0]
    return _unit(np.einsum("mai,qa->mqi", mesh.nodes[mesh.elements], along))


def _unit(direction: FloatArray) -> FloatArray:
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    if not np.all(length > 0) or not np.isfinite(direction).all():
        raise InputError("fibre has a length of zero or is not finite")
    return np.asarray(direction / length)


def _components(fixed_components: ArrayLike | None, n: int) -> BoolArray:
    if fixed_components is None:
        return np.zeros((n, 3), dtype=bool)
    fixed = np.asarray(fixed_components)
    if fixed.shape != (n, 3) or fixed.dtype != np.bool_:
        raise InputError(
            f"fixed_components: shape {fixed.shape} of {fixed.dtype}, expected ({n}, 3) of bool"
        )
    return fixed


def _force_curve(
    forces: Callable[[float], ArrayLike] | ArrayLike | None, n: int
) -> Callable[[float], FloatArray | None]:
    if forces is None:
        return lambda t: None
    if callable(forces):
        return lambda t: checked_floats(f"forces at t = {t:g} s", np.asarray(forces(t)), (n, 3))
    constant = checked_floats("forces", np.asarray(forces), (n, 3))
    return lambda t: constant


def _pressure_curve(
    pressure: Callable[[float], float] | ArrayLike,
) -> Callable[[float], float]:
    if callable(pressure):
        return pressure
    table = np.asarray(pressure, dtype=float)
    if table.ndim == 0:
        table = np.array([(0.0, table)])
    table = checked_floats("pressure table (s, MPa)", table, (None, 2))
    if np.any(np.diff(table[:, 0]) <= 0):
        raise InputError("pressure table: expected increasing times")
    return lambda t: float(np.interp(t, table[:, 0], table[:, 1]))


def _check_pressure_faces(mesh: SolidMesh) -> None:
    """Each pressure face must be part of an element and point away from it."""
    local = local_faces(mesh.element_type)
    known = np.sort(mesh.elements[:, local].reshape(-1, local.shape[1]), axis=1)
    owner = {face: k // len(local) for k, face in enumerate(map(tuple, known.tolist()))}
    corners = FACES[mesh.reference.face].corners
    for f, face in enumerate(mesh.pressure_faces):
        own = owner.get(tuple(np.sort(face).tolist()))
        if own is None:
            raise GeometryError(f"pressure face {f} {face.tolist()} is not a face of an element")
        a, b, c = np.moveaxis(mesh.nodes[face[corners]], 1, 0)
        normal = np.cross(b - a, c - a).sum(axis=0)
        inside = mesh.nodes[mesh.elements[own]].mean(axis=0)
        if normal @ (mesh.nodes[face].mean(axis=0) - inside) <= 0:
            raise GeometryError(
                f"pressure face {f} {face.tolist()} points into the solid; reverse its node order"
            )
