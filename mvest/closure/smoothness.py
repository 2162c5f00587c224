r"""Does the closed valve jump while a modulus changes? Curvature told from jumps.

A closed state bends with the moduli, and the more the farther they are changed, so that differences
over wide steps disagree with the derivative in any healthy valve. What a healthy valve does not do
is jump. With the exact derivative d = dx / d log E at every state, the way from one state to the
next is known but for what their derivatives do not explain,

.. math:: r = x_b - x_a - \tfrac12 (d_a + d_b) \log (E_b / E_a) .

The trapezoidal rule leaves of a smooth response a third-order term, -x''' h^3 / 12: half the step,
an eighth. A jump stays whole, whatever the step. A kink (a slope that changes by k) leaves at most
k h / 2, which falls in proportion. So a piece with more than `JUMP_LIMIT` unexplained at any one
vertex, or more than `SLOPE_LIMIT` of its way over all vertices, is halved until it is explained or
narrower than `RESOLUTION`. A path is not passed if then

* a vertex moves by more than `JUMP_LIMIT` unexplained: a jump, which no mean may hide;
* or more than `SLOPE_LIMIT` of a piece's way is unexplained and it can be seen: a vertex moves by
  more than `SEEN`. A share of a way that is itself too short to be seen says nothing;
* or what is unexplained adds up to more than `SLOPE_LIMIT` of the whole way: derivatives that are
  wrong everywhere, or many small jumps, which no piece shows;
* or a state's derivative explains neither of its two sides to `SIDE_LIMIT`. At a kink it is right
  on one of them.

What this cannot see: states that leave and come back between two neighbours; a jump smaller than
the limit; a derivative that is wrong at an end of the path alone; and whether a change steeper than
the resolution is continuous, which to an estimator of that modulus is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mvest.typing import FloatArray

JUMP_LIMIT = 0.1
"""mm, largest accepted unexplained move of any vertex: what other numerics may move in the mean."""
SLOPE_LIMIT = 0.05
"""Largest accepted unexplained part of a way, over all vertices, piece by piece and in all."""
SEEN = 0.02
"""mm, what no estimator sees of a single point: as `resolution_mm` of the errors that are learned
(:class:`mvest.observation.learned.ErrorBeliefs`)."""
SIDE_LIMIT = 0.2
"""Unexplained part of the way on both sides of a state from which its derivative is called wrong,
by half (of one half too large: h d / 4 in 5 h d / 4), and with it the width of an interval."""
RESOLUTION = 0.02
"""Width in log E below which a piece is not halved any more."""
ROUND_OFF = 1e-6
"""mm, unexplained moves that are none."""


@dataclass(frozen=True, slots=True, eq=False)
class PathState:
    """A closed state and its derivative along a path.

    Attributes
    ----------
    y : (n, 3) mm
    slope : (n, 3) mm
        Per unit of the logarithm of the factor.
    """

    y: FloatArray
    slope: FloatArray


@dataclass(frozen=True, slots=True)
class Piece:
    """From one state to the next.

    Attributes
    ----------
    low, high : float
        Factors on the moduli.
    unexplained_mm : float
        Of the vertex at which it is largest.
    vertices : int
        How many have more than the limit.
    unexplained, way : float
        mm, of all vertices (the root of the sum of squares): what the derivatives do not explain of
        the way, and its length by the derivatives.
    """

    low: float
    high: float
    unexplained_mm: float
    vertices: int
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
        """The unexplained over the way; 0 where there is no more than round-off."""
        return 0.0 if self.unexplained_mm <= ROUND_OFF else _share(self.unexplained, self.way)

    @property
    def explained(self) -> bool:
        """Whether it need not be halved."""
        return self.unexplained_mm <= JUMP_LIMIT and self.share <= SLOPE_LIMIT

    @property
    def width(self) -> float:
        """In log E."""
        return float(np.log(self.high / self.low))

    @property
    def fault(self) -> str:
        """Why it fails where it cannot be halved; empty if it passes."""
        if self.explained or self.unexplained_mm <= SEEN:
            return ""
        where = f"between {_percent(self.low)} and {_percent(self.high)}"
        if self.unexplained_mm > JUMP_LIMIT:
            return f"a jump of {self.unexplained_mm:.2g} mm at {self.vertices} vertices {where}"
        return (
            f"{100 * self.share:.2g} % of the way {where}, up to {self.unexplained_mm:.2g} mm, is "
            "not what the derivatives say"
        )


@dataclass(frozen=True, slots=True)
class Path:
    """Closed states along changing moduli.

    Attributes
    ----------
    name : str
        What is changed.
    pieces : tuple of Piece
        In ascending order, after halving; up to the first that cannot be explained.
    closures : int
        How many states were computed, without the middle one.
    reason : str
        Why it is not passed; empty if it is.
    """

    name: str
    pieces: tuple[Piece, ...]
    closures: int
    reason: str

    @property
    def share(self) -> float:
        """Unexplained share of the whole way: over all pieces, nothing cancels."""
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
        Factor -> state, or the reason why there is none.
    centre : PathState
        At the factor 1.
    factors : sequence of float
        Where else the path is looked at first, below and above 1.
    """
    states: dict[float, PathState] = {1.0: centre}
    pieces: list[Piece] = []
    tried, reason = 0, ""

    def missing(factor: float) -> str:
        nonlocal tried
        tried += 1
        found = close(factor)
        if isinstance(found, str):
            return f"no closed state at {_percent(factor)}: {found}"
        states[factor] = found
        return ""

    for factor in factors:
        if reason := missing(factor):
            return Path(name, (), tried, reason)
    # The last one is looked at first, so that pieces come in ascending order.
    waiting = [*pairwise(sorted(states))][::-1]
    while waiting and not reason:
        low, high = waiting.pop()
        piece = Piece.between(low, high, states)
        if piece.explained or piece.width < RESOLUTION:
            pieces.append(piece)
            reason = piece.fault
            continue
        middle = float(np.sqrt(low * high))
        reason = missing(middle)
        waiting += [(middle, high), (low, middle)]
    path = Path(name, tuple(pieces), tried, reason)
    return replace(path, reason=reason or _overall(path))


def _overall(path: Path) -> str:
    """Why pieces that pass one by one do not pass together; empty if they do."""
    for left, right in pairwise(path.pieces):
        if min(left.share, right.share) > SIDE_LIMIT:
            return (
                f"the derivative at {_percent(left.high)} explains neither side of it: "
                f"{100 * left.share:.2g} and {100 * right.share:.2g} % of the way are left"
            )
    if path.share > SLOPE_LIMIT:
        return f"{100 * path.share:.2g} % of the whole way is not what the derivatives say"
    return ""


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0 else float("inf") if part else 0.0


def _percent(factor: float) -> str:
    return f"{100 * (factor - 1):+.3g} %"
