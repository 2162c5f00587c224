"""One case: a valve at rest, and how it was seen in further frames.

A case is what an estimation knows of a patient. It is read from a folder (`mvest.cases.folder`) or
written by a simulation; nothing in it says what the moduli are. All lengths are mm, times s.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy import Chordae, LeafletSurface, Motion, Valve

__all__ = ["Frame", "Role", "Uncertainty", "ValveCase"]


class Role(Enum):
    """What a frame is for.

    ``REFERENCE`` is the open frame from which the model's geometry is taken; ``CLOSED`` the closed
    frame that is fitted; ``HELD_OUT`` a further frame of the closed valve (under another pressure,
    with the annulus and the papillary tips elsewhere) that no filter is shown and against which the
    fitted valve is judged.
    """

    REFERENCE = "reference"
    CLOSED = "closed"
    HELD_OUT = "held_out"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """How the valve was seen at one instant.

    Attributes
    ----------
    name : str
    time : float
        s.
    role : Role
    pressure_mmHg : float
        Transmitral pressure, positive where it closes the valve.
    vertices : ndarray
        ``(n, 3)`` mm.
    triangles : ndarray
        ``(m, 3)``.
    region : ndarray
        ``(m,)`` index into the regions of the case.
    annulus : ndarray
        ``(k, 3)`` mm, where the annulus vertices of the *reference* frame are in this frame.
    free_edge : ndarray
        ``(j, 3)`` mm, closed curve along the free edge.
    papillary_tips : ndarray
        ``(t, 3)`` mm.
    corresponds : bool
        Whether vertex i of this frame is the same material point as vertex i of the reference
        frame.
    """

    name: str
    time: float
    role: Role
    pressure_mmHg: float
    vertices: FloatArray
    triangles: IntArray
    region: IntArray
    annulus: FloatArray
    free_edge: FloatArray
    papillary_tips: FloatArray
    corresponds: bool


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How well vertices are seen.

    Attributes
    ----------
    std_mm : float
        Standard deviation of each coordinate.
    correlation_length_mm : float
        Over which errors of neighbouring vertices are alike along the leaflets; 0: independent.
    """

    std_mm: float
    correlation_length_mm: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.std_mm) and self.std_mm > 0):
            raise InputError(f"observation std_mm = {self.std_mm}, expected > 0")
        length = self.correlation_length_mm
        if not (np.isfinite(length) and length >= 0):
            raise InputError(f"observation correlation_length_mm = {length}, expected >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class ValveCase:
    """A valve and how it was seen.

    Attributes
    ----------
    name, description, source, licence : str
    simulated : bool
        Whether the frames come from a simulation; every picture and table says so.
    surface : LeafletSurface
        Midsurface of the reference frame with thickness and fibres; its vertices and triangles are
        those of the reference frame.
    annulus, free_edge : ndarray
        ``(k,)`` and ``(j,)`` vertices of ``surface`` in loop order.
    frames : tuple of Frame
        In the order of time, one of them the reference and one the closed frame.
    chordae : Chordae
    uncertainty : Uncertainty
    derived : tuple of str
        Sentences, one for everything that was not given but derived.
    sha256 : str
        Of all files of the folder; empty for a case that was not read from one.
    """

    name: str
    description: str
    source: str
    licence: str
    simulated: bool
    surface: LeafletSurface
    annulus: IntArray
    free_edge: IntArray
    frames: tuple[Frame, ...]
    chordae: Chordae
    uncertainty: Uncertainty
    derived: tuple[str, ...] = ()
    sha256: str = ""

    def __post_init__(self) -> None:
        for role in (Role.REFERENCE, Role.CLOSED):
            found = [frame.name for frame in self.frames if frame.role is role]
            if len(found) != 1:
                raise InputError(
                    f"case {self.name}: {len(found)} frames with the role {role.value} "
                    f"({', '.join(found) or 'none'}), expected one"
                )
        names = [frame.name for frame in self.frames]
        if len(set(names)) != len(names):
            raise InputError(f"case {self.name}: frame names {names} are not all different")
        times = [frame.time for frame in self.frames]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise InputError(f"case {self.name}: frame times {times} s do not increase")

    def frame(self, role: Role) -> Frame:
        """The only frame of a role (reference or closed)."""
        return next(frame for frame in self.frames if frame.role is role)

    @property
    def held_out(self) -> tuple[Frame, ...]:
        """The frames that no filter is shown."""
        return tuple(frame for frame in self.frames if frame.role is Role.HELD_OUT)

    @property
    def valve(self) -> Valve:
        """The valve at rest, with its boundary's way to the closed frame."""
        reference, closed = self.frame(Role.REFERENCE), self.frame(Role.CLOSED)
        return Valve(
            self.surface,
            self.annulus,
            self.free_edge,
            reference.papillary_tips,
            self.chordae,
            Motion(
                np.array([0.0, 1.0]),
                np.stack([self.surface.vertices[self.annulus], closed.annulus]),
                np.stack([reference.papillary_tips, closed.papillary_tips]),
            ),
        )
