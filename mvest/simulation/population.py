"""Populations of simulated valves in motion: anatomies, moduli, pressures and timing drawn.

Every valve has a random stream of its own, spawned from the seed, so that it does not depend on
how many processes work or on how often another valve was drawn again.

A population is kept in one ``.npz`` file without pickled objects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import GeometryError, InputError, require_numbers
from mvest.files import write_atomically
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.mechanics.settings import MechanicsSettings
from mvest.processes import side_by_side
from mvest.provenance import config_hash
from mvest.quantities import Factor, Length, Logarithm, Modulus
from mvest.reading.npz import check_array, read_npz
from mvest.simulation.motion import MotionSettings, RefusedError, close_in_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

MAX_DRAWS = 20
"""Valves drawn in a row until one closes."""


@dataclass(frozen=True, slots=True)
class PopulationSettings:
    """What is drawn. Spreads are standard deviations of logarithms.

    Attributes
    ----------
    motion : MotionSettings
        ``duration`` is the median one.
    scale : (float, float)
        Range of the factor on the anatomical variation (:mod:`mvest.valve.anatomy.variation`).
    moduli : mapping
        Parameter -> median in MPa, the paper's for a normal valve.
    moduli_spread : float
    pressure_spread : float
    chord_rest_length_spread : float
    duration_spread : float
    tip_motion : (float, float)
        mm, range of the distance that each papillary tip goes during closure.
    """

    motion: MotionSettings = field(default_factory=MotionSettings)
    scale: tuple[Factor, Factor] = (1.0, 1.5)
    moduli: Mapping[str, Modulus] = field(
        default_factory=lambda: {"E_f.anterior": 6.23, "E_f.posterior": 2.09}
    )
    moduli_spread: Logarithm = 0.35
    pressure_spread: Logarithm = 0.12
    chord_rest_length_spread: Logarithm = 0.015
    duration_spread: Logarithm = 0.15
    tip_motion: tuple[Length, Length] = (1.0, 3.0)

    def __post_init__(self) -> None:
        for name in ("scale", "tip_motion"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise InputError(f"population {name} = ({low}, {high}), expected 0 <= low <= high")
        spreads = "moduli_spread", "pressure_spread", "chord_rest_length_spread", "duration_spread"
        require_numbers(self, "population", *spreads, least=0)


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Simulated valves.

    Attributes
    ----------
    valves : tuple of MovingValve
    refused : mapping
        Reason -> how many valves were drawn again for it.
    settings_hash : str
        Of everything that they were made from (:func:`population_hash`).
    """

    valves: tuple[MovingValve, ...]
    refused: Mapping[str, int]
    settings_hash: str


def draw_population(
    count: int,
    seed: int,
    bases: Mapping[str, TemplateParameters],
    settings: PopulationSettings,
    mechanics: MechanicsSettings,
    *,
    processes: int = 1,
    progress: Callable[[int, MovingValve], None] | None = None,
) -> Population:
    """Draw and close valves.

    Parameters
    ----------
    count, seed : int
    bases : mapping
        Name -> median anatomy; they take turns, in a random order.
    settings : PopulationSettings
    mechanics : MechanicsSettings
    processes : int
        1 computes here, without further processes.
    progress : callable, optional
        Called with the number of each valve and the valve, in their order.

    Raises
    ------
    InputError
        If nothing is asked for or known, or a valve is refused 20 times in a row.
    """
    if count < 1 or processes < 1 or not bases:
        raise InputError(
            f"a population of {count} valves in {processes} processes from {len(bases)} anatomies, "
            "expected at least one of each"
        )
    known = population_hash(count, seed, bases, settings, mechanics)
    root = np.random.SeedSequence(seed)
    names = list(bases)
    order = np.random.default_rng(root.spawn(1)[0]).permuted(
        np.resize(np.arange(len(names)), count)
    )
    jobs = [
        (f"{names[which]}_{seed}_{k:03d}", bases[names[which]], sequence)
        for k, (which, sequence) in enumerate(zip(order, root.spawn(count), strict=True))
    ]
    made = side_by_side(_draw, ((*job, settings, mechanics) for job in jobs), processes)
    valves, refused = [], Counter[str]()
    for k, (valve, reasons) in enumerate(made):
        valves.append(valve)
        refused.update(reasons)
        if progress is not None:
            progress(k, valve)
    return Population(tuple(valves), dict(refused), known)


def population_hash(
    count: int,
    seed: int,
    bases: Mapping[str, TemplateParameters],
    settings: PopulationSettings,
    mechanics: MechanicsSettings,
) -> str:
    """SHA-256 of what a population is drawn from; the code is not part of it."""
    described: dict[str, Any] = {
        "count": count,
        "seed": seed,
        "bases": [[name, asdict(parameters)] for name, parameters in bases.items()],
        "settings": asdict(settings),
        "mechanics": asdict(mechanics),
    }
    return config_hash(described)


def _draw(
    name: str,
    base: TemplateParameters,
    sequence: np.random.SeedSequence,
    settings: PopulationSettings,
    mechanics: MechanicsSettings,
) -> tuple[MovingValve, list[str]]:
    """A valve, and why others were refused before it."""
    rng = np.random.default_rng(sequence)
    reasons: list[str] = []
    while len(reasons) < MAX_DRAWS:
        template = Template(vary(base, rng, rng.uniform(*settings.scale)))
        values = {
            parameter: median * _factor(settings.moduli_spread, rng)
            for parameter, median in settings.moduli.items()
        }
        values["pressure_scale"] = _factor(settings.pressure_spread, rng)
        values["chord_rest_length"] = _factor(settings.chord_rest_length_spread, rng)
        duration = settings.motion.duration * _factor(settings.duration_spread, rng)
        tip_motion = draw_tip_motion(template, settings.tip_motion, rng)
        motion = replace(settings.motion, duration=duration)
        try:
            return close_in_motion(name, template, values, motion, mechanics, tip_motion), reasons
        except RefusedError as error:
            reasons.append(error.reason.value)
    raise GeometryError(f"simulated valve {name}: refused {MAX_DRAWS} times: {'; '.join(reasons)}")


def _factor(spread: float, rng: np.random.Generator) -> float:
    return float(np.exp(spread * rng.standard_normal()))


def draw_tip_motion(
    template: Template, reach: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Where open tips are relative to closed ones ``(2, 3)`` mm: nearer to their insertions.

    Farther away, chordae would be taut in the open valve, which is to be free of stress.

    Parameters
    ----------
    template : Template
    reach : (float, float)
        mm, range of the distance.
    rng : numpy.random.Generator
    """
    direction = rng.standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    chordae, tips = template.chordae(), template.papillary_tips
    for k in range(2):
        towards = (chordae.insertion[chordae.tip == k] - tips[k]).mean(axis=0)
        direction[k] *= 1.0 if direction[k] @ towards > 0 else -1.0
    return np.asarray(direction * rng.uniform(*reach, size=(2, 1)))


VERSION = 1
"""Of the format."""

ARRAYS = {
    "version": ("i", ()), "settings_hash": ("U", ()), "refused_reasons": ("U", (None,)),
    "refused_counts": ("i", (None,)), "names": ("U", (None,)), "layout": ("i", (2,)),
    "frames": ("i", (None,)), "chordae": ("i", (None,)), "times": ("f", (None,)),
    "vertices": ("f", (None, None, 3)), "tips": ("f", (None, 2, 3)), "thickness": ("f", (None,)),
    "chord_phi": ("f", (None,)), "chord_s": ("f", (None,)), "chord_tip": ("i", (None,)),
}  # fmt: skip
"""Array -> kind and shape. What differs in length from valve to valve is in one piece, with the
number of ``frames`` or ``chordae`` of each."""


def save_population(path: Path, population: Population) -> None:
    """Write a population, whole or not at all, positions and times in single precision.

    Raises
    ------
    InputError
        If there is no valve, the valves' layouts differ, or the file cannot be written.
    """
    valves = population.valves
    layouts = {v.layout for v in valves}
    if len(layouts) != 1:
        raise InputError(f"{path}: valves of {len(layouts)} layouts, expected one layout")
    layout = valves[0].layout

    def joined(name: str, kind: type = np.float32) -> Any:
        return np.concatenate([np.asarray(getattr(v, name), dtype=kind) for v in valves])

    arrays: dict[str, Any] = {
        "version": np.array(VERSION),
        "settings_hash": np.array(population.settings_hash),
        "refused_reasons": np.array(list(population.refused), dtype=np.str_),
        "refused_counts": np.array(list(population.refused.values()), dtype=np.int32),
        "names": np.array([v.name for v in valves]),
        "layout": np.array([layout.columns, layout.rows], dtype=np.int32),
        "frames": np.array([len(v.times) for v in valves], dtype=np.int32),
        "chordae": np.array([len(v.chord_phi) for v in valves], dtype=np.int32),
        "chord_tip": joined("chord_tip", np.int32),
        **{
            name: joined(name)
            for name in ("times", "vertices", "tips", "thickness", "chord_phi", "chord_s")
        },
    }
    write_atomically(path, partial(np.savez_compressed, **arrays))


def load_population(path: Path) -> Population:
    """Read what :func:`save_population` wrote.

    Raises
    ------
    InputError
        If the file is missing, is of another version, or anything in it is not as it must be.
    """
    stored = read_npz(path, list(ARRAYS), exact=True)
    arrays: dict[str, Any] = {
        name: check_array(stored[name], f"{path}, {name}", kind, shape)
        for name, (kind, shape) in ARRAYS.items()
    }
    if arrays["version"] != VERSION:
        raise InputError(f"{path}, version: {arrays['version']}, expected {VERSION}")
    names, layout_size = arrays["names"], arrays["layout"]
    count = len(names)
    if count == 0 or len(set(names.tolist())) != count:
        raise InputError(f"{path}, names: {count} names, expected different ones, at least one")
    layout = ValveLayout(int(layout_size[0]), int(layout_size[1]))
    for name in ("frames", "chordae"):
        if arrays[name].shape != (count,) or np.any(arrays[name] < 0):
            raise InputError(f"{path}, {name}: expected a number for each of {count} valves")
    frames, chordae = int(arrays["frames"].sum()), int(arrays["chordae"].sum())
    reasons, refused = arrays["refused_reasons"], arrays["refused_counts"]
    for name, shape in (
        ("refused_counts", reasons.shape),
        ("times", (frames,)),
        ("vertices", (frames, layout.size, 3)),
        ("tips", (frames, 2, 3)),
        ("thickness", (count * layout.size,)),
        ("chord_phi", (chordae,)),
        ("chord_s", (chordae,)),
        ("chord_tip", (chordae,)),
    ):
        if arrays[name].shape != shape:
            raise InputError(f"{path}, {name}: shape {arrays[name].shape}, expected {shape}")
    if not np.isin(arrays["chord_tip"], (0, 1)).all():
        raise InputError(f"{path}, chord_tip: expected 0 and 1 only")
    at_frame = np.cumsum(arrays["frames"])[:-1]
    at_chord = np.cumsum(arrays["chordae"])[:-1]
    pieces = zip(
        names.tolist(),
        *(np.split(arrays[name], at_frame) for name in ("times", "vertices", "tips")),
        arrays["thickness"].reshape(count, -1),
        *(np.split(arrays[name], at_chord) for name in ("chord_phi", "chord_s", "chord_tip")),
        strict=True,
    )
    try:
        valves = tuple(MovingValve(name, layout, *parts) for name, *parts in pieces)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    counted = dict(zip(reasons.tolist(), refused.tolist(), strict=True))
    return Population(valves, counted, str(arrays["settings_hash"]))
