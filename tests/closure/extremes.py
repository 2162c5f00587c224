"""Closures of extreme valves, and whether they end as closures must."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mvest import (
    ClosureModel,
    ClosureProtocol,
    MechanicsSettings,
    MvestError,
    Template,
    TemplateParameters,
    TissueSettings,
    structured_mesh,
)
from mvest.mechanics.steps import Simulation
from mvest.mechanics.valve_system import boundary_loading

EQUILIBRIUM = 1e-8
"""Largest residual of a closed state over its largest force: ten times Newton's tolerance."""


@dataclass(frozen=True)
class Extreme:
    """One closure.

    Attributes
    ----------
    moduli : tuple of float
        E_f of the anterior and the posterior leaflet, MPa.
    pressure : float
        mmHg.
    fixed : mapping
        Parameters that are not differentiated by.
    thickness : float or None
        mm, of both leaflets; None: the template's.
    element : str
    cells : tuple of int
        Around the valve and along the leaflets.
    closes : bool or None
        Whether it has a closed state; Newton's method takes a while to find that there is none.
    """

    moduli: tuple[float, float] = (6.23, 2.09)
    pressure: float = 120.0
    fixed: Mapping[str, float] = field(default_factory=dict)
    thickness: float | None = None
    element: str = "hex18"
    cells: tuple[int, int] = (16, 2)
    closes: bool | None = True


SOFT, STIFF = (1e-3, 1e-3), (1e3, 1e3)
COARSE_TET4 = (36, 4)
EXTREMES = {
    "moduli 1e3 MPa": Extreme(STIFF),
    "pressure 0": Extreme(pressure=0.0),
    "pressure 0, moduli 1e-3 MPa": Extreme(SOFT, pressure=0.0),
    "pressure 0, moduli 1e3 MPa": Extreme(STIFF, pressure=0.0),
    "pressure 1 mmHg": Extreme(pressure=1.0),
    "pressure 300 mmHg": Extreme(pressure=300.0),
    "chords twice as long": Extreme(fixed={"chord_rest_length": 2.0}),
    "chords half as stiff": Extreme(fixed={"chord_stiffness": 0.5}),
    "chords twice as stiff": Extreme(fixed={"chord_stiffness": 2.0}),
    "thickness 4 mm": Extreme(thickness=4.0),
    "tet10": Extreme(element="tet10"),
    "tet10, moduli 1e3 MPa": Extreme(STIFF, element="tet10"),
    "tet4": Extreme(element="tet4", cells=COARSE_TET4),
    "tet4, moduli 1e3 MPa": Extreme(STIFF, element="tet4", cells=COARSE_TET4),
    "tet4, pressure 300 mmHg": Extreme(pressure=300.0, element="tet4", cells=COARSE_TET4),
    "tet4 too coarse to hold the valve": Extreme(element="tet4", closes=False),
    # On the verge: it has closed or not with the order in which numbers were multiplied.
    "mesh 6 x 2": Extreme(cells=(6, 2), closes=None),
    "mesh 300 x 40": Extreme(cells=(300, 40), closes=False),
    "mesh 300 x 40, thickness 4 mm": Extreme(thickness=4.0, cells=(300, 40), closes=False),
}
"""Those that end soon: which of them close is asserted."""

ENDLESS = {
    "moduli 1e-3 MPa": Extreme(SOFT),
    "anterior 1e-3, posterior 1e3 MPa": Extreme((1e-3, 1e3)),
    "anterior 1e3, posterior 1e-3 MPa": Extreme((1e3, 1e-3)),
    "pressure 300 mmHg, moduli 1e-3 MPa": Extreme(SOFT, pressure=300.0),
    "chords half as long": Extreme(fixed={"chord_rest_length": 0.5}),
    "thickness 0.2 mm": Extreme(thickness=0.2),
    "thickness 0.2 mm, moduli 1e-3 MPa": Extreme(SOFT, thickness=0.2),
    "mesh 6 x 2, moduli 1e-3 MPa": Extreme(SOFT, cells=(6, 2)),
    "tet10, moduli 1e-3 MPa": Extreme(SOFT, element="tet10"),
    "tet10, thickness 0.2 mm": Extreme(thickness=0.2, element="tet10"),
    "tet4, moduli 1e-3 MPa": Extreme(SOFT, element="tet4", cells=COARSE_TET4),
}
"""Those in which all steps are halved as often as they may be before the closure is given up."""


@dataclass(frozen=True)
class Ended:
    """How a closure ended.

    Attributes
    ----------
    reason : str
    converged : bool
    residual : float
        Of the last state over the largest force.
    intersects : bool
    finite : bool
        Whether positions and derivatives are.
    """

    reason: str
    converged: bool = False
    residual: float = np.nan
    intersects: bool = False
    finite: bool = True

    @property
    def sound(self) -> bool:
        """Whether it is a closed state in equilibrium, or a failure with its reason."""
        if not self.converged:
            return bool(self.reason)
        return self.residual <= EQUILIBRIUM and not self.intersects and self.finite


def model_of(extreme: Extreme) -> ClosureModel:
    """A model of a template valve with it."""
    changed = {}
    if extreme.thickness is not None:
        changed = {f"leaflets.{leaflet}.thickness": extreme.thickness for leaflet in REGIONS}
    template = Template(TemplateParameters().changed(changed))
    return ClosureModel(
        template.valve(16, 5),
        template.valve(60, 16),
        structured_mesh(template, extreme.element, *extreme.cells),
        MechanicsSettings(
            {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)},
            ClosureProtocol(pressure_mmHg=extreme.pressure),
        ),
        tuple(f"E_f.{leaflet}" for leaflet in REGIONS),
        dict(extreme.fixed),
    )


REGIONS = ("anterior", "posterior")


def close(extreme: Extreme) -> Ended:
    """Close a valve, and look at what comes of it."""
    try:
        model = model_of(extreme)
        simulation = model.close(np.array(extreme.moduli)).simulation
    except MvestError as error:
        return Ended(str(error))
    return look_at(model, simulation, extreme.moduli)


def look_at(model: ClosureModel, simulation: Simulation, moduli: tuple[float, ...]) -> Ended:
    """The last state of a closure in the eyes of a system that has seen nothing else."""
    x, dx = simulation.frames[-1], simulation.sensitivities[-1]
    system, _ = model.fresh().tuned(np.array(moduli))
    assert system.contact is not None
    loads = boundary_loading(system, model.valve, model.contact_valve, model.settings)(np.inf)
    state = system.evaluate(
        x, loads, system.search_contact(x), system.solid.initial_strain(), 0.0, tangent=False
    )
    state.residual[system.held] = 0.0
    return Ended(
        simulation.reason.value,
        simulation.converged,
        float(np.linalg.norm(state.residual)) / max(state.scale, 1e-12),
        system.contact.intersects(system.contact.points(x)),
        bool(np.isfinite(x).all() and np.isfinite(dx).all()),
    )
