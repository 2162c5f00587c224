"""Parameters besides those of the closure, above all a rigid displacement of the observed valve.

The model is bounded by the tracked annulus and papillary tips. A tracking error common to all later
points of the leaflets displaces them against this boundary and biases every modulus. So it is a
parameter: predicted closed frames are rotated and shifted before the comparison.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.closure.continuation import ClosedState
from mvest.closure.frames import ERROR, OFFSET, FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.mechanics.parameters import KINDS
from mvest.quantities import Within, within
from mvest.typing import FloatArray

REGISTRATION = ("shift.x", "shift.y", "shift.z", "turn.x", "turn.y", "turn.z")
"""Parameters of a displacement: shifts in mm, and a rotation vector in degrees."""
UNITS = {"shift": "mm", "turn": "degrees"}
LARGEST = {"mm": 1000, "degrees": 360}
LABELS = {
    "pressure_scale": "pressure (factor)",
    OFFSET: "offset of pressures",
    "chord_stiffness": "chordal stiffness (factor)",
    "chord_rest_length": "chordal rest length (factor)",
    "stiffening": "stiffening",
    "prestretch": "stretch when seen open (factor)",
}
"""Readable names of unknowns."""


def registration_of(names: tuple[str, ...], m: FloatArray) -> FloatArray:
    """Shift and rotation ``(6,)`` among parameters ``m (p,)``; zero for those not in ``names``."""
    values = dict(zip(names, map(float, m), strict=True))
    return np.array([values.get(name, 0.0) for name in REGISTRATION])


def unit_of(name: str) -> str:
    """Unit of a parameter; empty if it has none."""
    if name in REGISTRATION:
        return UNITS[name.partition(".")[0]]
    if is_frame_pressure(name):
        return "mmHg"
    kind = KINDS.get(name.partition(".")[0])
    return "" if kind is None else kind.unit


def label_of(name: str) -> str:
    """Readable name of an unknown: ``E_f anterior`` for ``E_f.anterior``."""
    kind, _, part = name.partition(".")
    if kind in ("E_f", "E_perp", "G"):
        return f"{kind} {part}"
    if kind == ERROR:
        return f"pressure in frame {part}"
    if kind in ("shift", "turn"):
        return f"{kind} {'along' if kind == 'shift' else 'about'} {part}"
    return LABELS.get(name, name)


def range_of(name: str) -> Within | None:
    """The admissible range of a parameter; None for unknown names."""
    if name in REGISTRATION:
        unit = unit_of(name)
        return within(-LARGEST[unit], LARGEST[unit], unit, "")
    kind = KINDS.get(name.partition(".")[0])
    return None if kind is None else within(kind.low, kind.high, kind.unit, kind.description)


def displace(points: FloatArray, registration: FloatArray, centre: FloatArray) -> FloatArray:
    """Points ``(..., 3)`` mm rotated about ``centre (3,)`` and shifted.

    ``registration (6,)`` is a shift in mm and a rotation vector in degrees (length: the angle).
    """
    turn = Rotation.from_rotvec(registration[3:], degrees=True).as_matrix()
    return np.asarray((points - centre) @ turn.T + centre + registration[:3])


def _turn_derivatives(vector: FloatArray) -> FloatArray:
    """Derivatives ``(3, 3, 3)`` of the rotation matrix by its rotation vector (rad), k first.

    Gallego and Yezzi 2015, J. Math. Imaging Vis. 51:378, eq. 9:
    dR/dv_k = [v_k v + v x (I - R) e_k]_x R / |v|^2, and [e_k]_x without rotation.
    """
    R, squared = Rotation.from_rotvec(vector).as_matrix(), float(vector @ vector)

    def cross(v: FloatArray) -> FloatArray:
        return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

    if squared < 1e-16:
        return np.stack([cross(unit) for unit in np.eye(3)])
    axes = [vector[k] * vector + np.cross(vector, (np.eye(3) - R)[:, k]) for k in range(3)]
    return np.stack([cross(axis) @ R / squared for axis in axes])


class RegisteredModel:
    """A closure that displaces all predicted frames except the open one.

    InputError if the names do not match.

    Parameters
    ----------
    model : ClosureModel or FramesModel
        Predicts the open frame and closed ones.
    names : tuple of str, (p,)
        Those of the model in its order, mixed with some of ``REGISTRATION``.
    """

    def __init__(self, model: ClosureModel | FramesModel, names: tuple[str, ...]) -> None:
        own = [k for k, name in enumerate(names) if name not in REGISTRATION]
        if tuple(names[k] for k in own) != model.names:
            raise InputError(
                f"parameters {', '.join(names)}: expected {', '.join(model.names)} in this order, "
                f"and some of {', '.join(REGISTRATION)}"
            )
        self.model = model
        self.names = names
        self._own = np.array(own, dtype=np.int64)
        self._frames = 1 + (len(model.frames) if isinstance(model, FramesModel) else 1)
        self._last: tuple[FloatArray, Prediction] | None = None
        self.centre: FloatArray = model.valve.motion.annulus[-1].mean(axis=0)

    @property
    def closed(self) -> ClosedState | None:
        """Starting state of the next prediction."""
        return self.model.closed

    def restart(self, closed: ClosedState | None) -> None:
        """Reset the model to a starting state."""
        self._last = None
        self.model.restart(closed)

    def mechanical(self, m: FloatArray) -> FloatArray:
        """The parameters of the closure among all parameters ``m (p,)``."""
        own = self.own(m)
        return self.model.of_closure(own) if isinstance(self.model, FramesModel) else own

    def own(self, m: FloatArray) -> FloatArray:
        """All parameters except those of the displacement."""
        return np.asarray(m, dtype=np.float64)[self._own]

    def seen(self, points: FloatArray, m: FloatArray) -> FloatArray:
        """Positions ``(..., 3)`` mm of the closed valve, displaced as parameters ``m`` say."""
        return displace(points, registration_of(self.names, m), self.centre)

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict; the valve is closed anew only if other parameters than the displacement change.

        Parameters and prediction are those of an ``ObservationModel``.
        """
        own = self.own(m)
        if self._last is None or not np.array_equal(self._last[0], own):
            self._last = own, self.model(own)
        prediction = self._last[1]
        if not prediction.converged:
            return prediction
        start = len(prediction.y) // self._frames
        closed = prediction.y[start:].reshape(-1, 3)
        registration = registration_of(self.names, m)
        turn = Rotation.from_rotvec(registration[3:], degrees=True).as_matrix()
        by_own = prediction.jacobian[start:].reshape(len(closed), 3, -1)
        jacobian = np.zeros((len(prediction.y), len(self.names)))
        jacobian[:start, self._own] = prediction.jacobian[:start]
        turned = np.einsum("ij,njp->nip", turn, by_own)
        jacobian[start:, self._own] = turned.reshape(closed.size, -1)
        turns = _turn_derivatives(np.deg2rad(registration[3:]))
        for k, name in enumerate(self.names):
            kind, _, axis = name.partition(".")
            i = "xyz".find(axis)
            if kind == "shift":
                jacobian[start + i :: 3, k] = 1.0
            elif kind == "turn":
                by_radian = (closed - self.centre) @ turns[i].T
                jacobian[start:, k] = np.deg2rad(by_radian).ravel()
        y = np.concatenate([prediction.y[:start], self.seen(closed, m).ravel()])
        return replace(prediction, y=y, jacobian=jacobian)
