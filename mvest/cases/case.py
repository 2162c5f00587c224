"""One case: a valve at rest and its observations in further frames.

A case is all that an estimation knows of a patient. It is read from a folder
(`mvest.cases.folder`) or written by a simulation. It does not contain the moduli. All lengths are
mm, times s.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any
from unicodedata import normalize

import numpy as np

from mvest.errors import InputError
from mvest.reading.npz import check_array
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve

MIN_SAMPLES, MAX_SAMPLES = 4, 500
LARGEST_ERROR = 20.0
"""mm, largest displacement of a point in any sample."""


class Role(StrEnum):
    """Purpose of a frame."""

    REFERENCE = "reference"
    """Open; the model's geometry is made of it."""
    CLOSED = "closed"
    """The closed frame that is fitted."""
    FITTED = "fitted"
    """A further closed frame that is fitted, with another pressure, annulus and tips."""
    HELD_OUT = "held_out"
    """No filter sees it; the fitted valve is tested against it."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The valve as observed at one instant."""

    name: str
    time: float  #: s
    role: Role
    pressure_mmHg: float  #: transmitral, positive if it closes the valve
    vertices: FloatArray  #: (n, 3) mm
    triangles: IntArray  #: (m, 3)
    region: IntArray  #: (m,) index into the regions of the case
    annulus: FloatArray  #: (k, 3) mm, the annulus vertices of the *reference* in this frame
    free_edge: FloatArray  #: (j, 3) mm, closed curve
    papillary_tips: FloatArray  #: (t, 3) mm
    corresponds: bool  #: vertex i is the same material point as vertex i of the reference


def check_different(
    field: str, names: Sequence[str], wrong: Callable[[str, str], InputError]
) -> None:
    """Raise ``wrong(field, what)`` unless names differ by more than case, spaces and NFKC form."""
    seen: dict[str, str] = {}
    for name in names:
        key = " ".join(normalize("NFKC", name).casefold().split())
        if key in seen:
            fault = "occurs twice" if seen[key] == name else f"and {seen[key]!r} look the same"
            raise wrong(field, f"the name {name!r} {fault}; expected different names")
        seen[key] = name


def check_frames(frames: Sequence[Any], wrong: Callable[[str, str], InputError]) -> None:
    """Raise ``wrong(field, what)`` unless names, times, roles and tips of frames are consistent.

    ``frames`` are those of a case or of its file (`mvest.cases.schema.FrameEntry`).
    """
    names = [frame.name for frame in frames]
    check_different("frames", names, wrong)
    tips = len(frames[0].papillary_tips)
    for number, (a, b) in enumerate(itertools.pairwise(frames), start=1):
        if b.time <= a.time:
            what = f"{b.time:g} of {b.name!r} is not after {a.time:g} of {a.name!r}"
            raise wrong(f"frames.{number}.time", f"{what}; put the frames in the order of time")
        if len(b.papillary_tips) != tips:
            raise wrong(
                f"frames.{number}.papillary_tips",
                f"{len(b.papillary_tips)} tips, but {tips} in frame {names[0]!r}; expected the "
                "same tips in the same order in all frames",
            )
    for role in (Role.REFERENCE, Role.CLOSED)[: len(frames)]:
        members = [frame.name for frame in frames if frame.role == role]
        if len(members) != 1:
            listed = ", ".join(members) or "none"
            what = f"{len(members)} frames have the role {role} ({listed}), expected exactly one"
            raise wrong("frames", what)


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Errors of the observed vertices."""

    std_mm: float | FloatArray  #: of each coordinate, of all vertices or of each vertex (n,)
    correlation_length_mm: float = 0.0  #: along the leaflets; 0: independent

    def __post_init__(self) -> None:
        std = np.array(self.std_mm, dtype=np.float64)
        if std.ndim > 1:
            raise InputError(f"observation std_mm: shape {std.shape}, expected one number or (n,)")
        bad = np.flatnonzero(~(np.isfinite(std) & (std > 0)))
        if len(bad):
            at = f" at vertex {bad[0]} ({len(bad)} vertices in all)" if std.ndim else ""
            raise InputError(f"observation std_mm = {std.flat[bad[0]]:g}{at}, expected > 0")
        length = self.correlation_length_mm
        if not (np.isfinite(length) and length >= 0):
            raise InputError(f"observation correlation_length_mm = {length}, expected >= 0")
        if std.ndim == 1:
            std.setflags(write=False)
            object.__setattr__(self, "std_mm", std)

    @property
    def typical_mm(self) -> float:
        """The standard deviation, or its root mean square over the vertices."""
        if isinstance(self.std_mm, np.ndarray):
            return float(np.sqrt(np.mean(self.std_mm**2)))
        return float(self.std_mm)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSamples:
    """Joint errors of all frames: samples of the true valve relative to the observed one.

    Errors of the frames that a model is built from (its open shape, the motion of its boundary, the
    lengths of its chordae) are not observation noise: they change what is predicted. Each sample is
    one possible error of all frames together.

    Samples of one source, such as an error and its mirror image, depend on each other.
    """

    #: (K, f, n, 3) mm, from the observed to the true position of each vertex in each frame of the
    #: case, in the axes of the case. Annulus and free edge move with their vertices.
    vertices: FloatArray
    tips: FloatArray  #: (K, f, t, 3) mm, the same of the papillary tips
    source: IntArray | None = None  #: (K,) number of each sample's source; None: all independent

    def __post_init__(self) -> None:
        for name in ("vertices", "tips"):
            given, where = np.asarray(getattr(self, name)), f"error samples, {name}"
            values = check_array(given, where, "f", (None, None, None, 3))
            bad = np.argwhere(np.abs(values) > LARGEST_ERROR)
            if len(bad):
                at = tuple(bad[0].tolist())
                raise InputError(
                    f"{where}: {values[at]} mm at {at}, expected at most {LARGEST_ERROR:g} mm"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if self.vertices.shape[:2] != self.tips.shape[:2]:
            raise InputError(
                f"error samples: {self.vertices.shape[:2]} samples and frames of the vertices, "
                f"{self.tips.shape[:2]} of the tips; expected as many"
            )
        if self.source is not None:
            given = np.asarray(self.source)
            source = check_array(given, "error samples, source", "i", (len(self),))
            source.setflags(write=False)
            object.__setattr__(self, "source", source)
        if not MIN_SAMPLES <= len(self) <= MAX_SAMPLES:
            raise InputError(f"{len(self)} error samples, expected {MIN_SAMPLES} to {MAX_SAMPLES}")

    def __len__(self) -> int:
        return len(self.vertices)


@dataclass(frozen=True, slots=True)
class Arrival:
    """By which way the geometry of a case arrived."""

    way: str  #: volume, surfaces, labels or vertices
    made_by: str = ""  #: SHA-256 of what made it of the data, such as detectors


@dataclass(frozen=True, slots=True, eq=False)
class ValveCase:
    """A valve and its observations."""

    name: str
    description: str
    source: str
    licence: str
    #: Whether the frames come from a simulation, which every picture and table then states.
    simulated: bool
    #: Midsurface of the reference frame with thickness and fibres; it has the vertices and
    #: triangles of the reference frame.
    surface: LeafletSurface
    annulus: IntArray  #: (k,) vertices of ``surface`` in loop order
    free_edge: IntArray  #: (j,) likewise
    #: In the order of time, one of them the reference and one the closed frame; or the reference
    #: alone, for an anatomy without an observed closure.
    frames: tuple[Frame, ...]
    chordae: Chordae
    uncertainty: Uncertainty
    #: Sentences, one for everything that was derived instead of given.
    derived: tuple[str, ...] = ()
    sha256: str = ""  #: of all files of the folder; empty for a case that was not read from one
    #: Joint errors of all frames, in their order; all frames correspond then.
    error_samples: ErrorSamples | None = None
    #: Whether chordae are laid out by the shape of the frames, and laid out again for each error
    #: sample. Otherwise they are measured.
    chordae_follow: bool = False
    arrival: Arrival | None = None  #: None: not stated

    def __post_init__(self) -> None:
        check_frames(self.frames, self._wrong)
        self._check_uncertainty()

    def _wrong(self, field: str, what: str) -> InputError:
        return InputError(f"case {self.name}: {field}: {what}")

    def _check_uncertainty(self) -> None:
        n, std, samples = len(self.surface.vertices), self.uncertainty.std_mm, self.error_samples
        if isinstance(std, np.ndarray):
            if std.shape != (n,):
                raise self._wrong("observation", f"std_mm of {len(std)} vertices, expected {n}")
            if self.closed is not None and not self.closed.corresponds:
                what = "std_mm of each vertex, but those of the closed frame do not correspond"
                raise self._wrong("observation", f"{what}; expected one number")
        if samples is None:
            return
        f, t = len(self.frames), len(self.frame(Role.REFERENCE).papillary_tips)
        names = self.surface.region_names
        if self.chordae_follow and (len(names) != 2 or "anterior" not in names or t != 2):
            what = "following error samples needs two regions, one of them anterior, and two "
            found = f"papillary tips (here: {', '.join(names)}; {t} tips)"
            raise self._wrong("chordae", what + found)
        for name, count in (("vertices", n), ("tips", t)):
            given = getattr(samples, name).shape[1:3]
            if given != (f, count):
                what = f"{name} of {given[0]} frames of {given[1]} points, expected {f} of {count}"
                raise self._wrong("error samples", what)
        for frame in self.frames:
            if not frame.corresponds:
                what = f"the vertices of frame {frame.name!r} do not correspond; expected that"
                raise self._wrong("error samples", f"{what} they do")

    def __str__(self) -> str:
        surface, tips = self.surface, self.frame(Role.REFERENCE).papillary_tips
        seen, length = self.uncertainty, self.uncertainty.correlation_length_mm
        frames = (
            f"frame {frame.name} ({frame.role.value}) at {frame.time:g} s, "
            f"{frame.pressure_mmHg:.3g} mmHg, {len(frame.vertices)} vertices, "
            f"{'same vertices as the reference' if frame.corresponds else 'no correspondence'}\n"
            for frame in self.frames
        )
        return (
            f"case {self.name}{' (simulated)' if self.simulated else ''}\n"
            f"{len(surface.vertices)} vertices, {len(surface.triangles)} triangles, leaflets "
            f"{', '.join(surface.region_names)}; {len(self.chordae.insertion)} chordae from "
            f"{len(tips)} papillary tips\n{''.join(frames)}seen within {seen.typical_mm:.3g} mm, "
            f"{f'correlated over {length:g} mm' if length else 'independent'}"
            + (f"; {len(self.error_samples)} error samples" if self.error_samples else "")
        )

    def frame(self, role: Role) -> Frame:
        """The only frame of a role (reference or closed); InputError if there is no closed one."""
        if role is Role.CLOSED and self.closed is None:
            raise InputError(
                f"case {self.name}: no closed frame, so there is nothing to estimate from; add one "
                "(role: closed), or simulate with this anatomy (valve=folder valve.folder=FOLDER)"
            )
        return next(frame for frame in self.frames if frame.role is role)

    @property
    def closed(self) -> Frame | None:
        """The closed frame; None for an anatomy alone."""
        return next((frame for frame in self.frames if frame.role is Role.CLOSED), None)

    @property
    def fitted(self) -> tuple[Frame, ...]:
        """The further frames to be fitted with the closed one."""
        return tuple(frame for frame in self.frames if frame.role is Role.FITTED)

    @property
    def held_out(self) -> tuple[Frame, ...]:
        """The frames that no filter sees."""
        return tuple(frame for frame in self.frames if frame.role is Role.HELD_OUT)

    @property
    def valve(self) -> Valve:
        """The valve at rest with its boundary's motion to the closed frame, if there is one."""
        reference = self.frame(Role.REFERENCE)
        closed = self.closed or reference
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
