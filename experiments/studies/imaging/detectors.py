"""Valves, training samples, detectors and trials of the detector study.

All are cached on disk under a key of their inputs and code, so an interrupted study continues.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from experiments.common.building.closure import mechanics_of
from experiments.common.progress import PartBar
from experiments.common.schema import NOT_HASHED, Values
from mvest.cache import Entry, get_or_make
from mvest.imaging.detection.shape_model import ShapeModel, fit_shape_model
from mvest.imaging.detection.trained_model import STAGES, DetectionModel, load_model, save_model
from mvest.imaging.learning.boosting import Boosters, Trees
from mvest.imaging.learning.training import (
    SEARCH_STAGES,
    TrainingSettings,
    train_stage,
    volume_samples,
)
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, MovingValve
from mvest.problem.stored import entry_of
from mvest.processes import side_by_side
from mvest.quantities import Count, Length, Processes, Seed, Share, within
from mvest.reading.documents import parse_json
from mvest.reading.npz import read_npz
from mvest.simulation.motion import MotionSettings
from mvest.simulation.population import draw_population, load_population, save_population
from mvest.simulation.trials import Trial
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters

Seen = tuple[Mapping[str, Any], Mapping[str, FloatArray]]
"""Row and arrays of a trial."""

Some = Annotated[int, within(1, 100_000, "", "things that each take their time")]


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnValves:
    """A population of simulated valves."""

    count: Some
    seed: Seed


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutSettings:
    """Numbers of simulated test volumes, with valves not used in training."""

    volumes: Some  # of one frame, within the ranges of training
    shifted: Some  # of one frame, outside the ranges of training
    sequences: Some  # of all frames, within the ranges of training
    shifted_sequences: Count
    wide_calibration: Count  # of calibration valves, each setting in or outside the ranges
    without_valve: Some  # of each kind of volume without a valve
    # mm: a detection with this mean point error is not the valve.
    wrong_mm: Length = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagingSettings:
    """Training and testing of detectors for valves in volumes."""

    bases: dict[str, TemplateParameters] = field(default_factory=dict)
    motion: MotionSettings = field(default_factory=MotionSettings)
    train: DrawnValves
    calibration: DrawnValves  # for the stated errors of the detectors
    test: DrawnValves
    training: TrainingSettings = field(default_factory=TrainingSettings)
    min_confidence: Share = MIN_CONFIDENCE  # of a detected valve
    evaluate: bool = True
    held_out: HeldOutSettings
    processes: Annotated[Processes, NOT_HASHED] = 1
    model: str | None = None  # file or "package" of detectors to test; null trains them


def _grow(name: str, files: Sequence[Path], settings: TrainingSettings, seed: int) -> Boosters:
    """Grow one stage at a time, because samples of all stages would fill the memory."""
    samples = (read_npz(file, [f"{name}.x", f"{name}.y"]).values() for file in files)
    x, y = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    return train_stage(name, x, y, settings, seed)


class ImagingStore:
    """The cached parts of a detector study with a resolved configuration."""

    def __init__(self, config: Values, settings: ImagingSettings) -> None:
        self._folder = Path(config["paths"]["outputs"]) / "detectors"
        self.settings, self.seed = settings, int(config["seed"])
        self._mechanics = mechanics_of(config)

    def _valves(self, which: str) -> Entry[tuple[MovingValve, ...]]:
        described = {
            "drawn": asdict(getattr(self.settings, which)),
            "bases": [[name, asdict(values)] for name, values in self.settings.bases.items()],
            "settings": asdict(self.settings.motion),
            "mechanics": asdict(self._mechanics),
        }
        return entry_of(self._folder / "valves", described, load_population)

    def population(self, which: str) -> tuple[MovingValve, ...]:
        """A population of simulated valves: ``train``, ``calibration`` or ``test``."""
        drawn, own = getattr(self.settings, which), self.settings

        def draw() -> tuple[MovingValve, ...]:
            what = drawn.count, drawn.seed, own.bases, own.motion, self._mechanics
            made = draw_population(*what, processes=own.processes)
            return tuple(_followed(f"valves: {which}", drawn.count, "valve", made))

        return self._valves(which).get_or_make(draw, save_population)

    def model_entry(self) -> Entry[DetectionModel]:
        """The cache entry of the trained detectors."""
        described = {**self._sampling(), "training": asdict(self.settings.training)}
        return entry_of(self._folder / "models", described, load_model)

    def samples_entry(self, number: int) -> Entry[Path]:
        """The cache entry of one training volume's samples, for any number of volumes."""
        described = {**self._sampling(), "number": number}
        return entry_of(self._folder / "samples", described, lambda path: path)

    def _sampling(self) -> dict[str, Any]:
        known = ("modes", "samples", "acquisition", "draft_volumes", "boosting")
        return {
            "valves": self._valves("train").path.stem,
            "settings": {key: asdict(self.settings.training)[key] for key in known},
            "seed": self.seed,
        }

    def train(self, trained_on: Values) -> DetectionModel:
        """Trained detectors; the first volumes train a draft."""
        settings, valves = self.settings.training, self.population("train")

        def train() -> DetectionModel:
            shape = fit_shape_model(valves, settings.modes)
            first = min(settings.draft_volumes, settings.volumes)
            files = self._samples(valves, shape, range(first), lambda: None)

            def draft() -> Trees | None:
                return self._grown(SEARCH_STAGES, files[:first]) if first else None

            files += self._samples(valves, shape, range(first, settings.volumes), draft)
            return DetectionModel(shape, self._grown(STAGES, files), dict(trained_on))

        return self.model_entry().get_or_make(train, save_model)

    def _samples(
        self,
        valves: Sequence[MovingValve],
        shape: ShapeModel,
        numbers: Sequence[int],
        make_draft: Callable[[], Trees | None],
    ) -> list[Path]:
        """Files of the samples of training volumes; a draft is trained if some are missing."""

        def make(missing: list[int]) -> Iterator[Any]:
            draft, settings = make_draft(), self.settings.training
            calls = (
                (valves[k % len(valves)], k, shape, settings, self.seed, draft)
                for k in (numbers[at] for at in missing)
            )
            return self._made("training volumes", volume_samples, calls, len(missing))

        return get_or_make([self.samples_entry(k) for k in numbers], make, _write)

    def _grown(self, stages: Sequence[str], files: Sequence[Path]) -> Trees:
        calls = ((name, files, self.settings.training, self.seed) for name in stages)
        return dict(zip(stages, self._made("stages", _grow, calls, len(stages)), strict=True))

    def tried(self, function: Any, trials: Sequence[Trial], file: Path) -> list[Seen]:
        """Rows and arrays of trials (`try_volume` or `try_sequence`), for detectors in a file."""
        # The measured accuracy of the detectors does not affect detection.
        boosters = load_model(file).boosters
        trees = "".join(text for name in STAGES for text in boosters[name].texts)
        key = hashlib.sha256(trees.encode()).hexdigest()
        of = ["calibration" if t.kind.endswith("calibration") else "test" for t in trials]
        drawn = {which: self._valves(which).path.stem for which in set(of)}
        valves = {which: self.population(which) for which in set(of)}
        entries = []
        for trial, which in zip(trials, of, strict=True):
            described = {"model": key, "trial": asdict(trial), "valves": drawn[which]}
            entries.append(entry_of(self._folder / "trials", described, _read_trial))

        def make(missing: list[int]) -> Iterator[Any]:
            calls = (
                (valves[of[k]][trials[k].number % len(valves[of[k]])], trials[k], file)
                for k in missing
            )
            kinds = ", ".join(dict.fromkeys(trials[k].kind for k in missing))
            return self._made(f"volumes: {kinds}", function, calls, len(missing))

        return get_or_make(entries, make, _write)

    def _made(self, title: str, function: Any, calls: Any, total: int) -> Iterator[Any]:
        return _followed(
            title, total, "part", side_by_side(function, calls, self.settings.processes)
        )


def _followed(title: str, total: int, part: str, made: Iterable[Any]) -> Iterator[Any]:
    """Yield the same values with a progress bar."""
    with PartBar(title, total, part) as bar:
        for one in made:
            yield one
            bar.step()


def _write(path: Path, arrays: Mapping[str, Any]) -> None:
    np.savez(path, **arrays)


def _read_trial(path: Path) -> Seen:
    arrays = read_npz(path)
    return parse_json(str(arrays.pop("row")), f"{path}: row"), arrays
