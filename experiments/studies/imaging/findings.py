"""Findings of the study of the image step; lengths in mm, None where a valve was not detected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from experiments.common.findings import Vector
from mvest.imaging.layout import ValveLayout

__all__ = [
    "Accuracy",
    "Confidences",
    "Correlations",
    "Coverage",
    "DetectedVolume",
    "Evaluation",
    "Findings",
    "KindOfVolume",
    "Learning",
    "ModelFile",
    "Population",
    "Sequence",
    "Spent",
]

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectedVolume:
    """A valve in one volume of one frame.

    Attributes
    ----------
    setting, valve : str
        How the volume was drawn, and of which valve.
    frame : int
    confidence : float
    surface_mm, point_mm, tips_mm : float or None
        Mean distance of the surfaces, of the same points of tissue, and of the papillary tips.
    annulus_area_error_percent, ap_error_mm : float or None
        With sign.
    state_right : bool or None
        Whether an open orifice is seen as open and a closed one as closed.
    seconds : float
        CPU time of one thread.
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
    """Errors of one stage after training on so many volumes.

    Attributes
    ----------
    stage : str
    training_volumes : int
    setting : str
    median, p90 : float
    unit : str
    volumes : int
        On which it was tested.
    """

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

    Attributes
    ----------
    setting, valve : str
    frames : int
    confidence : float
        Of the best frame.
    detected, wrong : bool
        Whether it is called a valve, and whether it is called so and is not the valve.
    surface_mm, points_mm, tips_mm : float
    surface_open_mm, surface_closed_mm : float
        Of the open and of the closed frame.
    annulus_area_error_percent, ap_error_mm, state_right_percent : float or None
    seconds : float
        CPU time of one thread.
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
    """Confidence in volumes of one kind.

    Attributes
    ----------
    kind : str
    volumes : int
    lowest, median, highest : float
    called_percent, wrongly_percent : float
        That are called a valve, and wrongly so.
    """

    kind: str
    volumes: int
    lowest: float
    median: float
    highest: float
    called_percent: float
    wrongly_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Confidences:
    """How sure detectors are of a valve, with and without one.

    Attributes
    ----------
    min_confidence : float
        From which on something is called a valve.
    wrong_mm : float
        Mean distance of its points from which on it is not the valve.
    rows : tuple of KindOfVolume
    values : mapping
        Kind -> confidence of each volume; over time, of the best frame.
    off_mm : mapping
        Kind -> mean distance of the points in each volume; None without a valve.
    highest_without_valve, highest_wrong : float
    lowest_right, best_threshold : float or None
        The latter parts right from wrong best; None where nothing is right.
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
    """Correlation of errors against distance, in b bins.

    Attributes
    ----------
    distance, correlation, pairs : (b,)
    """

    distance: Vector
    correlation: Vector
    pairs: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Errors of one frame of volumes over time beside the standard deviations that are stated.

    Attributes
    ----------
    setting, frame : str
    sequences : int
    share, share_about_mean : float
        Of coordinates within 1.96 of these; with the mean error taken off.
    rms_mm, stated_rms_mm : float
    """

    setting: str
    frame: str
    sequences: int
    share: float
    share_about_mean: float
    rms_mm: float
    stated_rms_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Errors that detectors state, from volumes over time of valves of their own.

    Attributes
    ----------
    std_mm : (n,)
        Standard deviation of a coordinate of each vertex.
    median_std_mm, correlation_length_mm, mean_error_mm : float
    sequences, left_out : int
        Volumes; those in which the valve was not detected, or something else was.
    correlogram : Correlations
    within_95 : tuple of Coverage
    """

    std_mm: Vector
    median_std_mm: float
    correlation_length_mm: float
    sequences: int
    left_out: int
    mean_error_mm: float
    correlogram: Correlations
    within_95: tuple[Coverage, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """What detectors do in volumes of valves that no training saw.

    Attributes
    ----------
    rows : tuple of DetectedVolume
    training : tuple of Learning
    confidence : Confidences
    sequences : tuple of Sequence
    accuracy : Accuracy
    volumes : mapping
        Volumes trained on -> rows of :func:`experiments.studies.imaging.trials.try_volume`; not
        kept in the results.
    sequence_frames : mapping
        Kind -> rows of :func:`experiments.studies.imaging.trials.try_sequence`; neither.
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
    """A population of simulated valves.

    Attributes
    ----------
    count : int
    refused : mapping
        Why a drawn valve was not taken -> how often.
    """

    count: int
    refused: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Spent:
    """What one part of the study cost.

    Attributes
    ----------
    cpu_s : float or None
        Of all processes together; None where it was not measured.
    wall_s : float or None
    """

    cpu_s: float | None
    wall_s: float | None = None


@dataclass(frozen=True, slots=True)
class ModelFile:
    """The detectors' file.

    Attributes
    ----------
    sha256 : str
    bytes : int
    """

    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What a study of detectors costs, and what came of it.

    Attributes
    ----------
    seconds : float
        CPU time of the training; 0 where it was not measured.
    memory_mb : float
        Largest, of the process.
    detectors : str
        Their key in the store.
    layout : ValveLayout
    valves : mapping
        Population -> what it is of.
    training_volumes : int
    spent : mapping
        Part -> what it cost.
    targets : mapping
        Setting -> column of the table -> limit.
    tested : Evaluation or None
        None for a training alone.
    measures : mapping
        What runs are compared by.
    model_file : ModelFile
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
