"""The sheet in this project's mechanics: solid-shells, Biot strain."""

from __future__ import annotations

import numpy as np

from experiments.studies.models.sheet.sheet import Sheet, inadmissible
from mvest.estimation.prediction import Prediction
from mvest.mechanics.blocks import box, outer_faces
from mvest.mechanics.body import simulate_body
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh, embed

__all__ = ["OwnSheet"]


class OwnSheet:
    """Positions ``(3 n,)`` mm of the sheet's observed points from its two moduli (MPa).

    An observation model of the filters (:class:`mvest.estimation.ObservationModel`): coordinates
    follow one another point by point, the Jacobian ``(3 n, 2)`` mm/MPa is exact.

    Parameters
    ----------
    sheet : Sheet
    element : str
        ``hex18``, the solid-shell of the valve, or ``hex27``, the triquadratic brick.
    """

    def __init__(self, sheet: Sheet, element: str = "hex18") -> None:
        self.sheet, self.element = sheet, element
        size = (sheet.length, sheet.width, sheet.thickness)
        self.nodes, self.elements = box(element, (*sheet.cells, sheet.layers), size)
        faces = outer_faces(self.elements, element)
        self._under = faces[np.all(np.isclose(self.nodes[faces][:, :, 2], 0.0), axis=1)]
        x, y = self.nodes[:, 0], self.nodes[:, 1]
        held = np.isclose(x, 0.0) | np.isclose(y, 0.0) | np.isclose(y, sheet.width)
        self._fixed = np.flatnonzero(held)
        centre = self.nodes[self.elements].mean(axis=1)
        self._region = (centre[:, 0] > 0.5 * sheet.length).astype(np.int64)
        fibre = np.tile([1.0, 0.0, 0.0], (len(self.nodes), 1))
        mesh = SolidMesh(
            self.nodes, self.elements, element, self._region, ("0", "1"), fibre, self._under
        )
        self._observe = embed(mesh, sheet.points)

    def __call__(self, moduli: FloatArray, /) -> Prediction:
        """Predict the observed positions and their derivatives."""
        refused = inadmissible(moduli)
        if refused is not None:
            return refused
        sheet = self.sheet
        loads = np.arange(1, sheet.load_steps + 1) / sheet.load_steps
        pressed = simulate_body(
            self.nodes,
            self.elements,
            self.element,
            material=[TransverselyIsotropic.isotropic(float(E), sheet.poisson) for E in moduli],
            region=self._region,
            fixed_nodes=self._fixed,
            pressure_faces=self._under,
            pressure=[(0.0, 0.0), (1.0, sheet.pressure)],
            times=loads,
            static=True,
            parameters=[Parameter(f"E_f.{k}", float(E)) for k, E in enumerate(moduli)],
        )
        if not pressed.converged:
            return Prediction.failed(f"own sheet: {pressed.reason.value}")
        y = self._observe(pressed.frames[-1]).ravel()
        derivatives = [self._observe(d).ravel() for d in pressed.sensitivities[-1]]
        return Prediction(y, np.column_stack(derivatives))
