"""A valve over a whole cycle: parameters in, all observed frames and their derivative out.

The state of the valve (positions, velocities, strains with their history) follows from the
parameters through the dynamics. It is no unknown of its own: where parameters are updated, the
state is that of the cycle run again with them, so that parameters and state are consistent at every
frame. What is not estimated is a disturbance of the state that no parameter explains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvest.closure.cycle.protocol import CycleProtocol
from mvest.closure.model import ClosureModel
from mvest.errors import InputError, MaterialError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.integrate import simulate
from mvest.mechanics.steps import Simulation
from mvest.mechanics.valve_system import boundary_loading
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CycleModel:
    """Predicted positions of the observed vertices in every frame of a cycle.

    Attributes
    ----------
    closure : ClosureModel
        Valve, mesh, mechanics and names of the parameters; its own protocol plays no part.
    protocol : CycleProtocol
    """

    closure: ClosureModel
    protocol: CycleProtocol

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.closure.names

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of predicted coordinates of each frame."""
        return (3 * len(self.closure.valve.surface.vertices),) * len(self.protocol.times)

    def fresh(self) -> CycleModel:
        """A model of the same that has not built anything."""
        return replace(self, closure=self.closure.fresh())

    def run(
        self, m: FloatArray, *, sensitivities: bool = True, until: int | None = None
    ) -> Simulation:
        """Run the cycle with parameters ``m (p,)`` from the open valve at rest.

        Parameters
        ----------
        m : ndarray
        sensitivities : bool
            Whether all frames are differentiated.
        until : int, optional
            The last observed frame that is wanted.

        Raises
        ------
        MaterialError
            If a modulus is inadmissible.
        """
        closure = self.closure
        system, parameters = closure.tuned(m)
        return simulate(
            system,
            boundary_loading(
                system, closure.valve, closure.contact_valve, closure.settings, self.protocol
            ),
            self.protocol.steps(until),
            damping=closure.damping(m),
            newton=closure.settings.newton,
            parameters=parameters if sensitivities else (),
            solver=closure.solver,
            on_step=closure.on_step,
        )

    def frames(self, m: FloatArray) -> FloatArray:
        """Positions ``(f, n, 3)`` mm of the observed vertices with parameters ``m (p,)``.

        Raises
        ------
        MaterialError
            If a modulus is inadmissible.
        InputError
            If the cycle cannot be followed to its end.
        """
        simulation = self.run(m, sensitivities=False)
        if not simulation.converged:
            raise InputError(f"no cycle with the parameters {m}: {_failure(simulation)}")
        at = self.protocol.frame_steps
        return np.stack([self.closure.observed(simulation.frames[k]) for k in at])

    def __call__(self, m: FloatArray, /) -> Prediction:
        """All frames, one after another, and their Jacobian.

        Inadmissible moduli and cycles that do not converge are failed predictions, not errors.
        """
        return self._predict(m, range(len(self.protocol.times)))

    def frame(self, k: int, m: FloatArray, /) -> Prediction:
        """Frame ``k`` alone; the cycle is run until there and no further."""
        return self._predict(m, [k])

    def _predict(self, m: FloatArray, wanted: range | list[int]) -> Prediction:
        try:
            simulation = self.run(m, until=wanted[-1])
        except MaterialError as error:
            return Prediction.failed(str(error))
        if not simulation.converged:
            return Prediction.failed(_failure(simulation))
        observed, at = self.closure.observed, self.protocol.frame_steps
        y = np.concatenate([observed(simulation.frames[at[k]]).ravel() for k in wanted])
        columns = [
            np.concatenate([observed(simulation.sensitivities[at[k], i]).ravel() for k in wanted])
            for i in range(len(self.names))
        ]
        return Prediction(y, np.stack(columns, axis=-1))


def _failure(simulation: Simulation) -> str:
    return f"{simulation.reason.value} (t = {simulation.times[-1]:.3f} s)"
