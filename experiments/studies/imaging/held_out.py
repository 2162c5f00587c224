"""Detectors on volumes of held-out valves: which volumes, and what they saw in them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.progress import PartBar
from experiments.studies.imaging.parallel import in_processes
from experiments.studies.imaging.store import ImagingStore
from experiments.studies.imaging.trials import (
    SEQUENCES,
    VOLUMES,
    WITHOUT_VALVE,
    Trial,
    try_sequence,
    try_volume,
)
from mvest.imaging.detection.tracking import TrackingSettings
from mvest.imaging.moving_valve import MovingValve
from mvest.kept import get_or_make
from mvest.reading.json_file import parse_json
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray

__all__ = ["HeldOut", "hold_out"]


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """What detectors saw in volumes of valves that no training saw.

    Attributes
    ----------
    volumes : dict
        Volumes trained on -> rows of :func:`experiments.studies.imaging.trials.try_volume`.
    sequences : dict
        Kind -> rows of :func:`experiments.studies.imaging.trials.try_sequence` and their arrays.
    """

    volumes: dict[int, list[dict[str, Any]]]
    sequences: dict[str, list[tuple[dict[str, Any], dict[str, FloatArray]]]]

    def detected(self, kind: str, min_confidence: float, wrong_mm: float = np.inf) -> HeldOut:
        """Only volumes over time of a kind whose valve is believed in, and is not a wrong one.

        Parameters
        ----------
        kind : str
        min_confidence : float
            Of the best frame.
        wrong_mm : float
            Mean distance of points over all frames from which on it is a wrong one.
        """
        kept = [
            (row, arrays)
            for row, arrays in self.sequences[kind]
            if max(frame["confidence"] for frame in row["frames"]) >= min_confidence
            and np.mean([frame["points"] for frame in row["frames"]]) < wrong_mm
        ]
        return HeldOut(self.volumes, {kind: kept})

    def confidence(self, kind: str) -> FloatArray:
        """Of each volume over time ``(S,)``, as `mvest.imaging.valve_sequence.ValveSequence`."""
        return np.array(
            [np.median([f["confidence"] for f in row["frames"]]) for row, _ in self.sequences[kind]]
        )

    def stacked(self, kind: str, name: str) -> FloatArray:
        """An array of all volumes over time `(S, ...)` mm, one of those of `try_sequence`."""
        return np.stack([arrays[name] for _, arrays in self.sequences[kind]])


def hold_out(
    store: ImagingStore, calibration: Sequence[MovingValve], test: Sequence[MovingValve]
) -> HeldOut:
    """Simulate all held-out volumes and search them; what was done before is read."""
    # The verdict changes nothing of what is seen.
    settings = replace(store.settings.detection, min_confidence=0.0)
    held_out = store.settings.held_out
    counts = dict(zip(VOLUMES, (held_out.volumes, held_out.shifted), strict=True))
    counts |= dict.fromkeys(WITHOUT_VALVE, held_out.without_valve)
    every = [store.training.volumes, *sorted(store.curve, reverse=True)]
    asked = []
    for kind, count in counts.items():
        for number in range(count):
            also = kind in VOLUMES and number < held_out.curve_volumes
            asked.append((_trial(store, kind, number), every if also else every[:1]))
    volumes = _volumes(store, asked, test, settings)
    lengths = (
        len(calibration),
        held_out.sequences,
        held_out.shifted_sequences,
        held_out.wide_calibration,
    )
    sequences = {
        kind: _sequences(
            store,
            [_trial(store, kind, number) for number in range(count)],
            "calibration" if kind.endswith("calibration") else "test",
            calibration if kind.endswith("calibration") else test,
            settings,
        )
        for kind, count in zip(SEQUENCES, lengths, strict=True)
    }
    return HeldOut(volumes, sequences)


def _trial(store: ImagingStore, kind: str, number: int) -> Trial:
    return Trial(kind, number, store.seed, store.training.acquisition)


def _volumes(
    store: ImagingStore,
    asked: Sequence[tuple[Trial, Sequence[int]]],
    valves: Sequence[MovingValve],
    settings: TrackingSettings,
) -> dict[int, list[dict[str, Any]]]:
    """Rows of single frames, by the number of volumes that detectors were trained on."""
    described = partial(_described, population=store.population_key("test"), store=store)
    jobs = [(trial, size) for trial, sizes in asked for size in sizes]
    entries = [
        store.store.entry(
            "volumes", described(trial, size=size, settings=settings), (try_volume,), _read
        )
        for trial, size in jobs
    ]

    def make(missing: list[int]) -> Iterator[dict[str, Any]]:
        left: dict[Trial, list[int]] = {}
        for trial, size in (jobs[k] for k in missing):
            left.setdefault(trial, []).append(size)
        calls = (
            (
                valves[trial.number % len(valves)],
                trial,
                {str(size): store.model_file(size) for size in sizes},
                settings,
            )
            for trial, sizes in left.items()
        )
        with PartBar("held-out volumes", len(left), "volume") as bar:
            done = in_processes(try_volume, calls, store.processes)
            for sizes, (result, _) in zip(left.values(), done, strict=True):
                yield from ({"row": json.dumps(result[str(size)])} for size in sizes)
                bar.step()

    rows: dict[int, list[dict[str, Any]]] = {}
    for (_, size), (row, _) in zip(jobs, get_or_make(entries, make, _write), strict=True):
        rows.setdefault(size, []).append(row)
    return rows


def _sequences(
    store: ImagingStore,
    trials: Sequence[Trial],
    which: str,
    valves: Sequence[MovingValve],
    settings: TrackingSettings,
) -> list[tuple[dict[str, Any], dict[str, FloatArray]]]:
    """Rows and arrays of sequences."""
    population, size = store.population_key(which), store.training.volumes
    closed = store.settings.population.motion.frames - 1
    entries = [
        store.store.entry(
            "sequences",
            _described(trial, population, store, size, settings),
            (try_sequence,),
            _read,
        )
        for trial in trials
    ]

    def make(missing: list[int]) -> Iterator[dict[str, Any]]:
        left = [trials[k] for k in missing]
        calls = (
            (valves[t.number % len(valves)], t, closed, store.model_file(size), settings)
            for t in left
        )
        with PartBar(f"volumes over time, {left[0].kind}", len(left), "volume") as bar:
            for result, _ in in_processes(try_sequence, calls, store.processes):
                yield result
                bar.step()

    return get_or_make(entries, make, _write)


def _described(
    trial: Trial, population: str, store: ImagingStore, size: int, settings: TrackingSettings
) -> dict[str, Any]:
    return {
        "trial": asdict(trial),
        "valves": population,
        "model": store.model_key(size),
        "settings": asdict(settings),
    }


def _write(place: Path, arrays: Mapping[str, Any]) -> None:
    np.savez(place, **arrays)


def _read(place: Path) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    arrays = read_npz(place)
    return parse_json(str(arrays.pop("row")), f"{place}: row"), arrays
