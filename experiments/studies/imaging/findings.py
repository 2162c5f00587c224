"""Findings of the study of the image step; lengths in mm, None where a valve was not detected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from experiments.common.records.findings import Vector
from mvest.imaging.layout import ValveLayout

__all__ = ["Accuracy", "Confidences", "Correlations", "Coverage", "DetectedVolume", "Evaluation",
           "Findings", "KindOfVolume", "Learning", "ModelFile", "Population", "Sequence",
           "Spent"]  # fmt: skip

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class DetectedVolume:
    """A valve in one volume of one frame, errors with sign, mean distances without.

    ``state_right`` says whether an open orifice is seen as open and a closed one as closed, and
    ``seconds`` are of the CPU, of one thread.
    """

    setting: str
    valve: str
    frame: int
    confidence: float
    surface_mm: float | None
    point_mm: float | None
    tips_mm: float | None
    annulus_area_error_percent: float | None
    ap_error_mm: float | None
    state_right: bool | None
    seconds: float


@dataclass(frozen=True, slots=True)
class Learning:
    """Errors of one stage after training on so many volumes, tested on ``volumes``."""

    stage: str
    training_volumes: int
    setting: str
    median: float
    p90: float
    unit: str
    volumes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Sequence:
    """A valve in a volume over time; means over the frames, errors without sign.

    Confidence is that of the best frame. What is wrong is called a valve and is not the valve.
    """

    setting: str
    valve: str
    frames: int
    confidence: float
    detected: bool
    wrong: bool
    surface_mm: float
    points_mm: float
    tips_mm: float
    surface_open_mm: float
    surface_closed_mm: float
    annulus_area_error_percent: float | None
    ap_error_mm: float | None
    state_right_percent: float | None
    seconds: float


@dataclass(frozen=True, slots=True)
class KindOfVolume:
    """Confidence in volumes of one kind, and how many are called a valve, and wrongly so."""

    kind: str
    volumes: int
    lowest: float
    median: float
    highest: float
    called_percent: float
    wrongly_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Confidences:
    """How sure detectors are of a valve, with and without one, by kind of volume.

    From ``min_confidence`` on something is called a valve, and it is not the valve where its points
    are on average ``wrong_mm`` off or more; ``off_mm`` is None without a valve. Volumes over time
    count with their best frame. ``best_threshold`` parts right from wrong best, and is None where
    nothing is right.
    """

    min_confidence: float
    wrong_mm: float
    rows: tuple[KindOfVolume, ...]
    values: Mapping[str, Vector]
    off_mm: Mapping[str, tuple[float | None, ...]]
    highest_without_valve: float
    highest_wrong: float
    lowest_right: float | None
    best_threshold: float | None


@dataclass(frozen=True, slots=True)
class Correlations:
    """Correlation of errors against distance, in bins ``(b,)``."""

    distance: Vector
    correlation: Vector
    pairs: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Errors of one frame of volumes over time beside the standard deviations that are stated.

    Shares are of coordinates within 1.96 of these. What is handed on with a case is less the error
    that is expected where a valve is found so (`mvest.cases.from_images.expected_error`), with the
    deviations about it.
    """

    setting: str
    frame: str
    sequences: int
    share: float
    share_handed_on: float
    rms_mm: float
    stated_rms_mm: float
    rms_handed_on_mm: float
    stated_handed_on_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Errors that detectors state, from volumes over time of valves of their own.

    ``std_mm (n,)`` is of a coordinate of each vertex. Volumes in which the valve was not detected,
    or something else was, are left out. In a volume errors are stated wider by a factor that
    ``widening`` gives for its confidence, and it is unlike those of training below ``like_from``
    (:class:`mvest.imaging.detection.trained_model.DetectionAccuracy`); ``unlike`` says how many
    volumes over time are, by setting.
    """

    std_mm: Vector
    median_std_mm: float
    correlation_length_mm: float
    sequences: int
    left_out: int
    mean_error_mm: float
    correlogram: Correlations
    within_95: tuple[Coverage, ...]
    widening: Vector = (1.0, 0.0)
    like_from: float = 0.0
    unlike: Mapping[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """What detectors do in volumes of valves that no training saw.

    ``volumes`` (by the number trained on) and ``sequence_frames`` (by kind) are rows of
    :mod:`experiments.studies.imaging.trials`, which the results do not keep.
    """

    rows: tuple[DetectedVolume, ...]
    training: tuple[Learning, ...]
    confidence: Confidences
    sequences: tuple[Sequence, ...]
    accuracy: Accuracy
    volumes: Mapping[str, tuple[Row, ...]] = field(default_factory=dict)
    sequence_frames: Mapping[str, tuple[Row, ...]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Population:
    """A population of simulated valves, and how often a drawn one was refused, by reason."""

    count: int
    refused: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Spent:
    """What one part of the study cost, of all processes together; None if not measured."""

    cpu_s: float | None
    wall_s: float | None = None


@dataclass(frozen=True, slots=True)
class ModelFile:
    """The detectors' file."""

    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What a study of detectors costs, by part, and what came of it; not all are tested.

    ``detectors`` is their key in the store, ``seconds`` the CPU time of the training, 0 where it
    was not measured. Targets are limits by setting and column of the table.
    """

    seconds: float
    memory_mb: float
    detectors: str
    layout: ValveLayout
    valves: Mapping[str, Population]
    training_volumes: int
    spent: Mapping[str, Spent]
    targets: Mapping[str, Mapping[str, float]]
    tested: Evaluation | None
    measures: Mapping[str, float]
    model_file: ModelFile
