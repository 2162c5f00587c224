r"""Tests whether the closed valve jumps while a modulus changes; curvature is not a jump.

The closed state of any valve is a curved function of the moduli, so differences over wide steps
disagree with the derivative. A well-behaved valve does not jump, though. Given the exact derivative
d = dx / d log E at two states, the unexplained part of their distance is

.. math:: r = x_b - x_a - \tfrac12 (d_a + d_b) \log (E_b / E_a) .

For a smooth response this error of the trapezoidal rule is -x''' h^3 / 12: halving the step leaves
an eighth. A jump does not shrink with the step. A kink (slope change k) leaves at most
k h / 2. A piece of the path is halved if more than `JUMP_LIMIT` of any vertex or more than
`SLOPE_LIMIT` of the motion of all vertices is unexplained, until it is narrower than `RESOLUTION`.
The path then fails if

* the unexplained motion of a vertex exceeds `JUMP_LIMIT`, which is a jump;
* more than `SLOPE_LIMIT` of a piece's motion is unexplained, and some vertex has more than `SEEN`
  of unexplained motion;
* the unexplained parts add up to more than `SLOPE_LIMIT` of the whole motion, as happens if
  derivatives are wrong everywhere or there are many small jumps;
* a state's derivative leaves more than `SIDE_LIMIT` unexplained on both sides. At a kink it is
  right on one side.

The test does not detect: states that leave and return between two neighbours; jumps smaller than
the limit; a derivative that is wrong only at an end of the path; and whether a change steeper than
the resolution is continuous, which does not affect an estimate of that modulus.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mvest.typing import FloatArray

JUMP_LIMIT = 0.1
"""mm, largest accepted unexplained motion of any vertex; equals the gate's limit on the mean."""
SLOPE_LIMIT = 0.05
"""Largest accepted unexplained fraction of the motion of all vertices, per piece and in total."""
SEEN = 0.02
"""mm, smallest motion of a single point that an estimator can see: `resolution_mm` of
:class:`mvest.observation.learned.ErrorBeliefs`."""
SIDE_LIMIT = 0.2
"""Unexplained fraction on both sides of a state above which its derivative, and hence the width of
an interval, is wrong by half (if it is half too large: h d / 4 of 5 h d / 4)."""
RESOLUTION = 0.02
"""Width in log E below which a piece is no longer halved."""
ROUND_OFF = 1e-6
"""mm, unexplained motion below this counts as zero."""


@dataclass(frozen=True, slots=True, eq=False)
class PathState:
    """A closed state and its derivative along a path."""

    y: FloatArray  #: (n, 3) mm
    slope: FloatArray  #: (n, 3) mm, per unit of the logarithm of the factor


@dataclass(frozen=True, slots=True)
class Piece:
    """The part of a path between two neighbouring states."""

    #: factors on the moduli
    low: float
    high: float
    unexplained_mm: float  #: largest unexplained motion of a vertex
    vertices: int  #: number of vertices that exceed `JUMP_LIMIT`
    #: mm, unexplained motion and whole motion by the derivatives; norms over all vertices
    unexplained: float
    way: float

    @classmethod
    def between(cls, low: float, high: float, states: Mapping[float, PathState]) -> Piece:
        """The piece between the states at two factors."""
        a, b, width = states[low], states[high], np.log(high / low)
        unexplained = b.y - a.y - 0.5 * width * (a.slope + b.slope)
        at_vertex = np.linalg.norm(unexplained, axis=1)
        way = 0.5 * width * float(np.linalg.norm(a.slope) + np.linalg.norm(b.slope))
        many = int((at_vertex > JUMP_LIMIT).sum())
        whole = float(np.linalg.norm(unexplained))
        return cls(low, high, float(at_vertex.max()), many, whole, way)

    @property
    def share(self) -> float:
        """Unexplained fraction of the motion; 0 for mere round-off."""
        return 0.0 if self.unexplained_mm <= ROUND_OFF else _share(self.unexplained, self.way)

    @property
    def explained(self) -> bool:
        """Whether the piece needs no halving."""
        return self.unexplained_mm <= JUMP_LIMIT and self.share <= SLOPE_LIMIT

    @property
    def width(self) -> float:
        """In log E."""
        return float(np.log(self.high / self.low))

    @property
    def fault(self) -> str:
        """Why the piece fails if it is not halved further; empty if it passes."""
        if self.explained or self.unexplained_mm <= SEEN:
            return ""
        where = f"between {_percent(self.low)} and {_percent(self.high)}"
        if self.unexplained_mm > JUMP_LIMIT:
            return f"a jump of {self.unexplained_mm:.2g} mm at {self.vertices} vertices {where}"
        return (
            f"the derivatives do not explain {100 * self.share:.2g} % of the motion {where}, up to "
            f"{self.unexplained_mm:.2g} mm"
        )


@dataclass(frozen=True, slots=True)
class Path:
    """Closed states along changing moduli."""

    name: str  #: what is changed
    pieces: tuple[Piece, ...]  #: in ascending order, after halving; up to the first that fails
    closures: int  #: number of computed states, without the central one
    reason: str  #: why it fails; empty if it passes

    @property
    def share(self) -> float:
        """Unexplained fraction of the whole motion; contributions of pieces do not cancel."""
        unexplained = sum(piece.unexplained for piece in self.pieces if piece.share > 0)
        return _share(unexplained, sum(piece.way for piece in self.pieces))

    @property
    def passed(self) -> bool:
        """Whether every piece is explained."""
        return not self.reason


def follow(
    name: str,
    close: Callable[[float], PathState | str],
    centre: PathState,
    factors: Sequence[float],
) -> Path:
    """Follow closed states along a factor on moduli and judge whether they jump.

    Parameters
    ----------
    name : str
    close : callable
        Maps a factor to a state, or to the reason why there is none.
    centre : PathState
        The state at factor 1.
    factors : sequence of float
        First other factors, below and above 1.
    """
    states: dict[float, PathState] = {1.0: centre}
    pieces: list[Piece] = []
    tried = 0

    def failure(factor: float) -> str:
        nonlocal tried
        tried += 1
        found = close(factor)
        if isinstance(found, str):
            return f"no closed state at {_percent(factor)}: {found}"
        states[factor] = found
        return ""

    for factor in factors:
        if reason := failure(factor):
            return Path(name, (), tried, reason)
    reason = ""
    # A stack, so that pieces are finished in ascending order.
    waiting = [*pairwise(sorted(states))][::-1]
    while waiting and not reason:
        low, high = waiting.pop()
        piece = Piece.between(low, high, states)
        if piece.explained or piece.width < RESOLUTION:
            pieces.append(piece)
            reason = piece.fault
            continue
        middle = float(np.sqrt(low * high))
        reason = failure(middle)
        waiting += [(middle, high), (low, middle)]
    path = Path(name, tuple(pieces), tried, reason)
    for left, right in pairwise(pieces):
        if not reason and min(left.share, right.share) > SIDE_LIMIT:
            reason = (
                f"the derivative at {_percent(left.high)} explains neither side: "
                f"{100 * left.share:.2g} and {100 * right.share:.2g} % of the motion are left"
            )
    if not reason and path.share > SLOPE_LIMIT:
        reason = f"the derivatives do not explain {100 * path.share:.2g} % of the whole motion"
    return replace(path, reason=reason)


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0 else float("inf") if part else 0.0


def _percent(factor: float) -> str:
    return f"{100 * (factor - 1):+.3g} %"
