"""Mechanics without a valve: any solid body under pressure and forces, from plain arrays.

Rectangular blocks of any element serve as sheets, strips and patches for examples and verification.
"""

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
from mvest.typing import FloatArray
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
    """Simulate a body with fixed nodes, pressure on faces and forces on nodes.

    InputError, GeometryError or MaterialError if an array has a wrong shape, an index out of
    range or a value that is not finite; times do not increase; an element is inverted; a pressure
    face belongs to no element or points into the solid; the material is invalid or needs a fibre.

    Parameters
    ----------
    nodes : array_like
        ``(n, 3)`` mm.
    elements : array_like
        ``(m, k)`` node indices in the order of :mod:`mvest.elements`.
    element_type : str
        ``tet4``, ``tet10``, ``hex18``, ``hex27``, ``wedge12`` or ``wedge18``. One layer of ``tet4``
        is up to thirty times too stiff in bending. All elements are too stiff if the body bends by
        more than its thickness within a cell (see the results on thin shells).
    material : TransverselyIsotropic, sequence of them, or Law
        One material, one per region, or your own :class:`mvest.mechanics.Law` for all regions.
    times : array_like
        ``(s,)`` s, end times of the steps, increasing, > 0.
    fixed_nodes : array_like
        ``(h,)`` nodes that do not move.
    fixed_components : array_like, optional
        ``(n, 3)`` bool, single coordinates x, y, z that are fixed: on a plane of symmetry normal to
        x the first one.
    pressure_faces : array_like, optional
        ``(f, kf)`` nodes of the loaded faces, normals out of the solid
        (:func:`mvest.mechanics.body.outer_faces` finds all faces).
    pressure : float, callable or array_like
        MPa, positive against the normal: a constant, a function of the time (s), or a table
        ``(t, 2)`` of times and pressures, linear between its rows and constant outside.
    forces : array_like or callable, optional
        ``(n, 3)`` N, dead forces on the nodes: constant, or a function of the time (s). The nodes
        of an edge or face of a quadratic element do not share a force equally.
    fibre : array_like, optional
        Fibre direction: one ``(3,)``, per node ``(n, 3)`` or per element and node ``(m, k, 3)``.
        Needed unless all materials are isotropic.
    region : array_like, optional
        ``(m,)`` material of each element; regions are called ``"0"``, ``"1"``, ...
    static : bool
        Equilibrium at each time, without inertia and damping. Steps that fail are halved, so the
        load should grow with the time.
    density : float
        t/mm^3.
    damping, newton : optional
        See :mod:`mvest.mechanics.integrate`; by default the paper's damping of 0.1 1/s and 0.1 s.
    parameters : sequence of Parameter
        Parameters of the derivatives, for example ``Parameter("E_f.0", 6.23)`` or
        ``Parameter("pressure_scale", 1.0)``.
    solver : str
        ``auto``, ``pardiso`` or ``superlu``. The result names the solver that was used.

    Returns
    -------
    Simulation
        Frames ``(1 + completed steps, n, 3)`` mm, the initial state first, and the reason why the
        run ended. A run that does not converge is a result, not an exception.

    Examples
    --------
    A sheet of solid-shells, clamped at its rim and inflated:

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
    single = (
        np.zeros((n, 3), dtype=bool) if fixed_components is None else np.asarray(fixed_components)
    )
    if single.shape != (n, 3) or single.dtype != np.bool_:
        raise InputError(
            f"fixed_components: shape {single.shape} of {single.dtype}, expected ({n}, 3) of bool"
        )
    system = System(
        Solid(mesh, law, density=density),
        pressure=PressureLoad(mesh.pressure_faces, mesh.reference.face),
        fixed_nodes=fixed,
        fixed_components=single,
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
        materials = tuple(material) if isinstance(material, Sequence) else (material,)
        if not materials or not all(isinstance(m, TransverselyIsotropic) for m in materials):
            raise MaterialError(
                "material must be a TransverselyIsotropic, a sequence of them, or a law "
                "(mvest.mechanics.Law)"
            )
        n_regions, law = len(materials), BiotLaw.of(materials)
        directed = any(m != TransverselyIsotropic.isotropic(m.E_f, m.nu_fp) for m in materials)
    if region is None and n_regions > 1:
        raise InputError(f"{n_regions} materials need the region (m,) of each element")
    if fibre is None and directed:
        raise InputError("fibre is needed: the material is not isotropic, or a law of your own")
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
    if fibre is None:
        # Any direction within the layers: along the first reference axis.
        along = mesh.reference.gradient(mesh.reference.node_coordinates)[:, :, 0]
        own = np.einsum("mai,qa->mqi", mesh.nodes[mesh.elements], along)
        mesh = replace(mesh, fibre=_unit(own))
    return mesh, law


def _unit(direction: FloatArray) -> FloatArray:
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    if not np.all(length > 0) or not np.isfinite(direction).all():
        raise InputError("fibre has a length of zero or is not finite")
    return np.asarray(direction / length)


def _force_curve(
    forces: Callable[[float], ArrayLike] | ArrayLike | None, n: int
) -> Callable[[float], FloatArray | None]:
    if forces is None:
        return lambda t: None
    if callable(forces):
        return lambda t: checked_floats(f"forces at t = {t:g} s", np.asarray(forces(t)), (n, 3))
    constant = checked_floats("forces", np.asarray(forces), (n, 3))
    return lambda t: constant


def _pressure_curve(pressure: Callable[[float], float] | ArrayLike) -> Callable[[float], float]:
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
    """Raise unless each pressure face belongs to an element and points away from it."""
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
