"""A rigid displacement between the axes of the model and those of what was seen.

The model is bounded by the annulus and the papillary tips as they were tracked. If the leaflets of
the later frames were seen displaced against these (by an error of tracking common to all their
points), every modulus is fitted to that displacement. So it is a parameter: predicted closed frames
are turned and shifted before they are compared.
"""

from __future__ import annotations

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
LABELS = {
    "pressure_scale": "pressure (factor)",
    OFFSET: "offset of pressures",
    "chord_stiffness": "chordal stiffness (factor)",
    "chord_rest_length": "chordal rest length (factor)",
    "stiffening": "stiffening",
    "prestretch": "stretch when seen open (factor)",
}
"""What a reader calls an unknown."""
LARGEST = {"mm": 1000, "degrees": 360}


def registration_of(names: tuple[str, ...], m: FloatArray) -> FloatArray:
    """Shift and turn ``(6,)`` out of parameters ``m (p,)``; zero where ``names`` lacks one."""
    values = dict(zip(names, map(float, m), strict=True))
    return np.array([values.get(name, 0.0) for name in REGISTRATION])


def unit_of(name: str) -> str:
    """Unit of a parameter of a closure or of a displacement; empty for what has none."""
    if name in REGISTRATION:
        return UNITS[name.partition(".")[0]]
    if is_frame_pressure(name):
        return "mmHg"
    kind = KINDS.get(name.partition(".")[0])
    return "" if kind is None else kind.unit


def label_of(name: str) -> str:
    """What a reader calls an unknown: ``E_f anterior`` for ``E_f.anterior``."""
    kind, _, part = name.partition(".")
    if kind in ("E_f", "E_perp", "G"):
        return f"{kind} {part}"
    if kind == ERROR:
        return f"pressure in frame {part}"
    if kind in ("shift", "turn"):
        return f"{kind} {'along' if kind == 'shift' else 'about'} {part}"
    return LABELS.get(name, name)


def range_of(name: str) -> Within | None:
    """The admissible range of a parameter of a closure or of a displacement; None for others."""
    if name in REGISTRATION:
        unit = unit_of(name)
        return within(-LARGEST[unit], LARGEST[unit], unit, "")
    kind = KINDS.get(name.partition(".")[0])
    return None if kind is None else within(kind.low, kind.high, kind.unit, kind.description)


def displace(points: FloatArray, registration: FloatArray, centre: FloatArray) -> FloatArray:
    """Points ``(..., 3)`` mm turned about ``centre (3,)`` and shifted.

    Parameters
    ----------
    points, centre : ndarray
        mm.
    registration : ndarray
        ``(6,)`` shift in mm and rotation vector in degrees (its length is the angle).
    """
    turn = Rotation.from_rotvec(registration[3:], degrees=True).as_matrix()
    return np.asarray((points - centre) @ turn.T + centre + registration[:3])


def _turn_derivatives(vector: FloatArray) -> FloatArray:
    """Derivatives ``(3, 3, 3)`` of the rotation matrix by its rotation vector (rad), k first.

    Gallego and Yezzi 2015, J. Math. Imaging Vis. 51:378, eq. 9:
    dR/dv_k = [v_k v + v x (I - R) e_k]_x R / |v|^2, and [e_k]_x for no rotation.
    """
    R = Rotation.from_rotvec(vector).as_matrix()
    squared = float(vector @ vector)
    out = np.empty((3, 3, 3))
    for k, unit in enumerate(np.eye(3)):
        if squared < 1e-16:
            out[k] = _cross(unit)
        else:
            axis = vector[k] * vector + np.cross(vector, (np.eye(3) - R)[:, k])
            out[k] = _cross(axis) @ R / squared
    return out


def _cross(v: FloatArray) -> FloatArray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class RegisteredModel:
    """A closure of which every frame but the open one is displaced before it is seen.

    Parameters
    ----------
    model : ClosureModel or FramesModel
        Predicts the open frame and closed ones.
    names : tuple of str, (p,)
        Those of the model, and some of ``REGISTRATION``, in any order.

    Raises
    ------
    InputError
        If a parameter of the model is missing or an unknown one is named.
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
        """Where the next prediction would start from."""
        return self.model.closed

    def restart(self, closed: ClosedState | None) -> None:
        """Forget everything but where to start from."""
        self._last = None
        self.model.restart(closed)

    def mechanical(self, m: FloatArray) -> FloatArray:
        """The parameters of the closure out of all."""
        own = self.own(m)
        return self.model.of_closure(own) if isinstance(self.model, FramesModel) else own

    def own(self, m: FloatArray) -> FloatArray:
        """All parameters but those of the displacement."""
        return np.asarray(m, dtype=np.float64)[self._own]

    def seen(self, points: FloatArray, m: FloatArray) -> FloatArray:
        """Positions ``(..., 3)`` mm of the closed valve as parameters ``m`` say they are seen."""
        return displace(points, registration_of(self.names, m), self.centre)

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does; only another displacement closes nothing."""
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
        seen = displace(closed, registration, self.centre)
        return replace(
            prediction, y=np.concatenate([prediction.y[:start], seen.ravel()]), jacobian=jacobian
        )
