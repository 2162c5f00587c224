"""How many closed frames under how well known pressures it takes to know the moduli of a case.

From derivatives at the generic moduli alone, nothing is estimated: information adds up over frames
whose errors are independent, what is not known of pressures, chordae, displacement and geometry is
common to them. Each design is a few small matrices; all of them need one set of closures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.closure.frames import ERROR, OFFSET, SCALE
from mvest.estimation.information.design import Design, together
from mvest.estimation.information.identifiability import Identifiability

__all__ = [
    "ERRORS_MMHG",
    "GROUPS",
    "HALF",
    "KINDS",
    "KIND_WORDS",
    "SHARES",
    "FrameDesigns",
    "StatedErrors",
    "design_text",
]

SHARES = (1.0, 0.875, 0.75, 0.625, 0.5)
"""Of the closed frame's pressure, under which the frames of designs are: 120 to 60 mmHg."""

HALF = 0.5
"""Of the prior's standard deviation, at which half the error of the generic guess is left."""


KINDS = ("factor", "offset", "each")
"""Of errors of pressures: a factor on all of them, an offset of all, and one of each by itself."""

ERRORS_MMHG = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Errors of pressures that are looked at."""

KIND_WORDS = {
    "factor": "as a factor on all",
    "offset": "as an offset of all",
    "each": "of each by itself",
}

GROUPS: dict[str, tuple[str, ...]] = {
    "the pressures": (SCALE, OFFSET, ERROR),
    "the chordae": ("chord_stiffness", "chord_rest_length"),
    "the displacement": ("shift", "turn"),
    "the geometry": ("geometry",),
}

EXACT = 1e-9
"""Relative error of a factor that is known; zero would take it out of what is estimated."""


@dataclass(frozen=True, slots=True)
class StatedErrors:
    """Standard deviations of errors of pressures: relative of the factor, the others in mmHg."""

    factor: float
    offset: float
    each: float

    @classmethod
    def of_kind(cls, kind: str, mmhg: float, pressure_mmHg: float) -> StatedErrors:
        """Errors of one of `KINDS` and of no other, as large under a pressure."""
        sizes = {one: mmhg if one == kind else 0.0 for one in KINDS}
        return cls(max(sizes["factor"] / pressure_mmHg, EXACT), sizes["offset"], sizes["each"])


@dataclass(frozen=True, slots=True, eq=False)
class FrameDesigns:
    """What closed frames of one valve say together.

    Attributes
    ----------
    pressures_mmHg : tuple of float
        Stated of the frames, the closed one's first.
    frames : tuple of Design
        What each of them says of all unknowns: those of the case, the pressures' errors in mmHg
        (`mvest.closure.frames`) and, where it is considered, the geometry's.
    knowledge : mapping
        Unknown but those errors -> its prior's standard deviation, relative or in its unit.
    stated : StatedErrors
        Errors of the pressures as they are stated.
    """

    pressures_mmHg: tuple[float, ...]
    frames: tuple[Design, ...]
    knowledge: Mapping[str, float]
    stated: StatedErrors

    @property
    def moduli(self) -> tuple[str, ...]:
        """Names of the moduli."""
        return tuple(name for name in self.knowledge if name.startswith("E_f."))

    def chosen(self, count: int) -> tuple[int, ...]:
        """Which frames make a design of ``count``: spread evenly over the pressures."""
        if count == 1:
            return (0,)
        return tuple(np.round(np.linspace(0, len(self.frames) - 1, count)).astype(int).tolist())

    def at(
        self, count: int, errors: StatedErrors | None = None, known: tuple[str, ...] = ()
    ) -> Identifiability:
        """What ``count`` frames and the prior say together.

        Parameters
        ----------
        count : int
        errors : StatedErrors, optional
            Of the pressures; default as stated.
        known : tuple of str
            Further unknowns that are taken to be known exactly, by the first part of their names.
        """
        errors = errors or self.stated
        members = self.chosen(count)
        knowledge = dict(self.knowledge)
        if SCALE in knowledge:
            knowledge[SCALE] = errors.factor
        for name in self.frames[0].names:
            kind, _, number = name.partition(".")
            if kind == OFFSET:
                knowledge[name] = errors.offset
            elif kind == ERROR:
                knowledge[name] = errors.each if int(number) in members else 0.0
        knowledge |= {n: 0.0 for n in self.frames[0].names if n.partition(".")[0] in known}
        return together(*(self.frames[k] for k in members)).at(1.0, knowledge)

    def left(
        self, count: int, errors: StatedErrors | None = None, known: tuple[str, ...] = ()
    ) -> dict[str, float]:
        """`shares` of what `at` says."""
        return self.shares(self.at(count, errors, known))

    def enough(self, modulus: str, errors: StatedErrors | None = None) -> int | None:
        """How many frames leave half of the generic guess's error or less; None: all leave more."""
        for count in range(1, len(self.frames) + 1):
            if self.left(count, errors)[modulus] <= HALF:
                return count
        return None

    def shares(self, bound: Identifiability) -> dict[str, float]:
        """Standard deviation of each modulus as a share of the prior's.

        The generic guess has 1: it is what is left of its error.
        """
        std = dict(zip(bound.names, map(float, bound.std), strict=True))
        return {modulus: std[modulus] / self.knowledge[modulus] for modulus in self.moduli}


def design_text(title: str, designs: FrameDesigns) -> str:
    """A table for a terminal: what is left of the generic guess's error, and what it takes.

    Shares are in percent, one for each modulus.
    """
    names = [modulus.partition(".")[2] for modulus in designs.moduli]
    pressures, own = designs.pressures_mmHg, designs.stated
    rows = {
        f"as stated ({100 * own.factor:.3g} % in common, offset {own.offset:g}, each {own.each:g})":
        None,
        "none": StatedErrors.of_kind("each", 0.0, pressures[0]),
    }  # fmt: skip
    rows |= {
        f"{mmhg:g} mmHg {KIND_WORDS[kind]}": StatedErrors.of_kind(kind, mmhg, pressures[0])
        for kind in KINDS
        for mmhg in (5.0, 20.0)
    }
    counts = range(1, len(designs.frames) + 1)
    width = max(map(len, rows))
    lines = [
        f"{title}: closed frames like this one under {', '.join(f'{p:.3g}' for p in pressures)} "
        f"mmHg; what they leave of the generic guess's error, {' / '.join(names)} (%)",
        f"  {'errors of the pressures':<{width}}"
        + "".join(f"{f'{n} frame' + 's' * (n > 1):>10}" for n in counts),
    ]
    for label, errors in rows.items():
        left = (designs.left(n, errors).values() for n in counts)
        cells = ("/".join(f"{100 * share:.0f}" for share in shares) for shares in left)
        lines.append(f"  {label:<{width}}" + "".join(f"{cell:>10}" for cell in cells))
    return "\n".join([*lines, *(f"  {_enough(designs, modulus)}" for modulus in designs.moduli)])


def _enough(designs: FrameDesigns, modulus: str) -> str:
    """What it takes for half the generic guess's error, or what keeps that from being reached."""
    name, largest = modulus.partition(".")[2], len(designs.frames)
    count = designs.enough(modulus)
    if count is not None:
        frames = "this frame" if count == 1 else f"{count} frames"
        return (
            f"E_f {name}: half of it is left with {frames} and pressures as stated; with errors of "
            "one kind alone, up to "
            + ", ".join(f"{_widest(designs, modulus, count, k):.0f} mmHg ({k})" for k in KINDS)
        )
    exact = designs.enough(modulus, StatedErrors.of_kind("each", 0.0, designs.pressures_mmHg[0]))
    if exact is not None:
        return (
            f"E_f {name}: half of it is left with {exact} frame{'s' * (exact > 1)} if the "
            f"pressures are exact, not with {largest} as they are stated"
        )
    names = {name.partition(".")[0] for name in designs.frames[0].names}
    left = {
        words: designs.left(largest, known=known)[modulus]
        for words, known in GROUPS.items()
        if names & set(known)
    }
    best = min(left, key=lambda words: left[words])
    return (
        f"E_f {name}: more than half of it is left with {largest} frames, also if the pressures "
        f"were exact; to know {best} would help best ({100 * left[best]:.0f} % left)"
    )


def _widest(designs: FrameDesigns, modulus: str, count: int, kind: str) -> float:
    """The largest of some errors (mmHg) of one kind with which half is reached."""
    sizes = {
        mmhg: designs.left(count, StatedErrors.of_kind(kind, mmhg, designs.pressures_mmHg[0]))
        for mmhg in ERRORS_MMHG
    }
    return max((mmhg for mmhg, left in sizes.items() if left[modulus] <= HALF), default=0.0)
