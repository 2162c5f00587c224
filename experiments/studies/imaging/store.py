"""What the study of detectors makes on its way and keeps: valves, samples and trained detectors.

Everything is named by what it was made from and by the code that made it, written whole or not at
all, and made once: an interrupted study goes on where it was.
"""

from __future__ import annotations

import hashlib
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from joblib.externals.loky import get_reusable_executor
from numpy.typing import NDArray

from experiments.common.building.closure import mechanics_of
from experiments.common.building.store import DIGITS, Store, key_of
from experiments.common.progress import PartBar
from experiments.studies.imaging.findings import Spent
from experiments.studies.imaging.parallel import in_processes
from experiments.studies.imaging.settings import ImagingSettings
from mvest.errors import InputError
from mvest.imaging.detection.shape_model import ShapeModel, fit_shape_model
from mvest.imaging.detection.trained_model import STAGES, DetectionModel, load_model, save_model
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.learning.training import (
    Draft,
    Samples,
    draft_of,
    samples_of,
    train_stage,
    volume_samples,
)
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.moving_valve import MovingValve
from mvest.kept import Entry, get_or_make
from mvest.provenance import write_json
from mvest.reading.json_file import read_mapping
from mvest.reading.npz import read_npz
from mvest.simulation.motion.files import load_population, save_population
from mvest.simulation.motion.population import Population, draw_population

__all__ = ["ImagingStore"]

Values = Mapping[str, Any]
T = TypeVar("T")

DRAFT = "draft.json"
"""File beside samples that says what their draft cost."""

SPENT = "spent.json"
"""In the folder of an entry: what it cost."""

VALVES, DETECTORS = "valves.npz", "detectors.npz"

PACKAGED = "package"
"""Stands for the detectors that come with the package."""

SAMPLED_BY = (volume_samples, draft_of, fit_shape_model)


class StoredSamples(Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]]):
    """Samples of one volume in a file, read stage by stage.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    cpu_s : float
        CPU seconds that it took to simulate the volume and to sample it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.cpu_s = float(read_npz(path, ["cpu_s"])["cpu_s"])

    def __getitem__(self, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        x, y = read_npz(self._path, [f"{name}.x", f"{name}.y"]).values()
        return x, y

    def __iter__(self) -> Iterator[str]:
        return iter(STAGES)

    def __len__(self) -> int:
        return len(STAGES)


class ImagingStore:
    """Makes and finds the parts of a study of detectors.

    Parameters
    ----------
    config : mapping
        The resolved configuration, checked.
    settings : ImagingSettings
        Of the study.
    """

    def __init__(self, config: Values, settings: ImagingSettings) -> None:
        self.store = Store(Path(config["paths"]["outputs"]) / "detectors")
        self.settings = settings
        self.processes, self.training = settings.processes, settings.training
        self.seed = int(config["seed"])
        self.mechanics = mechanics_of(config)
        self._drawn = {
            "train": settings.train,
            "calibration": settings.calibration,
            "test": settings.test,
        }
        self._shapes: ShapeModel | None = None
        self.given = None if settings.model is None else _file(settings.model)
        self.curve = () if self.given else settings.curve

    # -- valves -----------------------------------------------------------------------------------
    def _valves(self, which: str) -> Entry[Population]:
        described = {
            "drawn": asdict(self._drawn[which]),
            "bases": [[name, asdict(values)] for name, values in self.settings.bases.items()],
            "settings": asdict(self.settings.population),
            "mechanics": asdict(self.mechanics),
        }
        made_by = (draw_population, save_population)
        return self.store.entry(
            "valves", described, made_by, lambda path: load_population(path / VALVES), "{key}"
        )

    def population_key(self, which: str) -> str:
        """Key of a population: ``train``, ``calibration`` or ``test``."""
        return self._valves(which).path.name

    def population(self, which: str) -> Population:
        """A population of simulated valves.

        Raises
        ------
        MvestError
            If a valve does not close in 20 draws, or the store cannot be written.
        """
        about = self._drawn[which]

        def draw() -> tuple[Population, Spent]:
            began = _cpu_s(), time.monotonic()
            title = f"valves to {'train on' if which == 'train' else which}"
            with PartBar(title, about.count, "valve") as bar:
                made = draw_population(
                    about.count,
                    about.seed,
                    self.settings.bases,
                    self.settings.population,
                    self.mechanics,
                    processes=self.processes,
                    progress=lambda _number, _valve: bar.step(),
                )
            if self.processes > 1:
                # What processes have spent is known when they have ended.
                get_reusable_executor().shutdown(wait=True)
            return made, Spent(_cpu_s() - began[0], time.monotonic() - began[1])

        write = partial(_write_with_cost, save_population, VALVES)
        return self._valves(which).get_or_make(draw, write)

    def population_spent(self, which: str) -> Spent:
        """What a population cost."""
        return _spent(self._valves(which).path / SPENT)

    # -- training ---------------------------------------------------------------------------------
    @property
    def samples_key(self) -> str:
        """Key of the samples of all volumes, however many there are."""
        settings = {
            key: value
            for key, value in asdict(self.training).items()
            if key in ("modes", "samples", "acquisition", "draft_volumes", "boosting")
        }
        described = {
            "valves": self.population_key("train"),
            "settings": settings,
            "seed": self.seed,
        }
        return key_of(described, SAMPLED_BY)

    def model_key(self, volumes: int) -> str:
        """Key of the detectors that are trained on the first so many volumes, or of those given.

        What was measured of those given is no part of it: they find the same.
        """
        if self.given:
            return self._given_key
        described = {
            "samples": self.samples_key,
            "settings": asdict(self.training) | {"volumes": volumes},
        }
        return key_of(described, (*SAMPLED_BY, train_stage, save_model))

    @cached_property
    def _given_key(self) -> str:
        assert self.given is not None
        digest = hashlib.sha256()
        for name, array in sorted(read_npz(self.given).items()):
            if not name.startswith(("about", "accuracy.")):
                digest.update(name.encode() + array.tobytes())
        return digest.hexdigest()[:DIGITS]

    def samples(self, valves: Sequence[MovingValve], count: int) -> list[StoredSamples]:
        """Samples of the first ``count`` training volumes, simulated where they are missing."""
        first = min(count, self.training.draft_volumes)
        drafted = self._samples(valves, range(first), None)
        if count == first:
            return drafted
        return [*drafted, *self._samples(valves, range(first, count), drafted)]

    def _samples(
        self,
        valves: Sequence[MovingValve],
        numbers: Sequence[int],
        drafted: Sequence[StoredSamples] | None,
    ) -> list[StoredSamples]:
        """Samples of some volumes, with the mistakes of what is learned from those ``drafted``."""
        folder = self.store.folder / "samples" / self.samples_key
        entries = [
            Entry(folder / f"{k:05d}.npz", StoredSamples, counts=self.store.counts) for k in numbers
        ]

        def make(missing: list[int]) -> Iterator[tuple[Samples, float]]:
            shape = self.shapes(valves)
            draft = self._draft(drafted, folder) if drafted else None
            calls = (
                (valves[k % len(valves)], k, shape, self.training, self.seed, draft)
                for k in (numbers[at] for at in missing)
            )
            with PartBar("training volumes", len(missing), "volume") as bar:
                for made in in_processes(volume_samples, calls, self.processes):
                    yield made
                    bar.step()

        return get_or_make(entries, make, _write_samples)

    def _draft(self, drafted: Sequence[StoredSamples], folder: Path) -> Draft:
        with PartBar("draft of the search", 1, "search") as bar:
            began = time.process_time(), time.monotonic()
            draft = draft_of(drafted, self.training, self.seed)
            spent = Spent(time.process_time() - began[0], time.monotonic() - began[1])
            write_json(folder / DRAFT, asdict(spent))
            bar.step()
        return draft

    def draft_spent(self) -> Spent:
        """What the draft cost whose mistakes were learned from; nothing where there was none."""
        if self.training.volumes <= self.training.draft_volumes:
            return Spent(0.0, 0.0)
        return _spent(self.store.folder / "samples" / self.samples_key / DRAFT)

    def shapes(self, valves: Sequence[MovingValve]) -> ShapeModel:
        """The shape model of all training valves."""
        if self._shapes is None:
            self._shapes = fit_shape_model(valves, self.training.modes)
        return self._shapes

    def model(
        self, valves: Sequence[MovingValve], volumes: int, trained_on: Values
    ) -> tuple[DetectionModel, Path]:
        """Detectors trained on the first ``volumes`` volumes, and their file.

        Raises
        ------
        MvestError
            If there is nothing to train on, or the store cannot be written.
        """

        def train() -> tuple[DetectionModel, Spent]:
            samples = self.samples(valves, volumes)
            began, cpu_s = time.monotonic(), 0.0
            boosters: dict[str, Boosters] = {}
            calls = (
                (name, *samples_of(name, samples), self.training, self.seed) for name in STAGES
            )
            with PartBar(f"detectors from {volumes} volumes", len(STAGES), "stage") as bar:
                grown = in_processes(train_stage, calls, self.processes)
                for name, (trees, seconds) in zip(STAGES, grown, strict=True):
                    boosters[name], cpu_s = trees, cpu_s + seconds
                    bar.step()
            made = DetectionModel(self.shapes(valves), boosters, trained_on)
            return made, Spent(cpu_s, time.monotonic() - began)

        file = self.model_file(volumes)
        entry = Entry(file.parent, lambda _: load_model(file), counts=self.store.counts)
        return entry.get_or_make(train, partial(_write_with_cost, save_model, DETECTORS)), file

    def model_file(self, volumes: int) -> Path:
        """Where detectors are that were trained on so many volumes, or those given."""
        if self.given:
            return self.given
        return self.store.folder / "models" / self.model_key(volumes) / DETECTORS

    def model_spent(self, volumes: int) -> Spent:
        """What growing the trees cost, the volumes apart."""
        return _spent(self.model_file(volumes).with_name(SPENT))


def _file(model: str) -> Path:
    return MODEL_FILE if model == PACKAGED else Path(model)


def _write_with_cost(
    write: Callable[[Path, T], object], name: str, folder: Path, made: tuple[T, Spent]
) -> None:
    folder.mkdir()
    write(folder / name, made[0])
    write_json(folder / SPENT, asdict(made[1]))


def _cpu_s() -> float:
    """CPU seconds of this process and of those that it started and that have ended."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in usage)


def _write_samples(path: Path, made: tuple[Samples, float]) -> None:
    samples, cpu_s = made
    arrays: dict[str, Any] = {"cpu_s": np.array(cpu_s)}
    for name, (x, y) in samples.items():
        arrays |= {f"{name}.x": x, f"{name}.y": y}
    np.savez(path, **arrays)


def _spent(path: Path) -> Spent:
    """What a part cost, from beside it; unknown where it was brought here without that."""
    try:
        return Spent(**read_mapping(path))
    except (InputError, TypeError):
        return Spent(None, None)
