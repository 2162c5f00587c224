"""The file of a population of simulated valves: one ``.npz`` without pickled objects."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.imaging.layout import ValveLayout
from mvest.imaging.moving_valve import MovingValve
from mvest.reading.npz import check_array, read_npz
from mvest.simulation.motion.population import Population

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
    if layout != ValveLayout(layout.columns, layout.rows):
        raise InputError(
            f"{path}: valves of the regions {', '.join(layout.region_names)}, expected "
            f"{', '.join(ValveLayout().region_names)}"
        )

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
