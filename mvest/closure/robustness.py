"""The gate: tests whether the closed state is unique. Every anatomy should pass it.

Fitted moduli mean nothing if a smaller time step, a finer mesh or a slightly different modulus
folds the leaflets differently. The gate closes the valve under variations that must not matter and
compares the closed surfaces. It also follows the closed surface along changing moduli
(:mod:`mvest.closure.smoothness`): the path may curve but must not jump.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.closure.smoothness import Path, PathState, follow
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

MEAN_LIMIT = 0.1
MAX_LIMIT = 0.5
"""mm, largest accepted mean and maximal distance between closed states."""

PERTURBATION = 1.0
WAVELENGTH = 30.0
"""mm, largest displacement of a perturbed start, and its wavelength, long enough that the thick,
warped leaflets do not intersect."""
WAVES = 4

COMMON = (0.8, 0.95, 1.05, 1.2)
SINGLE = (0.8, 1.2)
"""First factors of a path, on all moduli together and on a single modulus."""


@dataclass(frozen=True, slots=True)
class GateCase:
    """One variation of the closure that must not change the closed state."""

    name: str
    dt: float = 1.0  #: factor on the time step
    ramp: float = 1.0  #: factor on the time over which pressure and boundary motion rise
    converged_path: bool = False  #: whether every step is solved as accurately as the last
    mesh: float = 1.0  #: factor on the number of cells along both directions of the leaflets
    activation: float = 1.0  #: factor on the activation distance of contact
    sampling: float = 1.0  #: factor on the density of the contact samples along both directions
    guided: bool = False  #: whether the model's guide is used
    #: seed of a smooth displacement of the open leaflets before they close; 0 for none
    perturbed: int = 0
    #: factor on all moduli E_f at which the valve first closes, and is continued from; 1: it closes
    #: from the open valve
    start: float = 1.0

    @property
    def remeshed(self) -> bool:
        """Whether the case needs another mesh or other contact samples than the model's."""
        return self.mesh != 1 or self.sampling != 1


REFERENCE = GateCase("reference")
GATE_CASES = (
    GateCase("time step / 2", dt=0.5),
    GateCase("time step / 4", dt=0.25),
    GateCase("time step / 16", dt=0.0625),
    GateCase("time step / 32, every step converged", dt=1 / 32, converged_path=True),
    GateCase("ramp / 3, time step / 32, converged", dt=1 / 32, ramp=1 / 3, converged_path=True),
    GateCase("activation distance - 10 %", activation=0.9),
    GateCase("contact samples x 1.33", sampling=4 / 3),
    GateCase("mesh x 1.5", mesh=1.5),
    GateCase("followed on coarser meshes", guided=True),
    GateCase("perturbed start", perturbed=1),
    GateCase("continued from E_f + 20 %", start=1.2),
    GateCase("continued from E_f - 20 %", start=0.8),
)


@dataclass(frozen=True, slots=True)
class GateRow:
    """Outcome of one case."""

    case: str
    #: distance between this closed surface and the reference's; NaN if the closure failed
    mean_mm: float
    max_mm: float
    passed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class GateReport:
    """All cases, the reference first, and the paths along the moduli.

    There is a path along a common factor on all moduli and, if there are several, along each of
    them. Without a closed reference there are no paths.
    """

    rows: tuple[GateRow, ...]
    paths: tuple[Path, ...] = ()

    @property
    def passed(self) -> bool:
        """The verdict."""
        return all(row.passed for row in self.rows) and all(path.passed for path in self.paths)

    @property
    def closures(self) -> int:
        """Number of closures that were computed."""
        return len(self.rows) + sum(path.closures for path in self.paths)


def vary(model: ClosureModel, case: GateCase) -> ClosureModel:
    """A fresh model that closes from the open valve, with a case's changes except the mesh.

    InputError if the case needs another mesh or other contact samples; these must come from an
    anatomy.
    """
    if case.remeshed:
        raise InputError(f"gate case {case.name!r} needs another mesh or other contact samples")
    fresh, settings = model.fresh(), model.settings
    protocol, newton, contact = settings.protocol, settings.newton, settings.contact
    tolerance = newton.tolerance if case.converged_path else newton.path_tolerance
    distance = contact.activation_distance * case.activation
    return replace(
        fresh,
        settings=replace(
            settings,
            protocol=replace(protocol, dt=protocol.dt * case.dt, ramp=protocol.ramp * case.ramp),
            newton=replace(newton, path_tolerance=tolerance),
            contact=replace(contact, activation_distance=distance),
        ),
        guide=fresh.guide if case.guided else None,
        continuation=case.start != 1,
        reach=np.inf,
        rounded_start=False,
        perturbation=_perturbation(model.mesh, case.perturbed) if case.perturbed else None,
    )


def _perturbation(mesh: SolidMesh, seed: int) -> FloatArray:
    """A sum of plane waves ``(n, 3)`` mm at the nodes, scaled to the largest displacement."""
    rng = np.random.default_rng(seed)
    normals, sides = rng.standard_normal((2, WAVES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    phases = mesh.nodes @ normals.T * (2 * np.pi / WAVELENGTH) + rng.uniform(0, 2 * np.pi, WAVES)
    moved = np.sin(phases) @ sides
    return np.asarray(moved * (PERTURBATION / np.linalg.norm(moved, axis=1).max()))


def run_gate(
    build: Callable[[GateCase], ClosureModel],
    m: FloatArray,
    cases: Sequence[GateCase] = GATE_CASES,
    on_case: Callable[[GateRow], None] = lambda row: None,
    on_path: Callable[[Path], None] = lambda path: None,
) -> GateReport:
    """Close the valve in all cases and along the moduli, and compare.

    Parameters
    ----------
    build : callable
        Makes the model of a case; all must observe the same material points.
    m : ndarray
        ``(p,)`` parameters; moduli are those named ``E_f.*``.
    cases : sequence of GateCase
    on_case, on_path : callable, optional
        Called with each finished row, and each finished path.
    """
    model = build(REFERENCE)
    is_modulus = np.array([name.startswith("E_f.") for name in model.names])
    reference = model(m)
    rows = [GateRow(REFERENCE.name, 0.0, 0.0, reference.converged, reference.reason)]
    on_case(rows[0])
    if not reference.converged:
        return GateReport(tuple(rows))
    closed = _closed(reference.y)
    for case in cases:
        varied = build(case)
        prediction = varied(np.where(is_modulus, case.start * m, m))
        if case.start != 1 and prediction.converged:
            prediction = varied(m)
        mean = largest = float("nan")
        if prediction.converged:
            distance = np.linalg.norm(_closed(prediction.y) - closed, axis=1)
            mean, largest = float(distance.mean()), float(distance.max())
        passed = mean <= MEAN_LIMIT and largest <= MAX_LIMIT
        rows.append(GateRow(case.name, mean, largest, passed, prediction.reason))
        on_case(rows[-1])
    moduli = np.flatnonzero(is_modulus).tolist()
    directions: list[tuple[str, FloatArray, tuple[float, ...]]] = []
    if moduli:
        directions.append(("E_f", is_modulus.astype(np.float64), COMMON))
    if len(moduli) > 1:
        directions += [(model.names[k], np.eye(len(m))[k], SINGLE) for k in moduli]
    paths = []
    for name, which, factors in directions:

        def state(prediction: Prediction, rates: FloatArray) -> PathState:
            return PathState(_closed(prediction.y), _closed(prediction.jacobian @ rates))

        def close(factor: float, which: FloatArray = which) -> PathState | str:
            at = m * factor**which
            prediction = model(at)
            return state(prediction, at * which) if prediction.converged else prediction.reason

        paths.append(follow(name, close, state(reference, m * which), factors))
        on_path(paths[-1])
    return GateReport(tuple(rows), tuple(paths))


def _closed(y: FloatArray) -> FloatArray:
    """The closed frame's vertices ``(n, 3)`` mm of both frames."""
    return y.reshape(2, -1, 3)[1]
