"""Which frames of a sequence a case is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mvest.cases.checks import CLOSING_PRESSURE
from mvest.cases.from_images.measures import Row, closed_frame
from mvest.errors import InputError
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence


@dataclass(frozen=True, slots=True)
class CaseFrames:
    """Which frames of a sequence are used, by their numbers.

    Attributes
    ----------
    open, closed : int
    pressure_mmHg : float
        Transmitral pressure in the closed frame.
    held_out : mapping
        Further frames of the closed valve -> transmitral pressure in mmHg.
    derived : tuple of str
        How frames were chosen that were not stated.
    """

    open: int
    closed: int
    pressure_mmHg: float
    held_out: Mapping[int, float] = field(default_factory=dict)
    derived: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        used = [self.open, self.closed, *self.held_out]
        if len(set(used)) != len(used):
            raise InputError(f"frames {used} (open, closed, held out) are not all different")
        low, high = CLOSING_PRESSURE
        for frame, pressure in ((self.closed, self.pressure_mmHg), *self.held_out.items()):
            if not low <= pressure <= high:
                raise InputError(
                    f"pressure of frame {frame} = {pressure} mmHg on the closed valve, expected "
                    f"{low:g} to {high:g} mmHg"
                )

    @property
    def in_order(self) -> list[int]:
        """Numbers of all of them, in the order of time."""
        return sorted([self.open, self.closed, *self.held_out])


def choose_frames(
    sequence: ValveSequence,
    rows: Sequence[Row],
    pressure_mmhg: float,
    *,
    open_: int | None = None,
    closed: int | None = None,
    held_out: Mapping[int, float] | None = None,
    min_confidence: float = MIN_CONFIDENCE,
) -> CaseFrames:
    """Choose the frames that were not stated.

    The closed frame is the one in which the leaflets touch over the largest area, the open frame
    the one with the largest orifice, among frames that are as confident as asked for.

    Parameters
    ----------
    sequence : ValveSequence
    rows : sequence
        Measures of every frame (`mvest.cases.from_images.measure_sequence`).
    pressure_mmhg : float
        In the closed frame.
    open_, closed : int, optional
        Where they are stated.
    held_out : mapping, optional
        Frame -> pressure, mmHg.
    min_confidence : float
        Of a frame that is chosen.

    Raises
    ------
    InputError
        A frame that is stated does not exist, or none can be chosen.
    """
    count, held = len(sequence.times), dict(held_out or {})
    for name, number in (("open", open_), ("closed", closed), *(("held-out", k) for k in held)):
        if number is not None and not 0 <= number < count:
            raise InputError(f"{name} frame {number}, expected one of 0 to {count - 1}")
    sure = [
        row
        for row in rows
        if sequence.frame_confidence[int(row["frame"] or 0)] >= min_confidence
        and row["orifice_mm2"] is not None
    ]
    among = f"among {len(sure)} of {count} frames with a confidence of {min_confidence:g} or more"
    derived = []
    if closed is None:
        closed = closed_frame([row for row in sure if int(row["frame"] or 0) not in held])
        derived.append(
            f"closed frame: {closed}, whose leaflets touch over the largest area, {among}"
        )
    if open_ is None:
        others = [row for row in sure if int(row["frame"] or 0) not in {closed, *held}]
        best = max(others, key=lambda row: row["orifice_mm2"] or 0.0, default=None)
        open_ = None if best is None else int(best["frame"] or 0)
        derived.append(f"open frame: {open_}, with the largest orifice, {among}")
    if open_ is None or closed is None:
        highest = float(np.max(sequence.frame_confidence))
        raise InputError(
            f"no open and closed frame can be chosen {among} (the best: {highest:.2f}); give the "
            "frames, or landmarks by hand"
        )
    return CaseFrames(open_, closed, pressure_mmhg, held, tuple(derived))
