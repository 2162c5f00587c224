"""What the study of detectors makes: valves, training samples, detectors and trials of them.

Everything is made once and cached on disk under a key of its inputs and of the code that makes it,
so an interrupted study goes on where it was.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from experiments.common.building.closure import mechanics_of
from experiments.common.progress import PartBar
from experiments.common.schema import NOT_HASHED, Values
from mvest.cache import Entry, get_or_make
from mvest.imaging.detection.shape_model import ShapeModel, fit_shape_model
from mvest.imaging.detection.tracking import TrackingSettings
from mvest.imaging.detection.trained_model import STAGES, DetectionModel, load_model, save_model
from mvest.imaging.learning.boosting import Trees
from mvest.imaging.learning.training import (
    Samples,
    TrainingSettings,
    draft_of,
    train_model,
    train_stage,
    volume_samples,
)
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import MovingValve
from mvest.problem.stored import Store, key_of
from mvest.processes import side_by_side
from mvest.quantities import Count, Length, Processes, Seed, within
from mvest.reading.documents import parse_json
from mvest.reading.npz import read_npz
from mvest.simulation.population import (
    Population,
    PopulationSettings,
    draw_population,
    load_population,
    save_population,
)
from mvest.simulation.trials import Trial
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters

Try = Callable[[MovingValve, Trial, Path, TrackingSettings], dict[str, Any]]
Seen = tuple[Mapping[str, Any], Mapping[str, FloatArray]]
"""Row and arrays of a trial."""

PACKAGED = "package"
"""Stands for the detectors that come with the package."""

Some = Annotated[int, within(1, 100_000, "", "things that each take their time")]

SAMPLED_BY = (volume_samples, draft_of, fit_shape_model)


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnValves:
    """A population of simulated valves."""

    count: Some
    seed: Seed


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutSettings:
    """The test: numbers of simulated volumes of valves that no training saw."""

    volumes: Some  # of one frame, drawn as those of training are
    shifted: Some  # of one frame, outside the ranges of training
    sequences: Some  # of all frames of a valve, drawn as those of training are
    shifted_sequences: Count
    wide_calibration: Count  # of valves to calibrate with, each setting within or outside
    without_valve: Some  # of each kind of volume in which there is none
    # mm: what is found is not the valve if its points are on average this far off.
    wrong_mm: Length = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagingSettings:
    """Detectors for valves in volumes: their training and their test."""

    bases: dict[str, TemplateParameters] = field(default_factory=dict)
    population: PopulationSettings = field(default_factory=PopulationSettings)
    train: DrawnValves
    calibration: DrawnValves  # measures the errors that detectors state
    test: DrawnValves
    training: TrainingSettings = field(default_factory=TrainingSettings)
    detection: TrackingSettings = field(default_factory=TrackingSettings)
    evaluate: bool = True
    held_out: HeldOutSettings
    processes: Annotated[Processes, NOT_HASHED] = 1
    model: str | None = None  # file or "package": detectors to be tested; null trains them
    publish_model: Annotated[bool, NOT_HASHED] = (
        False  # make the detectors those that come with the package
    )


class StoredSamples(Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]]):
    """Samples of one volume in a file, read stage by stage: those of all fill the memory."""

    def __init__(self, path: Path) -> None:
        self._path = path

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

    Attributes
    ----------
    given : Path or None
        File of detectors to be tested; None trains some.
    model_file : Path
        Of these, or of the trained ones.
    """

    def __init__(self, config: Values, settings: ImagingSettings) -> None:
        self._store = Store(Path(config["paths"]["outputs"]) / "detectors")
        self.settings, self.seed = settings, int(config["seed"])
        self._mechanics = mechanics_of(config)
        self.given: Path | None = None
        if settings.model is not None:
            self.given = MODEL_FILE if settings.model == PACKAGED else Path(settings.model)
        self.model_file = self.given or self._model_file()

    def _valves(self, which: str) -> Entry[Population]:
        described = {
            "drawn": asdict(getattr(self.settings, which)),
            "bases": [[name, asdict(values)] for name, values in self.settings.bases.items()],
            "settings": asdict(self.settings.population),
            "mechanics": asdict(self._mechanics),
        }
        made_by = (draw_population, save_population)
        return self._store.entry("valves", described, made_by, load_population)

    def population(self, which: str) -> tuple[MovingValve, ...]:
        """A population of simulated valves: ``train``, ``calibration`` or ``test``."""
        drawn = getattr(self.settings, which)

        def draw() -> Population:
            with PartBar(f"valves: {which}", drawn.count, "valve") as bar:
                return draw_population(
                    drawn.count,
                    drawn.seed,
                    self.settings.bases,
                    self.settings.population,
                    self._mechanics,
                    processes=self.settings.processes,
                    progress=lambda _number, _valve: bar.step(),
                )

        return self._valves(which).get_or_make(draw, save_population).valves

    def samples_folder(self) -> Path:
        """Folder of the samples of all training volumes, however many there are."""
        known = ("modes", "samples", "acquisition", "draft_volumes", "boosting")
        described = {
            "valves": self._valves("train").path.stem,
            "settings": {key: asdict(self.settings.training)[key] for key in known},
            "seed": self.seed,
        }
        return self._store.folder / "samples" / key_of(described, SAMPLED_BY)

    def _model_file(self) -> Path:
        described = {
            "samples": self.samples_folder().name,
            "settings": asdict(self.settings.training),
        }
        made_by = (*SAMPLED_BY, train_stage, save_model)
        return self._store.entry("models", described, made_by, load_model).path

    def train(self, valves: Sequence[MovingValve], trained_on: Values) -> DetectionModel:
        """Detectors trained on valves."""
        folder, settings = self.samples_folder(), self.settings.training

        def sampled(
            numbers: Sequence[int], shape: ShapeModel, make_draft: Callable[[], Trees] | None
        ) -> list[StoredSamples]:
            def make(missing: list[int]) -> Iterator[Samples]:
                draft = make_draft() if make_draft else None
                calls = (
                    (valves[k % len(valves)], k, shape, settings, self.seed, draft)
                    for k in (numbers[at] for at in missing)
                )
                return self._with_bar("training volumes", volume_samples, calls, len(missing))

            entries = [Entry(folder / f"{k:05d}.npz", StoredSamples) for k in numbers]
            return get_or_make(entries, make, _write_samples)

        def train() -> DetectionModel:
            with PartBar("training", len(STAGES), "stage") as bar:
                return train_model(
                    valves,
                    settings,
                    self.seed,
                    processes=self.settings.processes,
                    trained_on=trained_on,
                    progress=bar.step,
                    sampled=sampled,
                )

        return Entry(self.model_file, load_model).get_or_make(train, save_model)

    @cached_property
    def model_key(self) -> str:
        """Key of the detectors by their shapes and trees, whatever was measured of them since."""
        digest = hashlib.sha256()
        for name, array in sorted(read_npz(self.model_file).items()):
            if not name.startswith(("about", "accuracy.")):
                digest.update(name.encode() + array.tobytes())
        return digest.hexdigest()

    def tried(self, function: Try, trials: Sequence[Trial]) -> list[Seen]:
        """Rows and arrays of trials of the detectors, which are trained by now."""
        # The verdict changes nothing of what is found.
        settings = replace(self.settings.detection, min_confidence=0.0)
        of = ["calibration" if t.kind.endswith("calibration") else "test" for t in trials]
        valves = {which: self.population(which) for which in set(of)}
        entries = []
        for trial, which in zip(trials, of, strict=True):
            described = {
                "trial": asdict(trial),
                "valves": self._valves(which).path.stem,
                "model": self.model_key,
                "settings": asdict(settings),
            }
            entries.append(self._store.entry("trials", described, (function,), _read_trial))

        def make(missing: list[int]) -> Iterator[dict[str, Any]]:
            calls = (
                (valves[of[k]][trials[k].number % len(valves[of[k]])], trials[k], self.model_file,
                 settings)
                for k in missing
            )  # fmt: skip
            kinds = ", ".join(dict.fromkeys(trials[k].kind for k in missing))
            return self._with_bar(f"volumes: {kinds}", function, calls, len(missing))

        return get_or_make(entries, make, lambda path, arrays: np.savez(path, **arrays))

    def _with_bar(self, title: str, function: Any, calls: Any, total: int) -> Iterator[Any]:
        """What calls return, with a bar."""
        with PartBar(title, total, "volume") as bar:
            for made in side_by_side(function, calls, self.settings.processes):
                yield made
                bar.step()


def _write_samples(path: Path, samples: Samples) -> None:
    arrays: dict[str, Any] = {}
    for name, (x, y) in samples.items():
        arrays |= {f"{name}.x": x, f"{name}.y": y}
    np.savez(path, **arrays)


def _read_trial(path: Path) -> Seen:
    arrays = read_npz(path)
    return parse_json(str(arrays.pop("row")), f"{path}: row"), arrays
