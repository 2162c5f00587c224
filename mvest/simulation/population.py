"""Populations of simulated valves in motion: anatomies, moduli, pressures and timing drawn.

Every valve has its own random stream, spawned from the seed. So it does not depend on the number of
processes or on how often another valve was drawn again.

A population is stored in one ``.npz`` file without pickled objects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.files import write_atomically
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.mechanics.settings import MechanicsSettings
from mvest.processes import side_by_side
from mvest.quantities import Factor, Length, Logarithm, Modulus
from mvest.reading.npz import check_array, read_npz
from mvest.simulation.motion import DrawnValve, MotionSettings, RefusedError, close_in_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

MAX_DRAWS = 20
"""Largest number of valves drawn until one closes."""


@dataclass(frozen=True, slots=True)
class PopulationSettings:
    """What is drawn. Spreads are standard deviations of logarithms."""

    motion: MotionSettings = field(default_factory=MotionSettings)  #: with the median duration
    scale: tuple[Factor, Factor] = (1.0, 1.5)  #: range of the factor on the anatomical variation
    moduli: Mapping[str, Modulus] = field(  #: medians in MPa, the paper's for a normal valve
        default_factory=lambda: {"E_f.anterior": 6.23, "E_f.posterior": 2.09}
    )
    moduli_spread: Logarithm = 0.35
    pressure_spread: Logarithm = 0.12
    chord_rest_length_spread: Logarithm = 0.015
    duration_spread: Logarithm = 0.15
    tip_motion: tuple[Length, Length] = (1.0, 3.0)  #: mm, range of each tip's way during closure

    def __post_init__(self) -> None:
        for name in ("scale", "tip_motion"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise InputError(f"population {name} = ({low}, {high}), expected 0 <= low <= high")


def draw_population(
    count: int,
    seed: int,
    bases: Mapping[str, TemplateParameters],
    settings: PopulationSettings,
    mechanics: MechanicsSettings,
    *,
    processes: int = 1,
) -> Iterator[MovingValve]:
    """Draw and close valves, returned in their order.

    The median anatomies (``bases``, by name) are used equally often, in a random order. A single
    process is this one. InputError if no valve is requested or no anatomy given, GeometryError if a
    valve is refused `MAX_DRAWS` times.
    """
    if count < 1 or processes < 1 or not bases:
        raise InputError(
            f"a population of {count} valves in {processes} processes from {len(bases)} anatomies, "
            "expected at least one of each"
        )
    root, names = np.random.SeedSequence(seed), list(bases)
    order = np.random.default_rng(root.spawn(1)[0]).permuted(
        np.resize(np.arange(len(names)), count)
    )
    jobs = [
        (f"{names[which]}_{seed}_{k:03d}", bases[names[which]], sequence, settings, mechanics)
        for k, (which, sequence) in enumerate(zip(order, root.spawn(count), strict=True))
    ]
    return side_by_side(_draw, jobs, processes)


def _draw(
    name: str,
    base: TemplateParameters,
    sequence: np.random.SeedSequence,
    settings: PopulationSettings,
    mechanics: MechanicsSettings,
) -> MovingValve:
    """The first valve that is not refused."""
    rng = np.random.default_rng(sequence)
    medians = {name: (median, settings.moduli_spread) for name, median in settings.moduli.items()}
    medians["pressure_scale"] = (1.0, settings.pressure_spread)
    medians["chord_rest_length"] = (1.0, settings.chord_rest_length_spread)
    medians["duration"] = (settings.motion.duration, settings.duration_spread)
    reasons: list[str] = []
    while len(reasons) < MAX_DRAWS:
        template = Template(vary(base, rng, rng.uniform(*settings.scale)))
        values = {
            parameter: median * float(np.exp(spread * rng.standard_normal()))
            for parameter, (median, spread) in medians.items()
        }
        motion = replace(settings.motion, duration=values.pop("duration"))
        tip_motion = draw_tip_motion(template, settings.tip_motion, rng)
        drawn = DrawnValve(name, template, values, mechanics, tip_motion)
        try:
            return close_in_motion(drawn, motion)
        except RefusedError as error:
            reasons.append(str(error))
    raise GeometryError(f"simulated valve {name}: refused {MAX_DRAWS} times: {'; '.join(reasons)}")


def draw_tip_motion(
    template: Template, reach: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Displacement of open from closed tips ``(2, 3)`` mm, towards their chordae's insertions.

    Farther away, chordae would be taut in the open valve, which must be free of stress. ``reach``
    is the range of the distance, mm.
    """
    direction = rng.standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    chordae, tips = template.chordae(), template.papillary_tips
    for k in range(2):
        towards = (chordae.insertion[chordae.tip == k] - tips[k]).mean(axis=0)
        direction[k] *= 1.0 if direction[k] @ towards > 0 else -1.0
    return np.asarray(direction * rng.uniform(*reach, size=(2, 1)))


SHAPES: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "layout": ("i", (2,)), "times": ("f", (None,)), "vertices": ("f", (None, None, 3)),
    "tips": ("f", (None, 2, 3)), "thickness": ("f", (None,)), "chord_phi": ("f", (None,)),
    "chord_s": ("f", (None,)), "chord_tip": ("i", (None,)),
}  # fmt: skip
"""Array of a valve -> its kind (integer or float) and shape."""


def save_population(path: Path, valves: Sequence[MovingValve]) -> None:
    """Write a population atomically, positions and times in single precision.

    InputError if the file cannot be written.
    """
    arrays: dict[str, Any] = {"names": np.array([valve.name for valve in valves])}
    for k, valve in enumerate(valves):
        size = {"layout": (valve.layout.columns, valve.layout.rows)}
        for name, (kind, _) in SHAPES.items():
            values = size.get(name) or getattr(valve, name)
            arrays[f"{k}.{name}"] = np.asarray(values, np.int32 if kind == "i" else np.float32)
    write_atomically(path, partial(np.savez_compressed, **arrays))


def load_population(path: Path) -> tuple[MovingValve, ...]:
    """Read what :func:`save_population` wrote; InputError if it is missing or malformed."""
    stored = read_npz(path)
    valves: list[MovingValve] = []
    try:
        for k, name in enumerate(stored["names"].tolist()):
            own: dict[str, Any] = {
                part: check_array(stored[f"{k}.{part}"], f"{k}.{part}", *expected)
                for part, expected in SHAPES.items()
            }
            own["layout"] = ValveLayout(*own["layout"].tolist())
            valves.append(MovingValve(name, **own))
    except (KeyError, InputError) as error:
        missing = " is missing" if isinstance(error, KeyError) else ""
        raise InputError(f"{path}: {error}{missing}") from error
    return tuple(valves)
