"""All detectors together with the shapes they know, as one file."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from mvest.errors import InputError, cannot_write
from mvest.imaging.detection.boosting import Boosters
from mvest.imaging.detection.boundary import BoundaryDetector
from mvest.imaging.detection.landmark_detector import LandmarkDetector
from mvest.imaging.detection.pose_search import REFINEMENTS, PoseSearch
from mvest.imaging.detection.position import PositionDetector
from mvest.imaging.detection.rim_detector import RimDetector
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.detection.shape_start import ShapeStart
from mvest.imaging.landmarks import LANDMARKS
from mvest.imaging.layout import ValveLayout
from mvest.typing import FloatArray

__all__ = ["MODEL_FILE", "Accuracy", "DetectionModel", "default_model", "load_model", "save_model"]

MODEL_FILE = Path(__file__).resolve().parent.parent / "models" / "tee.npz"
"""The trained model that comes with the package."""

FORMAT = "mvest detection model"
VERSION = 1
STAGES = (
    "position",
    "pose_coarse",
    "pose_fine",
    *(f"pose_refine_{k}" for k in range(len(REFINEMENTS))),
    "shape",
    *(f"landmark_{k}" for k in range(len(LANDMARKS))),
    "annulus",
    "free_edge",
    "boundary",
)
"""Names of all sets of trees."""


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """How the detectors err on simulated volumes that they have not seen.

    Attributes
    ----------
    std_mm : (n,)
        Of each coordinate of each vertex.
    correlation_length_mm : float
    samples : (S, F, n, 3)
        Errors in the valve's axes, mm: of S sequences, in the open and in the closed frame.
    tip_samples : (S, F, 2, 3)
    """

    std_mm: FloatArray
    correlation_length_mm: float
    samples: FloatArray
    tip_samples: FloatArray


class DetectionModel:
    """Everything that was learned.

    Parameters
    ----------
    shape : ShapeModel
    boosters : mapping
        One for each of :data:`STAGES`.
    trained_on : mapping
        Plain values: what made it (configuration, seeds, numbers of valves and volumes, versions).
    accuracy : Accuracy, optional
        Measured on held-out data; None for a model that was never tested.
    sha256 : str
        Of the file it was read from.
    """

    def __init__(
        self,
        shape: ShapeModel,
        boosters: Mapping[str, Boosters],
        trained_on: Mapping[str, Any],
        accuracy: Accuracy | None = None,
        sha256: str = "",
    ) -> None:
        missing = [name for name in STAGES if name not in boosters]
        if missing:
            raise InputError(f"detection model: no trees for {', '.join(missing)}")
        self.shape, self.boosters = shape, dict(boosters)
        self.trained_on, self.accuracy, self.sha256 = dict(trained_on), accuracy, sha256
        self.position = PositionDetector(boosters["position"])
        self.poses = PoseSearch(
            boosters["pose_coarse"],
            boosters["pose_fine"],
            tuple(boosters[f"pose_refine_{k}"] for k in range(len(REFINEMENTS))),
        )
        self.start = ShapeStart(boosters["shape"])
        self.landmarks = LandmarkDetector(
            tuple(boosters[f"landmark_{k}"] for k in range(len(LANDMARKS)))
        )
        self.annulus = RimDetector(0, boosters["annulus"])
        self.free_edge = RimDetector(-1, boosters["free_edge"])
        self.boundary = BoundaryDetector(boosters["boundary"])


def save_model(path: Path | str, model: DetectionModel) -> None:
    """Write a model as one ``.npz``: arrays, trees as LightGBM's text, provenance as JSON.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    shape = model.shape
    about = {
        "format": FORMAT,
        "version": VERSION,
        "columns": shape.layout.columns,
        "rows": shape.layout.rows,
        "region_names": list(shape.layout.region_names),
        "trained_on": model.trained_on,
        "trees": {name: model.boosters[name].outputs for name in STAGES},
    }
    arrays: dict[str, Any] = {
        "about": _bytes(json.dumps(about, sort_keys=True)),
        "shape.size_mm": np.array(shape.size_mm),
        "shape.mean": shape.mean.astype(np.float32),
        "shape.modes": shape.modes.astype(np.float32),
        "shape.std": shape.std,
        "shape.tips": shape.tips,
    }
    for name in STAGES:
        for k, text in enumerate(model.boosters[name].texts):
            arrays[f"trees.{name}.{k}"] = _bytes(text)
    if model.accuracy is not None:
        told = model.accuracy
        arrays["accuracy.std_mm"] = told.std_mm
        arrays["accuracy.correlation_length_mm"] = np.array(told.correlation_length_mm)
        arrays["accuracy.samples"] = told.samples.astype(np.float32)
        arrays["accuracy.tip_samples"] = told.tip_samples.astype(np.float32)
    target = Path(path)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    try:
        part = target.with_name(f".part-{target.name}")
        part.write_bytes(buffer.getvalue())
        part.replace(target)
    except OSError as fault:
        raise cannot_write(target, fault) from fault


def load_model(path: Path | str) -> DetectionModel:
    """Read a model; nothing in the file is executed or unpickled.

    Raises
    ------
    InputError
        If the file is missing, is no such model, is of another version, or is incomplete.
    """
    source = Path(path)
    try:
        raw = source.read_bytes()
    except OSError as fault:
        raise InputError(
            f"{source}: cannot be read ({fault.strerror}), expected a model"
        ) from fault
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as stored:
            return _model(stored, source, hashlib.sha256(raw).hexdigest())
    except (zipfile.BadZipFile, ValueError, KeyError, EOFError, OSError) as fault:
        if isinstance(fault, InputError):
            raise
        raise InputError(f"{source}: {fault}; expected a {FORMAT} of version {VERSION}") from fault


def default_model() -> DetectionModel:
    """The model that comes with the package, trained on simulated transoesophageal echo.

    Raises
    ------
    InputError
        If the package holds none, or it cannot be read.
    """
    if not MODEL_FILE.is_file():
        raise InputError(
            f"{MODEL_FILE}: no trained detectors come with this installation; expected what "
            "python -m experiments.run experiment=imaging imaging.publish_model=true makes"
        )
    return load_model(MODEL_FILE)


def _model(stored: NpzFile, source: Path, sha256: str) -> DetectionModel:
    about = json.loads(_text(stored["about"]))
    if about.get("format") != FORMAT or about.get("version") != VERSION:
        raise InputError(
            f"{source}: format {about.get('format')!r}, version {about.get('version')!r}; expected "
            f"{FORMAT!r}, version {VERSION}"
        )
    layout = ValveLayout(about["columns"], about["rows"], tuple(about["region_names"]))
    shape = ShapeModel(
        layout,
        float(stored["shape.size_mm"]),
        stored["shape.mean"].astype(np.float64),
        stored["shape.modes"].astype(np.float64),
        stored["shape.std"],
        stored["shape.tips"],
    )
    if shape.mean.shape != (layout.size, 3) or shape.modes.shape[1:] != (layout.size, 3):
        raise InputError(f"{source}: shapes do not fit its layout")
    boosters = {
        name: Boosters(
            tuple(_text(stored[f"trees.{name}.{k}"]) for k in range(outputs)), f"{source}, {name}"
        )
        for name, outputs in about["trees"].items()
    }
    accuracy = None
    if "accuracy.std_mm" in stored.files:
        accuracy = Accuracy(
            stored["accuracy.std_mm"],
            float(stored["accuracy.correlation_length_mm"]),
            stored["accuracy.samples"].astype(np.float64),
            stored["accuracy.tip_samples"].astype(np.float64),
        )
    return DetectionModel(shape, boosters, about["trained_on"], accuracy, sha256)


def _bytes(text: str) -> NDArray[np.uint8]:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _text(array: Any) -> str:
    return bytes(array.astype(np.uint8)).decode()
