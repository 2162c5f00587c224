"""Populations of simulated valves in motion: anatomies, moduli, pressures and timing drawn.

Every valve has its own random stream, spawned from the seed. So it does not depend on the number of
processes or on how often another valve was drawn again. They are stored in one ``.npz`` file.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
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
from mvest.reading.npz import read_npz
from mvest.simulation.motion import DrawnValve, MotionSettings, RefusedError, close_in_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

MAX_DRAWS = 20
"""Largest number of valves drawn until one closes."""

SCALE = (1.0, 1.5)
"""Range of the factor on the anatomical variation."""
TIP_MOTION_MM = (1.0, 3.0)
"""Range of the distance that a papillary tip moves during closure."""
MEDIANS = {
    "E_f.anterior": (6.23, 0.47),
    "E_f.posterior": (2.09, 0.47),
    "pressure_scale": (1.0, 0.15),
    "chord_stiffness": (1.0, 0.2),
    "chord_rest_length": (1.0, 0.02),
}
"""Median (moduli in MPa, the paper's for a normal valve) and SD of the logarithm: the prior of the
estimator (`mvest.personalisation.settings.default_settings`), so that detectors are calibrated on
the valves that it expects."""
DURATION_SPREAD = 0.15
"""SD of the logarithm of the duration about that of the settings."""


def draw_population(
    count: int,
    seed: int,
    bases: Mapping[str, TemplateParameters],
    settings: MotionSettings,
    mechanics: MechanicsSettings,
    *,
    processes: int = 1,
) -> Iterator[MovingValve]:
    """Draw and close valves, returned in their order.

    The median anatomies (``bases``, by name) are used equally often, in a random order. Durations
    are drawn about that of the settings. A single process is this one. InputError if no valve is
    requested or no anatomy given, GeometryError if a valve is refused `MAX_DRAWS` times.
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
    settings: MotionSettings,
    mechanics: MechanicsSettings,
) -> MovingValve:
    """The first valve that is not refused."""
    rng = np.random.default_rng(sequence)
    medians = {**MEDIANS, "duration": (settings.duration, DURATION_SPREAD)}
    reasons: list[str] = []
    while len(reasons) < MAX_DRAWS:
        template = Template(vary(base, rng, rng.uniform(*SCALE)))
        values = {
            parameter: median * float(np.exp(spread * rng.standard_normal()))
            for parameter, (median, spread) in medians.items()
        }
        motion = replace(settings, duration=values.pop("duration"))
        drawn = DrawnValve(name, template, values, mechanics, draw_tip_motion(template, rng))
        try:
            return close_in_motion(drawn, motion)
        except RefusedError as error:
            reasons.append(str(error))
    raise GeometryError(f"simulated valve {name}: refused {MAX_DRAWS} times: {'; '.join(reasons)}")


def draw_tip_motion(template: Template, rng: np.random.Generator) -> FloatArray:
    """Displacement of open from closed tips ``(2, 3)`` mm, towards their chordae's insertions.

    Away from them, chordae would be taut in the open valve, which must be free of stress.
    """
    direction = rng.standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    chordae, tips = template.chordae(), template.papillary_tips
    for k in range(2):
        towards = (chordae.insertion[chordae.end_tip == k] - tips[k]).mean(axis=0)
        direction[k] *= 1.0 if direction[k] @ towards > 0 else -1.0
    return np.asarray(direction * rng.uniform(*TIP_MOTION_MM, size=(2, 1)))


PARTS = ("times", "vertices", "tips", "thickness", "chord_phi", "chord_s", "chord_tip")
"""The stored arrays of a valve, besides the size of its layout."""


def save_population(path: Path, valves: Sequence[MovingValve]) -> None:
    """Write a population atomically, positions and times in single precision.

    InputError if the file cannot be written.
    """
    arrays: dict[str, Any] = {"names": np.array([valve.name for valve in valves])}
    for k, valve in enumerate(valves):
        arrays[f"{k}.layout"] = valve.layout.columns, valve.layout.rows
        for part in PARTS:
            kind = np.int32 if part == "chord_tip" else np.float32
            arrays[f"{k}.{part}"] = np.asarray(getattr(valve, part), kind)
    write_atomically(path, partial(np.savez_compressed, **arrays))


def load_population(path: Path) -> tuple[MovingValve, ...]:
    """Read what :func:`save_population` wrote; InputError if it is missing or malformed."""
    stored = read_npz(path)
    valves: list[MovingValve] = []
    try:
        for k, name in enumerate(stored["names"].tolist()):
            parts: dict[str, Any] = {
                part: stored[f"{k}.{part}"].astype(int if part == "chord_tip" else float)
                for part in PARTS
            }
            valves.append(MovingValve(name, ValveLayout(*stored[f"{k}.layout"].tolist()), **parts))
    except (KeyError, InputError) as error:
        missing = " is missing" if isinstance(error, KeyError) else ""
        raise InputError(f"{path}: {error}{missing}") from error
    return tuple(valves)
